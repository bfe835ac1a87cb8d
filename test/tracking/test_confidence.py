"""When the output's basin is certain: laws of tracking.confidence."""

import numpy as np
import pytest

from hat_ros.config import RefinementConfig
from hat_ros.geometry import lie
from hat_ros.tracking.confidence import BasinConfidence
from hat_ros.types import Candidates, Selection, StateReason

CONFIG = RefinementConfig()
APART_DEG = 30.0
CERTAIN = StateReason.CONFIRMED
RIGHT, WRONG = (lie.transform(lie.so3_exp(np.array([0, 0, a])), np.array([0, 0, 5.0])) for a in (0.0, np.pi / 2))


def _selection(right, wrong, appearance_right=None):
    """Path scores of both basins; appearance says the same unless told otherwise."""
    path = np.array([right, wrong], dtype=float)
    scaled = path if appearance_right is None else np.array([appearance_right, 0.0])
    return Selection(
        Candidates(lie.row_from_matrix(np.stack([RIGHT, WRONG])), path), scaled, path, int(np.argmax(path))
    )


def _after(*selections, output=RIGHT):
    confidence = BasinConfidence(CONFIG, APART_DEG)
    for selection in selections:
        confidence.update(selection, output)
    return confidence


def test_a_clear_lead_of_the_outputs_basin_is_needed():
    assert _after(_selection(0.0, -CONFIG.min_margin)).verdict(confirmed=True) == CERTAIN
    assert _after(_selection(0.0, -CONFIG.min_margin + 0.1)).verdict(confirmed=True) == StateReason.AMBIGUOUS


def test_a_lead_of_another_basin_contradicts_the_output():
    confidence = _after(_selection(0.0, -20.0), output=WRONG)
    assert confidence.margin == -20.0
    assert confidence.verdict(confirmed=True) == StateReason.AMBIGUOUS


def test_without_confirmation_only_a_sure_lead_will_do():
    assert _after(_selection(0.0, -CONFIG.sure_margin)).verdict(confirmed=False) == CERTAIN
    assert _after(_selection(0.0, -CONFIG.sure_margin + 0.1)).verdict(confirmed=False) == StateReason.UNCONFIRMED


def test_appearance_must_agree_with_the_decoder_at_two_keyframes_in_a_row():
    clear, against = _selection(0.0, -10.0), _selection(0.0, -10.0, appearance_right=-1.0)
    assert _after(against).verdict(confirmed=True) == StateReason.OUTSHONE
    assert _after(against, clear).verdict(confirmed=True) == StateReason.OUTSHONE
    assert _after(against, clear, clear).verdict(confirmed=True) == CERTAIN


def test_frames_between_keyframes_change_nothing():
    selection = _selection(0.0, -5.0)
    before, after = _after(selection), _after(selection, Selection.none(), Selection.none())
    assert before.margin == after.margin == 5.0


def test_a_lead_without_a_competing_basin_is_none():
    alone = Selection(Candidates(lie.row_from_matrix(RIGHT[None]), np.zeros(1)), np.zeros(1), np.zeros(1), 0)
    assert _after(alone).margin == np.inf
    assert _after(alone).verdict(confirmed=False) == StateReason.UNCONFIRMED
    assert _after(alone).verdict(confirmed=True) == CERTAIN


@pytest.mark.parametrize("output", [None, RIGHT])
def test_nothing_is_known_before_the_first_keyframe(output):
    confidence = _after(Selection.none(), output=output)
    assert np.isnan(confidence.margin)
    assert confidence.verdict(confirmed=False) != CERTAIN
