"""The segmentation network as the tracker runs it: by OpenCV, no other library.

A small U-Net of depthwise separable convolutions with one encoder and two decoders. The first sees the image alone: its
output is evidence, log-odds of target against background. The second sees a prior silhouette as well (a predicted pose,
or the previous mask): its output decides the mask of a tracked frame. So no evidence is ever told the pose that it is
used to judge.
"""

from __future__ import annotations

from importlib.resources import as_file, files
from pathlib import Path

import cv2
import numpy as np

from hat_ros.array_types import Float32, UInt8
from hat_ros.errors import WeightsError

WEIGHTS_NAME = "segmenter.onnx"
# Both sides of an input must be multiples of this.
STRIDE = 32
# The prior silhouette is given at so many times the pixel size of the image.
PRIOR_STRIDE = 2
IMAGE, PRIOR, EVIDENCE, TRACKED = "image", "prior", "evidence", "tracked"
CHANNELS = 4

# Sides of the empty image that a network is tried on when it is loaded.
_TRIAL_PX = 2 * STRIDE
# Colours are centred and scaled as training images have them on average; the logarithm covers -2 to 2.
_SCALED = ((np.arange(256) / 255.0 - 0.35) / 0.3).astype(np.float32)
_STRETCHED = (np.log1p(np.arange(256)) / np.log(256.0) * 4.0 - 2.0).astype(np.float32)


def network_input(rgb: UInt8) -> Float32:
    """(1, CHANNELS, H, W) of an (H, W, 3) image: its colours, and its brightness on a logarithmic scale.

    What lies in shadow differs from black sky by a few grey levels, which the logarithm spreads.
    """
    out = np.empty((1, CHANNELS, *rgb.shape[:2]), np.float32)
    out[0, :3] = _SCALED[rgb].transpose(2, 0, 1)
    out[0, 3] = _STRETCHED[cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)]
    return out


class SegmentationNetwork:
    """Log-odds of target against background, pixel by pixel.

    Args:
        path: ONNX file as ``hat train segmenter`` writes it; None = the one that comes with the package.

    Raises:
        WeightsError: the file is missing, cannot be read, or is no such network.
    """

    def __init__(self, path: Path | None = None) -> None:
        if path is not None:
            self._net = _read(path)
        else:
            with as_file(files("hat_ros.segmentation").joinpath(WEIGHTS_NAME)) as packaged:
                self._net = _read(packaged)

    def evidence(self, rgb: UInt8) -> Float32:
        """(H, W) log-odds in nats from the image alone, (H, W, 3) uint8 with sides of multiples of STRIDE."""
        self._feed(rgb, None)
        return _joined(self._net.forward(EVIDENCE))

    def with_prior(self, rgb: UInt8, prior: Float32) -> tuple[Float32, Float32]:
        """Evidence, and log-odds given a prior silhouette, both (H, W).

        Args:
            rgb: (H, W, 3) uint8.
            prior: (H / PRIOR_STRIDE, W / PRIOR_STRIDE) float32, share of each cell inside the silhouette.
        """
        self._feed(rgb, prior)
        evidence, tracked = self._net.forward((EVIDENCE, TRACKED))
        return _joined(evidence), _joined(tracked)

    def _feed(self, rgb: UInt8, prior: Float32 | None) -> None:
        height, width = rgb.shape[:2]
        cells = np.zeros((1, 1, height // PRIOR_STRIDE, width // PRIOR_STRIDE), np.float32)
        if prior is not None:
            cells[0, 0] = prior - np.float32(0.5)
        self._net.setInput(network_input(rgb), IMAGE)
        self._net.setInput(cells, PRIOR)


def _read(path: Path) -> cv2.dnn.Net:
    """The network of a file, tried on an empty image: other networks load as well, and fail only when they are run."""
    if not path.is_file():
        raise WeightsError(f"{path}: no such file: segmentation.learned.weights must name an ONNX file, or be empty")
    try:
        net = cv2.dnn.readNetFromONNX(str(path))
        net.setInput(np.zeros((1, CHANNELS, _TRIAL_PX, _TRIAL_PX), np.float32), IMAGE)
        net.setInput(np.zeros((1, 1, _TRIAL_PX // PRIOR_STRIDE, _TRIAL_PX // PRIOR_STRIDE), np.float32), PRIOR)
        shapes = {cells.shape for cells in net.forward((EVIDENCE, TRACKED))}
    except cv2.error:
        shapes = set()
    if shapes != {(1, 4, _TRIAL_PX // 2, _TRIAL_PX // 2)}:
        raise WeightsError(
            f"{path}: no segmentation network: segmentation.learned.weights must name a segmenter.onnx that "
            f"`hat train segmenter` wrote, or be empty for the one in the package"
        )
    return net


def _joined(cells: np.ndarray) -> Float32:
    """(H, W) from (1, 4, H / 2, W / 2): each channel is one of the four pixels of a cell."""
    _, _, height, width = cells.shape
    return np.ascontiguousarray(cells.reshape(2, 2, height, width).transpose(2, 0, 3, 1).reshape(2 * height, 2 * width))
