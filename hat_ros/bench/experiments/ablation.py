"""``hat ablate``: the paper's component table, sensitivity sweeps, filters and offline reference, on any clips.

The front ends run once per clip (``--mode observe``, candidates at every frame); every row re-runs Stages 3 and 4
alone over those observations. Errors are pooled over all frames of all clips, as the paper pools a data set. Two runs
more per clip stand beside them: one whose motion sees masked frames where the first one sees raw ones, or the reverse,
and one of the tracking baseline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.bench.evaluation import metrics
from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.bench.experiments.ablation_rows import Row, table_rows
from hat_ros.bench.experiments.run_matrix import Job, Outcome
from hat_ros.bench.methods.temporal import replay_temporal
from hat_ros.bench.source import SourceSpec
from hat_ros.config import HatConfig, load_config
from hat_ros.errors import RunError, UsageError
from hat_ros.geometry import lie
from hat_ros.io.provenance import code_hash
from hat_ros.io.result_bag import read_result_bag
from hat_ros.io.results import BAG_FOLDER, CONFIG_FILE, write_config
from hat_ros.io.run_log import RunLog

_ERRORS = (
    Column("E_t_m_mean", "E_t m", ".4f", r"$E_t$ (m)"),
    Column("E_q_deg_mean", "E_q deg", ".2f", r"$E_q$ ($^\circ$)"),
    Column("E_p_mean", "E_p", ".4f", "$E_p$"),
    Column("E_p_sd", "SD", ".3f"),
    Column("E_q_over_90_share", ">90", ".1%"),
    Column("coverage", "cover", ".1%"),
)
_ANCHORS = (
    Column("anchor_deg_mean", "anchor deg", ".2f"),
    Column("anchor_over_90_share", "anchor >90", ".2%"),
    Column("anchors", "anchors", "d"),
)
_COLUMNS = (Column("name", "configuration"), *_ERRORS, *_ANCHORS)
_ORACLE = (
    Column("clip", "clip"),
    Column("oracle_keyframes", "images", "d"),
    Column("oracle_median_deg", "best of K, median deg", ".2f"),
    Column("oracle_within_15_share", "best<15", ".1%"),
    Column("oracle_within_30_share", "best<30", ".1%"),
    Column("E_q_over_90_share", "first >90", ".1%"),
)
_RANGES = (
    Column("depth_from_m", "depth from m", ".0f"),
    Column("depth_to_m", "to m", ".0f"),
    Column("frames", "frames", "d"),
    Column("rotation_deg_q25", "E_q deg, 25 %", ".2f"),
    Column("rotation_deg_median", "median", ".2f"),
    Column("rotation_deg_q75", "75 %", ".2f"),
    Column("depth_m_q25", "depth error m, 25 %", ".4f"),
    Column("depth_m_median", "median", ".4f"),
    Column("depth_m_q75", "75 %", ".4f"),
    Column("over_90_share", ">90", ".1%"),
    Column("depth_energy_share", "depth's share of E_t^2", ".1%"),
)

# What a run of the front ends depends on.
_FRONT_END_SECTIONS = ("segmentation", "hypotheses", "slam", "nets", "refinement")

# Runs per clip, by what they are for.
OBSERVED, MASKED_OTHERWISE, TRACKING = "observed", "masked-otherwise", "tracking"


@dataclass(frozen=True)
class Plan:
    """What an ablation runs.

    Attributes:
        config: temporal settings and front ends, merged.
        jobs: the runs that everything else is made from; their label ``kind`` says which, ``masked`` whether motion
            saw the target alone.
    """

    config: HatConfig
    jobs: list[Job]


def plan(
    clips: Sequence[tuple[SourceSpec, tuple[str, ...]]],
    out: Path,
    config: str,
    front_end: str | None = None,
    overrides: Sequence[str] = (),
    limit: int | None = None,
) -> Plan:
    """Merge the configurations, write the result to ``out/config.yaml``, and list the runs of the front ends.

    Args:
        clips: recordings with ground truth, each with settings of its own for the front ends.
        out: folder of the runs.
        config: preset or file of the temporal settings.
        front_end: preset or file of segmentation, hypotheses and motion, and of what belongs to its scores
            (``score_scale``, ``running_gate``); None = that of ``config``.
        overrides: ``key=value`` settings on top of both.
        limit: at most this many frames per clip.

    Raises:
        ConfigError: a configuration is bad.
        UsageError: two recordings have the same name.
        RunError: ``out`` cannot be written.
    """
    if len({spec.name for spec, _ in clips}) < len(clips):
        raise UsageError("two recordings have the same name: rename one of them")
    merged = _merged(config, front_end, overrides)
    # Without the temporal settings, so that runs of the front ends are used again when only those change.
    front_ends = HatConfig(**{name: getattr(merged, name) for name in _FRONT_END_SECTIONS})
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_config(out, merged)
        (out / "front_end").mkdir(exist_ok=True)
        write_config(out / "front_end", front_ends)
    except OSError as error:
        raise RunError(f"cannot write {out}: {error.strerror}") from None
    jobs = [job for clip in clips for job in _front_end_jobs(*clip, str(out / "front_end" / CONFIG_FILE), limit)]
    return Plan(merged, jobs)


def _merged(config: str, front_end: str | None, overrides: Sequence[str]) -> HatConfig:
    """Temporal settings of one preset with the front ends of another."""
    merged = load_config(config, overrides)
    if front_end is None:
        return merged
    front = load_config(front_end, overrides)
    # How scores are scaled and whether candidates of one frame support each other is the estimator's nature.
    selector = replace(
        merged.selector, score_scale=front.selector.score_scale, running_gate=front.selector.running_gate
    )
    return replace(merged, selector=selector, **{name: getattr(front, name) for name in _FRONT_END_SECTIONS})


def _front_end_jobs(spec: SourceSpec, settings: tuple[str, ...], config_file: str, limit: int | None) -> list[Job]:
    masked = load_config(config_file, settings).slam.masked
    otherwise = (*settings, f"slam.masked={str(not masked).lower()}")
    kinds = (
        (OBSERVED, "observe", settings, masked),
        (MASKED_OTHERWISE, "observe", otherwise, not masked),
        (TRACKING, "tracking", settings, masked),
    )
    jobs = []
    for kind, mode, overrides, is_masked in kinds:
        labels = {"clip": spec.name, "kind": kind, "masked": str(is_masked).lower()}
        jobs.append(Job(f"{spec.name}-{kind}", spec, mode, config_file, overrides, 0, limit, labels))
    return jobs


def tables(plan: Plan, outcomes: Sequence[Outcome]) -> dict[str, Table]:
    """All tables, by file name; clips whose runs failed are left out."""
    broken = {outcome.job.labels["clip"] for outcome in outcomes if outcome.figures is None}
    logs: dict[str, dict[str, RunLog]] = {}
    by_mask: dict[str, list[RunLog]] = {"true": [], "false": []}
    for outcome in outcomes:
        labels = outcome.job.labels
        if labels["clip"] not in broken:
            log = read_result_bag(outcome.folder / BAG_FOLDER)
            logs.setdefault(labels["kind"], {})[labels["clip"]] = log
            if labels["kind"] != TRACKING:
                by_mask[labels["masked"]].append(log)
    if not logs:
        return {}
    clips, rows = logs[OBSERVED], table_rows(plan.config)
    observed = list(clips.values())
    tracking = {"name": "tracking (refine the last pose)", **pooled(list(logs[TRACKING].values()))}
    components = table_of("Cumulative components, causal throughout", rows["components"], observed)
    filters = table_of("Search for the best filters", rows["filters"], observed)
    masks = [
        {"name": name, **pooled([replay_temporal(log, plan.config) for log in by_mask[masked]])}
        for name, masked in (("target masked for motion", "true"), ("raw frames for motion", "false"))
    ]
    return {
        "components": with_change(replace(components, rows=[tracking, *components.rows])),
        "sensitivity": table_of("Sensitivity, one setting at a time", rows["sensitivity"], observed),
        "selectors": with_best_filters(table_of("Selection at keyframes", rows["selectors"], observed), filters),
        "filters": filters,
        "offline": table_of(
            "Causal, and offline (whole-clip smoothing), on the same observations", rows["offline"], observed
        ),
        "by_clip": clip_table(rows["offline"], clips),
        "masks": Table("Background masking of the motion estimate", _COLUMNS, masks),
        "candidates": candidate_table(clips),
        "ranges": range_table(observed),
    }


def trace(plan: Plan, outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Where every cell comes from: run folders (each with its configuration, commit and input hashes), and by row
    what differs from ``config.yaml``. The same code over the same runs gives the same cells."""
    rows = table_rows(plan.config)
    return {
        "code_sha256": code_hash(),
        "config": CONFIG_FILE,
        "runs": {
            kind: [f"runs/{o.job.name}" for o in outcomes if o.job.labels["kind"] == kind and o.figures is not None]
            for kind in (OBSERVED, MASKED_OTHERWISE, TRACKING)
        },
        "rows": {name: [row.settings(plan.config) for row in lines] for name, lines in rows.items()},
    }


def with_best_filters(selectors: Table, filters: Table) -> Table:
    """The table of selectors with the one setting of each filter whose anchors are closest to the ground truth."""
    best: dict[str, dict[str, Any]] = {}
    for row in filters.rows:
        kind = row["name"].split(",")[0]
        if kind not in best or row["anchor_deg_mean"] < best[kind]["anchor_deg_mean"]:
            best[kind] = row
    return replace(selectors, rows=[*selectors.rows, *best.values()])


def table_of(title: str, rows: Sequence[Row], observations: Sequence[RunLog]) -> Table:
    """Run every row over every clip and pool the errors."""
    lines = [{"name": row.name, **pooled([row.replay(log) for log in observations])} for row in rows]
    return Table(title, _COLUMNS, lines)


def with_change(table: Table) -> Table:
    """The same table with the relative change of E_p from the row above."""
    rows: list[dict[str, Any]] = []
    for row in table.rows:
        rows.append({**row, "change": row["E_p_mean"] / rows[-1]["E_p_mean"] - 1.0 if rows else None})
    return replace(table, columns=(*table.columns, Column("change", "E_p change", "+.1%")), rows=rows)


def clip_table(rows: Sequence[Row], observations: Mapping[str, RunLog]) -> Table:
    """E_p of every row side by side, clip by clip."""
    lines = [
        {"clip": clip, **{row.name: pooled([row.replay(log)])["E_p_mean"] for row in rows}}
        for clip, log in observations.items()
    ]
    columns = (Column("clip", "clip"), *(Column(row.name, row.name, ".4f") for row in rows))
    return Table("E_p by clip, on the same observations", columns, lines)


def candidate_table(observations: Mapping[str, RunLog]) -> Table:
    """What an oracle could reach: the best of the K candidates of every image, and how often the first is wrong."""
    lines = []
    for clip, log in observations.items():
        first = _best_appearance(log)
        lines.append(
            {
                "clip": clip,
                **metrics.candidate_oracle([group.pose_rows for group in log.candidates], log.T_true),
                **metrics.summarise(metrics.pose_errors(first, log.T_true)),
            }
        )
    return Table("Candidates of every image", _ORACLE, lines)


def range_table(observations: Sequence[RunLog]) -> Table:
    """Errors of the best appearance by true depth, before any temporal selection."""
    T_est = np.concatenate([_best_appearance(log) for log in observations])
    T_true = np.concatenate([log.T_true for log in observations])
    lines = []
    for line in metrics.range_bins(T_est, T_true):
        here = (T_true[:, 2, 3] >= line["depth_from_m"]) & (T_true[:, 2, 3] < line["depth_to_m"])
        lines.append({**line, "depth_energy_share": metrics.depth_energy_share(T_est[here], T_true[here])})
    return Table("Best appearance by range", _RANGES, lines)


def _best_appearance(log: RunLog) -> Float:
    """(N, 4, 4) first candidate of every image, NaN without one."""
    rows = [group.pose_rows[0] if len(group) else np.full(7, np.nan) for group in log.candidates]
    return lie.matrix_from_row(np.array(rows).reshape(-1, 7))


def pooled(logs: Sequence[RunLog]) -> dict[str, Any]:
    """Errors over all frames of all clips, and those of the anchors chosen at keyframes."""
    T_est = np.concatenate([log.T_est for log in logs])
    T_true = np.concatenate([log.T_true for log in logs])
    has_truth = np.concatenate([log.has_truth for log in logs])
    has_output = np.concatenate([log.has_output for log in logs])
    anchors = np.concatenate([log.anchor_errors_deg() for log in logs])
    anchors = anchors[np.isfinite(anchors)]
    return {
        **metrics.summarise(metrics.pose_errors(T_est, T_true)),
        **metrics.coverage(has_output, has_truth),
        "anchor_deg_mean": float(anchors.mean()) if len(anchors) else float("nan"),
        "anchor_over_90_share": float(np.mean(anchors > metrics.WRONG_BASIN_DEG)) if len(anchors) else float("nan"),
        "anchors": len(anchors),
    }
