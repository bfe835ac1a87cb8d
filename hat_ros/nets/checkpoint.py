"""Public network weights: where they come from, where they go, and how they are read safely.

Nothing is ever downloaded. A checkpoint is looked for in one folder: ``nets.weights_folder``, else ``$HAT_WEIGHTS``,
else ``$XDG_DATA_HOME/hat_ros/weights``, or up to two folders below, as publishers lay it out. A pickled file is opened
only after its SHA-256 agrees with the published one or the user allows another, and then with ``weights_only=True``;
safetensors hold no code, so for them names and shapes are the whole check. :func:`convert` turns a pickled file into
safetensors once, reading it without running anything that it names.

This module imports torch and safetensors only inside the functions that read tensors, so that listing and checking
work without them.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hat_ros.errors import MissingDependencyError, WeightsError
from hat_ros.nets.checkpoint_registry import CHECKPOINTS, Checkpoint

if TYPE_CHECKING:
    import torch

LOG = logging.getLogger(__name__)

_NO_CHECKSUM = "none published"


def weights_folder(folder: str | Path | None = None) -> Path:
    """Folder of the checkpoints: the argument, else ``$HAT_WEIGHTS``, else the user's data folder."""
    chosen = folder or os.environ.get("HAT_WEIGHTS")
    if chosen:
        return Path(chosen).expanduser()
    data = os.environ.get("XDG_DATA_HOME") or "~/.local/share"
    return Path(data).expanduser() / "hat_ros" / "weights"


def checkpoint_named(name: str) -> Checkpoint:
    """The registry's entry.

    Raises:
        WeightsError: there is no such entry.
    """
    try:
        return CHECKPOINTS[name]
    except KeyError:
        raise WeightsError(f"no checkpoint is called '{name}', known are {', '.join(CHECKPOINTS)}") from None


def find(name: str, folder: str | Path | None = None) -> Path:
    """Path of the checkpoint on this machine, the safetensors file first.

    Raises:
        WeightsError: it is not there; the message names file, source, checksum and folder.
    """
    entry = checkpoint_named(name)
    root = weights_folder(folder)
    file = entry.filename
    if entry.library_folder:
        # The last: as the publisher's own tools keep what they have fetched.
        patterns = [f"{place}/config.json" for place in (file, f"*/{file}", f"models--*--{file}/snapshots/*")]
    else:
        patterns = [entry.converted_filename, file, f"*/{file}", f"*/*/{file}"]
    found = [path for pattern in patterns for path in sorted(root.glob(pattern)) if path.is_file()]
    if found:
        return found[0].parent if entry.library_folder else found[0]
    names = f"the folder {entry.filename} is not"
    if not entry.library_folder:
        names = f"neither {entry.filename} nor {entry.converted_filename} is"
    raise WeightsError(
        f"{name}: {names} in {root}; get {entry.filename} from "
        f"{entry.source} (SHA-256 {entry.sha256 or _NO_CHECKSUM}, licence: {entry.licence}) and put it there, or "
        f"point HAT_WEIGHTS or nets.weights_folder at the folder that holds it"
    )


def sha256_of(path: Path) -> str:
    """Hexadecimal SHA-256 of a file, read in blocks."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()


def verify_companions(entry: Checkpoint, folder: Path) -> None:
    """Check the small files that belong beside a checkpoint.

    Raises:
        WeightsError: one is missing or altered.
    """
    for name, digest in entry.companions:
        file = folder / Path(name).name
        if not file.is_file():
            raise WeightsError(f"{file} is missing: get it from {entry.source}")
        _verify(entry, file, digest)


def load_state(name: str, folder: str | Path | None = None, allow_unverified: bool = False) -> dict[str, torch.Tensor]:
    """Tensors of a checkpoint on the CPU, under the names that our networks use.

    Args:
        name: registry name.
        folder: the weights folder.
        allow_unverified: take a file of another checksum than the published one, with a warning.

    Raises:
        WeightsError: missing, altered, unreadable, or not a flat mapping of names to tensors.
        MissingDependencyError: torch or safetensors is not installed.
    """
    entry = checkpoint_named(name)
    path = find(name, folder)
    if entry.library_folder:
        raise WeightsError(f"{name}: {path} is a folder for the transformers library, not a state dict")
    if path.suffix == ".safetensors":
        return _read_safetensors(path)
    _verify(entry, path, entry.sha256, allow_unverified)
    torch = _import("torch")
    _refuse_program(path)
    try:
        data = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError:
        raise WeightsError(
            f"{path}: holds more than tensors, so it is not opened directly; run `hat weights convert {name}` once"
        ) from None
    except Exception as error:  # of a damaged file the library lets out whatever its parsers meet
        raise WeightsError(f"{path}: is not a readable torch file ({_one_line(error)})") from None
    return _normalised(entry, path, data)


def load_into(module: torch.nn.Module, state: Mapping[str, torch.Tensor], name: str) -> None:
    """Copy a state dict into a network: every tensor of it, same names, same shapes, finite values.

    What else a publisher stored beside them (a head for training, say) is left out, and said.

    Args:
        module: the network.
        state: tensor names -> tensors.
        name: what the error messages call the checkpoint.

    Raises:
        WeightsError: a tensor is missing, has another shape, or a value is not finite.
    """
    verify_fit(module, state, name)
    wanted = module.state_dict()
    if extra := [key for key in state if key not in wanted]:
        LOG.info("%s: %d tensors that the network does not have are left out%s", name, len(extra), _some(extra))
    module.load_state_dict({key: state[key] for key in wanted}, strict=True)


def verify_fit(module: torch.nn.Module, state: Mapping[str, torch.Tensor], name: str) -> None:
    """What :func:`load_into` requires, without copying; the network's own tensors need no values.

    Raises:
        WeightsError: as there.
    """
    wanted = module.state_dict()
    missing = [key for key in wanted if key not in state]
    if missing:
        raise WeightsError(
            f"{name}: the checkpoint does not fit the network: {len(missing)} tensors missing{_some(missing)}; "
            f"it must be the file named by `hat weights list`"
        )
    for key in wanted:
        tensor = state[key]
        if tuple(tensor.shape) != tuple(wanted[key].shape):
            raise WeightsError(
                f"{name}: tensor '{key}' must have shape {tuple(wanted[key].shape)}, found {tuple(tensor.shape)}; "
                f"it must be the file named by `hat weights list`"
            )
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise WeightsError(f"{name}: tensor '{key}' holds values that are not finite; get the file again")


def convert(
    name: str, source: str | Path | None = None, folder: str | Path | None = None, allow_unverified: bool = False
) -> Path:
    """Rewrite a pickled checkpoint as ``<name>.safetensors`` in the weights folder; returns the new path.

    The pickle is read with a reader that knows tensors and plain containers only. Anything else that the file names
    (training settings, library classes) becomes an inert placeholder: nothing of it is imported or called.

    Args:
        name: registry name.
        source: the pickled file; default is its place in the weights folder.
        folder: the weights folder.
        allow_unverified: take a file of another checksum than the published one, with a warning.

    Raises:
        WeightsError: the file is missing, altered, a TorchScript archive, or holds no state dict.
        MissingDependencyError: torch or safetensors is not installed.
    """
    entry = checkpoint_named(name)
    if entry.library_folder:
        raise WeightsError(f"{name}: comes as a folder for the transformers library; there is nothing to convert")
    root = weights_folder(folder)
    places = sorted(path for above in ("", "*/", "*/*/") for path in root.glob(above + entry.filename))
    path = Path(source).expanduser() if source else next(iter(places), root / entry.filename)
    if not path.is_file():
        raise WeightsError(f"{name}: {path} is not a file; get {entry.filename} from {entry.source}")
    digest = _verify(entry, path, entry.sha256, allow_unverified)
    torch, safetensors = _import("torch"), _import("safetensors.torch")
    from hat_ros.nets.inert_pickle import inert_pickle

    _refuse_program(path)
    try:
        data = torch.load(path, map_location="cpu", weights_only=False, pickle_module=inert_pickle())
    except Exception as error:  # of a damaged file the library lets out whatever its parsers meet
        raise WeightsError(f"{path}: is not a readable torch file ({_one_line(error)})") from None
    state = {key: tensor.clone().contiguous() for key, tensor in _normalised(entry, path, data).items()}
    root.mkdir(parents=True, exist_ok=True)
    out = root / entry.converted_filename
    partial = out.with_suffix(".partial")
    safetensors.save_file(state, str(partial), metadata={"checkpoint": name, "source_sha256": digest})
    partial.replace(out)
    return out


def _verify(entry: Checkpoint, path: Path, expected: str, allow_unverified: bool = False) -> str:
    """SHA-256 of the file; raises when it differs from the published one, unless that is allowed."""
    digest = sha256_of(path)
    if not expected or digest == expected:
        return digest
    if not allow_unverified:
        raise WeightsError(
            f"{entry.name}: {path} has SHA-256 {digest}, published is {expected}: the file is damaged or another "
            f"version; get it again from {entry.source}, or, if you know it, go on with --allow-unverified "
            f"(nets.allow_unverified)"
        )
    LOG.warning("%s: %s has SHA-256 %s, published is %s; taken all the same", entry.name, path, digest, expected)
    return digest


def _refuse_program(path: Path) -> None:
    """Refuse a TorchScript archive: torch would run the code in it, whatever pickle reader it is given.

    It is told by the entries that torch itself goes by, listed with torch's own reader: no other reading of the same
    bytes can differ. A file that is no zip holds no such archive.
    """
    with path.open("rb") as stream:
        if stream.read(4) != b"PK\x03\x04":
            return
    reader = _import("torch")._C.PyTorchFileReader
    try:
        records = reader(str(path)).get_all_records()
    except (RuntimeError, ValueError) as error:  # the second: names that are no UTF-8
        raise WeightsError(f"{path}: is not a readable torch file ({_one_line(error)})") from None
    if any(record == "constants.pkl" or record.startswith("code/") for record in records):
        raise WeightsError(
            f"{path}: is a TorchScript archive, a program instead of weights; it is not opened: get the state dict"
        )


def _read_safetensors(path: Path) -> dict[str, torch.Tensor]:
    safetensors, errors = _import("safetensors.torch"), _import("safetensors")
    try:
        return safetensors.load_file(str(path))
    except (errors.SafetensorError, OSError, ValueError, KeyError, RuntimeError) as error:
        raise WeightsError(f"{path}: is not a readable safetensors file ({_one_line(error)})") from None


def _normalised(entry: Checkpoint, path: Path, data: Any) -> dict[str, torch.Tensor]:
    """State dict out of what the file held: container opened, prefixes renamed, unused rows cut."""
    torch = _import("torch")
    if entry.container:
        data = data.get(entry.container) if isinstance(data, Mapping) else None
    if not isinstance(data, Mapping) or not data or not all(isinstance(value, torch.Tensor) for value in data.values()):
        where = f"under '{entry.container}'" if entry.container else "at its top level"
        raise WeightsError(f"{entry.name}: {path} holds no mapping of names to tensors {where}; get the public file")
    state = dict(_renamed(entry, data))
    for key, rows in entry.cut_rows:
        if key in state:
            state[key] = state[key][:rows]
    return state


def _renamed(entry: Checkpoint, data: Mapping[str, torch.Tensor]) -> Iterator[tuple[str, torch.Tensor]]:
    for key, tensor in data.items():
        for old, new in entry.renames:
            if key.startswith(old):
                key = new + key[len(old) :]
                break
        yield key, tensor


def _import(module: str) -> Any:
    try:
        return __import__(module, fromlist=["_"])
    except ModuleNotFoundError as error:
        raise MissingDependencyError(
            f"reading network weights needs the package '{error.name}', which is not installed: "
            f"run `make install-nets` (or `pip install 'hat_ros[nets]'`)"
        ) from None


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:160]


def _some(keys: list[str]) -> str:
    return f" ({', '.join(keys[:3])}{', ...' if len(keys) > 3 else ''})" if keys else ""
