"""Throughput, latency and memory of a run, summed up from what was measured per frame."""

from __future__ import annotations

import numpy as np
import pytest

from hat_ros.app.timing import MEASURED, WARMUP_FRAMES, LapClock, latency_summary, memory_summary, resident_mib


def row(**values):
    return tuple(values.get(name, 0.0) for name in MEASURED)


def test_speed_is_by_the_clock_on_the_wall_and_leaves_out_warm_up():
    slow = row(latency_ms=1000.0, period_ms=1000.0)
    overlapping = row(latency_ms=30.0, period_ms=10.0, motion_ms=3.0)  # three frames in flight
    summary = latency_summary([slow] * WARMUP_FRAMES + [overlapping] * 50)
    assert summary["fps"] == pytest.approx(100.0)
    assert summary["latency_ms_p50"] == summary["latency_ms_p99"] == pytest.approx(30.0)
    assert summary["motion_ms_mean"] == pytest.approx(3.0)


def test_what_a_whole_clip_method_computes_after_the_last_frame_counts():
    row = tuple({"period_ms": 100.0}.get(name, 1.0) for name in MEASURED)
    assert latency_summary([row] * (WARMUP_FRAMES + 10))["fps"] == pytest.approx(10.0)
    assert latency_summary([row] * (WARMUP_FRAMES + 10), finish_s=1.0)["fps"] == pytest.approx(5.0)


def test_memory_growth_compares_quarters():
    rows = [row(rss_mib=100.0 + (i >= 60) * 5.0) for i in range(80)]
    assert memory_summary(rows)["memory_growth_mib"] == pytest.approx(5.0)
    assert np.isnan(memory_summary(rows[:3])["memory_growth_mib"])
    assert 1.0 < resident_mib() < 1e5


def test_latency_of_nothing_is_nan():
    assert np.isnan(latency_summary([])["fps"])


def test_laps_follow_each_other():
    clock = LapClock()
    np.linalg.svd(np.random.default_rng(0).normal(size=(300, 300)))
    wall_ms, cpu_ms = clock.lap()
    assert wall_ms > 0
    assert cpu_ms > 0
    assert clock.lap()[0] < wall_ms
