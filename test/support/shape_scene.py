"""A lopsided spacecraft without symmetry, and pictures of it, for tests of hypotheses and refinement."""

import cv2
import numpy as np
import trimesh

from hat_ros.bench.synth.sunlit import Light, SunlitRenderer
from hat_ros.geometry import lie
from hat_ros.target.loading import target_from_scene
from hat_ros.target.ray_renderer import RayRenderer
from hat_ros.target.srgb import srgb_from_linear
from hat_ros.types import Camera, Frame

CAMERA = Camera(np.array([[500.0, 0, 159.5], [0, 500.0, 119.5], [0, 0, 1]]), 320, 240)


def spacecraft(name="lopsided"):
    """The target made of :func:`craft_parts`."""
    parts = craft_parts()
    for mesh, grey in parts:
        mesh.visual.face_colors = np.tile([grey, grey, grey, 255], (len(mesh.faces), 1))
    return target_from_scene(trimesh.Scene([mesh for mesh, _ in parts]), name)


def craft_parts():
    """Meshes and greys of a box with one long panel, a dish and a boom, about 2.5 m across."""
    return [
        (trimesh.creation.box((0.8, 0.7, 0.9)), 200),
        (trimesh.creation.box((1.4, 0.04, 0.6), transform=lie.transform(np.eye(3), [1.1, 0, 0.1])), 90),
        (trimesh.creation.cone(0.35, 0.4, transform=lie.transform(np.eye(3), [-0.1, 0.1, 0.45])), 230),
        (trimesh.creation.cylinder(0.05, 0.9, transform=lie.transform(np.eye(3), [-0.3, -0.3, -0.8])), 150),
    ]


def random_pose(rng, target, range_m=(6.0, 9.0), offset=0.06):
    """(4, 4) T_cam_target: any orientation, near the middle of the image."""
    R = lie.matrix_from_quat(rng.normal(size=4))
    z = rng.uniform(*range_m)
    center = z * np.array([rng.uniform(-offset, offset), rng.uniform(-offset, offset), 1.0])
    return lie.transform(R, center - R @ target.center_m)


def picture(target, T_cam_target, camera=CAMERA, background=0, stamp_ns=1):
    """A frame and the true mask: diffuse shading with a sun beside the camera, anti-aliased."""
    renderer = RayRenderer(target)
    fine = Camera(
        np.array(
            [
                [4 * camera.K[0, 0], 0, 4 * camera.K[0, 2] + 1.5],
                [0, 4 * camera.K[1, 1], 4 * camera.K[1, 2] + 1.5],
                [0, 0, 1],
            ]
        ),
        4 * camera.width,
        4 * camera.height,
    )
    view = renderer.render(T_cam_target, fine)
    sun = np.array([0.4, -0.3, -1.0]) / np.linalg.norm([0.4, -0.3, -1.0])
    shade = 0.25 + 0.75 * np.clip(view.normal_cam @ sun, 0, 1)
    image = np.where(view.mask[..., None], view.rgb * shade[..., None], background).astype(np.float32)
    size = (camera.width, camera.height)
    rgb = np.rint(cv2.resize(image, size, interpolation=cv2.INTER_AREA)).astype(np.uint8)
    mask = renderer.render(T_cam_target, camera, color=False).mask
    return Frame(stamp_ns, rgb, camera), mask


def pose_errors(T_cam_target, T_true):
    """Rotation error in degrees, position error as a share of the range."""
    turn = np.degrees(lie.angle_between(T_cam_target[..., :3, :3], T_true[:3, :3]))
    return turn, np.linalg.norm(T_cam_target[..., :3, 3] - T_true[:3, 3], axis=-1) / np.linalg.norm(T_true[:3, 3])


def sunlit_picture(target, T_cam_target, to_sun_cam, exposure=0.8, camera=CAMERA):
    """A frame in hard sunlight before a black sky, and the true mask: what is in shadow is all but black."""
    light = Light(np.asarray(to_sun_cam, dtype=np.float64), ambient=0.002)
    renderer = SunlitRenderer(target)
    radiance, _ = renderer.render(T_cam_target, camera, light)
    rgb = np.rint(srgb_from_linear(np.clip(radiance * exposure, 0, 1))).astype(np.uint8)
    mask = renderer.plain.render(T_cam_target, camera, color=False).mask
    return Frame(1, rgb, camera), mask
