"""Reading pickled checkpoints without running them: tensors and plain containers are real, all else is inert."""

from __future__ import annotations

import collections
import pickle
import types
from typing import Any

import torch


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
        # torch answers for its storage types itself before it asks here.
        def find_class(self, module: str, name: str) -> Any:
            return allowed.get((module, name), _Placeholder)

    stand_in = types.ModuleType("inert_pickle")
    stand_in.Unpickler = Unpickler  # type: ignore[attr-defined]
    stand_in.load = lambda stream, **options: Unpickler(stream, **options).load()  # type: ignore[attr-defined]
    return stand_in
