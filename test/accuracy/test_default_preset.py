"""The accuracy gate: the default preset over `bags/demo` and seeded synthetic clips, each within its bands.

The clips are in `gate_clips`, what came out of them and the bands around it in `gate_bands`. The table of all clips is
printed after the tests; a failing clip shows its own. About two minutes of processor time.
"""

import dataclasses
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from gate_bands import BANDS, HEADER, Figures, band_row, bands_left, measure
from gate_clips import CLIPS, Recording, record_demo

import hat_ros

pytestmark = pytest.mark.accuracy

RECORDERS = {"demo": record_demo} | {clip.name: clip.record for clip in CLIPS}


class Recordings:
    """Renders the next clip in a thread while the present one is tracked.

    Args:
        names: the clips, in the order in which they are asked for.
        pool: renders them.
    """

    def __init__(self, names: list[str], pool: ThreadPoolExecutor) -> None:
        self._rest = iter(names)
        self._pool = pool
        self._ahead = self._start()

    def take(self, name: str) -> Recording:
        asked, recording = self._ahead.result()
        assert asked == name, "the clips must be asked for in order"
        self._ahead = self._start()
        return recording

    def _start(self):
        name = next(self._rest, None)
        return None if name is None else self._pool.submit(lambda: (name, RECORDERS[name]()))


@pytest.fixture(scope="module")
def recordings(request) -> Iterator[Recordings]:
    items = [item for item in request.session.items if item.path == request.path and hasattr(item, "callspec")]
    names = [item.callspec.params["name"] for item in items]
    with ThreadPoolExecutor(1) as pool:
        yield Recordings(names, pool)
        pool.shutdown(cancel_futures=True)


@pytest.mark.parametrize("name", RECORDERS)
def test_clip_stays_within_its_bands(name, recordings, table, record_property):
    outcome = measure(recordings.take(name))
    left = bands_left(outcome.figures, BANDS[name])
    # For tools/mutate.py, in the JUnit report.
    record_property("clip", name)
    record_property("package", str(Path(hat_ros.__file__).parent))
    record_property("poses", outcome.poses_sha256)
    record_property("left", ", ".join(left))
    row = band_row(name, outcome.figures, BANDS[name])
    table += [row] if table else [HEADER, row]
    assert not left, f"{', '.join(left)} left the band\n{HEADER}\n{row}"


def test_every_clip_has_bands():
    assert set(BANDS) == set(RECORDERS)


def test_seeds_count_up_and_two_craft_are_not_of_the_package():
    assert [clip.seed for clip in CLIPS] == list(range(1, len(CLIPS) + 1))
    assert len({clip.craft for clip in CLIPS if clip.craft.startswith("random")}) >= 2


def test_each_band_can_be_left():
    good = BANDS["demo"].measured
    assert bands_left(good, BANDS["demo"]) == []
    for change in (
        {"mean_e_p": 0.1},
        {"beyond_30": 5},
        {"coverage": 0.9},
        {"right_tracking": 0.8},
        {"false_tracking": 1},
        {"mean_e_p": float("inf")},
    ):
        assert bands_left(dataclasses.replace(good, **change), BANDS["demo"]) == [*change]


def test_silence_leaves_a_band():
    silent = Figures(mean_e_p=float("inf"), beyond_30=0, coverage=0.0, right_tracking=0.0)
    assert {"coverage", "right_tracking"} <= set(bands_left(silent, BANDS["demo"]))
