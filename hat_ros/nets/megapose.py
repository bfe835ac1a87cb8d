"""MegaPose: coarse scoring and iterative render-and-compare refinement (RGB), in plain PyTorch.

Labbe et al., "MegaPose: 6D Pose Estimation of Novel Objects via Render & Compare", CoRL 2022. Conventions of the
published networks: metres; ``T_cam_target`` as everywhere; images (3, H, W) float32 in [0, 1], RGB, not normalised;
network input 240 x 320; channels = image crop, then [RGB, normals] of each rendered view. All functions are batched
over a leading axis B and work on any device.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor, nn

from hat_ros.nets.resnet import ResNet34, is_pre_activation

CROP_HEIGHT, CROP_WIDTH = 240, 320
N_VIEWS_REFINER = 4
_CROP_MARGIN = 1.4
_MIN_DEPTH_M = 0.1
_ROI_SAMPLES = 4


class ViewRenderer(Protocol):
    """Renders the target the way the networks were trained (``render.network_views``)."""

    def render_views(self, T_cam_target: Tensor, K: Tensor) -> Tensor:
        """(B, 4, 4) poses and (B, 3, 3) crop intrinsics -> (B, 6, 240, 320) RGB and coded normals in [0, 1]."""
        ...


class CoarseNet(nn.Module):
    """Classifier: how well one rendered view explains the crop."""

    def __init__(self, pre_activation: bool = False) -> None:
        super().__init__()
        self.backbone = ResNet34(3 + 6, pre_activation)
        self.views_logits_head = nn.Linear(512, 1)

    def forward(self, crops_and_renders: Tensor) -> Tensor:
        """(B, 9, 240, 320) -> (B,) logits."""
        return self.views_logits_head(self.backbone(crops_and_renders))[:, 0]


class RefinerNet(nn.Module):
    """Regressor of the pose update from the crop and four rendered views."""

    def __init__(self, pre_activation: bool = False) -> None:
        super().__init__()
        self.backbone = ResNet34(3 + 6 * N_VIEWS_REFINER, pre_activation)
        self.pose_fc = nn.Linear(512, 9)

    def forward(self, crops_and_renders: Tensor) -> Tensor:
        """(B, 27, 240, 320) -> (B, 9) update, see :func:`apply_update`."""
        return self.pose_fc(self.backbone(crops_and_renders))


def build_net(kind: type[CoarseNet] | type[RefinerNet], state: Mapping[str, Tensor]) -> CoarseNet | RefinerNet:
    """The network whose layout the state dict has (7x7 or 5x5 stem), not yet loaded."""
    return kind(is_pre_activation(state)).eval()


# --- geometry -------------------------------------------------------------------------------------------------------


def rotation_from_columns(first: Tensor, second: Tensor) -> Tensor:
    """Rotation from two columns by Gram-Schmidt with z = x cross y: (..., 3), (..., 3) -> (..., 3, 3)."""
    x = nn.functional.normalize(first, dim=-1)
    z = nn.functional.normalize(torch.linalg.cross(x, second), dim=-1)
    return torch.stack([x, torch.linalg.cross(z, x), z], dim=-1)


def orthonormalise(T_cam_target: Tensor) -> Tensor:
    """Pose with its rotation rebuilt from its first two columns: (B, 4, 4) -> (B, 4, 4)."""
    out = T_cam_target.clone()
    out[:, :3, :3] = rotation_from_columns(T_cam_target[:, :3, 0], T_cam_target[:, :3, 1])
    return out


def pose_from_box(R_cam_target: Tensor, points: Tensor, K: Tensor, box_xyxy: Tensor) -> Tensor:
    """Initial poses from a detection box: the depth at which the target is as large as the box.

    Args:
        R_cam_target: (B, 3, 3) rotations.
        points: (N, 3) vertices in metres; the convex hull's are enough.
        K: (3, 3) intrinsics of the image.
        box_xyxy: (4,) pixels.

    Returns:
        (B, 4, 4) ``T_cam_target`` centred on the box.
    """
    xy = torch.einsum("bij,nj->bni", R_cam_target[:, :2], points)
    extent = xy.amax(dim=1) - xy.amin(dim=1)
    size = box_xyxy[2:] - box_xyxy[:2] + 1
    focal = torch.stack([K[0, 0], K[1, 1]])
    z = 0.5 * (focal * extent / size).sum(dim=1)
    centre = 0.5 * (box_xyxy[:2] + box_xyxy[2:])
    ray = torch.stack([(centre[0] - K[0, 2]) / K[0, 0], (centre[1] - K[1, 2]) / K[1, 1], torch.ones_like(centre[0])])
    T = torch.zeros(len(z), 4, 4, dtype=z.dtype, device=z.device)
    T[:, :3, :3], T[:, :3, 3], T[:, 3, 3] = R_cam_target, ray * z[:, None], 1
    return T


def project_boxes(T_cam_target: Tensor, K: Tensor, points: Tensor) -> Tensor:
    """Boxes of the projected points: (B, 4, 4), (B, 3, 3), (N, 3) -> (B, 4) x1 y1 x2 y2 px."""
    p = points @ T_cam_target[:, :3, :3].transpose(1, 2) + T_cam_target[:, None, :3, 3]
    uvw = p @ K.transpose(1, 2)
    uv = uvw[..., :2] / uvw[..., 2:].clamp(min=_MIN_DEPTH_M)
    return torch.cat([uv.amin(dim=1), uv.amax(dim=1)], dim=1)


def crop_boxes(T_cam_target: Tensor, K: Tensor, points: Tensor, image_hw: tuple[int, int]) -> Tensor:
    """Crop around the projected target origin that holds all points with a margin: -> (B, 4) px."""
    boxes = project_boxes(T_cam_target, K, points)
    origin = (K @ T_cam_target[:, :3, 3:])[..., 0]
    centre = origin[:, :2] / origin[:, 2:]
    reach = torch.maximum((boxes[:, :2] - centre).abs(), (boxes[:, 2:] - centre).abs())
    ratio = max(image_hw) / min(image_hw)
    width = 2 * _CROP_MARGIN * torch.maximum(reach[:, 0], reach[:, 1] * ratio)
    height = 2 * _CROP_MARGIN * torch.maximum(reach[:, 0] / ratio, reach[:, 1])
    half = 0.5 * torch.stack([width, height], dim=1)
    return torch.cat([centre - half, centre + half], dim=1)


def crop_intrinsics(K: Tensor, boxes: Tensor) -> Tensor:
    """Intrinsics of the 240 x 320 crops: (B, 3, 3), (B, 4) -> (B, 3, 3)."""
    scale = torch.stack([CROP_WIDTH / (boxes[:, 2] - boxes[:, 0]), CROP_HEIGHT / (boxes[:, 3] - boxes[:, 1])], dim=1)
    middle = torch.tensor([(CROP_WIDTH - 1) / 2, (CROP_HEIGHT - 1) / 2], dtype=K.dtype, device=K.device)
    out = K.clone()
    out[:, 0, 0] = K[:, 0, 0] * scale[:, 0]
    out[:, 1, 1] = K[:, 1, 1] * scale[:, 1]
    out[:, :2, 2] = middle + scale * (K[:, :2, 2] - 0.5 * (boxes[:, :2] + boxes[:, 2:]))
    return out


def _interpolation_rows(start: Tensor, end: Tensor, n_out: int, n_in: int) -> Tensor:
    """(B, n_out, n_in) averaging-and-interpolating matrix of RoIAlign along one axis."""
    bin_size = (end - start).clamp(min=1.0) / n_out
    sub = (torch.arange(_ROI_SAMPLES, dtype=start.dtype, device=start.device) + 0.5) / _ROI_SAMPLES
    index = torch.arange(n_out, dtype=start.dtype, device=start.device)
    at = start[:, None, None] + (index[:, None] + sub) * bin_size[:, None, None]
    inside = (at >= -1) & (at <= n_in)
    at = torch.where(inside, at, 0.0).clamp(0, n_in - 1)
    low = at.floor().clamp(max=n_in - 1)
    high = (low + 1).clamp(max=n_in - 1)
    upper = at - low
    rows = torch.zeros(len(start), n_out, n_in, dtype=start.dtype, device=start.device)
    rows.scatter_add_(2, low.long(), (1 - upper) * inside / _ROI_SAMPLES)
    rows.scatter_add_(2, high.long(), upper * inside / _ROI_SAMPLES)
    return rows


def roi_align(image: Tensor, boxes: Tensor) -> Tensor:
    """RoIAlign (sampling ratio 4, not half-pixel aligned) of one image: (C, H, W), (B, 4) -> (B, C, 240, 320).

    Bilinear weights and the zero outside the image are products of one factor per axis, so the crop is two matrix
    products, over the part of the image that any box reaches, instead of a gather of 16 samples per pixel. He et al.,
    "Mask R-CNN", ICCV 2017.
    """
    _, height, width = image.shape
    x0, x1 = _reached(boxes[:, 0], boxes[:, 2], width)
    y0, y1 = _reached(boxes[:, 1], boxes[:, 3], height)
    rows = _interpolation_rows(boxes[:, 1] - y0, boxes[:, 3] - y0, CROP_HEIGHT, y1 - y0)
    cols = _interpolation_rows(boxes[:, 0] - x0, boxes[:, 2] - x0, CROP_WIDTH, x1 - x0)
    return torch.einsum("byh,chw,bxw->bcyx", rows, image[:, y0:y1, x0:x1], cols)


def _reached(start: Tensor, end: Tensor, size: int) -> tuple[int, int]:
    """Half-open pixel range along one axis outside which no box samples; where it ends before the image does, so far
    out that no sample is clamped there."""
    low = float((start.min() - 2).nan_to_num(0.0).clamp(0, size - 1))
    high = float((torch.maximum(end, start + 1).max() + 3).nan_to_num(size).clamp(1, size))
    return math.floor(low), max(math.ceil(high), math.floor(low) + 1)


def extra_views(T_cam_target: Tensor) -> Tensor:
    """The refiner's four cameras around the target: (B, 4, 4) -> (B, 4, 4, 4) ``T_view_target``.

    View 0 is the camera itself, view 1 the same centre turned to look at the target's origin, views 2 and 3 look from
    45 degrees to either side at sqrt(2) times the distance.
    """
    c = T_cam_target[:, :3, 3]
    distance = c.norm(dim=-1, keepdim=True)
    origin = torch.zeros_like(c)
    T_cam_view1 = _look_at(origin, c)
    right = T_cam_view1[:, :3, 0]
    views = [T_cam_view1, _look_at(distance * right, c), _look_at(-distance * right, c)]
    T_view_target = [T_cam_target] + [_rigid_inverse(T) @ T_cam_target for T in views]
    return torch.stack(T_view_target, dim=1)


def _look_at(position: Tensor, at: Tensor) -> Tensor:
    """Camera pose (x right, y down, z to ``at``) with up = -y of the current camera: (B, 3) -> (B, 4, 4)."""
    forward = nn.functional.normalize(at - position, dim=-1)
    up = torch.tensor([0.0, -1.0, 0.0], dtype=at.dtype, device=at.device).expand_as(at)
    right = nn.functional.normalize(torch.linalg.cross(forward, up), dim=-1)
    T = torch.zeros(len(at), 4, 4, dtype=at.dtype, device=at.device)
    T[:, :3, 0], T[:, :3, 1], T[:, :3, 2] = right, torch.linalg.cross(forward, right), forward
    T[:, :3, 3], T[:, 3, 3] = position, 1
    return T


def _rigid_inverse(T: Tensor) -> Tensor:
    R_t = T[:, :3, :3].transpose(1, 2)
    out = torch.zeros_like(T)
    out[:, :3, :3], out[:, :3, 3:], out[:, 3, 3] = R_t, -R_t @ T[:, :3, 3:], 1
    return out


def apply_update(T_cam_target: Tensor, K_crop: Tensor, update: Tensor) -> Tensor:
    """Apply the refiner's 9 numbers: two rotation columns, then image shift vx, vy and depth factor vz.

    Args:
        T_cam_target: (B, 4, 4) current poses.
        K_crop: (B, 3, 3) intrinsics of the crops.
        update: (B, 9); the identity is (1,0,0, 0,1,0, 0,0,1).

    Returns:
        (B, 4, 4) updated poses.
    """
    t = T_cam_target[:, :3, 3]
    z = update[:, 8] * t[:, 2]
    focal = torch.stack([K_crop[:, 0, 0], K_crop[:, 1, 1]], dim=1)
    xy = (update[:, 6:8] / focal + t[:, :2] / t[:, 2:]) * z[:, None]
    out = T_cam_target.clone()
    out[:, :3, :3] = rotation_from_columns(update[:, :3], update[:, 3:6]) @ T_cam_target[:, :3, :3]
    out[:, :2, 3], out[:, 2, 3] = xy, z
    return out


# --- inference ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class CropPoints:
    """Surface points that size the crops: 2000 for the crop, 200 for the extra views (metres)."""

    crop: Tensor
    views: Tensor


def score_coarse(
    net: Callable[[Tensor], Tensor],
    image: Tensor,
    K: Tensor,
    T_cam_target: Tensor,
    points: CropPoints,
    renderer: ViewRenderer,
) -> Tensor:
    """Logits of poses by rendering each once: image (3, H, W), K (3, 3), (B, 4, 4) -> (B,)."""
    T = orthonormalise(T_cam_target)
    Ks = K.expand(len(T), 3, 3)
    boxes = crop_boxes(T, Ks, points.crop, (image.shape[1], image.shape[2]))
    renders = renderer.render_views(T, crop_intrinsics(Ks, boxes))
    return score_renders(net, image, boxes, renders)


def score_renders(net: Callable[[Tensor], Tensor], image: Tensor, boxes: Tensor, renders: Tensor) -> Tensor:
    """Logits of ready renders against the crops: (B, 4) boxes, (B, 6, 240, 320) renders -> (B,)."""
    return net(torch.cat([roi_align(image, boxes), renders], dim=1))


def refine_once(
    net: Callable[[Tensor], Tensor],
    image: Tensor,
    K: Tensor,
    T_cam_target: Tensor,
    points: CropPoints,
    renderer: ViewRenderer,
) -> Tensor:
    """One refiner iteration on all poses: image (3, H, W), K (3, 3), (B, 4, 4) -> (B, 4, 4)."""
    T = orthonormalise(T_cam_target)
    K_crop, crops, T_views, K_views = refiner_inputs(image, K, T, points)
    n = len(T)
    renders = renderer.render_views(T_views.flatten(0, 1), K_views.flatten(0, 1))
    update = net(torch.cat([crops, renders.reshape(n, 6 * N_VIEWS_REFINER, CROP_HEIGHT, CROP_WIDTH)], dim=1))
    return apply_update(T, K_crop, update)


def refiner_inputs(
    image: Tensor, K: Tensor, T_cam_target: Tensor, points: CropPoints
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """What one iteration looks at.

    Returns:
        ``K_crop (B, 3, 3)``, ``crops (B, 3, 240, 320)``, ``T_view_target (B, 4, 4, 4)``, ``K_views (B, 4, 3, 3)``.
    """
    n = len(T_cam_target)
    Ks = K.expand(n, 3, 3)
    boxes = crop_boxes(T_cam_target, Ks, points.crop, (image.shape[1], image.shape[2]))
    K_crop = crop_intrinsics(Ks, boxes)
    T_views = extra_views(T_cam_target)
    Ks_extra = K.expand(n * (N_VIEWS_REFINER - 1), 3, 3)
    extra = T_views[:, 1:].flatten(0, 1)
    K_extra = crop_intrinsics(Ks_extra, crop_boxes(extra, Ks_extra, points.views, (image.shape[1], image.shape[2])))
    K_views = torch.cat([K_crop[:, None], K_extra.reshape(n, N_VIEWS_REFINER - 1, 3, 3)], dim=1)
    return K_crop, roi_align(image, boxes), T_views, K_views
