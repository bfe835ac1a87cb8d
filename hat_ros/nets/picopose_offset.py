"""Stage 3 of PicoPose: dense feature fusion (DPT) and the coarse-to-fine correspondence decoder.

Parameter names are the published checkpoint's own. Ranftl et al., "Vision Transformers for Dense Prediction", ICCV
2021 (fusion head); Hai et al., "Shape-Constraint Recurrent Flow for 6D Object Pose Estimation", CVPR 2023 (decoder).
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional as F

LEVEL_SIDES = (16, 32, 64)
_WIDTH = 256
_RADIUS = 2


def _resize(x: Tensor, side: int) -> Tensor:
    return F.interpolate(x, size=(side, side), mode="bilinear", align_corners=True)


class _ResidualUnit(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv1, self.bn1 = nn.Conv2d(_WIDTH, _WIDTH, 3, 1, 1), nn.BatchNorm2d(_WIDTH)
        self.conv2, self.bn2 = nn.Conv2d(_WIDTH, _WIDTH, 3, 1, 1), nn.BatchNorm2d(_WIDTH)

    def forward(self, x: Tensor) -> Tensor:
        y = self.bn1(self.conv1(torch.relu(x)))
        return self.bn2(self.conv2(torch.relu(y))) + x


class _Fusion(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.out_conv = nn.Conv2d(_WIDTH, _WIDTH, 1)
        self.resConfUnit1, self.resConfUnit2 = _ResidualUnit(), _ResidualUnit()

    def forward(self, x: Tensor, lateral: Tensor | None, side: int) -> Tensor:
        if lateral is not None:
            x = x + self.resConfUnit1(lateral)
        return self.out_conv(_resize(self.resConfUnit2(x), side))


class _Scratch(nn.Module):
    layer2_rn: nn.Conv2d
    layer3_rn: nn.Conv2d
    layer4_rn: nn.Conv2d
    refinenet2: _Fusion
    refinenet3: _Fusion
    refinenet4: _Fusion

    def __init__(self, widths: tuple[int, ...]) -> None:
        super().__init__()
        for index, width in enumerate(widths, start=1):
            setattr(self, f"layer{index}_rn", nn.Conv2d(width, _WIDTH, 3, 1, 1, bias=False))
            setattr(self, f"refinenet{index}", _Fusion())
        # The checkpoint stores the depth head that this trunk came from, refinenet1 included; nothing reads them.
        self.output_conv1 = nn.Conv2d(_WIDTH, _WIDTH // 2, 3, 1, 1)
        self.output_conv2 = nn.Sequential(nn.Conv2d(_WIDTH // 2, 32, 3, 1, 1), nn.ReLU(), nn.Conv2d(32, 1, 1))


class DptHead(nn.Module):
    """Fuses four transformer levels into maps of 16, 32 and 64 cells a side."""

    def __init__(self, dim: int = 1024, widths: tuple[int, ...] = (256, 512, 1024, 1024)) -> None:
        super().__init__()
        self.projects = nn.ModuleList(nn.Conv2d(dim, width, 1) for width in widths)
        self.resize_layers = nn.ModuleList(
            [
                nn.ConvTranspose2d(widths[0], widths[0], 4, 4),
                nn.ConvTranspose2d(widths[1], widths[1], 2, 2),
                nn.Identity(),
                nn.Conv2d(widths[3], widths[3], 3, 2, 1),
            ]
        )
        self.scratch = _Scratch(widths)

    def forward(self, features: list[Tensor]) -> list[Tensor]:
        """Four (B, dim, 16, 16) maps -> (B, 256, 16, 16), (B, 256, 32, 32), (B, 256, 64, 64)."""
        s = self.scratch
        maps = [
            resize(project(x)) for x, project, resize in zip(features, self.projects, self.resize_layers, strict=True)
        ]
        low2, low3, low4 = s.layer2_rn(maps[1]), s.layer3_rn(maps[2]), s.layer4_rn(maps[3])
        path4 = s.refinenet4(low4, None, LEVEL_SIDES[0])
        path3 = s.refinenet3(path4, low3, LEVEL_SIDES[1])
        return [path4, path3, s.refinenet2(path3, low2, LEVEL_SIDES[2])]


class _ConvRelu(nn.Module):
    def __init__(self, n_in: int, n_out: int, kernel: int) -> None:
        super().__init__()
        self.conv = nn.Conv2d(n_in, n_out, kernel, 1, kernel // 2)

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(self.conv(x))


class _MotionEncoder(nn.Module):
    def __init__(self, n_correlations: int) -> None:
        super().__init__()
        self.corr_net = nn.Sequential(_ConvRelu(n_correlations, 256, 1), _ConvRelu(256, 192, 3))
        self.flow_net = nn.Sequential(_ConvRelu(2, 128, 7), _ConvRelu(128, 64, 3))
        self.out_net = nn.Sequential(_ConvRelu(256, 126, 3))

    def forward(self, correlation: Tensor, flow: Tensor) -> Tensor:
        x = torch.cat([self.corr_net(correlation), self.flow_net(flow)], dim=1)
        return torch.cat([self.out_net(x), flow], dim=1)


class _Predictor(nn.Module):
    def __init__(self, n_out: int, kernel: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(_ConvRelu(2 * _WIDTH + 128, 512, 3), _ConvRelu(512, 256, 3))
        self.predict_layer = nn.Conv2d(256, n_out, kernel, 1, kernel // 2)

    def forward(self, x: Tensor) -> Tensor:
        return self.predict_layer(self.layers(x))


def pixel_grid(side: int, like: Tensor) -> Tensor:
    """(2, side, side) integer (x, y) coordinates."""
    axis = torch.arange(side, dtype=like.dtype, device=like.device)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    return torch.stack([x, y])


def _sample(maps: Tensor, coordinates: Tensor) -> Tensor:
    """Bilinear samples, zero outside: (B, C, h, w) at (B, ..., 2) pixels -> (B, C, ...) with two sample axes."""
    h, w = maps.shape[-2:]
    scale = torch.tensor([max(w - 1, 1), max(h - 1, 1)], dtype=maps.dtype, device=maps.device)
    return F.grid_sample(maps, 2 * coordinates / scale - 1, mode="bilinear", padding_mode="zeros", align_corners=True)


def lookup_correlation(template: Tensor, image: Tensor, coordinates: Tensor, n_levels: int) -> Tensor:
    """Correlation of each template cell with a 5 x 5 window of the image map, per pyramid level.

    Args:
        template: (B, C, s, s). image: (B, C, s, s). coordinates: (B, 2, s, s) window centres in image cells.
        n_levels: pyramid levels, each halving the image side.

    Returns:
        (B, 25 n_levels, s, s); within a level the x offset is the slow index.
    """
    n, width, side, _ = template.shape
    volume = torch.einsum("bcp,bcq->bpq", template.flatten(2), image.flatten(2)) / math.sqrt(width)
    volume = volume.reshape(n * side * side, 1, side, side)
    offset = torch.arange(-_RADIUS, _RADIUS + 1, dtype=template.dtype, device=template.device)
    dx, dy = torch.meshgrid(offset, offset, indexing="ij")
    window = torch.stack([dx, dy], dim=-1)
    centre = coordinates.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2)
    out = []
    for level in range(n_levels):
        samples = _sample(volume, centre / 2**level + window)
        out.append(samples.reshape(n, side, side, -1).permute(0, 3, 1, 2))
        if level + 1 < n_levels:
            volume = F.avg_pool2d(volume, 2)
    return torch.cat(out, dim=1)


class FlowDecoder(nn.Module):
    """Template-to-image flow and certainty, one update per level from 16 to 64 cells a side."""

    def __init__(self) -> None:
        super().__init__()
        levels = range(len(LEVEL_SIDES))
        self.proj = nn.ModuleList(nn.Sequential(nn.Conv2d(_WIDTH, _WIDTH, 1), nn.BatchNorm2d(_WIDTH)) for _ in levels)
        self.encoder = nn.ModuleList(_MotionEncoder((2 * _RADIUS + 1) ** 2 * (level + 1)) for level in levels)
        self.flow_pred = nn.ModuleList(_Predictor(2, 3) for _ in levels)
        self.mask_pred = nn.ModuleList(_Predictor(1, 1) for _ in levels)

    def forward(
        self, template: list[Tensor], image: list[Tensor], flow: Tensor, certainty: Tensor
    ) -> list[tuple[Tensor, Tensor]]:
        """Per level (flow (B, 2, s, s) in cells of that level, certainty logits (B, 1, s, s)).

        Args:
            template, image: the three maps of :class:`DptHead`.
            flow: (B, 2, 16, 16) initial flow. certainty: (B, 1, 16, 16) initial certainty.
        """
        out = []
        for level, side in enumerate(LEVEL_SIDES):
            if level:
                flow, certainty = 2 * _resize(flow, side), _resize(certainty, side)
            f_template, f_image = self.proj[level](template[level]), self.proj[level](image[level])
            at = pixel_grid(side, flow) + flow
            correlation = lookup_correlation(f_template, f_image, at, level + 1)
            warped = _sample(f_image, at.permute(0, 2, 3, 1))
            x = torch.cat([f_template, warped, self.encoder[level](correlation, flow)], dim=1)
            flow, certainty = flow + self.flow_pred[level](x), certainty + self.mask_pred[level](x)
            out.append((flow, certainty))
        return out


class OffsetRegressor(nn.Module):
    """The fusion head, shared by template and image, and the decoder."""

    def __init__(self, dim: int = 1024) -> None:
        super().__init__()
        self.dpt_head = DptHead(dim)
        self.flow_decoder = FlowDecoder()
