"""The networks of DROID-SLAM in plain PyTorch: encoders, correlation, recurrent update.

Source: Teed and Deng, "DROID-SLAM: Deep Visual SLAM for Monocular, Stereo, and RGB-D Cameras", NeurIPS 2021
(arXiv:2108.10869); module and tensor names are those of the public checkpoint ``droid.pth``, all 102 of them.

Everything here lives at 1/8 resolution: ``h = H / 8``, ``w = W / 8``; coordinates are (x, y) in units of 8 pixels.
E counts edges of the factor graph, n images.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from hat_ros.errors import FrameError
from hat_ros.nets import checkpoint

FEATURE_CHANNELS = 128
CORRELATION_LEVELS = 4
CORRELATION_RADIUS = 3
STRIDE_PX = 8

# Mean and standard deviation of ImageNet in RGB order, for images scaled to 0..1.
_MEAN_RGB = (0.485, 0.456, 0.406)
_STD_RGB = (0.229, 0.224, 0.225)
_MAX_MOTION = 64.0
_ETA_SCALE = 0.01


class ResidualBlock(nn.Module):
    """Two 3x3 convolutions with a skip; a strided block projects the skip with a 1x1 convolution."""

    def __init__(self, channels_in: int, channels_out: int, norm: Callable[[int], nn.Module], stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(channels_in, channels_out, 3, stride=stride, padding=1)
        self.conv2 = nn.Conv2d(channels_out, channels_out, 3, padding=1)
        self.norm1, self.norm2 = norm(channels_out), norm(channels_out)
        self.downsample: nn.Module = nn.Identity()
        if stride != 1:
            self.downsample = nn.Sequential(nn.Conv2d(channels_in, channels_out, 1, stride=stride), norm(channels_out))

    def forward(self, x: Tensor) -> Tensor:
        """(n, c_in, H, W) -> (n, c_out, H / stride, W / stride)."""
        y = F.relu(self.norm1(self.conv1(x)))
        y = F.relu(self.norm2(self.conv2(y)))  # before the sum too, as the network was trained
        return F.relu(self.downsample(x) + y)


class Encoder(nn.Module):
    """Image to 1/8 resolution features."""

    def __init__(self, channels_out: int, norm: Callable[[int], nn.Module]) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, 32, 7, stride=2, padding=3)
        self.norm1 = norm(32)
        self.layer1 = nn.Sequential(ResidualBlock(32, 32, norm, 1), ResidualBlock(32, 32, norm, 1))
        self.layer2 = nn.Sequential(ResidualBlock(32, 64, norm, 2), ResidualBlock(64, 64, norm, 1))
        self.layer3 = nn.Sequential(ResidualBlock(64, 128, norm, 2), ResidualBlock(128, 128, norm, 1))
        self.conv2 = nn.Conv2d(128, channels_out, 1)

    def forward(self, images: Tensor) -> Tensor:
        """(n, 3, H, W) normalised -> (n, channels_out, h, w)."""
        x = F.relu(self.norm1(self.conv1(images)))
        return self.conv2(self.layer3(self.layer2(self.layer1(x))))


class GlobalGru(nn.Module):
    """Convolutional GRU whose gates also see a gated global average of the hidden state."""

    def __init__(self, hidden: int, inputs: int) -> None:
        super().__init__()
        self.convz = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convr = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.convq = nn.Conv2d(hidden + inputs, hidden, 3, padding=1)
        self.w = nn.Conv2d(hidden, hidden, 1)
        self.convz_glo = nn.Conv2d(hidden, hidden, 1)
        self.convr_glo = nn.Conv2d(hidden, hidden, 1)
        self.convq_glo = nn.Conv2d(hidden, hidden, 1)

    def forward(self, hidden: Tensor, inputs: Tensor) -> Tensor:
        """(E, 128, h, w), (E, 320, h, w) -> next hidden state (E, 128, h, w)."""
        context = (torch.sigmoid(self.w(hidden)) * hidden).mean(dim=(-2, -1), keepdim=True)
        both = torch.cat([hidden, inputs], dim=1)
        z = torch.sigmoid(self.convz(both) + self.convz_glo(context))
        r = torch.sigmoid(self.convr(both) + self.convr_glo(context))
        q = torch.tanh(self.convq(torch.cat([r * hidden, inputs], dim=1)) + self.convq_glo(context))
        return (1 - z) * hidden + z * q


class Aggregate(nn.Module):
    """Pools the hidden states of all edges that leave a frame into that frame's depth damping and up-sampling mask."""

    def __init__(self) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(128, 128, 3, padding=1)
        self.conv2 = nn.Conv2d(128, 128, 3, padding=1)
        self.eta = nn.Sequential(nn.Conv2d(128, 1, 3, padding=1))
        self.upmask = nn.Sequential(nn.Conv2d(128, STRIDE_PX * STRIDE_PX * 9, 1))

    def pool(self, hidden: Tensor, group: Tensor, n_groups: int) -> Tensor:
        """(E, 128, h, w), (E,) group of each edge -> (n_groups, 128, h, w)."""
        x = F.relu(self.conv1(hidden))
        total = x.new_zeros((n_groups, *x.shape[1:])).index_add_(0, group, x)
        count = x.new_zeros(n_groups).index_add_(0, group, x.new_ones(len(group)))
        return F.relu(self.conv2(total / count.view(-1, 1, 1, 1)))

    def damping(self, pooled: Tensor) -> Tensor:
        """(n, 128, h, w) -> damping of inverse depth (n, h, w), float32."""
        return _ETA_SCALE * F.softplus(self.eta(pooled)[:, 0].float())


def _head(channels_out: int) -> list[nn.Module]:
    return [
        nn.Conv2d(128, 128, 3, padding=1),
        nn.ReLU(),
        nn.Conv2d(128, channels_out, 3, padding=1),
    ]


class UpdateOperator(nn.Module):
    """One step of the recurrent flow refinement."""

    def __init__(self) -> None:
        super().__init__()
        lookups = CORRELATION_LEVELS * (2 * CORRELATION_RADIUS + 1) ** 2
        self.corr_encoder = nn.Sequential(
            nn.Conv2d(lookups, 128, 1), nn.ReLU(), nn.Conv2d(128, 128, 3, padding=1), nn.ReLU()
        )
        self.flow_encoder = nn.Sequential(
            nn.Conv2d(4, 128, 7, padding=3), nn.ReLU(), nn.Conv2d(128, 64, 3, padding=1), nn.ReLU()
        )
        self.gru = GlobalGru(128, 128 + 128 + 64)
        self.delta = nn.Sequential(*_head(2))
        self.weight = nn.Sequential(*_head(2), nn.Sigmoid())
        self.agg = Aggregate()

    def forward(
        self, hidden: Tensor, inp: Tensor, lookup: Tensor, motion: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Refine the flow of every edge.

        Args:
            hidden: (E, 128, h, w) recurrent state.
            inp: (E, 128, h, w) context features of the source frames.
            lookup: (E, 196, h, w) correlation around the current flow.
            motion: (E, 4, h, w) current flow and last residual, clamped to 64 here; None = all zero.

        Returns:
            next hidden state (E, 128, h, w), flow correction (E, h, w, 2) float32, confidence (E, h, w, 2) float32.
        """
        if motion is None:
            motion = lookup.new_zeros((len(lookup), 4, *lookup.shape[-2:]))
        motion = motion.clamp(-_MAX_MOTION, _MAX_MOTION)
        inputs = torch.cat([inp, self.corr_encoder(lookup), self.flow_encoder(motion)], dim=1)
        hidden = self.gru(hidden, inputs)
        delta = self.delta(hidden).permute(0, 2, 3, 1).float()
        weight = self.weight(hidden).permute(0, 2, 3, 1).float()
        return hidden, delta, weight


class DroidNet(nn.Module):
    """The whole network. Stateless: the recurrent state belongs to the caller's factor graph.

    Args:
        autocast: reduced precision of encoders and update operator; None computes in float32.
    """

    def __init__(self, autocast: torch.dtype | None = None) -> None:
        super().__init__()
        self.fnet = Encoder(FEATURE_CHANNELS, nn.InstanceNorm2d)
        self.cnet = Encoder(2 * FEATURE_CHANNELS, _no_norm)
        self.update = UpdateOperator()
        self.autocast_dtype = autocast
        self._mean: Tensor
        self._std: Tensor
        self.register_buffer("_mean", torch.tensor(_MEAN_RGB).view(3, 1, 1), persistent=False)
        self.register_buffer("_std", torch.tensor(_STD_RGB).view(3, 1, 1), persistent=False)

    @classmethod
    def from_checkpoint(
        cls,
        folder: str | Path | None = None,
        allow_unverified: bool = False,
        device: str | torch.device = "cpu",
        autocast: torch.dtype | None = None,
    ) -> DroidNet:
        """The network with the public weights, ready for inference.

        Raises:
            WeightsError: the checkpoint is missing, altered or does not fit.
        """
        net = cls(autocast)
        checkpoint.load_into(net, checkpoint.load_state("droid", folder, allow_unverified), "droid")
        return net.requires_grad_(False).eval().to(device)

    @property
    def dtype(self) -> torch.dtype:
        """Precision in which feature maps and hidden states are best stored."""
        return self.autocast_dtype or torch.float32

    def features(self, images_bgr: Tensor) -> Tensor:
        """Matching features: (n, 3, H, W) uint8 BGR -> (n, 128, h, w)."""
        with self._autocast(images_bgr):
            return self.fnet(self._normalised(images_bgr)).to(self.dtype)

    def context(self, images_bgr: Tensor) -> tuple[Tensor, Tensor]:
        """First hidden state and context features: (n, 3, H, W) uint8 BGR -> two of (n, 128, h, w)."""
        with self._autocast(images_bgr):
            hidden, inp = self.cnet(self._normalised(images_bgr)).split(FEATURE_CHANNELS, dim=1)
            return torch.tanh(hidden).to(self.dtype), F.relu(inp).to(self.dtype)

    def refine(
        self, hidden: Tensor, inp: Tensor, lookup: Tensor, motion: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """One step of :class:`UpdateOperator` in the network's precision."""
        with self._autocast(hidden):
            hidden, delta, weight = self.update(hidden, inp, lookup, motion)
        return hidden.to(self.dtype), delta, weight

    def damping(self, hidden: Tensor, group: Tensor, n_groups: int) -> Tensor:
        """Damping of inverse depth per source frame: (E, 128, h, w), (E,) -> (n_groups, h, w) float32."""
        with self._autocast(hidden):
            return self.update.agg.damping(self.update.agg.pool(hidden, group, n_groups))

    def upsampling_mask(self, hidden: Tensor, group: Tensor, n_groups: int) -> Tensor:
        """Logits of :func:`upsample_disparity`: (E, 128, h, w), (E,) -> (n_groups, 576, h, w) float32."""
        with self._autocast(hidden):
            return self.update.agg.upmask(self.update.agg.pool(hidden, group, n_groups)).float()

    def correlation(self, features_i: Tensor, features_j: Tensor, stored: bool = True) -> Correlation:
        """Correlation of E feature pairs (E, 128, h, w); see :class:`Correlation`."""
        return Correlation(features_i, features_j, stored)

    def _normalised(self, images_bgr: Tensor) -> Tensor:
        if images_bgr.dtype != torch.uint8 or images_bgr.ndim != 4 or images_bgr.shape[1] != 3:
            raise FrameError(
                f"DROID needs uint8 images (n, 3, H, W), found {images_bgr.dtype} {tuple(images_bgr.shape)}"
            )
        if images_bgr.shape[2] % STRIDE_PX or images_bgr.shape[3] % STRIDE_PX:
            raise FrameError(f"DROID needs image sides that are multiples of 8 px, found {tuple(images_bgr.shape[2:])}")
        return (images_bgr.flip(1).float() / 255.0 - self._mean) / self._std

    def _autocast(self, tensor: Tensor) -> torch.autocast:
        enabled = self.autocast_dtype is not None
        return torch.autocast(tensor.device.type, dtype=self.autocast_dtype or torch.bfloat16, enabled=enabled)


def _no_norm(_channels: int) -> nn.Module:
    return nn.Identity()


class Correlation:
    """Dot products of all pixel pairs of E image pairs, looked up around a flow on four scales.

    Stored, the volume of one edge takes ``(h w)^2 * 4/3`` values (50 MB at 384 x 512 in float32); otherwise only the
    features are kept and the volume is formed again for a few edges at a time. Both answer the same numbers, because
    average pooling of the second image commutes with the dot product.

    Args:
        features_i: (E, 128, h, w) features of the source frames.
        features_j: (E, 128, h, w) features of the target frames.
        stored: keep the volume.
    """

    # Edges whose volume is formed together when it is not stored.
    CHUNK = 4

    def __init__(self, features_i: Tensor, features_j: Tensor, stored: bool = True) -> None:
        # A quarter on each side, 1 / 16 in all, as the network was trained; so the products stay small in float16.
        self._source, self._pyramid = features_i / 4.0, _pyramid(features_j / 4.0)
        self._n_edges = len(features_i)
        self._volume: list[Tensor] | None = None
        if stored:
            self._volume = self._form(slice(None))
            del self._source, self._pyramid

    def __len__(self) -> int:
        return self._n_edges

    def levels(self) -> list[Tensor]:
        """The four volumes, (E, h, w, h / 2^l, w / 2^l)."""
        return self._volume if self._volume is not None else self._form(slice(None))

    def lookup(self, coords: Tensor) -> Tensor:
        """Correlation in a 7 x 7 window on each scale: (E, h, w, 2) float32 coordinates in image j -> (E, 196, h, w).

        Bilinear, zero outside. Channels run level by level, inside one the x offset is the slow index.
        """
        if self._volume is not None:
            return _window(self._volume, coords)
        parts = [slice(first, first + self.CHUNK) for first in range(0, len(self), self.CHUNK)]
        return torch.cat([_window(self._form(part), coords[part]) for part in parts])

    def select(self, index: Tensor) -> None:
        """Keep the edges ``index`` (int64), in that order."""
        self._n_edges = len(index)
        if self._volume is not None:
            self._volume = [level.index_select(0, index) for level in self._volume]
        else:
            self._source = self._source.index_select(0, index)
            self._pyramid = [level.index_select(0, index) for level in self._pyramid]

    def append(self, other: Correlation) -> None:
        """Add the edges of another correlation of the same kind."""
        self._n_edges += len(other)
        if self._volume is not None and other._volume is not None:
            self._volume = [torch.cat(pair) for pair in zip(self._volume, other._volume, strict=True)]
        else:
            self._source = torch.cat([self._source, other._source])
            self._pyramid = [torch.cat(pair) for pair in zip(self._pyramid, other._pyramid, strict=True)]

    def _form(self, edges: slice) -> list[Tensor]:
        source = self._source[edges].flatten(2).transpose(1, 2)
        h, w = self._source.shape[-2:]
        volumes = []
        for level in self._pyramid:
            part = level[edges]
            volumes.append((source @ part.flatten(2)).view(len(part), h, w, *part.shape[-2:]))
        return volumes


def _pyramid(features: Tensor) -> list[Tensor]:
    """Average pooling 2 x 2, floor sizes; a side that is already one pixel wide stops there."""
    levels = [features]
    for _ in range(CORRELATION_LEVELS - 1):
        kernel = (min(2, levels[-1].shape[-2]), min(2, levels[-1].shape[-1]))
        levels.append(F.avg_pool2d(levels[-1], kernel, stride=kernel))
    return levels


def _window(volumes: list[Tensor], coords: Tensor) -> Tensor:
    """Bilinear windows of all levels: coords (E, h, w, 2) -> (E, 196, h, w)."""
    edges, h, w, _ = coords.shape
    side = 2 * CORRELATION_RADIUS + 1
    steps = torch.arange(-CORRELATION_RADIUS, CORRELATION_RADIUS + 2, device=coords.device)
    out = []
    for level, volume in enumerate(volumes):
        rows, cols = volume.shape[-2:]
        # A centre further out than this sees only zeros; clamping keeps the integer conversion defined.
        centre = (coords / 2**level).clamp(-1e4, 1e4).reshape(-1, 2)
        corner = centre.floor()
        frac = (centre - corner).to(volume.dtype)
        x = corner[:, 0].long()[:, None] + steps
        y = corner[:, 1].long()[:, None] + steps
        # All 49 taps share one fraction, so 8 x 8 integer neighbours serve them all.
        inside = ((x >= 0) & (x < cols))[:, :, None] & ((y >= 0) & (y < rows))[:, None, :]
        index = x.clamp(0, cols - 1)[:, :, None] + y.clamp(0, rows - 1)[:, None, :] * cols
        patch = volume.reshape(edges * h * w, rows * cols).gather(1, index.flatten(1)).view_as(index) * inside
        fx, fy = frac[:, 0, None, None], frac[:, 1, None, None]
        patch = patch[:, :-1] * (1 - fx) + patch[:, 1:] * fx
        patch = patch[:, :, :-1] * (1 - fy) + patch[:, :, 1:] * fy
        out.append(patch.reshape(edges, h, w, side * side))
    return torch.cat(out, dim=-1).permute(0, 3, 1, 2)


def upsample_disparity(disparity: Tensor, mask: Tensor) -> Tensor:
    """Convex combination of the 3 x 3 neighbours: (n, h, w), (n, 576, h, w) logits -> (n, H, W)."""
    n, h, w = disparity.shape
    share = mask.view(n, 9, STRIDE_PX, STRIDE_PX, h, w).softmax(dim=1)
    neighbours = F.unfold(disparity[:, None], 3, padding=1).view(n, 9, 1, 1, h, w)
    full = (share * neighbours).sum(dim=1)
    return full.permute(0, 3, 1, 4, 2).reshape(n, STRIDE_PX * h, STRIDE_PX * w)
