import numpy as np
import pytest

pytest.importorskip("torch", reason="the extra 'train' is not installed")

from hat_ros.bench.training import figures
from hat_ros.bench.training.figures import curve_rows, overlap_rows
from hat_ros.bench.training.samples import Sample


class Samples:
    """Squares of 10 and 40 pixels, every second pair with a prior, and one sample without a target."""

    SIDES = (10, 10, 40, 40, 0)

    def sample(self, number: int) -> Sample:
        target = np.zeros((64, 64), np.float32)
        target[: self.SIDES[number], : self.SIDES[number]] = 1
        prior = np.full((32, 32), 0.5 * (number % 2), np.float32)
        return Sample(np.zeros((64, 64, 3), np.uint8), prior, target, np.ones((64, 64), np.float32))


def test_samples_are_counted_by_size_and_prior(monkeypatch):
    found = np.array([[0.1, 0.9], [0.3, 0.5], [0.6, 0.9], [0.8, 1.0], [np.nan, np.nan]])
    monkeypatch.setattr(figures, "overlaps", lambda model, composer, count: found[:count])
    rows = overlap_rows(None, Samples(), 5)
    table = {(row.low_px, row.high_px): row for row in rows}
    everything = table[0.0, float("inf")]
    assert (everything.samples, everything.primed) == (4, 2)
    assert everything.evidence == pytest.approx(0.45)
    assert everything.evidence_primed == pytest.approx(0.55)
    assert everything.tracked == pytest.approx(0.75)
    assert table[0.0, 15.0].evidence == pytest.approx(0.2)
    assert table[30.0, 60.0].tracked == pytest.approx(1.0)
    assert table[15.0, 30.0].samples == 0
    assert np.isnan(table[15.0, 30.0].tracked)


def test_curve_rows_name_their_columns():
    (row,) = curve_rows(np.array([[0.9, 0.95, 0.93, 12.0]]))
    assert row == {"from": 0.9, "to": 1.0, "stated": 0.95, "target": 0.93, "pixels": 12}
