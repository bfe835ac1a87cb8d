"""Tables hold exactly what was agreed, or are rejected."""

from __future__ import annotations

import numpy as np
import pytest
from wire_samples import ROS, STAMP, candidates, through_dds

from hat_ros.errors import WireError
from hat_ros.io import messages, topics
from hat_ros.types import Candidates, Selection


def broken(change):
    message = through_dds(ROS.candidates(STAMP, "cam", candidates()))
    change(message)
    return message


def swap_names(message):
    message.fields[0].name, message.fields[1].name = "y", "x"


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (swap_names, "columns must be x y z"),
        (lambda m: m.fields.pop(), "columns must be"),
        (lambda m: setattr(m.fields[3], "datatype", 7), "column 'qx' must be one FLOAT64"),
        (lambda m: setattr(m.fields[3], "offset", 25), "offset 24"),
        (lambda m: setattr(m.fields[3], "count", 2), "count 2"),
        (lambda m: setattr(m, "is_bigendian", True), "little-endian"),
        (lambda m: setattr(m, "height", 2), "height 1"),
        (lambda m: setattr(m, "point_step", 96), "point_step 104"),
        (lambda m: setattr(m, "row_step", 0), "row_step 416"),
        (lambda m: setattr(m, "data", m.data[:-1]), "must hold 416 bytes, found 415"),
        (lambda m: setattr(m, "width", 3), "row_step 312"),
    ],
)
def test_tables_that_are_off_are_rejected(change, complaint):
    with pytest.raises(WireError, match=complaint):
        messages.candidates_from(broken(change))


def test_empty_tables_keep_their_fields():
    message = through_dds(ROS.candidates(STAMP, "cam", Candidates.none()))
    assert [field.name for field in message.fields] == list(topics.CANDIDATE_COLUMNS)
    assert len(messages.candidates_from(message)) == 0
    assert messages.selection_from(through_dds(ROS.selection(STAMP, "cam", Selection.none()))).selected == -1


def test_a_single_row_table_with_two_rows_is_rejected():
    message = ROS.table(STAMP, "cam", topics.ADMISSION_COLUMNS, np.zeros((2, len(topics.ADMISSION_COLUMNS))))
    with pytest.raises(WireError, match="one row, found 2"):
        messages.admitted_from(message)
