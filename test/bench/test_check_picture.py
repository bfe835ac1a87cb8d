"""The picture of `hat check`: which side is where, and the frames below."""

import numpy as np
import trimesh

from hat_ros.bench.check_picture import _SIDES, TILE_PX, picture
from hat_ros.geometry import lie
from hat_ros.target.loading import load_target


def test_sides_are_rotations_that_look_along_their_axis():
    for name, rows in _SIDES.items():
        R = np.array(rows, float)
        assert np.linalg.det(R) == 1.0
        toward_camera = -R[2]
        assert toward_camera["xyz".index(name[1])] == (1.0 if name[0] == "+" else -1.0)
    assert lie.angle_between(np.array(_SIDES["+x"], float), np.array(_SIDES["-x"], float)) > 3.1


def test_a_long_box_is_long_in_the_right_tiles(tmp_path):
    trimesh.creation.box((0.2, 1.0, 0.2)).export(tmp_path / "rod.ply")
    target = load_target(tmp_path / "rod.ply")
    rgb = picture(target, [np.full((20, 40, 3), 200, np.uint8)])
    assert rgb.shape == (3 * TILE_PX, 3 * TILE_PX, 3)
    across = np.ptp(np.flatnonzero((rgb[TILE_PX // 2 + 20, :TILE_PX] != 40).any(axis=-1)))
    along = np.ptp(np.flatnonzero((rgb[TILE_PX // 2 + 20, TILE_PX : 2 * TILE_PX] != 40).any(axis=-1)))
    assert across > 3 * along  # from +x the y axis runs to the right; from +y it runs away
    frame = rgb[2 * TILE_PX :, :TILE_PX]
    assert (frame[TILE_PX // 2] == 200).all() and not frame[: TILE_PX // 5].any()
