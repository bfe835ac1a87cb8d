"""Tables: PointCloud2 with named little-endian FLOAT64 columns.

It is the one message of ROS's common packages that is atomic, stamped, exact and takes any number of rows.

Names, order, types and sizes are checked; anything else is a :class:`~hat_ros.errors.WireError`. A table may grow at
its end only.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.errors import WireError
from hat_ros.io.message_family import MessageFamily

_FLOAT64 = 8
_EXACT_INT = 2.0**53


class TableWire(MessageFamily):
    """Encodes tables."""

    def __init__(
        self,
        message_class: Callable[[str], type],
        octets: Callable[[Any], Any],
        numbers: Callable[[Sequence[float]], Any],
    ) -> None:
        super().__init__(message_class, octets, numbers)
        self._fields: dict[tuple[str, ...], list[Any]] = {}

    def table(self, stamp_ns: int, frame_id: str, columns: tuple[str, ...], rows: Float) -> Any:
        """PointCloud2 of (N, C) float64 rows."""
        rows = np.ascontiguousarray(rows, dtype="<f8").reshape(-1, len(columns))
        return self._class("sensor_msgs/msg/PointCloud2")(
            header=self.header(stamp_ns, frame_id),
            height=1,
            width=len(rows),
            fields=self._point_fields(columns),
            is_bigendian=False,
            point_step=8 * len(columns),
            row_step=8 * len(columns) * len(rows),
            data=self._octets(rows.tobytes()),
            is_dense=bool(np.isfinite(rows).all()),
        )

    def _point_fields(self, columns: tuple[str, ...]) -> list[Any]:
        if columns not in self._fields:
            field = self._class("sensor_msgs/msg/PointField")
            self._fields[columns] = [
                field(name=name, offset=8 * i, datatype=_FLOAT64, count=1) for i, name in enumerate(columns)
            ]
        return list(self._fields[columns])


def read_table(message: Any, columns: tuple[str, ...], n_first: int | None = None) -> Float:
    """(N, C) float64 rows of a table message.

    Args:
        message: a PointCloud2.
        columns: the names that it must have, in this order.
        n_first: of a table that grew, how many columns it had at first. Those of an older writer that are missing
            behind them are NaN; what a newer one adds at the end is left out. None: just these columns.

    Raises:
        WireError: names, order, types, sizes or byte order are not exactly those promised.
    """
    names = tuple(field.name for field in message.fields)
    low, high = (len(columns), len(columns)) if n_first is None else (n_first, len(names))
    n_known = min(len(names), len(columns))
    if not low <= len(names) <= high or names[:n_known] != columns[:n_known]:
        raise WireError(f"table columns must be {' '.join(columns)}, found {' '.join(names) or 'none'}")
    for i, field in enumerate(message.fields):
        if (field.offset, field.datatype, field.count) != (8 * i, _FLOAT64, 1):
            raise WireError(
                f"table column '{field.name}' must be one FLOAT64 at offset {8 * i}, found datatype {field.datatype}, "
                f"count {field.count}, offset {field.offset}"
            )
    step, n = 8 * len(names), message.width
    if message.is_bigendian or message.height != 1 or message.point_step != step or message.row_step != step * n:
        raise WireError(
            f"table must be little-endian, height 1, point_step {step}, row_step {step * n}; found bigendian "
            f"{bool(message.is_bigendian)}, height {message.height}, point_step {message.point_step}, "
            f"row_step {message.row_step}"
        )
    if len(message.data) != step * n:
        raise WireError(f"table of {n} rows must hold {step * n} bytes, found {len(message.data)}")
    rows = np.full((n, len(columns)), np.nan)
    rows[:, :n_known] = np.frombuffer(message.data, dtype="<f8").reshape(n, len(names))[:, :n_known]
    return rows


def one_row(message: Any, columns: tuple[str, ...], n_first: int | None = None) -> dict[str, float]:
    """Column -> value of a table with exactly one row; arguments of :func:`read_table`.

    Raises:
        WireError: see :func:`read_table`, or another number of rows.
    """
    rows = read_table(message, columns, n_first)
    if len(rows) != 1:
        raise WireError(f"table must have one row, found {len(rows)}")
    return dict(zip(columns, rows[0].tolist(), strict=True))


def whole_number(name: str, value: float, low: int = 0) -> int:
    """A value that must be whole and at least ``low``."""
    if not (low <= value < _EXACT_INT) or value != int(value):
        raise WireError(f"column '{name}' must be a whole number from {low}, found {value}")
    return int(value)


def flag(name: str, value: float) -> bool:
    """A value that must be 0 or 1."""
    if value not in (0.0, 1.0):
        raise WireError(f"column '{name}' must be 0 or 1, found {value}")
    return value == 1.0


def check_poses(pose_rows: Float) -> None:
    """Refuse pose rows (..., 7) that are no poses.

    Raises:
        WireError: not finite, or the quaternion is not of unit length.
    """
    for row in pose_rows.reshape(-1, 7):
        if not np.isfinite(row).all() or abs(math.hypot(*row[3:]) - 1.0) > 1e-6:
            raise WireError(f"a pose must be finite with a unit quaternion, found {row.tolist()}")
