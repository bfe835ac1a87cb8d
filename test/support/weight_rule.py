"""Weights made from nothing but their names and shapes.

The public checkpoints cannot be shipped. The recorded reference answers under test/data were made with weights drawn
by this rule, so a network that agrees with them in every name and shape computes the same numbers.
"""

import math
import zlib

import numpy as np
import torch


def rule_values(name: str, shape: tuple[int, ...]) -> np.ndarray:
    """float32 values: PCG64 seeded by the CRC-32 of the name; fan-in scaled matrices, vectors near one or zero."""
    rng = np.random.Generator(np.random.PCG64(zlib.crc32(name.encode("utf-8")) & 0xFFFFFFFF))
    z = rng.standard_normal(shape)
    if len(shape) >= 2:
        z = z * (0.7 * math.sqrt(2 / math.prod(shape[1:])))
    else:
        last = name.rsplit(".", 1)[-1]
        if last in ("weight", "gamma"):
            z = 1 + 0.05 * z
        elif last == "running_var":
            z = 1 + 0.1 * np.abs(z)
        else:
            z = 0.05 * z
    return z.astype(np.float32)


def rule_state(net: torch.nn.Module) -> dict[str, torch.Tensor]:
    """A state dict of rule weights for a network; integer tensors are zero."""
    return {
        name: torch.from_numpy(rule_values(name, tuple(value.shape)))
        if value.is_floating_point()
        else torch.zeros_like(value)
        for name, value in net.state_dict().items()
    }


def rule_filled(net: torch.nn.Module) -> torch.nn.Module:
    """The network with rule weights, in evaluation mode."""
    net.load_state_dict(rule_state(net))
    return net.eval()
