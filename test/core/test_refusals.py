"""No refused frame vanishes: counted by reason, the first case in words."""

from __future__ import annotations

from hat_ros.core.refusals import Refusals


def test_sentences_that_differ_in_numbers_alone_are_one_reason():
    refusals = Refusals()
    for stamp in (30, 10, 20):
        refusals.add(f"frame {stamp}: header.stamp must increase, found {stamp} ns after 40 ns")
    refusals.add("frame 50: image encoding 'x' is not supported")
    assert refusals.total == 4
    assert refusals.records() == [
        {"count": 3, "first": "frame 30: header.stamp must increase, found 30 ns after 40 ns"},
        {"count": 1, "first": "frame 50: image encoding 'x' is not supported"},
    ]
    assert str(refusals).startswith("3 x frame 30: header.stamp must increase")


def test_records_read_back():
    refusals = Refusals()
    for sentence in ("frame 1: black", "frame 2: black", "frame 3: too small"):
        refusals.add(sentence)
    assert Refusals.from_records(refusals.records()).records() == refusals.records()


def test_any_number_of_reasons_stays_bounded_and_counted():
    refusals = Refusals()
    for index in range(500):
        refusals.add(f"frame {index}: encoding '{'x' * index}' is not supported")
    assert refusals.total == 500
    assert len(refusals.records()) <= 21
