"""The report contains what it promises, in one file, with and without ground truth."""

import json
import re

import numpy as np
import pytest
from scripted import steps, truth

from hat_ros.bench.evaluation.figures import error_figure, image_bytes
from hat_ros.bench.evaluation.report import write_report
from hat_ros.bench.evaluation.score import score_run
from hat_ros.io.results import write_json
from hat_ros.io.run_log import RunLogBuilder


def log_of(true=True):
    builder = RunLogBuilder()
    for step in steps():
        builder.add(step.candidates, step.motion, step.estimate)
    return builder.build(truth() if true else {})


def page_of(tmp_path, log, strip=()):
    run = {"source": "/data/<clip>", "source_sha256": "abc123", "code": "deadbeef", "command": ["hat", "track"]}
    write_report(
        tmp_path / "report.html", "clip: hat", log, score_run(log), run, "keyframes:\n  gap_frames: 6\n", strip
    )
    return (tmp_path / "report.html").read_text()


def test_report_is_self_contained_and_traceable(tmp_path):
    strip = [("0.0 s, TRACKING", np.zeros((24, 32, 3), np.uint8))]
    page = page_of(tmp_path, log_of(), strip)
    assert not re.search(r'(src|href)="(?!data:)', page), "nothing is fetched"
    assert page.count("data:image/png") == 2, "errors over time, errors by range"
    assert page.count("data:image/jpeg") == 1
    for text in ("E_p mean", "coverage", "abc123", "deadbeef", "gap_frames: 6", "0.0 s, TRACKING"):
        assert text in page
    assert "&lt;clip&gt;" in page, "what comes from outside is escaped"
    assert "nan" not in re.sub(r'base64,[^"]*', "", page)


def test_report_without_truth_shows_the_poses(tmp_path):
    page = page_of(tmp_path, log_of(true=False))
    assert page.count("data:image/png") == 1
    assert "E_p mean" not in page


def test_figure_marks_what_happened():
    figure = error_figure(log_of())
    assert figure.axes[0].get_ylabel().startswith("rotation error")
    labels = [label.get_text() for label in figure.axes[3].get_yticklabels()]
    assert labels == ["keyframe", "anchor", "anchor gated", "reset"]
    states = {text.get_text() for text in figure.axes[3].get_legend().get_texts()}
    assert states == {"UNINITIALISED", "TRACKING", "COASTING", "LOST"}


@pytest.mark.parametrize("form", ["png", "svg", "pdf"])
def test_same_run_same_picture(form):
    assert image_bytes(error_figure(log_of()), form) == image_bytes(error_figure(log_of()), form)


def test_anchor_errors():
    errors = log_of().anchor_errors_deg()
    np.testing.assert_allclose(errors[[0, 4, 8]], 2.0)
    assert np.isnan(np.delete(errors, [0, 4, 8])).all()


def test_score_run_has_the_promised_fields(tmp_path):
    figures = score_run(log_of())
    assert figures["frames"] == figures["targets"] == 10
    assert figures["valid"] == 7
    assert figures["coverage"] == pytest.approx(0.7)
    assert figures["E_q_deg_mean"] == pytest.approx(np.mean([1, 2, 3, 4, 5, 6, 7]))
    assert figures["E_t_m_mean"] == pytest.approx(0.05)
    assert figures["oracle_within_15_share"] == 1.0
    assert figures["relative_motion_deg_median"] == pytest.approx(0.0, abs=1e-6)
    assert figures["state_lost"] == 2
    for name in ("E_p_mean", "E_p_sd", "E_t_m_sd", "E_q_deg_sd", "E_q_over_90_share", "inside_95_share"):
        assert name in figures
    write_json(tmp_path / "m.json", figures | {"empty": float("nan")})
    assert json.loads((tmp_path / "m.json").read_text())["empty"] is None


def test_frames_without_an_answer_lower_coverage():
    builder = RunLogBuilder()
    for step in steps(6):
        builder.add(step.candidates, step.motion, step.estimate)
    for known in (truth(6), {}):
        figures = score_run(builder.build(known), played=10, refused=3)
        assert (figures["frames"], figures["refused"], figures["dropped"]) == (10, 3, 1)
        assert (figures["targets"], figures["valid"], figures["coverage"]) == (10, 5, 0.5)
    builder.dropped_total = 4
    stopped = score_run(builder.build(truth(6)))
    assert (stopped["frames"], stopped["dropped"], stopped["coverage"]) == (10, 4, 0.5)


def test_score_of_an_empty_run():
    figures = score_run(RunLogBuilder().build({}))
    assert figures["frames"] == 0
    assert np.isnan(figures["E_p_mean"])
