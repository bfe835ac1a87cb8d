"""DINOv2 vision transformer, ViT-L/14 without registers; parameter names are the published checkpoint's own.

Oquab et al., "DINOv2: Learning Robust Visual Features without Supervision", TMLR 2024. Written here because PicoPose
checkpoints carry their fine-tuned copy under these names, which `transformers` splits and renames.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

# The reference resizes position embeddings with this offset on the scale factor, which shifts the samples slightly.
_POSITION_OFFSET = 0.1


class _Attention(nn.Module):
    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.n_heads = n_heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.proj = nn.Linear(dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        n, length, dim = x.shape
        q, k, v = self.qkv(x).reshape(n, length, 3, self.n_heads, dim // self.n_heads).permute(2, 0, 3, 1, 4)
        return self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(n, length, dim))


class _LayerScale(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.gamma = nn.Parameter(torch.ones(dim))

    def forward(self, x: Tensor) -> Tensor:
        return x * self.gamma


class _Mlp(nn.Module):
    def __init__(self, dim: int) -> None:
        super().__init__()
        self.fc1 = nn.Linear(dim, 4 * dim)
        self.fc2 = nn.Linear(4 * dim, dim)

    def forward(self, x: Tensor) -> Tensor:
        return self.fc2(F.gelu(self.fc1(x)))


class _Block(nn.Module):
    def __init__(self, dim: int, n_heads: int) -> None:
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=1e-6)
        self.attn = _Attention(dim, n_heads)
        self.ls1 = _LayerScale(dim)
        self.norm2 = nn.LayerNorm(dim, eps=1e-6)
        self.mlp = _Mlp(dim)
        self.ls2 = _LayerScale(dim)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.ls1(self.attn(self.norm1(x)))
        return x + self.ls2(self.mlp(self.norm2(x)))


class _PatchEmbedding(nn.Module):
    def __init__(self, dim: int, patch_px: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(3, dim, patch_px, patch_px)

    def forward(self, x: Tensor) -> Tensor:
        return self.proj(x).flatten(2).transpose(1, 2)


class DinoV2(nn.Module):
    """ViT that answers with the raw patch tokens after chosen blocks (before the final norm).

    Args:
        dim: token width. n_blocks: depth. n_heads: attention heads. patch_px: patch side.
        grid: side of the position-embedding grid it was trained with.
    """

    def __init__(
        self, dim: int = 1024, n_blocks: int = 24, n_heads: int = 16, patch_px: int = 14, grid: int = 37
    ) -> None:
        super().__init__()
        self.patch_px, self.grid = patch_px, grid
        self.cls_token = nn.Parameter(torch.zeros(1, 1, dim))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + grid * grid, dim))
        # Stored by the checkpoints for their training objective; inference does not use it.
        self.mask_token = nn.Parameter(torch.zeros(1, dim))
        self.patch_embed = _PatchEmbedding(dim, patch_px)
        self.blocks = nn.ModuleList(_Block(dim, n_heads) for _ in range(n_blocks))
        self.norm = nn.LayerNorm(dim, eps=1e-6)

    def forward(self, images: Tensor, after_blocks: tuple[int, ...]) -> list[Tensor]:
        """(B, 3, 14 h, 14 w) normalised images -> per asked block a (B, dim, h, w) map, row-major patches."""
        n, _, height, width = images.shape
        h, w = height // self.patch_px, width // self.patch_px
        x = torch.cat([self.cls_token.expand(n, -1, -1), self.patch_embed(images)], dim=1)
        x = x + self._positions(h, w)
        maps = []
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in after_blocks:
                maps.append(x[:, 1:].transpose(1, 2).reshape(n, -1, h, w))
            if index >= max(after_blocks):
                break
        return maps

    def _positions(self, h: int, w: int) -> Tensor:
        if h == w == self.grid:
            return self.pos_embed
        table = self.pos_embed[:, 1:].reshape(1, self.grid, self.grid, -1).permute(0, 3, 1, 2)
        scale = ((h + _POSITION_OFFSET) / self.grid, (w + _POSITION_OFFSET) / self.grid)
        table = F.interpolate(table, scale_factor=scale, mode="bicubic", align_corners=False)
        return torch.cat([self.pos_embed[:, :1], table.flatten(2).transpose(1, 2)], dim=1)
