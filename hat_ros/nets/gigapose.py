"""GigaPose: template retrieval, then scale and in-plane rotation from single patch matches, in plain PyTorch.

Nguyen et al., "GigaPose: Fast and Robust Novel Object Pose Estimation via One Correspondence", CVPR 2024. Crops are
224 x 224 px with 16 x 16 patches. The transformer is the one of :mod:`hat_ros.nets.dinov2`; the second, small network
looks at the crops at 256 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from hat_ros.nets.dinov2 import DinoV2
from hat_ros.nets.picopose import GRID, PATCH_PX
from hat_ros.nets.resnet import BasicBlock

_MIN_SIMILARITY = 0.5
_CYCLE_PATCHES = 3
_INLIER_PX = 14.0
_IST_PX = 256
_IST_WIDTHS = (128, 192, 256, 512)
_LAST_BLOCK = 23


class _AeNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.dinov2_model = DinoV2()

    def forward(self, crops: Tensor) -> Tensor:
        return F.normalize(self.dinov2_model(crops, (_LAST_BLOCK,))[0], dim=1)


class IstBackbone(nn.Module):
    """The second network's features: (B, 3, 224, 224) crops -> (B, 256, 16, 16)."""

    layer1: nn.Sequential
    layer2: nn.Sequential
    layer3: nn.Sequential
    layer4: nn.Sequential

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 128, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(128)
        n_in = 128
        for index, width in enumerate(_IST_WIDTHS, start=1):
            stride = 1 if index == 1 else 2
            setattr(self, f"layer{index}", nn.Sequential(BasicBlock(n_in, width, stride), BasicBlock(width, width, 1)))
            n_in = width
        self.layer4_outconv = nn.Conv2d(512, 256, 1, bias=False)

    def forward(self, crops: Tensor) -> Tensor:
        """One feature per patch."""
        x = F.interpolate(crops, size=(_IST_PX, _IST_PX), mode="bilinear", align_corners=True)
        x = torch.relu(self.bn1(self.conv1(x)))
        return self.layer4_outconv(self.layer4(self.layer3(self.layer2(self.layer1(x)))))


def _mlp(n_out: int, *closing: nn.Module) -> nn.Sequential:
    return nn.Sequential(
        nn.Linear(512, 512), nn.ReLU(), nn.Linear(512, 256), nn.ReLU(), nn.Linear(256, n_out), *closing
    )


class _Regressor(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.scale_predictor = _mlp(1)
        self.inplane_predictor = _mlp(2, nn.Tanh())

    def forward(self, image: Tensor, template: Tensor) -> tuple[Tensor, Tensor]:
        x = torch.cat([image, template], dim=1)
        return self.scale_predictor(x)[:, 0], self.inplane_predictor(x)


class _IstNet(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.backbone = IstBackbone()
        self.regressor = _Regressor()


class GigaPoseNet(nn.Module):
    """Both networks under the published names ``ae_net`` and ``ist_net``."""

    def __init__(self) -> None:
        super().__init__()
        self.ae_net = _AeNet()
        self.ist_net = _IstNet()


@dataclass(frozen=True)
class Matches:
    """Patch correspondences with one template: (M,) row-major patch indices and their similarities."""

    template: Tensor
    image: Tensor
    similarity: Tensor


def match(image: Tensor, image_mask: Tensor, templates: Tensor, template_masks: Tensor) -> list[Matches]:
    """The nearest template patch of every image patch, where the way back ends within three patches.

    The reference takes index 0 for "no match" and tests it also on the template's list at the image patch's position;
    both quirks are kept, since the published numbers were made with them.

    Args:
        image: (C, 16, 16) unit features. image_mask: (16, 16) of 0 and 1. templates: (N, C, 16, 16) unit features.
        template_masks: (N, 16, 16).

    Returns:
        One entry per template; the template's score is the sum of its similarities over 256.
    """
    similarity = torch.einsum("ct,ncs->nts", image.flatten(1), templates.flatten(2))
    masks = image_mask.flatten()[:, None] * template_masks.flatten(1)[:, None]
    similarity = torch.where((masks > 0) & (similarity >= _MIN_SIMILARITY), similarity, torch.zeros_like(similarity))
    best, to_template = similarity.max(dim=2)
    to_image = similarity.argmax(dim=1)
    back, index = to_image.gather(1, to_template), torch.arange(GRID * GRID, device=image.device)
    dy, dx = back // GRID - index // GRID, back % GRID - index % GRID
    near = torch.hypot(dx.float(), dy.float()) <= _CYCLE_PATCHES
    keep = near & (best > 0) & (to_template != 0) & (to_image != 0)
    return [Matches(to_template[i][k], index[k], best[i][k]) for i, k in enumerate(keep)]


def best_similarity(template_px: Tensor, image_px: Tensor, scale: Tensor, inplane: Tensor) -> tuple[Tensor, Tensor]:
    """One-point RANSAC, exhaustively: each match proposes a 2-D similarity, the one with most inliers wins.

    Args:
        template_px, image_px: (M, 2) matched positions in crop pixels.
        scale: (M,) predicted scale. inplane: (M, 2) predicted (cos, sin), not normalised: as published, its length is
            part of the scale.

    Returns:
        (3, 3) affine from template crop to image crop, and its number of inliers.
    """
    c, s = scale * inplane[:, 0], scale * inplane[:, 1]
    linear = torch.stack([torch.stack([c, -s], dim=1), torch.stack([s, c], dim=1)], dim=1)
    shift = image_px - (linear @ template_px[:, :, None])[..., 0]
    mapped = torch.einsum("mij,nj->mni", linear, template_px) + shift[:, None]
    inliers = ((mapped - image_px).norm(dim=2) <= _INLIER_PX).sum(dim=1)
    winner = inliers.argmax()
    affine = torch.eye(3, dtype=scale.dtype, device=scale.device)
    affine[:2, :2], affine[:2, 2] = linear[winner], shift[winner]
    return affine, inliers[winner]


def patch_px(index: Tensor) -> Tensor:
    """Crop pixels of row-major patch indices, without the half patch (as published): (M,) -> (M, 2) x y."""
    return torch.stack([index % GRID, index // GRID], dim=1).float() * PATCH_PX
