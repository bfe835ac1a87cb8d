"""SPARK-2024, stream 2: ``images/RT500/img000...jpg`` and one CSV with the poses of all sequences.

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
    path = _only_csv(root)
    rows = _rows(path)
    camera = camera_from_label(K, SIZE, "spark")
    for name in sorted(rows):
        if sequences and name not in sequences:
            continue
        files = []
        for index, (line, row) in enumerate(sorted(rows[name], key=lambda item: item[1]["filename"])):
            image = named_in(root / "images", f"{name}/{row['filename']}", f"{path}, line {line}")
            if not image.is_file():
                raise DatasetError(f"{path}, line {line}: image {image} does not exist")
            quat, translation = [row[c] for c in _COLUMNS[5:]], [row[c] for c in _COLUMNS[2:5]]
            pose = pose_from_label(quat, translation, "xyzw", f"{path}, line {line}")
            files.append(ImageFile(stamp_of(index), image, pose))
        yield ImageRecording(name, camera, model, files)


def _only_csv(root: Path) -> Path:
    found = sorted(root.glob("*.csv"))
    if len(found) != 1:
        raise DatasetError(f"{root}: expected one CSV file beside 'images', found {len(found)}")
    return found[0]


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
