"""What is derived from a result bag: tables of poses and errors, and reading them back."""

import csv

import numpy as np
import pytest
from scripted import stamp, steps, truth

from hat_ros.bench.evaluation.metrics import pose_errors
from hat_ros.bench.evaluation.result_folder import read_errors, read_folder, write_tables
from hat_ros.errors import UsageError
from hat_ros.geometry import lie
from hat_ros.geometry.symmetry import Symmetry, about_center
from hat_ros.io.run_log import RunLogBuilder
from hat_ros.types import TrackState


def run():
    builder = RunLogBuilder()
    for step in steps():
        builder.add(step.candidates, step.motion, step.estimate)
    return builder.build(truth())


def test_tables(tmp_path):
    write_tables(tmp_path, run(), Symmetry())
    rows = list(csv.DictReader((tmp_path / "poses.csv").open()))
    assert [int(row["stamp_ns"]) for row in rows] == [stamp(i) for i in range(10)]
    assert rows[0]["state"] == "UNINITIALISED"
    assert rows[0]["x_m"] == rows[0]["E_p"] == "", "no output has no error, not an error of zero"
    assert float(rows[3]["E_q_deg"]) == pytest.approx(3.0)
    assert float(rows[3]["E_t_m"]) == pytest.approx(0.05)
    assert rows[8]["state"] == TrackState.LOST.name
    assert rows[8]["qw"] == ""
    tum = (tmp_path / "poses.tum").read_text().splitlines()
    assert len(tum) == 7
    assert tum[0].startswith("1.100000000 ")


def test_errors_are_read_back_exactly(tmp_path):
    log = run()
    write_tables(tmp_path, log, Symmetry())
    errors = pose_errors(log.T_est, log.T_true)
    expected = np.column_stack([errors.translation_m, np.degrees(errors.rotation_rad), errors.pose, errors.pose])
    np.testing.assert_array_equal(read_errors(tmp_path), expected)
    assert np.isnan(expected).any()


def test_the_error_to_the_nearest_equal_stands_beside_the_plain_one(tmp_path):
    """The truth turned by a half turn that is a symmetry: the output is right all the same."""
    half = about_center(np.diag([-1.0, -1, 1]), np.zeros(3))
    log = run()
    turned = {stamp: lie.row_from_matrix(lie.matrix_from_row(row) @ half) for stamp, row in truth().items()}
    write_tables(tmp_path, log.with_truth(turned), Symmetry(np.stack([np.eye(4), half])))
    plain, nearest = read_errors(tmp_path)[:, 2:].T
    expected = pose_errors(log.T_est, log.T_true).pose
    np.testing.assert_allclose(nearest, expected, atol=1e-6)
    assert (plain[np.isfinite(plain)] > 2.0).all()


def test_a_table_of_an_older_run_has_no_error_to_the_nearest(tmp_path):
    (tmp_path / "poses.csv").write_text("stamp_ns,E_t_m,E_q_deg,E_p\n1,0.5,2.0,0.1\n")
    np.testing.assert_array_equal(read_errors(tmp_path), [[0.5, 2.0, 0.1, np.nan]])


@pytest.mark.parametrize(("name", "text"), [("run.json", "{"), ("metrics.json", None), ("config.yaml", None)])
def test_an_unfinished_folder_is_refused(tmp_path, name, text):
    for file in ("run.json", "metrics.json", "config.yaml"):
        (tmp_path / file).write_text("{}")
    assert read_folder(tmp_path) == ({}, {}, "{}")
    if text is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_text(text)
    with pytest.raises(UsageError, match="no finished result folder"):
        read_folder(tmp_path)
