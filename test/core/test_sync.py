"""Joins by stamp and admission by credit give the same answer whatever the order of arrival."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hat_ros.core.sync import RESTART_FRAMES, Admission, ExactJoin
from hat_ros.errors import FrameError, RunError


def drain(join):
    out = []
    while join.peek() is not None:
        out.append(join.take())
    return out


@given(st.permutations(["a"] * 6 + ["b"] * 6 + ["c"] * 6))
def test_join_gives_the_same_sets_for_every_interleaving_of_fifo_streams(order):
    join, sent, out = ExactJoin("abc"), dict.fromkeys("abc", 0), []
    for name in order:
        sent[name] += 1
        join.put(name, sent[name], f"{name}{sent[name]}")
        out += drain(join)
    assert out == [(n, {name: f"{name}{n}" for name in "abc"}) for n in range(1, 7)]
    assert len(join) == 0


def test_join_waits_for_the_missing_stream_and_names_it():
    join = ExactJoin(("slam", "selection"))
    join.put("slam", 5, "x")
    assert join.peek() is None
    assert join.missing() == (5, ("selection",))


def test_join_notices_a_lost_message():
    join = ExactJoin(("a", "b"))
    join.put("a", 1, 0)
    join.put("a", 2, 0)
    join.put("b", 2, 0)
    with pytest.raises(RunError, match="frame 1 never had b"):
        join.take()


def test_join_forgets_what_was_given_up_and_counts_what_comes_late():
    join = ExactJoin(("a", "b"))
    join.put("a", 1, 0)
    join.put("a", 2, 0)
    join.put("b", 2, 0)
    join.drop_before(2)
    assert join.take()[0] == 2
    join.put("b", 1, 0)
    assert join.late == 1
    assert len(join) == 0


def test_join_take_without_a_complete_set_is_a_mistake_of_the_caller():
    with pytest.raises(LookupError):
        ExactJoin("a").take()


@given(st.lists(st.permutations("abc"), min_size=9, max_size=9))
def test_join_after_a_step_back_whatever_comes_first(orders):
    """Stream ``a`` decides; one frame is under way, so its items come in any order, but before those of the next."""
    join, out, newest = ExactJoin("abc"), [], 0
    stamps = [7, 8, 9, 3, 4, 8, 9, 8, 9]  # two steps back, and stamps that come again
    for index, (stamp, order) in enumerate(zip(stamps, orders, strict=True)):
        for name in order:
            if name == "a":
                if stamp <= newest:
                    join.restart("a", stamp)
                newest = stamp
            join.put(name, stamp, index)
        out += drain(join)
    assert out == [(stamp, dict.fromkeys("abc", index)) for index, stamp in enumerate(stamps)]
    assert (len(join), join.late) == (0, 0)


def test_join_gives_up_the_sets_of_before_a_step_back():
    join = ExactJoin("abc")
    join.put("a", 8, "old")
    join.put("b", 8, "old")
    join.put("b", 5, "new")
    join.put("c", 9, "never admitted, may be a new one")
    join.restart("a", 5)
    join.put("a", 5, "new")
    join.put("c", 5, "new")
    assert drain(join) == [(5, dict.fromkeys("abc", "new"))]
    assert join.missing() == (9, ("a", "b"))


def test_join_keeps_late_items_only_until_the_next_set():
    join = ExactJoin("ab")
    for stamp in (1, 2):
        for name in "ab":
            join.put(name, stamp, 0)
        drain(join)
        join.put("b", 1, "late")
    for name in "ab":
        join.put(name, 3, 0)
    drain(join)
    join.restart("a", 1)
    join.put("a", 1, "new")
    assert join.peek() is None, "what came late before frame 3 is no part of a frame after it"
    join.put("b", 1, "new")
    assert drain(join) == [(1, {"a": "new", "b": "new"})]
    assert join.late == 2


def test_join_is_bounded_under_a_flood_of_late_items():
    join = ExactJoin("ab")
    for name in "ab":
        join.put(name, 1000, 0)
    drain(join)
    for stamp in range(1, 1000):
        join.put("b", stamp, 0)
    join.restart("a", 1)
    assert join.late + len(join) == 999
    assert len(join) <= 16


@given(st.integers(1, 16), st.integers(1, 60))
def test_never_more_in_flight_than_credits(credits, n):
    admission = Admission(credits)
    for stamp in range(1, n + 1):
        if not admission.has_credit:
            assert admission.answered(admission.in_flight[0])
        assert admission.admit(stamp) == stamp - 1
        assert len(admission.in_flight) <= credits


@pytest.mark.parametrize("stamp", [0, -5, 7, 10])
def test_stamps_that_do_not_increase_are_refused_and_change_nothing(stamp):
    admission = Admission(4)
    admission.admit(10)
    with pytest.raises(FrameError, match=r"header\.stamp must"):
        admission.admit(stamp)
    assert (admission.seq, admission.in_flight) == (0, (10,))


def offered(admission, stamps):
    """Which of the stamps enter."""
    entered = []
    for stamp in stamps:
        try:
            admission.admit(stamp)
        except FrameError:
            continue
        entered.append(stamp)
    return entered


def test_a_clock_that_stepped_back_begins_anew_after_some_frames_in_order():
    old = list(range(50, 50 + 2 * RESTART_FRAMES))
    admission = Admission(99, restarts=True)
    admission.admit(100)
    assert not any(admission.begins_anew(stamp) for stamp in (99, 100, 101))
    assert offered(admission, old[: RESTART_FRAMES - 1]) == []
    assert admission.begins_anew(old[RESTART_FRAMES - 1])
    assert offered(admission, old[RESTART_FRAMES - 1 :]) == old[RESTART_FRAMES - 1 :]
    assert offered(Admission(99), [100, *old]) == [100], "a replay refuses them for ever"


@pytest.mark.parametrize(
    "stamps",
    [
        [100] * 20,  # the same frame again and again
        [99, 98, 97, 96, 95, 94, 93, 92, 91, 90],  # backwards
        [97, 98, 99, 101, 98, 99, 100, 102, 99],  # a few late ones between frames in time
        [0] * 20,  # no time at all
        [50, 51, 52, 53, 40, 41, 42, 43, 30],  # never so many in a row
    ],
)
def test_duplicates_and_late_frames_do_not_begin_anew(stamps):
    admission = Admission(99, restarts=True)
    admission.admit(100)
    assert offered(admission, stamps) == [stamp for stamp in stamps if stamp > 100]


def test_one_stamp_from_the_future_costs_a_few_frames():
    admission = Admission(99, restarts=True)
    assert offered(admission, [10, 10**18, *range(11, 20)]) == [10, 10**18, *range(10 + RESTART_FRAMES, 20)]


def test_an_answer_counts_once_and_only_for_what_is_in_flight():
    admission = Admission(2)
    admission.admit(1)
    assert admission.answered(1)
    assert not admission.answered(1)
    assert not admission.answered(99)


def test_giving_up_frees_all_credits_and_later_answers_are_strangers():
    admission = Admission(2)
    admission.admit(1)
    admission.admit(2)
    assert admission.give_up() == (1, 2)
    assert admission.has_credit
    assert not admission.answered(1)


def test_forgotten_stamps_let_older_ones_in_where_they_may_begin_anew():
    for restarts in (True, False):
        admission = Admission(1, restarts)
        admission.admit(50)
        admission.answered(50)
        admission.forget_stamps()
        if restarts:
            assert admission.admit(7) == 1
        else:
            with pytest.raises(FrameError, match="must increase"):
                admission.admit(7)
