"""The segmentation network in PyTorch, and its export to ONNX; how it is run: :mod:`hat_ros.segmentation.network`."""

from __future__ import annotations

import warnings
from itertools import pairwise
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn.functional import avg_pool2d, interpolate

from hat_ros.segmentation.network import CHANNELS, EVIDENCE, IMAGE, PRIOR, PRIOR_STRIDE, STRIDE, TRACKED

# Channels of the five scales (1/2 to 1/32 of the image), and blocks at each: few where cells are many.
_WIDTHS = (16, 32, 64, 128, 192)
_DEPTHS = (1, 2, 3, 4, 5)
# Pixels per cell of the finest scale, which has half the image's resolution: the last layer gives all of them.
_PIXELS = 4

# Operators of this ONNX version load in OpenCV 4.6 to 5.
_OPSET = 11
# Sides of the example that the graph is written for; OpenCV infers the shapes again for other inputs.
_EXAMPLE_PX = 5 * STRIDE


class _Block(nn.Module):
    """Depthwise, then pointwise convolution, each with its normalisation; added to the input where sizes allow."""

    def __init__(self, inputs: int, outputs: int, stride: int = 1) -> None:
        super().__init__()
        self.residual = inputs == outputs and stride == 1
        self.depthwise = nn.Sequential(
            nn.Conv2d(inputs, inputs, 3, stride, 1, groups=inputs, bias=False), nn.BatchNorm2d(inputs)
        )
        self.pointwise = nn.Sequential(nn.Conv2d(inputs, outputs, 1, bias=False), nn.BatchNorm2d(outputs))

    def forward(self, x: Tensor) -> Tensor:
        """(N, inputs, H, W) to (N, outputs, H / stride, W / stride)."""
        y = self.pointwise(torch.relu(self.depthwise(x)))
        return torch.relu(x + y if self.residual else y)


class _Decoder(nn.Module):
    """From the coarsest scale back to the pixels; the encoder's features are added at every scale, and the prior."""

    def __init__(self, with_prior: bool) -> None:
        super().__init__()
        wide = _WIDTHS[::-1]
        self.narrow = nn.ModuleList(
            nn.Sequential(nn.Conv2d(coarse, fine, 1, bias=False), nn.BatchNorm2d(fine))
            for coarse, fine in pairwise(wide)
        )
        self.prior = nn.ModuleList(nn.Conv2d(1, fine, 3, 1, 1) for fine in wide[1:] if with_prior)
        self.blocks = nn.ModuleList(_Block(fine, fine) for fine in wide[1:])
        self.last = nn.Conv2d(_WIDTHS[0], _PIXELS, 3, 1, 1)

    def forward(self, features: list[Tensor], priors: list[Tensor]) -> Tensor:
        """Features and priors from fine to coarse, no priors for a decoder without; (N, 4, H / 2, W / 2) log-odds."""
        y = features[-1]
        for step, (narrow, block) in enumerate(zip(self.narrow, self.blocks, strict=True)):
            level = len(features) - 2 - step
            y = interpolate(narrow(y), scale_factor=2.0, mode="nearest") + features[level]
            if priors:
                y = y + self.prior[step](priors[level])
            y = block(torch.relu(y))
        return self.last(y)


class Segmenter(nn.Module):
    """Image and prior to the log-odds of both decoders, (N, 4, H / 2, W / 2) each."""

    def __init__(self) -> None:
        super().__init__()
        finest = _WIDTHS[0]
        stem = nn.Sequential(nn.Conv2d(CHANNELS, finest, 3, 2, 1, bias=False), nn.BatchNorm2d(finest), nn.ReLU())
        scales = [nn.Sequential(stem, *(_Block(finest, finest) for _ in range(_DEPTHS[0])))]
        for level in range(1, len(_WIDTHS)):
            inputs, outputs = _WIDTHS[level - 1], _WIDTHS[level]
            more = (_Block(outputs, outputs) for _ in range(_DEPTHS[level] - 1))
            scales.append(nn.Sequential(_Block(inputs, outputs, 2), *more))
        self.encoder = nn.ModuleList(scales)
        self.evidence, self.tracked = _Decoder(with_prior=False), _Decoder(with_prior=True)

    def forward(self, image: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
        """(N, CHANNELS, H, W) and (N, 1, H / PRIOR_STRIDE, W / PRIOR_STRIDE) to cells of log-odds."""
        features = []
        for scale in self.encoder:
            image = scale(image)
            features.append(image)
        priors = [prior]
        for _ in features[1:]:
            priors.append(avg_pool2d(priors[-1], 2))
        return self.evidence(features, []), self.tracked(features, priors)


def joined(cells: Tensor) -> Tensor:
    """(N, H, W) pixels from (N, 4, H / 2, W / 2) cells."""
    return nn.functional.pixel_shuffle(cells, 2)[:, 0]


def export(model: Segmenter, path: Path, scales: tuple[float, float], offsets: tuple[float, float]) -> None:
    """Write the network as ONNX, its normalisations and its calibration folded into the convolutions.

    Args:
        model: trained.
        path: file to write.
        scales: factor of the log-odds of each decoder, from the calibration.
        offsets: added after it, nats.
    """
    folded = folded_copy(model)
    with torch.no_grad():
        for decoder, scale, offset in zip((folded.evidence, folded.tracked), scales, offsets, strict=True):
            for parameter in decoder.last.parameters():
                parameter.mul_(scale)
            decoder.last.get_parameter("bias").add_(offset)
    image = torch.zeros(1, CHANNELS, _EXAMPLE_PX, _EXAMPLE_PX)
    prior = torch.zeros(1, 1, _EXAMPLE_PX // PRIOR_STRIDE, _EXAMPLE_PX // PRIOR_STRIDE)
    with warnings.catch_warnings():
        # The newer exporter begins at opset 18, which OpenCV 4.6 cannot read.
        warnings.simplefilter("ignore", DeprecationWarning)
        torch.onnx.export(
            folded,
            (image, prior),
            str(path),
            input_names=[IMAGE, PRIOR],
            output_names=[EVIDENCE, TRACKED],
            opset_version=_OPSET,
            dynamo=False,
        )


def folded_copy(model: Segmenter) -> Segmenter:
    """The trained function without normalisations: each is folded into the convolution before it."""
    copy = Segmenter()
    copy.load_state_dict(model.state_dict())
    copy.eval()
    for module in list(copy.modules()):
        if isinstance(module, nn.Sequential):
            for (name, convolution), (next_name, norm) in pairwise(list(module.named_children())):
                if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
                    setattr(module, name, nn.utils.fuse_conv_bn_eval(convolution, norm))
                    setattr(module, next_name, nn.Identity())
    return copy
