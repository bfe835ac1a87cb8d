"""Backend ``droid``: DROID-SLAM as the paper runs it, incrementally, each pose fixed once it is emitted.

This is the only place where DROID's camera-from-world poses are turned into ``T_slam_cam``.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import cv2
import numpy as np
import torch

from hat_ros.array_types import Float, UInt8
from hat_ros.config import DroidConfig, HatConfig
from hat_ros.errors import ConfigError
from hat_ros.geometry import lie
from hat_ros.motion.droid_frontend import DroidFrontend
from hat_ros.motion.droid_global import finish
from hat_ros.motion.droid_graph import MAX_FACTORS
from hat_ros.motion.droid_keyframes import FlowModel
from hat_ros.nets.droid import STRIDE_PX, DroidNet
from hat_ros.nets.runtime import Runtime
from hat_ros.target.model import Target
from hat_ros.types import Camera, Detection, Frame, Motion, PosePrior

# Correlation needs this many 1/8 pixels on the short side for its coarsest level to hold one.
_MIN_SIDE = 8
_MAX_VOLUME_BYTES = 4 * 2**30


class DroidSlam:
    """Target-relative camera motion by DROID-SLAM.

    No motion is given before the warm-up's keyframes are there, and, while the background is suppressed, none for
    frames without a detection, which do not reach the tracker. A change of the camera and a result that is not finite
    start a new epoch.

    Args:
        config: the whole configuration; ``slam.droid`` is used.
        target: not used; DROID knows no model.
        model: the flow network; default is the public one.

    Raises:
        WeightsError: the public weights are missing or altered.
        ConfigError: the device does not exist.
    """

    def __init__(self, config: HatConfig, target: Target | None, model: FlowModel | None = None) -> None:
        self._config, self._masked = config.slam.droid, config.slam.masked
        runtime = Runtime(config.nets, "droid", as_released=torch.float16)
        self._device = runtime.device
        self._model = model or DroidNet.from_checkpoint(
            config.nets.weights_folder,
            config.nets.allow_unverified,
            device=runtime.device,
            autocast=runtime.dtype if runtime.reduced_precision else None,
        )
        self._frontend: DroidFrontend | None = None
        self._camera: Camera | None = None
        self._epoch = 0

    @torch.inference_mode()
    def update(self, frame: Frame, detection: Detection | None, prior: PosePrior | None) -> Motion:
        """Advance by one frame whose background is suppressed already; no prior is used."""
        if self._masked and (detection is None or not detection.mask.any()):
            return Motion.none(self._epoch, self.n_keyframes)
        if self._camera is not None and not _same_camera(self._camera, frame.camera):
            self.reset()
        image, intrinsics = prepare(frame, self._config)
        if self._frontend is None:
            self._camera = frame.camera
            self._frontend = self._new_frontend(image, intrinsics)
        pose = self._frontend.track(frame.stamp_ns, torch.from_numpy(image).to(self._device))
        if pose is None:
            return Motion.none(self._epoch, self.n_keyframes)
        row = pose.double().cpu().numpy()
        if not np.isfinite(row).all():
            self.reset()
            return Motion.none(self._epoch)
        return Motion(True, self._epoch, slam_rows(row), self.n_keyframes)

    def reset(self) -> None:
        """Forget the target; the next frame starts a new epoch."""
        if self._frontend is not None:
            self._epoch += 1
        self._frontend, self._camera = None, None

    @property
    def n_keyframes(self) -> int:
        """Keyframes held."""
        return len(self._frontend.keyframes) if self._frontend else 0

    def _new_frontend(self, image: UInt8, intrinsics: Float, keep_all: bool = False) -> DroidFrontend:
        shape = image.shape[2] // STRIDE_PX, image.shape[3] // STRIDE_PX
        rows = torch.tensor(intrinsics / STRIDE_PX, dtype=torch.float32, device=self._device)
        stored = keep_volumes(self._config, shape, self._model.dtype)
        return DroidFrontend(self._config, self._model, rows, shape, keep_all=keep_all, stored=stored)


@torch.inference_mode()
def whole_clip_motions(
    config: HatConfig, clip: Sequence[tuple[Frame, Detection | None]], model: FlowModel | None = None
) -> list[Motion]:
    """Motion of a whole clip by global optimisation: the non-causal reference of :class:`DroidSlam`.

    Args:
        config: the whole configuration; ``slam.droid`` is used.
        clip: frames of one camera, their background suppressed already, with their detections.
        model: the flow network; default is the public one.

    Returns:
        One motion per frame, none where there was no detection; all in one epoch.

    Raises:
        RunError: the clip has too little motion for the warm-up.
        WeightsError: the public weights are missing or altered.
        ConfigError: the device does not exist.
    """
    slam = DroidSlam(config, None, model)
    used = [not config.slam.masked or (d is not None and bool(d.mask.any())) for _, d in clip]
    indices = np.flatnonzero(used)
    if not len(indices):
        return [Motion.none() for _ in used]

    def images() -> Iterator[tuple[int, torch.Tensor]]:
        for index in indices.tolist():  # one at a time: a clip need not fit into memory
            frame, _ = clip[index]
            yield frame.stamp_ns, torch.from_numpy(prepare(frame, config.slam.droid)[0]).to(slam._device)

    image, intrinsics = prepare(clip[int(indices[0])][0], config.slam.droid)
    frontend = slam._new_frontend(image, intrinsics, keep_all=True)
    for stamp_ns, image_bgr in images():
        frontend.track(stamp_ns, image_bgr)
    rows = iter(slam_rows(finish(frontend, images()).double().cpu().numpy()))
    n = len(frontend.keyframes)
    return [Motion(True, 0, next(rows), n) if use else Motion.none(0, n) for use in used]


def prepare(frame: Frame, config: DroidConfig) -> tuple[UInt8, Float]:
    """Resize to the input area, crop right and bottom to multiples of 8, and put channels in DROID's order.

    Returns:
        image (1, 3, H, W) uint8 BGR and its intrinsics (4,) ``fx fy cx cy`` in pixels.

    Raises:
        ConfigError: the image would be too small to work on.
    """
    height, width = frame.camera.height, frame.camera.width
    factor = np.sqrt(config.input_area_px / (height * width))
    new_h, new_w = int(height * factor), int(width * factor)
    if min(new_h, new_w) < _MIN_SIDE * STRIDE_PX:
        raise ConfigError(
            f"slam.droid.input_area_px {config.input_area_px} makes a {new_w}x{new_h} image of {width}x{height}: "
            f"both sides need at least {_MIN_SIDE * STRIDE_PX} px, raise it"
        )
    resized = np.asarray(cv2.resize(frame.rgb, (new_w, new_h), interpolation=cv2.INTER_LINEAR), np.uint8)
    cropped = resized[: new_h - new_h % STRIDE_PX, : new_w - new_w % STRIDE_PX, ::-1]
    K, sx, sy = frame.camera.K, new_w / width, new_h / height
    # The released pre-processing scales the principal point without the half-pixel shift.
    intrinsics = np.array([K[0, 0] * sx, K[1, 1] * sy, K[0, 2] * sx, K[1, 2] * sy])
    return np.ascontiguousarray(cropped.transpose(2, 0, 1))[None], intrinsics


def keep_volumes(config: DroidConfig, shape: tuple[int, int], dtype: torch.dtype) -> bool:
    """Whether correlation volumes of (h, w) features are stored; the limit is a constant, so every machine agrees."""
    if config.correlation != "auto":
        return config.correlation == "stored"
    pixels = shape[0] * shape[1]
    return MAX_FACTORS * pixels**2 * 4 // 3 * dtype.itemsize <= _MAX_VOLUME_BYTES


def _same_camera(a: Camera, b: Camera) -> bool:
    return (a.width, a.height) == (b.width, b.height) and np.array_equal(a.K, b.K)


def slam_rows(camera_from_world: Float) -> Float:
    """Rows of ``T_slam_cam`` from DROID's ``T_cam_world``: (..., 7) -> (..., 7)."""
    return lie.row_from_matrix(lie.inverse(lie.matrix_from_row(camera_from_world)))
