"""What a run measures per frame, and how it is summed up."""

from __future__ import annotations

import resource
import time
from pathlib import Path

import numpy as np

STAGE_NAMES = ("segmentation", "hypotheses", "motion", "selector", "fusion")
MEASURED = (
    "latency_ms",
    "period_ms",
    "cpu_ms",
    "decode_ms",
    *(f"{name}_ms" for name in STAGE_NAMES),
    "rss_mib",
)
# First frames left out of throughput and latency: compiled code is loaded and caches are filled there.
WARMUP_FRAMES = 10


class LapClock:
    """Wall time and processor time of the whole process, between answers."""

    def __init__(self) -> None:
        self._last = time.perf_counter(), time.process_time()

    def lap(self) -> tuple[float, float]:
        """Wall and processor time since the last call or the construction, both in milliseconds."""
        now = time.perf_counter(), time.process_time()
        wall_s, cpu_s = (b - a for a, b in zip(self._last, now, strict=True))
        self._last = now
        return 1e3 * wall_s, 1e3 * cpu_s


def resident_mib() -> float:
    """Resident memory of this process in MiB; NaN where the system does not say."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, ValueError, IndexError):
        return float("nan")
    return pages * resource.getpagesize() / 2**20


def memory_summary(rows: list[tuple[float, ...]]) -> dict[str, float]:
    """How much resident memory grew from the first to the last quarter of a run: medians over rows of MEASURED."""
    rss_mib = np.array([row[MEASURED.index("rss_mib")] for row in rows])
    quarter = len(rss_mib) // 4
    if quarter == 0:
        return {"memory_growth_mib": float("nan")}
    # The first quarter begins after warm-up: caches fill there by design.
    first = rss_mib[min(WARMUP_FRAMES, quarter) :][:quarter]
    return {"memory_growth_mib": float(np.median(rss_mib[-quarter:]) - np.median(first))}


def latency_summary(rows: list[tuple[float, ...]], finish_s: float = 0.0, sequential: bool = False) -> dict[str, float]:
    """Throughput, latency percentiles and mean time per stage over rows of :data:`MEASURED`, after warm-up.

    Throughput counts everything that is done while the recording runs: decoding, the method, writing of results; and
    ``finish_s``, what a method that is not causal computes after the last frame. ``sequential``: frames were processed
    one after another, so that the time of the detector (Stage 1) can be left out of the throughput, as published.
    """
    table = np.array(rows[WARMUP_FRAMES:] or rows, dtype=np.float64).reshape(-1, len(MEASURED))
    if not len(table):
        return {"fps": float("nan"), "latency_ms_p50": float("nan"), "latency_ms_p99": float("nan")}
    column = dict(zip(MEASURED, table.T, strict=True))
    total_s = 1e-3 * column["period_ms"].sum() + finish_s
    rest_s = total_s - 1e-3 * column["segmentation_ms"].sum()
    return {
        "fps": float(len(table) / total_s),
        **({"fps_without_detector": float(len(table) / rest_s)} if sequential and rest_s > 0 else {}),
        "latency_ms_p50": float(np.percentile(column["latency_ms"], 50)),
        "latency_ms_p99": float(np.percentile(column["latency_ms"], 99)),
        "latency_ms_max": float(column["latency_ms"].max()),
        "cpu_ms_mean": float(column["cpu_ms"].mean()),
        "decode_ms_mean": float(column["decode_ms"].mean()),
        **{f"{name}_ms_mean": float(column[f"{name}_ms"].mean()) for name in STAGE_NAMES},
    }
