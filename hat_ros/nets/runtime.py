"""Where a network runs: device, precision, and getting arrays there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hat_ros.config import NetsConfig
from hat_ros.errors import ConfigError


class Runtime:
    """Device and arithmetic of the learned backends.

    Args:
        config: the ``nets`` section.

    Raises:
        ConfigError: ``cuda`` is asked for and there is none.
    """

    def __init__(self, config: NetsConfig) -> None:
        if config.device == "cuda" and not torch.cuda.is_available():
            raise ConfigError("nets.device is 'cuda' but torch sees no such device; use 'auto' or 'cpu'")
        use_cuda = config.device == "cuda" or (config.device == "auto" and torch.cuda.is_available())
        self.device = torch.device("cuda" if use_cuda else "cpu")
        self.dtype = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}[config.precision]

    @property
    def reduced_precision(self) -> bool:
        """Whether networks compute in less than float32; never on the CPU."""
        return self.device.type != "cpu" and self.dtype != torch.float32

    def place(self, net: torch.nn.Module) -> Callable[..., Any]:
        """The network on the device, for inference only, and :meth:`wrap` around it."""
        return self.wrap(net.to(self.device).eval().requires_grad_(False))

    def wrap(self, net: torch.nn.Module) -> Callable[..., Any]:
        """A placed network that computes in the chosen precision and answers in float32.

        Reduced precision covers the network alone: the geometry around it (boxes, poses) stays in float32, and so does
        everything on the CPU, where parity is promised.
        """
        if not self.reduced_precision:
            return net

        def run(*inputs: torch.Tensor) -> Any:
            with torch.autocast(self.device.type, dtype=self.dtype):
                out = net(*inputs)
            return [x.float() for x in out] if isinstance(out, (list, tuple)) else out.float()

        return run

    def tensor(self, array: NDArray) -> torch.Tensor:
        """float32 tensor on the device."""
        return torch.from_numpy(np.ascontiguousarray(array, dtype=np.float32)).to(self.device)

    def image(self, rgb: NDArray[np.uint8]) -> torch.Tensor:
        """(H, W, 3) uint8 -> (3, H, W) float32 in [0, 1] on the device; moved as bytes."""
        moved = torch.from_numpy(np.ascontiguousarray(rgb)).to(self.device)
        return moved.permute(2, 0, 1).float() / 255
