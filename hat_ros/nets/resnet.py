"""ResNet-34 in the two layouts that MegaPose checkpoints come in; parameter names are the checkpoints' own.

torchvision is not a dependency (only this backbone and RoIAlign would be needed of it). Architectures: He et al.,
"Deep Residual Learning for Image Recognition", CVPR 2016 (post-activation), and "Identity Mappings in Deep Residual
Networks", ECCV 2016 (pre-activation).
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn

from hat_ros.errors import WeightsError

_BLOCKS_PER_LAYER = (3, 4, 6, 3)
_WIDTHS = (64, 128, 256, 512)


class BasicBlock(nn.Module):
    """Two 3x3 convolutions, activation after the addition."""

    def __init__(self, n_in: int, n_out: int, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(n_in, n_out, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(n_out)
        self.conv2 = nn.Conv2d(n_out, n_out, 3, 1, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(n_out)
        self.downsample = None
        if stride != 1 or n_in != n_out:
            self.downsample = nn.Sequential(nn.Conv2d(n_in, n_out, 1, stride, bias=False), nn.BatchNorm2d(n_out))

    def forward(self, x: Tensor) -> Tensor:
        """(B, n_in, H, W) -> (B, n_out, H/stride, W/stride)."""
        skip = x if self.downsample is None else self.downsample(x)
        y = torch.relu(self.bn1(self.conv1(x)))
        return torch.relu(self.bn2(self.conv2(y)) + skip)


class PreActivationBlock(nn.Module):
    """Two 3x3 convolutions, each after its own norm and activation; the skip is one convolution."""

    def __init__(self, n_in: int, n_out: int, stride: int) -> None:
        super().__init__()
        self.bn1 = nn.BatchNorm2d(n_in)
        self.conv1 = nn.Conv2d(n_in, n_out, 3, stride, 1, bias=False)
        self.bn2 = nn.BatchNorm2d(n_out)
        self.conv2 = nn.Conv2d(n_out, n_out, 3, 1, 1, bias=False)
        self.downsample = None
        if stride != 1 or n_in != n_out:
            self.downsample = nn.Conv2d(n_in, n_out, 1, stride, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, n_in, H, W) -> (B, n_out, H/stride, W/stride)."""
        y = torch.relu(self.bn1(x))
        skip = x if self.downsample is None else self.downsample(y)
        return self.conv2(torch.relu(self.bn2(self.conv1(y)))) + skip


class ResNet34(nn.Module):
    """Image to one 512-vector.

    Args:
        n_channels: input channels.
        pre_activation: the 5x5-stem layout without the closing linear layer.
    """

    layer1: nn.Sequential
    layer2: nn.Sequential
    layer3: nn.Sequential
    layer4: nn.Sequential

    def __init__(self, n_channels: int, pre_activation: bool = False) -> None:
        super().__init__()
        stem, block = (5, PreActivationBlock) if pre_activation else (7, BasicBlock)
        self.conv1 = nn.Conv2d(n_channels, 64, stem, 2, stem // 2, bias=False)
        self.bn1 = nn.BatchNorm2d(64)
        self.maxpool = nn.MaxPool2d(3, 2, 1)
        n_in = 64
        for index, (n_blocks, width) in enumerate(zip(_BLOCKS_PER_LAYER, _WIDTHS, strict=True), start=1):
            blocks = [
                block(n_in if i == 0 else width, width, 2 if i == 0 and index > 1 else 1) for i in range(n_blocks)
            ]
            setattr(self, f"layer{index}", nn.Sequential(*blocks))
            n_in = width
        self.fc = None if pre_activation else nn.Linear(512, 512)

    def forward(self, x: Tensor) -> Tensor:
        """(B, n_channels, H, W) -> (B, 512)."""
        x = self.maxpool(torch.relu(self.bn1(self.conv1(x))))
        x = self.layer4(self.layer3(self.layer2(self.layer1(x))))
        x = x.mean(dim=(2, 3))
        return x if self.fc is None else self.fc(x)


def is_pre_activation(state: Mapping[str, Tensor], stem_key: str = "backbone.conv1.weight") -> bool:
    """Which of the two layouts a state dict holds, read from the size of its stem.

    Raises:
        WeightsError: there is no stem, or it has neither size.
    """
    if stem_key not in state:
        raise WeightsError(f"checkpoint has no tensor '{stem_key}': is it a MegaPose checkpoint?")
    side = int(state[stem_key].shape[-1])
    if side not in (5, 7):
        raise WeightsError(f"checkpoint tensor '{stem_key}' has a {side}x{side} kernel; known stems are 7x7 and 5x5")
    return side == 5
