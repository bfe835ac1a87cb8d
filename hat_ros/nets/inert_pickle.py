"""Reading pickled checkpoints without running them: tensors and plain containers are real, all else is inert."""

from __future__ import annotations

import collections
import pickle
import pickletools
import types
from typing import IO, Any

import torch

# Objects in one file; the largest public checkpoints have some thousands.
_MAX_MEMO = 10_000_000


class _Placeholder:
    """Stands for every object of a pickle that is neither a tensor nor a plain container."""

    def __init__(self, *_args: Any, **_kwargs: Any) -> None:
        pass

    def __call__(self, *_args: Any, **_kwargs: Any) -> _Placeholder:
        return self

    def __setstate__(self, _state: Any) -> None:
        pass

    def __setitem__(self, _key: Any, _value: Any) -> None:
        pass

    def __hash__(self) -> int:
        return 0

    def append(self, _item: Any) -> None:
        """Accept list items of an unknown list subclass."""

    def extend(self, _items: Any) -> None:
        """Accept list items of an unknown list subclass."""


def _check_memo(stream: IO[bytes]) -> None:
    """Refuse a pickle that numbers its objects absurdly: for a few bytes the reader would fill up to 64 GiB.

    Raises:
        pickle.UnpicklingError: a number above ``_MAX_MEMO``.
    """
    start = stream.tell()
    for code, value, _ in pickletools.genops(stream):
        if code.name in ("PUT", "LONG_BINPUT") and isinstance(value, int) and value > _MAX_MEMO:
            raise pickle.UnpicklingError(f"object number {value} is too large")
    stream.seek(start)


def inert_pickle() -> types.ModuleType:
    """A stand-in for :mod:`pickle` whose reader resolves tensors and plain containers, and nothing else."""
    allowed: dict[tuple[str, str], Any] = {
        ("collections", "OrderedDict"): collections.OrderedDict,
        ("torch", "Size"): torch.Size,
        ("torch", "device"): torch.device,
        ("torch._utils", "_rebuild_tensor_v2"): torch._utils._rebuild_tensor_v2,
        ("torch._utils", "_rebuild_parameter"): torch._utils._rebuild_parameter,
    }

    class Unpickler(pickle.Unpickler):
        def __init__(self, stream: IO[bytes], **options: Any) -> None:
            _check_memo(stream)
            super().__init__(stream, **options)

        # torch answers for its storage types itself before it asks here.
        def find_class(self, module: str, name: str) -> Any:
            return allowed.get((module, name), _Placeholder)

    stand_in = types.ModuleType("inert_pickle")
    stand_in.Unpickler = Unpickler  # type: ignore[attr-defined]
    stand_in.load = lambda stream, **options: Unpickler(stream, **options).load()  # type: ignore[attr-defined]
    return stand_in
