"""The player waits as long as the graph makes progress."""

from __future__ import annotations

import pytest
from single_node import add

from hat_ros.errors import StageTimeoutError
from hat_ros.ros.diagnostics import OK
from hat_ros.ros.player_node import PlayerNode


def test_a_node_that_says_something_new_is_not_given_up(executor, clean_bag):
    player = add(executor, PlayerNode, bag=str(clean_bag), config="default")
    player.start()
    session, playback = player.session, player.session.playback
    progress = []
    for text in ("busy: 8 of 162", "busy: 8 of 162", "busy: 16 of 162"):
        playback.progress_s = 0.0
        session.on_diagnostics(player.wire.diagnostics(0, "hat: hypotheses", OK, text, {}))
        progress.append(playback.progress_s > 0.0)
    assert progress == [True, False, True]
    playback.progress_s = 0.0
    with pytest.raises(StageTimeoutError, match=r"hypotheses: busy: 16 of 162.*raise graph\.startup_timeout_s"):
        session.feed()
