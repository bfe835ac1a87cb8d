"""A weights folder full of rule weights, so that the learned backends run end to end (their poses mean nothing)."""

from pathlib import Path

import torch
from safetensors.torch import save_file
from weight_rule import rule_state


def save_rule_weights(folder: Path, name: str, net: torch.nn.Module) -> None:
    """Write ``<name>.safetensors`` for a network."""
    folder.mkdir(parents=True, exist_ok=True)
    save_file({key: value.contiguous() for key, value in rule_state(net).items()}, str(folder / f"{name}.safetensors"))
