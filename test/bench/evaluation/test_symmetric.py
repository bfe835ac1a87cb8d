"""MSSD, MSPD and recalls, against their definitions written out, and the nearest of equal truths."""

import numpy as np
import pytest
from symmetric_bodies import body

from hat_ros.bench.evaluation.symmetric import average_recalls, errors_to_nearest, mspd, mssd, nearest_truth
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry
from hat_ros.target.exact_symmetry import exact_symmetry
from hat_ros.types import Camera

CAMERA = Camera(np.array([[900.0, 0, 320], [0, 900.0, 240], [0, 0, 1]]), 640, 480)


def poses(seed, near=None):
    rng = np.random.default_rng(seed)
    if near is None:
        return lie.transform(lie.matrix_from_quat(rng.normal(size=(6, 4))), rng.normal(size=(6, 3)) * 0.3 + [0, 0, 8])
    return near @ lie.transform(lie.so3_exp(0.05 * rng.normal(size=(6, 3))), 0.05 * rng.normal(size=(6, 3)))


def written_out(T_est, T_true, points, equals, project):
    """As published: the least over the equals of the largest distance of a vertex."""

    def seen(T):
        cam = points @ T[:3, :3].T + T[:3, 3]
        return CAMERA.project(cam) if project else cam

    return min(np.linalg.norm(seen(T_est) - seen(T_true @ S), axis=1).max() for S in equals)


@pytest.mark.parametrize("name", ["cube", "box", "rocket", "drum"])
def test_they_are_what_is_published(name):
    target = body(name)
    symmetry = exact_symmetry(target)
    T_true = poses(1)
    T_est = poses(2, near=T_true @ symmetry.sampled()[[-1]])
    equals, points = symmetry.sampled(), target.vertices_m
    surface, image = mssd(T_est, T_true, target, symmetry), mspd(T_est, T_true, target, symmetry, CAMERA)
    for i in range(len(T_true)):
        assert surface[i] == pytest.approx(written_out(T_est[i], T_true[i], points, equals, project=False))
        assert image[i] == pytest.approx(written_out(T_est[i], T_true[i], points, equals, project=True))
    assert surface.max() < 0.4
    assert mssd(T_est, T_true, target, Symmetry()).max() > surface.max()


def test_free_turns_are_sampled_as_the_toolkit_does():
    equals = exact_symmetry(body("rocket")).sampled()
    assert len(equals) == 315
    np.testing.assert_allclose(np.diff(np.unwrap(np.arctan2(equals[:, 1, 0], equals[:, 0, 0]))), 2 * np.pi / 315)


def test_a_missing_output_has_no_error_and_counts_as_a_miss():
    target, T_true = body("cube"), poses(3)
    T_est = T_true.copy()
    T_est[:3] = np.nan
    surface, image = (
        mssd(T_est, T_true, target, Symmetry()),
        mspd(T_est, T_true, target, Symmetry(), CAMERA),
    )
    assert np.isnan(surface).tolist() == np.isnan(image).tolist() == [True] * 3 + [False] * 3
    assert average_recalls(surface, image, 1.0, 640, 6) == {"AR_MSSD": 0.5, "AR_MSPD": 0.5}
    off = np.array([0.26, 0.0])
    assert average_recalls(off, 100 * off, 1.0, 1280, 2) == {"AR_MSSD": 0.75, "AR_MSPD": 0.9}


def test_a_vertex_behind_the_camera_is_infinitely_off():
    T = poses(4)
    T[:, 2, 3] = 0.1
    assert np.isinf(mspd(T, T, body("cube"), Symmetry(), CAMERA)).all()


def test_the_nearest_equal_of_the_truth():
    symmetry, T_true = exact_symmetry(body("cube")), poses(5)
    T_est = poses(6, near=T_true)
    swapped = T_true @ symmetry.turns[7]
    swapped[0] = T_est[1] = np.nan
    nearest = nearest_truth(T_est, swapped, symmetry)
    np.testing.assert_allclose(nearest[2:], T_true[2:], atol=1e-9)
    assert np.isnan(nearest[0]).all()
    np.testing.assert_array_equal(nearest[1], swapped[1])
    errors = errors_to_nearest(T_est, swapped, symmetry)
    assert np.isnan(errors.pose[:2]).all() and (errors.pose[2:] < 0.3).all()
    assert nearest_truth(T_est, swapped, Symmetry()) is swapped
