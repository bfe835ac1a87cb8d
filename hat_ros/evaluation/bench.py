"""``hat bench``: clips x methods x masks x starts in one table, so that the failing stage is visible at a glance."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hat_ros.errors import UsageError
from hat_ros.evaluation.campaign import Job, Outcome
from hat_ros.evaluation.tables import Column, Table

GIVEN_MASKS = ("segmentation.backend=annotated",)

_WHERE = (
    Column("clip", "clip"),
    Column("masks", "masks"),
    Column("start", "start"),
    Column("mode", "mode"),
)
_FIGURES = (
    Column("E_p_mean", "E_p", ".4f", "$E_p$"),
    Column("E_p_sd", "SD", ".3f"),
    Column("E_t_m_mean", "E_t m", ".3f", r"$E_t$ (m)"),
    Column("E_t_m_sd", "SD", ".3f"),
    Column("E_q_deg_mean", "E_q deg", ".2f", r"$E_q$ ($^\circ$)"),
    Column("E_q_deg_sd", "SD", ".2f"),
    Column("E_q_over_90_share", ">90", ".1%"),
    Column("coverage", "cover", ".1%"),
    Column("oracle_within_15_share", "best<15", ".1%"),
    Column("oracle_within_30_share", "best<30", ".1%"),
    Column("mask_iou_mean", "IoU", ".3f"),
    Column("mask_iou_over_0_9_share", "IoU>.9", ".1%"),
    Column("relative_motion_deg_median", "rel deg", ".3f"),
    Column("untrue_tracking_share", "untrue", ".1%"),
    Column("inside_95_share", "in 95%", ".1%"),
    Column("fps", "fps", ".1f"),
    Column("latency_ms_p50", "p50 ms", ".1f"),
    Column("latency_ms_p99", "p99 ms", ".1f"),
    Column("cpu_ms_mean", "cpu ms", ".1f"),
    Column("peak_memory_mib", "MiB", ".0f"),
    Column("memory_growth_mib", "+MiB", ".1f"),
)
_STAGES = (
    Column("fps", "fps", ".1f"),
    Column("cpu_ms_mean", "cpu ms", ".2f"),
    Column("decode_ms_mean", "decode ms", ".2f"),
    Column("segmentation_ms_mean", "segmentation ms", ".2f"),
    Column("hypotheses_ms_mean", "hypotheses ms", ".2f"),
    Column("motion_ms_mean", "motion ms", ".2f"),
    Column("selector_ms_mean", "selector ms", ".2f"),
    Column("fusion_ms_mean", "fusion ms", ".2f"),
)


def bench_jobs(
    recordings: Sequence[str],
    modes: Sequence[str],
    masks: Sequence[str],
    starts: Sequence[int],
    config: str,
    overrides: Sequence[str] = (),
    limit: int | None = None,
) -> list[Job]:
    """The runs of a benchmark, clip by clip.

    Args:
        recordings: bags or sequence folders; ``CLIP@key=value[,key=value]`` gives one clip settings of its own.
        modes: methods.
        masks: ``own`` (the preset's segmentation) and/or ``given`` (the recording's masks).
        starts: cold-start offsets in frames.
        config: preset or YAML file.
        overrides: settings for all runs.
        limit: at most this many frames per run.

    Raises:
        UsageError: a recording does not exist, or two have the same name.
    """
    jobs: dict[str, Job] = {}
    for text in recordings:
        path, own_settings = _split_settings(text)
        for mask in masks:
            for start in starts:
                for mode in modes:
                    name = f"{path.name}-{mode}-{mask}-{start}"
                    if name in jobs:
                        raise UsageError(f"two recordings are called {path.name}: rename one of the folders")
                    settings = (*overrides, *own_settings, *(GIVEN_MASKS if mask == "given" else ()))
                    labels = {"clip": path.name, "masks": mask, "start": str(start), "mode": mode}
                    jobs[name] = Job(name, path, mode, config, settings, start, limit, labels)
    return list(jobs.values())


def _split_settings(text: str) -> tuple[Path, tuple[str, ...]]:
    path, settings = Path(text), ()
    if not path.exists() and "@" in text:
        name, _, rest = text.rpartition("@")
        path, settings = Path(name), tuple(rest.split(","))
    if not path.exists():
        raise UsageError(f"recording {path}: no such file or folder")
    return path.resolve(), settings


def bench_table(outcomes: Sequence[Outcome]) -> Table:
    """Accuracy, recall, masks, motion, honesty, speed and memory of every run."""
    return Table("Benchmark", (*_WHERE, *_FIGURES, Column("run", "run")), _rows(outcomes))


def stage_table(outcomes: Sequence[Outcome]) -> Table:
    """Mean time per frame by stage; a stage that runs at keyframes only is averaged over all frames."""
    return Table("Time per frame by stage", (*_WHERE, *_STAGES), _rows(outcomes))


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """One line per failed run."""
    return [f"{outcome.job.name}: {outcome.failure}" for outcome in outcomes if outcome.figures is None]


def _rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    return [{**o.job.labels, **(o.figures or {}), "run": f"runs/{o.job.name}"} for o in outcomes]
