"""Where a network runs: device, precision, and getting arrays there."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from hat_ros.array_types import UInt8
from hat_ros.config import NetsConfig
from hat_ros.errors import ConfigError

_PRECISIONS = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
NETWORKS = ("mask2former", "megapose", "picopose", "gigapose", "droid")
# Larger batches fall out of the processor's cache: measured a quarter slower at 64 images of 240 x 320.
_CPU_BATCH = 8


class Runtime:
    """Device and arithmetic of a learned backend.

    Args:
        config: the ``nets`` section.
        network: name by which ``nets.device`` may give it a device of its own, one of :data:`NETWORKS`.
        as_released: what ``nets.precision: auto`` means on an accelerator: the precision that the network was
            published to run in.

    Attributes:
        device: where the network and its tensors live.
        dtype: what the network computes in; float32 on the CPU, whatever the configuration says.

    Raises:
        ConfigError: the device is unknown or not on this machine.
    """

    def __init__(self, config: NetsConfig, network: str, as_released: torch.dtype = torch.float32) -> None:
        self.device = choose_device(device_of(config.device, network))
        named = as_released if config.precision == "auto" else _PRECISIONS[config.precision]
        self.dtype = torch.float32 if self.device.type == "cpu" else named

    @property
    def reduced_precision(self) -> bool:
        """Whether networks compute in less than float32; never on the CPU."""
        return self.dtype != torch.float32

    def place(self, net: torch.nn.Module) -> Callable[..., Any]:
        """The network on the device, for inference only, and :meth:`wrap` around it."""
        # Channels last: what convolutions are fastest in, an eighth on the CPU and more on tensor cores.
        # torch documents the argument, its declared overloads lack it.
        net = net.to(self.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        return self.wrap(net.eval().requires_grad_(False))

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
        """float32 tensor on the device; an array that may not be written, such as a mapped file, is copied."""
        values = np.ascontiguousarray(array, dtype=np.float32)
        return torch.from_numpy(values if values.flags.writeable else values.copy()).to(self.device)

    def image(self, rgb: UInt8) -> torch.Tensor:
        """(H, W, 3) uint8 -> (3, H, W) float32 in [0, 1] on the device; moved as bytes."""
        moved = torch.from_numpy(np.ascontiguousarray(rgb)).to(self.device)
        return moved.permute(2, 0, 1).float() / 255

    def batches(self, n_images: int, size: int) -> Iterator[slice]:
        """Slices that cover ``n_images``, at most ``size`` images each and no more than pays on this device."""
        step = size if self.device.type != "cpu" else min(size, _CPU_BATCH)
        for start in range(0, n_images, step):
            yield slice(start, min(start + step, n_images))


def device_of(names: str, network: str) -> str:
    """The device that ``nets.device`` names for a network: its own, else the one for all.

    Raises:
        ConfigError: a part is malformed or names no network.
    """
    chosen, own = "auto", {}
    for part in names.split(","):
        key, separator, device = (word.strip() for word in part.rpartition("="))
        if not separator:
            chosen = device
        elif key in NETWORKS:
            own[key] = device
        else:
            raise ConfigError(f"nets.device: '{key}' is no network, known are {', '.join(NETWORKS)}")
    return own.get(network, chosen)


def choose_device(name: str) -> torch.device:
    """Device of a configuration value.

    Raises:
        ConfigError: unknown, or CUDA is asked for and absent.
    """
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        device = None
    if device is None or device.type not in ("cpu", "cuda"):
        raise ConfigError(f"nets.device: '{name}' is not a device, use auto, cpu, cuda or cuda:N")
    if device.type == "cuda" and (device.index or 0) >= torch.cuda.device_count():
        raise ConfigError(f"nets.device: '{name}' is not on this machine, use auto or cpu")
    return device
