"""PicoPose: template retrieval, 2-D affine alignment and dense correspondences, in plain PyTorch.

Liu et al., "PicoPose: Progressive Pixel-to-Pixel Correspondence Learning for Novel Object Pose Estimation", 2025. All
crops are 224 x 224 px; the transformer sees 16 x 16 patches of 14 px. Crop matrices ``M`` map image pixels to crop
pixels. Functions are batched over hypotheses (B) and work on any device.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hat_ros.nets.dinov2 import DinoV2
from hat_ros.nets.picopose_offset import LEVEL_SIDES, OffsetRegressor, pixel_grid

CROP_PX = 224
PATCH_PX = 14
GRID = CROP_PX // PATCH_PX
FEATURE_BLOCKS = (5, 11, 17, 23)
_MIN_CERTAINTY = 0.5
# CLIP's image statistics; the reference applies them to channels in BGR order, in this order.
_MEAN = (0.48145466, 0.4578275, 0.40821073)
_STD = (0.26862954, 0.26130258, 0.27577711)


def _head(n_out: int, *closing: nn.Module) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, 256), nn.ReLU(), nn.Linear(256, n_out), *closing
    )


class AffineRegressor(nn.Module):
    """Stage 2: translation, scale and in-plane rotation from the similarity volume."""

    def __init__(self) -> None:
        super().__init__()
        self.features = nn.Sequential(
            nn.Conv2d(GRID * GRID, 256, 1),
            nn.GroupNorm(32, 256),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, 2, 1, bias=False),
            nn.GroupNorm(32, 256),
            nn.ReLU(),
        )
        self.fc1 = nn.Linear(256 * (GRID // 2) ** 2, 1024)
        self.fc2 = nn.Linear(1024, 256)
        self.translation_predictor = _head(2)
        self.scale_predictor = _head(1)
        self.inplane_predictor = _head(2, nn.Tanh())

    def forward(self, similarity: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, 256, 16, 16) -> translation (B, 2) in patches, scale (B,), in-plane (B, 2) = (cos, sin)."""
        x = self.features(similarity).flatten(1)
        x = F.leaky_relu(self.fc2(F.leaky_relu(self.fc1(x), 0.1)), 0.1)
        inplane = F.normalize(self.inplane_predictor(x), dim=1)
        return self.translation_predictor(x), self.scale_predictor(x)[:, 0], inplane


class FeatureExtractor(nn.Module):
    """Stage 1's backbone under the checkpoint's name."""

    def __init__(self) -> None:
        super().__init__()
        self.dinov2 = DinoV2()

    def forward(self, crops: Tensor) -> list[Tensor]:
        """(B, 3, 224, 224) normalised crops -> four (B, 1024, 16, 16) maps, the last for matching."""
        return self.dinov2(crops, FEATURE_BLOCKS)


class PicoPoseNet(nn.Module):
    """The three stages; 603 tensors with the published checkpoint's names."""

    def __init__(self) -> None:
        super().__init__()
        self.feature_extractor = FeatureExtractor()
        self.affine_regressor = AffineRegressor()
        self.offset_regressor = OffsetRegressor()


def normalise_crops(crops_bgr: Tensor) -> Tensor:
    """(B, 3, 224, 224) BGR in [0, 1] -> network input."""
    mean = torch.tensor(_MEAN, dtype=crops_bgr.dtype, device=crops_bgr.device)
    std = torch.tensor(_STD, dtype=crops_bgr.dtype, device=crops_bgr.device)
    return (crops_bgr - mean[:, None, None]) / std[:, None, None]


def patch_mask(mask: Tensor) -> Tensor:
    """Crop masks at patch resolution, nearest: (B, 224, 224) -> (B, 16, 16)."""
    return F.interpolate(mask[:, None], size=(GRID, GRID), mode="nearest")[:, 0]


def match_templates(image: Tensor, image_mask: Tensor, templates: Tensor) -> Tensor:
    """Retrieval score of every template (Stage 1).

    The reference multiplies template-indexed and image-indexed flags position by position and ignores matches to
    patch 0; both quirks are kept, since the published numbers were made with them.

    Args:
        image: (C, 16, 16) last feature map. image_mask: (16, 16). templates: (N, C, 16, 16).

    Returns:
        (N,) scores.
    """
    f_image, f_templates = F.normalize(image.flatten(1), dim=0), F.normalize(templates.flatten(2), dim=1)
    mask = image_mask.flatten()
    similarity = torch.einsum("ct,ncs->nts", f_image, f_templates) * mask[:, None]
    best, nearest_template = similarity.max(dim=2)
    nearest_image = similarity.argmax(dim=1)
    valid = mask * (nearest_image != 0) * (nearest_template != 0)
    return (best * valid).sum(dim=1) / (GRID * GRID)


def similarity_volume(image: Tensor, templates: Tensor, template_mask: Tensor) -> Tensor:
    """Input of Stage 2: (C, 16, 16), (B, C, 16, 16), (B, 16, 16) -> (B, 256, 16, 16).

    Channel = template patch; the spatial axes are the image patch, transposed (as trained).
    """
    f_image, f_templates = F.normalize(image.flatten(1), dim=0), F.normalize(templates.flatten(2), dim=1)
    similarity = torch.einsum("ct,bcs->bst", f_image, f_templates) * template_mask.flatten(1)[:, :, None]
    return similarity.clamp(min=0).reshape(len(templates), GRID * GRID, GRID, GRID).transpose(2, 3)


def affine_matrix(translation: Tensor, scale: Tensor, inplane: Tensor, centre_px: Tensor) -> Tensor:
    """Template-crop to image-crop affine: (B, 2), (B,), (B, 2), (B, 2) -> (B, 3, 3) in crop pixels.

    ``centre_px`` is the template's projected origin in its crop, which the affine moves by the predicted translation.
    """
    c, s = scale * inplane[:, 0], scale * inplane[:, 1]
    M = torch.zeros(len(scale), 3, 3, dtype=scale.dtype, device=scale.device)
    M[:, 0, 0], M[:, 0, 1], M[:, 1, 0], M[:, 1, 1], M[:, 2, 2] = c, -s, s, c, 1
    moved = (M[:, :2, :2] @ centre_px[:, :, None])[..., 0]
    M[:, :2, 2] = centre_px + PATCH_PX * translation - moved
    return M


def affine_pose(
    affine: Tensor, M_image: Tensor, K_image: Tensor, T_template: Tensor, M_template: Tensor, K_template: Tensor
) -> Tensor:
    """Stage 2's pose: in-plane rotation, centre and depth from the affine.

    Args:
        affine: (B, 3, 3). M_image: (3, 3). K_image: (3, 3). T_template: (B, 4, 4). M_template: (B, 3, 3).
        K_template: (3, 3).

    Returns:
        (B, 4, 4) ``T_cam_target``.
    """
    full = torch.linalg.inv(M_image) @ affine @ M_template
    t = T_template[:, :3, 3]
    centre = (K_template @ t[:, :, None])[..., 0]
    centre = (full @ (centre / centre[:, 2:])[:, :, None])[..., 0]
    z = t[:, 2] / full[:, :2, 0].norm(dim=1) * K_image[0, 0] / K_template[0, 0]
    angle = torch.atan2(affine[:, 1, 0], affine[:, 0, 0])
    R_z = torch.zeros(len(angle), 3, 3, dtype=affine.dtype, device=affine.device)
    R_z[:, 0, 0], R_z[:, 0, 1] = angle.cos(), -angle.sin()
    R_z[:, 1, 0], R_z[:, 1, 1], R_z[:, 2, 2] = angle.sin(), angle.cos(), 1
    T = T_template.clone()
    T[:, :3, :3] = R_z @ T_template[:, :3, :3]
    T[:, :3, 3] = (torch.linalg.inv(K_image) @ centre[:, :, None])[..., 0] * z[:, None]
    return T


def initial_flow(affine: Tensor, template_mask: Tensor) -> Tensor:
    """Flow that the affine predicts, in patches: (B, 3, 3), (B, 16, 16) -> (B, 2, 16, 16)."""
    grid = pixel_grid(GRID, affine)
    centres = ((grid + 0.5) * PATCH_PX).flatten(1)
    mapped = affine[:, :2, :2] @ centres + affine[:, :2, 2:]
    mapped = mapped.reshape(-1, 2, GRID, GRID) / PATCH_PX
    return mapped * template_mask[:, None] - grid


def correspondences(flow: Tensor, certainty: Tensor) -> tuple[Tensor, Tensor]:
    """Certain matches of one hypothesis at 64 x 64 cells: (2, 64, 64), (1, 64, 64) -> source, image (M, 2) int64.

    Image cells are truncated towards zero and must lie strictly inside the crop, as in the reference.
    """
    side = LEVEL_SIDES[-1]
    source = pixel_grid(side, flow).flatten(1).T
    at = source + flow.flatten(1).T
    keep = (certainty.flatten().sigmoid() > _MIN_CERTAINTY) & ((at > 0) & (at < side - 1)).all(dim=1)
    return source[keep].long(), at[keep].long()
