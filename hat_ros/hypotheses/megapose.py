"""MegaPose as a hypothesis backend: 576 coarse views, the ten best refined and scored again (paper, Mega-HAT).

The public multi-hypothesis RGB pipeline with two changes that the HAT authors describe: the coarse views are rendered
once per camera and CAD model, for a centred square box of half size 0.2 min(W, H), and re-used for every image; and
the K refined poses are all kept, with their logits as scores. Per keyframe that leaves 576 + K coarse passes and 5 K
refiner passes, K + 20 K renders (K re-scored, 4 views x 5 iterations x K), instead of 576 more.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from hat_ros.array_types import Float, UInt8
from hat_ros.cache import cached_arrays
from hat_ros.config import HatConfig, NetsConfig
from hat_ros.geometry import lie
from hat_ros.nets import megapose as mp
from hat_ros.nets.checkpoint import load_into, load_state
from hat_ros.nets.runtime import Runtime
from hat_ros.nets.so3_grid import so3_grid
from hat_ros.target import masks
from hat_ros.target.model import Target
from hat_ros.target.network_views import NetworkViewRenderer
from hat_ros.target.rendering import Renderer, create_renderer
from hat_ros.types import Camera, Candidates, Detection, Frame, PosePrior, Refined, RotationPrior

LOG = logging.getLogger(__name__)

_FORMAT = 2
_N_CROP_POINTS, _N_VIEW_POINTS = 2000, 200
_CANONICAL_HALF_SIZE = 0.2
_CROP_SIZE = (mp.CROP_WIDTH, mp.CROP_HEIGHT)


class MegaPose:
    """The two networks and the renderer around one target; also the refiner of GigaPose.

    Args:
        config: the whole configuration.
        target: the CAD model.
        network: whose device they share.

    Raises:
        WeightsError: a checkpoint is missing or does not fit.
    """

    def __init__(self, config: HatConfig, target: Target, network: str = "megapose") -> None:
        self.settings = config.hypotheses.megapose
        self._target = target
        self.runtime = Runtime(config.nets, network)
        self.renderer = TorchViews(target, self.runtime)
        self._coarse = self._load(mp.CoarseNet, "megapose_coarse", config.nets)
        self._refiner = self._load(mp.RefinerNet, "megapose_refiner", config.nets)
        self.points = crop_points(target, self.runtime)

    def _load(
        self, kind: type[mp.CoarseNet] | type[mp.RefinerNet], name: str, nets: NetsConfig
    ) -> Callable[[Tensor], Tensor]:
        state = load_state(name, nets.weights_folder, nets.allow_unverified)
        net = mp.build_net(kind, state)
        load_into(net, state, name)
        return self.runtime.place(net)

    @torch.inference_mode()
    def refine(self, image: Tensor, K: Tensor, T_cam_target: Tensor) -> tuple[Tensor, Tensor]:
        """Refined poses (B, 4, 4) and their coarse logits (B,): image (3, H, W), K (3, 3), (B, 4, 4)."""
        T = T_cam_target
        for _ in range(self.settings.refiner_iterations):
            T = mp.refine_once(self._refiner, image, K, T, self.points, self.renderer)
        return T, mp.score_coarse(self._coarse, image, K, T, self.points, self.renderer)

    def candidates(self, image: Tensor, K: Tensor, T_cam_target: Tensor, detection: Detection) -> Candidates:
        """:meth:`refine` as candidates, ranked as given; a pose that the updates drove out of all bounds is none."""
        T, logits = (found.double().cpu().numpy() for found in self.refine(image, K, T_cam_target))
        rigid = lie.is_rigid(T)
        return Candidates.from_matrices(T[rigid], logits[rigid], detection.box_xyxy, np.flatnonzero(rigid))

    def refined(self, frame: Frame, detection: Detection | None, T_cam_target: Float) -> Refined | None:
        """One pose (4, 4) refined, see :class:`~hat_ros.stages.PoseRefiner`: the network tells no covariance.

        Its support is the coarse network's score. None when the updates drove the pose out of all bounds.
        """
        runtime = self.runtime
        start = runtime.tensor(T_cam_target)[None]
        T, logits = (
            found.double().cpu().numpy()[0]
            for found in self.refine(runtime.image(frame.rgb), runtime.tensor(frame.camera.K), start)
        )
        if not lie.is_rigid(T) or not T[2, 3] > 0 or not np.isfinite(logits):
            return None
        overlap = float("nan")
        if detection is not None and detection.silhouette:
            overlap = masks.overlap(self._silhouettes.render(T, frame.camera).mask, detection.mask)
        score = float(1.0 / (1.0 + np.exp(-np.clip(logits, -50.0, 50.0))))
        return Refined(lie.row_from_matrix(T), np.full((6, 6), np.nan), overlap, score, overlap)

    @cached_property
    def _silhouettes(self) -> Renderer:
        return create_renderer("rays", self._target)

    @torch.inference_mode()
    def score_prepared(self, image: Tensor, boxes: Tensor, renders: Tensor) -> Tensor:
        """Coarse logits of ready uint8 renders, in batches: (3, H, W), (B, 4), (B, 6, 240, 320) -> (B,)."""
        logits = []
        for batch in self.runtime.batches(len(boxes), self.settings.batch_size):
            views = renders[batch].float() / 255
            logits.append(mp.score_renders(self._coarse, image, boxes[batch], views))
        return torch.cat(logits)


class MegaPoseHypotheses:
    """Stage 2 backend ``megapose``; see the module's text."""

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._megapose = MegaPose(config, target)
        self._target = target
        self._n_candidates = config.hypotheses.max_candidates
        self._padding = config.hypotheses.megapose.box_padding
        self._views: tuple[Camera, Tensor] | None = None

    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """K refined poses with their logits; the prior is not used (published behaviour)."""
        runtime = self._megapose.runtime
        image, K = runtime.image(frame.rgb), runtime.tensor(frame.camera.K)
        box = padded_box(detection.box_xyxy, self._padding, frame.camera)
        T = mp.pose_from_box(self._grid, self._hull, K, runtime.tensor(box))
        size = (image.shape[1], image.shape[2])
        boxes = mp.crop_boxes(mp.orthonormalise(T), K.expand(len(T), 3, 3), self._megapose.points.crop, size)
        logits = self._megapose.score_prepared(image, boxes, self._coarse_views(frame.camera))
        best = logits.topk(min(self._n_candidates, len(logits))).indices
        return self._megapose.candidates(image, K, T[best], detection)

    def refine(
        self, frame: Frame, detection: Detection | None, T_cam_target: Float, prior: RotationPrior | None = None
    ) -> Refined | None:
        """See :class:`~hat_ros.stages.PoseRefiner`; the prior is not used."""
        return self._megapose.refined(frame, detection, T_cam_target)

    def reset(self) -> None:
        """Nothing is learned from earlier frames."""

    @cached_property
    def _grid(self) -> Tensor:
        return self._megapose.runtime.tensor(lie.matrix_from_quat(so3_grid(2)))

    @cached_property
    def _hull(self) -> Tensor:
        return self._megapose.runtime.tensor(self._target.hull_m)

    def _coarse_views(self, camera: Camera) -> Tensor:
        """(576, 6, 240, 320) uint8, kept until the camera changes and, between runs, in the cache folder."""
        if self._views is None or not _same_camera(self._views[0], camera):
            key = f"{_FORMAT}:{self._target.sha256}:{camera.K.tobytes().hex()}:{camera.width}x{camera.height}"
            arrays = cached_arrays("megapose-views", key, lambda: {"views": self._render_coarse(camera)})
            self._views = camera, torch.from_numpy(np.array(arrays["views"])).to(self._megapose.runtime.device)
        return self._views[1]

    def _render_coarse(self, camera: Camera) -> UInt8:
        LOG.info("rendering %d coarse views, once per CAD model and camera", len(self._grid))
        runtime, points = self._megapose.runtime, self._megapose.points
        half = _CANONICAL_HALF_SIZE * min(camera.width, camera.height)
        centre = np.array([camera.width, camera.height]) / 2
        box = runtime.tensor(np.concatenate([centre - half, centre + half]))
        K = runtime.tensor(camera.K)
        T = mp.orthonormalise(mp.pose_from_box(self._grid, self._hull, K, box))
        Ks = K.expand(len(T), 3, 3)
        K_crop = mp.crop_intrinsics(Ks, mp.crop_boxes(T, Ks, points.crop, (camera.height, camera.width)))
        return self._megapose.renderer.render_bytes(T, K_crop)


class TorchViews:
    """:class:`hat_ros.nets.megapose.ViewRenderer` on the CPU, on as many threads as torch has."""

    def __init__(self, target: Target, runtime: Runtime) -> None:
        self._renderer = NetworkViewRenderer(target, torch.get_num_threads())
        self._runtime = runtime

    def render_views(self, T_cam_target: Tensor, K: Tensor) -> Tensor:
        """(B, 4, 4), (B, 3, 3) -> (B, 6, 240, 320) float32 in [0, 1]."""
        views = torch.from_numpy(self.render_bytes(T_cam_target, K)).to(self._runtime.device)
        return views.float() / 255

    def render_bytes(self, T_cam_target: Tensor, K: Tensor) -> UInt8:
        """(B, 4, 4), (B, 3, 3) -> (B, 6, 240, 320) uint8."""
        poses, cameras = T_cam_target.double().cpu().numpy(), K.double().cpu().numpy()
        views = self._renderer.render_many(poses, cameras, _CROP_SIZE)
        return np.ascontiguousarray(views.transpose(0, 3, 1, 2))


def crop_points(target: Target, runtime: Runtime) -> mp.CropPoints:
    """Surface points that size the crops: vertices drawn with the published seed.

    A model with fewer vertices than the reference draws (which then stops with an assertion) gets points drawn evenly
    over its surface as well.
    """
    points = target.vertices_m
    if len(points) < _N_CROP_POINTS:
        corners, area = target.corners_m, target.face_areas_m2
        rng = np.random.default_rng(0)
        face = rng.choice(len(corners), _N_CROP_POINTS, p=area / area.sum())
        weights = rng.dirichlet(np.ones(3), _N_CROP_POINTS)
        points = np.concatenate([points, np.einsum("nk,nkc->nc", weights, corners[face])])
    # RandomState, not Generator: the published networks saw crops sized by exactly this draw.
    draw = [np.random.RandomState(0).choice(len(points), n, replace=False) for n in (_N_CROP_POINTS, _N_VIEW_POINTS)]
    return mp.CropPoints(runtime.tensor(points[draw[0]]), runtime.tensor(points[draw[1]]))


def padded_box(box_xyxy: Float, padding: float, camera: Camera) -> Float:
    """Box (4,) grown by a share of its size on each side and clipped to the image."""
    margin = padding * (box_xyxy[2:] - box_xyxy[:2])
    size = np.array([camera.width, camera.height], dtype=np.float64)
    return np.concatenate([np.clip(box_xyxy[:2] - margin, 0, size), np.clip(box_xyxy[2:] + margin, 0, size)])


def _same_camera(a: Camera, b: Camera) -> bool:
    return (a.width, a.height) == (b.width, b.height) and np.array_equal(a.K, b.K)
