"""``hat ablate``: the paper's component table, sensitivity sweeps, filters and offline reference, on any clips.

The front ends run once per clip (``--mode observe``, candidates at every frame); every row below re-runs Stages 3 and
4 alone over those observations. Errors are pooled over all frames of all clips, as the paper pools a data set.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.config import HatConfig, load_config
from hat_ros.errors import RunError, UsageError
from hat_ros.evaluation import metrics
from hat_ros.evaluation.campaign import Job, Outcome
from hat_ros.evaluation.filters import ParticleSelector, UkfSelector
from hat_ros.evaluation.runlog import RunLog
from hat_ros.evaluation.tables import Column, Table
from hat_ros.evaluation.temporal_replay import replay_offline, replay_temporal
from hat_ros.result_bag import read_result_bag
from hat_ros.results import BAG_FOLDER, CONFIG_FILE, write_config
from hat_ros.source import SourceSpec

# No rotation disagrees by more: the gate is off.
GATE_OFF_DEG = 180.0
STRIDES = (5, 10, 20, 40)
CANDIDATE_COUNTS = (5, 10)
SIZE_REFERENCES_PX = (300.0, 400.0, 500.0, 600.0)
GATE_ANGLES_DEG = (45.0, 75.0, 120.0, GATE_OFF_DEG)
RELATIVE_WEIGHTS = (0.05, 0.1, 0.25, 0.5)

# kind, mode, settings of the runs that everything else is made from.
_RUNS = (
    ("masked", "observe", ("slam.masked=true",)),
    ("unmasked", "observe", ("slam.masked=false",)),
    ("tracking", "tracking", ()),
)

Variant = Callable[[RunLog], RunLog]

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


@dataclass(frozen=True)
class Row:
    """One line of a table: what it is called and how its runs are made from the observations of a clip."""

    name: str
    variant: Variant


@dataclass(frozen=True)
class Plan:
    """What an ablation runs.

    Attributes:
        config: temporal settings and front ends, merged.
        jobs: the runs that everything else is made from; their label ``kind`` says which.
    """

    config: HatConfig
    jobs: list[Job]


def plan(
    clips: Sequence[SourceSpec],
    out: Path,
    config: str,
    front_end: str | None = None,
    overrides: Sequence[str] = (),
    limit: int | None = None,
) -> Plan:
    """Merge the configurations, write the result to ``out/config.yaml``, and list the runs of the front ends.

    Args:
        clips: recordings with truth.
        out: campaign folder.
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
    merged = load_config(config, overrides)
    if front_end is not None:
        front = load_config(front_end, overrides)
        merged = replace(
            merged,
            segmentation=front.segmentation,
            hypotheses=front.hypotheses,
            slam=front.slam,
            nets=front.nets,
            refinement=front.refinement,
            # How scores are scaled and whether candidates of one frame support each other is the estimator's nature.
            selector=replace(
                merged.selector, score_scale=front.selector.score_scale, running_gate=front.selector.running_gate
            ),
        )
    if len({spec.name for spec in clips}) < len(clips):
        raise UsageError("two recordings have the same name: rename one of them")
    try:
        out.mkdir(parents=True, exist_ok=True)
        write_config(out, merged)
        # Without the temporal settings, so that runs of the front ends are used again when only those change.
        (out / "front_end").mkdir(exist_ok=True)
        write_config(
            out / "front_end",
            HatConfig(
                segmentation=merged.segmentation,
                hypotheses=merged.hypotheses,
                slam=merged.slam,
                nets=merged.nets,
                refinement=merged.refinement,
            ),
        )
    except OSError as error:
        raise RunError(f"cannot write {out}: {error.strerror}") from None
    jobs = []
    for spec in clips:
        for kind, mode, settings in _RUNS:
            labels = {"clip": spec.name, "kind": kind}
            config_file = str(out / "front_end" / CONFIG_FILE)
            jobs.append(Job(f"{spec.name}-{kind}", spec, mode, config_file, settings, 0, limit, labels))
    return Plan(merged, jobs)


def tables(plan: Plan, outcomes: Sequence[Outcome]) -> dict[str, Table]:
    """All tables, by file name; clips whose runs failed are left out."""
    logs: dict[str, list[RunLog]] = {kind: [] for kind, _, _ in _RUNS}
    broken = {outcome.job.labels["clip"] for outcome in outcomes if outcome.figures is None}
    for outcome in outcomes:
        if outcome.job.labels["clip"] not in broken:
            logs[outcome.job.labels["kind"]].append(read_result_bag(outcome.folder / BAG_FOLDER))
    masked, config = logs["masked"], plan.config
    if not masked:
        return {}
    components = table_of("Cumulative components, causal throughout", component_rows(config), masked)
    tracking = {"name": "tracking (refine the last pose)", **pooled(logs["tracking"])}
    masks = [
        {"name": name, **pooled([replay_temporal(log, config) for log in logs[kind]])}
        for name, kind in (("target masked for motion", "masked"), ("raw frames for motion", "unmasked"))
    ]
    return {
        "components": replace(components, rows=[tracking, *components.rows]),
        "sensitivity": table_of("Sensitivity, one setting at a time", sweep_rows(config), masked),
        "selectors": table_of("Selection at keyframes", selector_rows(config), masked),
        "offline": table_of("Causal and offline on the same observations", reference_rows(config), masked),
        "masks": Table("Background masking of the motion estimate", components.columns, masks),
    }


def component_rows(config: HatConfig) -> list[Row]:
    """The cumulative component table (paper, Table "Cumulative component ablations"), and the inertial prior.

    The prior weighs as much as relative motion where the configuration has it off.
    """
    fusion_only = _with(
        config,
        selector={"motion_weight_per_deg": 0.0, "running_gate": False, "size_weighting": False},
        fusion={"gate_angle_deg": GATE_OFF_DEG, "inertial_weight": 0.0},
    )
    viterbi = replace(fusion_only, selector=replace(config.selector, size_weighting=False))
    sized = replace(viterbi, selector=replace(config.selector, size_weighting=True))
    gated = _with(sized, fusion={"gate_angle_deg": config.fusion.gate_angle_deg})
    inertia = config.fusion.inertial_weight or config.fusion.relative_weight
    return [
        Row("keyframe anchors + SLAM fusion", _causal(fusion_only)),
        Row("+ Viterbi basin selection", _causal(viterbi)),
        Row("+ size-weighted unary", _causal(sized)),
        Row(f"+ disagreement gate (D = {config.fusion.gate_angle_deg:g} deg)", _causal(gated)),
        Row(f"+ inertial prior (v = {inertia:g})", _causal(_with(gated, fusion={"inertial_weight": inertia}))),
    ]


def sweep_rows(config: HatConfig) -> list[Row]:
    """The sensitivity sweeps (paper, Sec. "Hyperparameter Sensitivity"): one setting varied at a time."""
    rows = [
        Row(
            f"stride {gap}, K = 5",
            _causal(_with(config, keyframes={"gap_frames": gap}, hypotheses={"max_candidates": 5})),
        )
        for gap in STRIDES
    ]
    rows += [Row(f"K = {k}", _causal(_with(config, hypotheses={"max_candidates": k}))) for k in CANDIDATE_COUNTS]
    rows += [
        Row(f"s0 = {s0:g} px", _causal(_with(config, selector={"size_weighting": True, "size_ref_px": s0})))
        for s0 in SIZE_REFERENCES_PX
    ]
    rows.append(Row("no size weight", _causal(_with(config, selector={"size_weighting": False}))))
    rows += [
        Row(
            "D off" if angle == GATE_OFF_DEG else f"D = {angle:g} deg",
            _causal(_with(config, fusion={"gate_angle_deg": angle})),
        )
        for angle in GATE_ANGLES_DEG
    ]
    rows += [Row(f"w = {w:g}", _causal(_with(config, fusion={"relative_weight": w}))) for w in RELATIVE_WEIGHTS]
    return rows


def selector_rows(config: HatConfig) -> list[Row]:
    """The decoder against what could stand in its place (paper, Sec. "Continuous-State Filters")."""
    appearance = _with(config, selector={"motion_weight_per_deg": 0.0, "running_gate": False})
    return [
        Row("best appearance", _causal(appearance)),
        Row("forward Viterbi", _causal(config)),
        Row("particle filter on SO(3)", lambda log: replay_temporal(log, config, ParticleSelector(config.selector))),
        Row("UKF", lambda log: replay_temporal(log, config, UkfSelector(config.selector))),
        Row("offline backtrace", lambda log: replay_offline(log, config)),
    ]


def reference_rows(config: HatConfig) -> list[Row]:
    """Causal against offline on the same observations (paper, Table "Causal and offline HAT")."""
    every_frame = _with(
        config,
        keyframes={"gap_frames": 1},
        selector={"motion_weight_per_deg": 0.0, "running_gate": False},
        fusion={"relative_weight": 0.0},
    )
    return [
        Row("independent (best appearance, every frame)", _causal(every_frame)),
        Row("causal", _causal(config)),
        Row("offline", lambda log: replay_offline(log, config)),
    ]


def table_of(title: str, rows: Sequence[Row], observations: Sequence[RunLog]) -> Table:
    """Run every row over every clip and pool the errors."""
    return Table(
        title,
        (Column("name", "configuration"), *_ERRORS, *_ANCHORS),
        [{"name": row.name, **pooled([row.variant(log) for log in observations])} for row in rows],
    )


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


def _causal(config: HatConfig) -> Variant:
    return lambda log: replay_temporal(log, config)


def _with(config: HatConfig, **sections: dict[str, Any]) -> HatConfig:
    return replace(config, **{name: replace(getattr(config, name), **values) for name, values in sections.items()})
