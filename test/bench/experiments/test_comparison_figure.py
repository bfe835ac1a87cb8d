"""The summary figure: a panel per clip, a bar per run, empty places for failed runs."""

import numpy as np

from hat_ros.bench.evaluation.figures import image_bytes
from hat_ros.bench.experiments.comparison_figure import bench_figure

ROWS = [
    {"clip": "a", "mode": "hat", "masks": "own", "start": "0", "E_p_mean": 0.1, "E_p_sd": 0.05, "fps": 30.0},
    {"clip": "a", "mode": "independent", "masks": "own", "start": "0", "E_p_mean": 0.4, "E_p_sd": None, "fps": 5.0},
    {"clip": "b", "mode": "hat", "masks": "own", "start": "0"},
    {"clip": "b", "mode": "hat", "masks": "given", "start": "0", "E_p_mean": 0.2, "E_p_sd": 0.1, "fps": 20.0},
]


def test_a_panel_per_clip_and_labels_that_tell_bars_apart():
    figure = bench_figure(ROWS)
    panels = [axis for axis in figure.axes if axis.get_title()]
    assert [axis.get_title() for axis in panels] == ["a", "b"]
    assert [label.get_text() for label in panels[0].get_xticklabels()] == ["hat", "independent"]
    assert [label.get_text() for label in panels[1].get_xticklabels()] == ["hat, masks own", "hat, masks given"]
    heights = [bar.get_height() for bar in panels[0].patches]
    np.testing.assert_allclose(heights, [0.1, 0.4])


def test_failed_runs_leave_their_place_and_same_rows_give_the_same_bytes():
    failed = [{"clip": "c", "mode": "hat", "masks": "own", "start": "0"}]
    assert image_bytes(bench_figure(failed)) == image_bytes(bench_figure(failed))
    assert image_bytes(bench_figure(ROWS), "svg") == image_bytes(bench_figure(ROWS), "svg")
