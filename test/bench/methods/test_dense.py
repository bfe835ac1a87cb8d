"""The dense refinement: which refiner, the anchors' basin, and poses taken anew where silhouettes diverge."""

import numpy as np
import pytest

from hat_ros.bench.methods.dense import DenseRefinement
from hat_ros.config import RefinementConfig
from hat_ros.geometry import lie
from hat_ros.types import Camera, Candidates, Detection, Estimate, Frame, Refined, TrackState

CAMERA = Camera(np.array([[200.0, 0, 31.5], [0, 200.0, 31.5], [0, 0, 1]]), 64, 64)
FRAME = Frame(1, np.zeros((64, 64, 3), np.uint8), CAMERA)
NOTHING = Estimate(1, TrackState.LOST, np.full(7, np.nan), np.full((6, 6), np.nan))
OUTLINE = Detection(np.pad(np.ones((20, 20), bool), 22))


def turned(angle_deg):
    return lie.transform(lie.so3_exp(np.radians([0.0, angle_deg, 0.0])), np.array([0.0, 0, 5]))


class Network:
    """A refiner that leaves poses alone; its silhouettes fit near some angles."""

    def __init__(self, *fits_deg):
        self.fits_deg, self.seen = fits_deg, []

    def refine(self, frame, detection, T_cam_target, prior=None):
        self.seen.append(T_cam_target)
        fits = any(np.allclose(T_cam_target, turned(angle)) for angle in self.fits_deg)
        overlap = np.nan if detection is None else 0.9 if fits else 0.2
        return Refined(lie.row_from_matrix(T_cam_target), np.eye(6), overlap, 0.5, overlap)

    def reset(self):
        pass


class Stage:
    """Stage 2 with this refiner; its new hypotheses stand at these angles, best first."""

    def __init__(self, refiner, *angles_deg):
        self.refiner, self.angles_deg, self.n_asked = refiner, angles_deg, 0

    def generate(self, frame, detection, prior):
        self.n_asked += 1
        return Candidates.from_matrices(
            np.array([turned(a) for a in self.angles_deg]), -np.arange(len(self.angles_deg))
        )


def measured(stage, decided_deg=0.0, detection=OUTLINE):
    return DenseRefinement(RefinementConfig(), None, stage).measure(FRAME, detection, turned(decided_deg), NOTHING)[0]


def test_where_the_silhouette_fits_the_decided_pose_is_refined_by_the_network_alone():
    stage = Stage(Network(0.0), 40.0)
    np.testing.assert_allclose(measured(stage), turned(0.0), atol=1e-12)
    assert (stage.n_asked, len(stage.refiner.seen)) == (0, 1)


def test_where_silhouettes_diverge_the_best_new_pose_in_the_basin_takes_its_place():
    stage = Stage(Network(40.0), 170.0, 40.0, 10.0)
    np.testing.assert_allclose(measured(stage), turned(40.0), atol=1e-12)
    assert stage.n_asked == 1


@pytest.mark.parametrize("angles_deg", [(170.0,), (100.0, 120.0), ()])
def test_nothing_beyond_the_basin_is_taken(angles_deg):
    assert np.isnan(measured(Stage(Network(100.0, 120.0, 170.0), *angles_deg))).all()


def test_a_new_pose_that_fits_no_better_is_none():
    assert np.isnan(measured(Stage(Network(), 40.0))).all()


def test_without_a_silhouette_the_network_has_the_last_word():
    stage = Stage(Network(), 40.0)
    np.testing.assert_allclose(measured(stage, detection=None), turned(0.0), atol=1e-12)
    assert stage.n_asked == 0
