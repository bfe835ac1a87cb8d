import pytest

from hat_ros.bench.training.card import calibration_figure, card_text, overlap_table

ROW = {"samples": 4, "evidence": 0.5, "primed": 2, "evidence_primed": 0.4, "tracked": float("nan")}
CURVE = [
    {"from": 0.1 * number, "to": 0.1 * number + 0.1, "stated": 0.1 * number + 0.05, "target": 0.1 * number, "pixels": 5}
    for number in range(9)
] + [{"from": 0.9, "to": 1.0, "stated": 0.96, "target": 0.93, "pixels": 7}]


def data(cads):
    return {
        "cads": cads,
        "models": [],
        "generated": {"seeds": [0, 1, 2], "views": 12},
        "backgrounds": 9,
        "seed": 1,
        "code_sha256": "0" * 64,
    }


def card(cads):
    return {
        "network": {"file": "segmenter.onnx", "bytes": 640_000, "sha256": "ab", "parameters": 153_048},
        "training_data": data(cads),
        "kept_data": data([]),
        "training": {
            "steps": 10,
            "batch": 32,
            "coarse_share": 0.7,
            "coarse_px": 128,
            "side_px": 160,
            "sample_seed": 11,
            "seed": 0,
            "seconds": 90.0,
            "threads": 2,
            "workers": 1,
            "loss": 0.5,
        },
        "overlap": [{"low_px": 0.0, "high_px": float("inf")} | ROW, {"low_px": 30.0, "high_px": 60.0} | ROW],
        "calibration": {"scales": [1.0, 1.1], "offsets": [0.0, 0.1], "curve": CURVE},
        "versions": {"torch": "2"},
    }


def test_cad_files_are_named_and_asked_for():
    text = card_text(card([{"file": "iss.glb", "sha256": "0123456789abcdef", "views": 320}]))
    assert "`iss.glb` (`0123456789ab`, 320 views)" in text
    assert "give them with `--cad`" in text
    assert "a clone of it rebuilds" not in text


def test_without_cad_files_a_clone_is_enough():
    assert "a clone of it rebuilds these data" in card_text(card([]))


def test_figures_are_in_the_text():
    text = card_text(card([]))
    assert "said to be target at 90 % and more (on average 96.0%), 93.0% are" in text
    assert "| 30 to 60 px | 4 | 0.500 | 2 | 0.400 | - |" in text
    assert "1.5 minutes" in text


def test_the_table_for_the_terminal_has_the_same_rows():
    lines = overlap_table(card([])["overlap"]).text().splitlines()
    assert lines[3].split() == ["all", "4", "0.500", "2", "0.400", "-"]


@pytest.mark.parametrize("pixels", [5, 0])
def test_the_figure_leaves_out_empty_bins(pixels):
    curve = [CURVE[-1], CURVE[0] | {"pixels": pixels}]
    figure = calibration_figure(curve)
    x, y = figure.axes[0].lines[1].get_data()
    assert list(zip(x, y, strict=True)) == [(96.0, 93.0), (5.0, 0.0)][: 1 + bool(pixels)]
