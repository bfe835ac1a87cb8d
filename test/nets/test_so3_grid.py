from pathlib import Path

import numpy as np
import pytest

from hat_ros.nets.so3_grid import so3_grid

DATA = Path(__file__).parents[1] / "data"


def test_level_two_is_the_grid_of_the_published_coarse_network():
    published = np.load(DATA / "megapose_coarse.npz")["so3_grid_576_quat_xyzw"].astype(float)
    published /= np.linalg.norm(published, axis=1, keepdims=True)
    grid = so3_grid(2)
    distance = np.minimum(
        np.linalg.norm(published[:, None] - grid, axis=2), np.linalg.norm(published[:, None] + grid, axis=2)
    )
    assert distance.min(axis=1).max() < 2e-6
    assert len(set(distance.argmin(axis=1))) == 576


@pytest.mark.parametrize(("level", "size", "covering_deg"), [(1, 72, 64), (2, 576, 33)])
def test_grid_covers_all_rotations(level, size, covering_deg):
    grid = so3_grid(level)
    assert grid.shape == (size, 4)
    q = np.random.default_rng(0).normal(size=(2000, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    nearest = 2 * np.degrees(np.arccos(np.clip(np.abs(q @ grid.T).max(axis=1), 0, 1)))
    assert nearest.max() < covering_deg


def test_level_zero_is_refused():
    with pytest.raises(ValueError, match="at least 1"):
        so3_grid(0)
