"""Recordings on which a search that knows nothing goes wrong: two craft of a kind, and one that looks alike turned."""

import numpy as np
import trimesh
from shape_scene import craft_parts, picture

from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter
from hat_ros.target.loading import load_target
from hat_ros.types import Camera

CAMERA = Camera(np.array([[500.0, 0, 239.5], [0, 500.0, 119.5], [0, 0, 1]]), 480, 240)
FIRST_NS, STEP_NS = 1_000_000_000, 100_000_000
_ATTITUDES = (lie.so3_exp(np.array([0.5, 0.4, 0.3])), lie.so3_exp(np.array([-1.0, 1.0, 2.0])))
_POSITIONS = (np.array([-2.5, 0.1, 11.0]), np.array([2.6, -0.1, 10.5]))
_LONG_SIDE_UP = lie.so3_exp(np.array([0.35, 0.15, 0.2])) @ lie.so3_exp(np.array([0, np.pi / 2, 0]))


def craft_at(place, index):
    """(4, 4) pose of the left (0) or right (1) craft in a frame."""
    return lie.transform(lie.so3_exp(np.array([0, 0.01 * index, 0])) @ _ATTITUDES[place], _POSITIONS[place])


def block_at(index):
    """(4, 4) pose of the block in a frame: what tells its ends apart is on its far side."""
    turn = lie.so3_exp(np.array([0, 0.01 * index, 0.01 * index]))
    return lie.transform(turn @ _LONG_SIDE_UP, np.array([0.3, 0.1, 8.0]))


def as_text(T_cam_target, off_m=(0.0, 0.0, 0.0)):
    """A pose as the configuration takes it, moved by (3,) metres."""
    row = lie.row_from_matrix(T_cam_target) + np.array([*off_m, 0, 0, 0, 0])
    return " ".join(f"{value:.6f}" for value in row)


def write_two_craft(path, n_frames):
    """A bag with both craft before a black sky."""

    def image(target, index):
        views = [picture(target, craft_at(place, index), CAMERA)[0].rgb for place in (0, 1)]
        return np.maximum(*views)

    return _write(path, craft_parts(), image, n_frames)


def write_block(path, n_frames):
    """A bag with a block that looks alike from both ends while a small box at one of them is hidden."""
    box = trimesh.creation.box((0.2, 0.2, 0.3), transform=lie.transform(np.eye(3), [0.5, 0.3, 0.5]))
    parts = [(trimesh.creation.box((0.8, 1.2, 2.0)), 190), (box, 120)]
    return _write(path, parts, lambda target, index: picture(target, block_at(index), CAMERA)[0].rgb, n_frames)


def _write(path, parts, image, n_frames):
    for mesh, grey in parts:
        mesh.visual.face_colors = np.tile([grey, grey, grey, 255], (len(mesh.faces), 1))
    model = path.parent / "craft.glb"
    trimesh.Scene([mesh for mesh, _ in parts]).export(model)
    target = load_target(model)
    with BagWriter(path) as writer:
        for index in range(n_frames):
            noise = np.random.default_rng(index).normal(2.0, 2.0, (CAMERA.height, CAMERA.width, 3))
            rgb = np.clip(image(target, index) + noise, 0, 255).astype(np.uint8)
            writer.write_frame(FIRST_NS + index * STEP_NS, rgb, CAMERA)
        writer.write_target(model)
    return path
