"""Joins by stamp and admission by credit give the same answer whatever the order of arrival."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hat_ros.core.sync import Admission, ExactJoin
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
