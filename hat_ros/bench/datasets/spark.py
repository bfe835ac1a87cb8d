"""SPARK-2024, stream 2: ``images/RT500/img000...jpg`` and CSV files with the poses of the sequences.

Columns: sequence, filename, Tx, Ty, Tz, Qx, Qy, Qz, Qw (scalar last); ``p_cam = R(q) p + T``, metres. The camera is
the published one; images have no lens distortion.
"""

from __future__ import annotations

import csv
from collections.abc import Collection, Iterator
from pathlib import Path

from hat_ros.bench.datasets.image_files import ImageFile, ImageRecording, camera_from_label, pose_from_label, stamp_of
from hat_ros.bench.datasets.sequence import named_in
from hat_ros.errors import DatasetError

SIZE = (1440, 1080)
K = ((1744.922, 0.0, 720.0), (0.0, 1746.586, 540.0), (0.0, 0.0, 1.0))
_COLUMNS = ("sequence", "filename", "tx", "ty", "tz", "qx", "qy", "qz", "qw")


def open_spark(root: Path, model: Path | None = None, sequences: Collection[str] = ()) -> Iterator[ImageRecording]:
    """Recordings of a SPARK folder, one per sequence of the CSV.

    Args:
        root: folder with ``images`` and the CSV.
        model: CAD model in metres; required, the data set brings none.
        sequences: names such as ``RT500`` to keep, empty = all.

    Raises:
        DatasetError: missing folders, malformed CSV, missing images.
    """
    if model is None:
        raise DatasetError("spark: name the CAD model with --model, the data set brings none")
    rows = _all_rows(root)
    camera = camera_from_label(K, SIZE, "spark")
    for name in sorted(rows):
        if sequences and name not in sequences:
            continue
        files = []
        for index, (filename, (where, row)) in enumerate(sorted(rows[name].items())):
            image = named_in(root / "images", f"{name}/{filename}", where)
            if not image.is_file():
                raise DatasetError(f"{where}: image {image} does not exist")
            quat, translation = [row[c] for c in _COLUMNS[5:]], [row[c] for c in _COLUMNS[2:5]]
            pose = pose_from_label(quat, translation, "xyzw", where)
            files.append(ImageFile(stamp_of(index), image, pose))
        yield ImageRecording(name, camera, model, files)


def _all_rows(root: Path) -> dict[str, dict[str, tuple[str, dict[str, str]]]]:
    """Sequence -> image -> (where it stands, row by lower-case column name), of all CSV files beside ``images``.

    A file without the columns is left out where another has them; an image that stands twice must be the same.
    """
    paths = sorted(root.glob("*.csv"))
    out: dict[str, dict[str, tuple[str, dict[str, str]]]] = {}
    failure: DatasetError | None = None
    if not paths:
        raise DatasetError(f"{root}: expected a CSV file beside 'images', found none")
    for path in paths:
        try:
            rows = _rows(path)
        except DatasetError as error:
            failure = failure or error
            continue
        for sequence, entries in rows.items():
            for line, row in entries:
                where, known = out.setdefault(sequence, {}).setdefault(row["filename"], (f"{path}, line {line}", row))
                if any(known[column] != row[column] for column in _COLUMNS):
                    raise DatasetError(f"{path}, line {line}: {sequence}/{row['filename']} has another pose in {where}")
    if not out and failure is not None:
        raise failure
    return out


def _rows(path: Path) -> dict[str, list[tuple[int, dict[str, str]]]]:
    """Sequence -> (line number, row by lower-case column name)."""
    out: dict[str, list[tuple[int, dict[str, str]]]] = {}
    try:
        with path.open(newline="", encoding="utf-8-sig") as file:
            reader = csv.reader(file)
            header = [column.strip().lower() for column in next(reader, [])]
            missing = [column for column in _COLUMNS if column not in header]
            if missing:
                raise DatasetError(f"{path}: column '{missing[0]}' is missing, found {', '.join(header) or 'nothing'}")
            for row in reader:
                if not row:
                    continue
                if len(row) != len(header):
                    raise DatasetError(f"{path}, line {reader.line_num}: {len(row)} values for {len(header)} columns")
                entry = dict(zip(header, (value.strip() for value in row), strict=True))
                out.setdefault(entry["sequence"], []).append((reader.line_num, entry))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise DatasetError(f"{path}: cannot be read as CSV ({error})") from None
    if not out:
        raise DatasetError(f"{path}: no rows below the header")
    return out
