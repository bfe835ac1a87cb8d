"""The recorder needs a folder."""

from __future__ import annotations

from single_node import add

from hat_ros.ros.recorder_node import RecorderNode


def test_recorder_needs_a_place_to_write(executor):
    node = add(executor, RecorderNode)
    node.start()
    assert "parameter 'out' is empty" in str(node.failure)
