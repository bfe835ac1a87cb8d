"""Whether a checkpoint is what a network will take: read and compared by the same code that a run loads it with."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from hat_ros.errors import MissingDependencyError, WeightsError
from hat_ros.nets.checkpoint import checkpoint_named, find, load_state, verify_companions, verify_fit
from hat_ros.nets.checkpoint_registry import Checkpoint

if TYPE_CHECKING:
    import torch

    State = dict[str, torch.Tensor]


@dataclass(frozen=True)
class WeightsStatus:
    """What :func:`check` found for one checkpoint.

    Attributes:
        checkpoint: the entry asked about.
        path: the file that a network would load, None when there is none.
        usable: a network can load it as it is.
        message: one sentence for people: what was found, and what to do if it is not usable.
    """

    checkpoint: Checkpoint
    path: Path | None
    usable: bool
    message: str


def check(name: str, folder: str | Path | None = None, allow_unverified: bool = False) -> WeightsStatus:
    """Whether a checkpoint is there, unaltered, and fits its network: it is read whole, as a run reads it.

    Args:
        name: registry name.
        folder: the weights folder.
        allow_unverified: another checksum than the published one will do.

    Raises:
        WeightsError: there is no such entry.
    """
    entry = checkpoint_named(name)
    path: Path | None = None
    try:
        path = find(name, folder)
        if entry.library_folder:
            from hat_ros.nets.mask2former_files import load_mask2former

            load_mask2former(path)
            return WeightsStatus(entry, path, True, f"{path}: every tensor fits the network")
        if path.suffix != ".safetensors" and not allow_unverified:
            verify_companions(entry, path.parent)
        state = load_state(name, folder, allow_unverified)
        verify_fit(_empty_network(name, state), state, name)
    except (WeightsError, MissingDependencyError) as error:
        return WeightsStatus(entry, path, False, str(error))
    verified = entry.sha256 and path.suffix != ".safetensors" and not allow_unverified
    confirmed = "published checksum confirmed, " if verified else ""
    return WeightsStatus(entry, path, True, f"{path}: {confirmed}{len(state)} tensors, all fit the network")


def _empty_network(name: str, state: State) -> torch.nn.Module:
    """The network that a checkpoint is for, without values: names and shapes only."""
    import torch

    with torch.device("meta"):
        return _NETWORKS[name](state)


def _droid(state: State) -> torch.nn.Module:
    from hat_ros.nets.droid import DroidNet

    return DroidNet(None)


def _megapose_coarse(state: State) -> torch.nn.Module:
    from hat_ros.nets import megapose

    return megapose.build_net(megapose.CoarseNet, state)


def _megapose_refiner(state: State) -> torch.nn.Module:
    from hat_ros.nets import megapose

    return megapose.build_net(megapose.RefinerNet, state)


def _picopose(state: State) -> torch.nn.Module:
    from hat_ros.nets.picopose import PicoPoseNet

    return PicoPoseNet()


def _gigapose(state: State) -> torch.nn.Module:
    from hat_ros.nets.gigapose import GigaPoseNet

    return GigaPoseNet()


_NETWORKS: dict[str, Callable[[State], torch.nn.Module]] = {
    "droid": _droid,
    "megapose_coarse": _megapose_coarse,
    "megapose_refiner": _megapose_refiner,
    "picopose": _picopose,
    "gigapose": _gigapose,
}
