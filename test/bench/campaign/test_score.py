"""Figures of a clip from what came out of it frame by frame."""

import numpy as np
import pytest

from hat_ros.bench.campaign.play import Played
from hat_ros.bench.campaign.score import figures_of, figures_of_failure, rounded
from hat_ros.types import TrackState

NAN = np.nan
TRACKING, LOST, COASTING = TrackState.TRACKING, TrackState.LOST, TrackState.COASTING


def played(e_p, **more):
    n = len(e_p)
    series = {
        "e_p": np.array(e_p, dtype=float),
        "e_p_plain": np.array(e_p, dtype=float) + 2.0,
        "rotation_deg": np.degrees(np.array(e_p, dtype=float)) / 2,
        "state": np.full(n, int(TRACKING)),
        "mask_iou": np.ones(n),
        "best_deg": np.full(n, NAN),
        "inside_95": np.full(n, NAN),
        "segmentation_ms": np.arange(n, dtype=float),
        "frame_ms": np.full(n, 20.0),
    }
    return Played(**series | {key: np.array(value) for key, value in more.items()})


def test_found_needs_accuracy_and_coverage():
    assert figures_of(played([0.05] * 10))["found"]
    assert figures_of(played([0.05] * 9 + [NAN]))["found"]
    assert not figures_of(played([0.05] * 8 + [NAN] * 2))["found"]
    assert not figures_of(played([0.05] * 9 + [0.6]))["found"]


def test_a_pose_counts_whatever_is_published():
    figures = figures_of(played([0.01] * 10, state=[int(LOST)] * 10))
    assert figures["found"]
    assert figures["first_tracking"] == np.inf
    assert (figures["right"], figures["right_tracking"], figures["tracking"]) == (10, 0, 0)


def test_frames_until_right_and_until_tracking():
    states = [int(state) for state in (LOST, LOST, TRACKING, TRACKING)]
    figures = figures_of(played([NAN, 0.04, 0.3, 0.01], state=states))
    assert (figures["first_right"], figures["first_tracking"]) == (2, 3)
    assert figures_of(played([0.2, 0.06]))["first_right"] == np.inf


def test_wrong_and_far_tracking():
    states = [int(state) for state in (TRACKING, TRACKING, COASTING, TRACKING, TRACKING)]
    figures = figures_of(played([0.01, 0.11, 0.7, 0.7, 0.2], state=states, rotation_deg=[0.1, 5, 40, 10, 31]))
    assert (figures["tracking"], figures["tracking_wrong"], figures["tracking_far"]) == (4, 3, 2)


def test_overlaps_hypotheses_and_ellipsoids():
    figures = figures_of(
        played(
            [0.01] * 4,
            state=[int(state) for state in (TRACKING, TRACKING, COASTING, TRACKING)],
            mask_iou=[NAN, 0.5, 0.0, 1.0],
            best_deg=[14.0, NAN, 16.0, NAN],
            inside_95=[1.0, 0.0, 0.0, NAN],
        )
    )
    assert (figures["masks"], figures["mask_iou_sum"]) == (3, 1.5)
    assert (figures["keyframes"], figures["best_within"]) == (2, 1)
    assert (figures["ellipsoids"], figures["inside_95"]) == (2, 1)
    assert figures["segmentation_ms_mean"] == 1.5


def test_the_error_to_the_nearest_equal_decides_and_the_plain_one_stands_beside_it():
    figures = figures_of(played([0.05] * 9 + [NAN]))
    assert figures["found"]
    assert (figures["E_p_mean"], figures["E_p_plain_mean"]) == (pytest.approx(0.05), pytest.approx(2.05))


def test_a_clip_without_any_pose():
    figures = figures_of(played([NAN, NAN], state=[int(LOST)] * 2))
    assert not figures["found"]
    assert (figures["coverage"], figures["E_p_mean"]) == (0, np.inf)


def test_a_failed_clip_has_the_same_figures_and_is_not_found():
    failed = figures_of_failure(7)
    assert failed.keys() == figures_of(played([0.01])).keys()
    assert not failed["found"]
    assert failed["mask_iou_sum"] / failed["masks"] == 0


def test_series_hold_null_where_there_is_none():
    assert rounded(np.array([0.1234567, NAN, np.inf])) == [pytest.approx(0.12346), None, None]
