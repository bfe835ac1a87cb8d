"""Before and after over the same clips."""

from dataclasses import replace

import pytest
from campaign_results import result

from hat_ros.bench.campaign.compare import compare
from hat_ros.errors import UsageError

BEFORE = [result(index, found=index in (0, 1)) for index in range(8)]
AFTER = [result(index, found=index in (1, 2, 3, 4)) for index in range(8)]


def test_won_and_lost_by_name():
    comparison = compare(BEFORE, AFTER)
    assert [line[:6] for line in comparison.won] == ["000002", "000003", "000004"]
    assert [line[:6] for line in comparison.lost] == ["000000"]
    row = comparison.table.rows[0]
    assert (row["found_before"], row["found_after"], row["gain"], row["won"], row["lost"]) == (0.25, 0.5, 0.25, 3, 1)
    assert row["gain_low"] < 0.25 < row["gain_high"]
    text = comparison.text()
    assert "won: 3" in text
    assert "left out" not in text


def test_the_interval_is_of_pairs():
    """The same clip won by both says nothing about a change."""
    row = compare(BEFORE, BEFORE).table.rows[0]
    assert (row["gain"], row["gain_low"], row["gain_high"]) == (0, 0, 0)


def test_clips_of_one_campaign_are_left_out():
    comparison = compare(BEFORE, AFTER[:5])
    assert comparison.table.rows[0]["clips"] == 5
    assert "3 clips that only one" in comparison.text()


def test_other_clips_are_refused():
    other = [replace(AFTER[0], factors=AFTER[0].factors | {"craft": "cassini"})]
    with pytest.raises(UsageError, match="clip 0 is not the same"):
        compare(BEFORE, other)
    with pytest.raises(UsageError, match="no clip in common"):
        compare(BEFORE, [])
