"""One face for all encoding."""

from __future__ import annotations

from wire_samples import ROS, STAMP, through_dds


def test_diagnostics_have_text_level_and_figures():
    message = through_dds(ROS.diagnostics(STAMP, "hat: slam", 2, "bad", {"answered": 3}))
    status = message.status[0]
    assert (status.name, status.level, status.message) == ("hat: slam", b"\x02", "bad")
    assert [(item.key, item.value) for item in status.values] == [("answered", "3")]
