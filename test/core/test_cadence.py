import pytest

from hat_ros.core.cadence import Cadence

PERIOD_NS = 100_000_000


def missed(stamps):
    cadence = Cadence()
    return [cadence.missed(stamp) for stamp in stamps]


@pytest.mark.parametrize("every", [1, 2, 7])
def test_a_steady_camera_leaves_nothing_out_at_any_rate(every):
    assert missed([i * every * PERIOD_NS for i in range(20)]) == [0] * 20


def test_what_is_left_out_is_counted_once():
    stamps = [i * PERIOD_NS for i in (*range(10), *range(15, 25))]
    assert missed(stamps) == [0] * 10 + [5] + [0] * 9


def test_jitter_of_the_stamps_is_no_gap():
    jitter = (0, 10, -10, 5, -8, 10, -5, 8, 0, -10)
    assert missed([i * PERIOD_NS + 1_000_000 * jitter[i % 10] for i in range(40)]) == [0] * 40


def test_a_new_rate_becomes_the_usual_one():
    stamps = [i * PERIOD_NS for i in (*range(10), *range(12, 60, 3))]
    counted = missed(stamps)
    assert counted[10] == 2 and counted[-5:] == [0] * 5


def test_after_a_reset_there_is_nothing_to_compare_with():
    cadence = Cadence()
    for i in range(5):
        cadence.missed(i * PERIOD_NS)
    cadence.reset()
    assert cadence.missed(100 * PERIOD_NS) == 0
