"""``hat ablate``: the paper's component table, sensitivity sweeps, filters and offline reference, on any clips.

The front ends run once per clip (``--mode observe``, candidates at every frame); every row below re-runs Stages 3 and
4 alone over those observations. Errors are pooled over all frames of all clips, as the paper pools a data set.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.config import HatConfig, flat_options, load_config
from hat_ros.errors import RunError, UsageError
from hat_ros.evaluation import metrics
from hat_ros.evaluation.campaign import Job, Outcome
from hat_ros.evaluation.filters import FilterNoise, ParticleSelector, UkfSelector
from hat_ros.evaluation.tables import Column, Table
from hat_ros.evaluation.temporal_replay import replay_offline, replay_temporal
from hat_ros.provenance import code_hash
from hat_ros.result_bag import read_result_bag
from hat_ros.results import BAG_FOLDER, CONFIG_FILE, write_config
from hat_ros.runlog import RunLog
from hat_ros.source import SourceSpec

# No rotation disagrees by more: the gate is off.
GATE_OFF_DEG = 180.0
STRIDES = (5, 10, 20, 40)
CANDIDATE_COUNTS = (5, 10)
SIZE_REFERENCES_PX = (300.0, 400.0, 500.0, 600.0)
GATE_ANGLES_DEG = (45.0, 75.0, 120.0, GATE_OFF_DEG)
RELATIVE_WEIGHTS = (0.05, 0.1, 0.25, 0.5)
FILTER_MOTION_DEG = (1.0, 3.0, 10.0)
FILTER_CANDIDATE_DEG = (3.0, 10.0, 30.0)

# kind, mode, settings of the runs that everything else is made from.
_RUNS = (
    ("masked", "observe", ("slam.masked=true",)),
    ("unmasked", "observe", ("slam.masked=false",)),
    ("tracking", "tracking", ()),
)

# What may stand in Stage 3's place.
_SELECTORS = {"viterbi": None, "particles": ParticleSelector, "ukf": UkfSelector}

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
_BEST_APPEARANCE = {"motion_weight_per_deg": 0.0, "running_gate": False}


@dataclass(frozen=True)
class Row:
    """One line of a table: what it is called, and what runs over the observations of a clip.

    Attributes:
        name: for people.
        config: temporal settings.
        offline: the offline reference, else the causal stages.
        selector: ``viterbi``, ``particles`` or ``ukf``.
        noise: of a filter; None for the decoder.
    """

    name: str
    config: HatConfig
    offline: bool = False
    selector: str = "viterbi"
    noise: FilterNoise | None = None

    def replay(self, log: RunLog) -> RunLog:
        """The row's answer to one clip."""
        if self.offline:
            return replay_offline(log, self.config)
        stand_in = _SELECTORS[self.selector]
        return replay_temporal(log, self.config, stand_in and stand_in(self.config.selector, self.noise))

    def settings(self, base: HatConfig) -> dict[str, Any]:
        """What differs from the configuration of the campaign, and what ran."""
        usual = {key: value for key, (value, _) in flat_options(base).items()}
        changed = {key: v for key, (v, _) in flat_options(self.config).items() if v != usual[key]}
        noise = None if self.noise is None else asdict(self.noise)
        ran = {"offline": self.offline, "selector": self.selector, "noise": noise}
        return {"name": self.name, **ran, "settings": changed}


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
    clips = []
    broken = {outcome.job.labels["clip"] for outcome in outcomes if outcome.figures is None}
    for outcome in outcomes:
        if outcome.job.labels["clip"] not in broken:
            logs[outcome.job.labels["kind"]].append(read_result_bag(outcome.folder / BAG_FOLDER))
            clips.append(outcome.job.labels["clip"])
    masked, config = logs["masked"], plan.config
    if not masked:
        return {}
    rows = table_rows(config)
    tracking = {"name": "tracking (refine the last pose)", **pooled(logs["tracking"])}
    components = table_of("Cumulative components, causal throughout", rows["components"], masked)
    filters = table_of("Search for the best filters", rows["filters"], masked)
    masks = [
        {"name": name, **pooled([replay_temporal(log, config) for log in logs[kind]])}
        for name, kind in (("target masked for motion", "masked"), ("raw frames for motion", "unmasked"))
    ]
    return {
        "components": with_change(replace(components, rows=[tracking, *components.rows])),
        "sensitivity": table_of("Sensitivity, one setting at a time", rows["sensitivity"], masked),
        "selectors": with_best_filters(table_of("Selection at keyframes", rows["selectors"], masked), filters),
        "filters": filters,
        "offline": table_of("Causal and offline on the same observations", rows["offline"], masked),
        "by_clip": clip_table(rows["offline"], dict(zip(dict.fromkeys(clips), masked, strict=True))),
        "masks": Table("Background masking of the motion estimate", _COLUMNS, masks),
    }


def table_rows(config: HatConfig) -> dict[str, list[Row]]:
    """The rows that are made from the masked observations, by table."""
    return {
        "components": component_rows(config),
        "sensitivity": sweep_rows(config),
        "selectors": selector_rows(config),
        "filters": filter_rows(config),
        "offline": reference_rows(config),
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
            for kind, _, _ in _RUNS
        },
        "rows": {name: [row.settings(plan.config) for row in lines] for name, lines in rows.items()},
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
        Row("keyframe anchors + SLAM fusion", fusion_only),
        Row("+ Viterbi basin selection", viterbi),
        Row("+ size-weighted unary", sized),
        Row(f"+ disagreement gate (D = {config.fusion.gate_angle_deg:g} deg)", gated),
        Row(f"+ inertial prior (v = {inertia:g})", _with(gated, fusion={"inertial_weight": inertia})),
    ]


def sweep_rows(config: HatConfig) -> list[Row]:
    """The sensitivity sweeps (paper, Sec. "Hyperparameter Sensitivity"): one setting varied at a time."""
    five = {"max_candidates": 5}
    rows = [
        Row(f"stride {gap}, K = 5", _with(config, keyframes={"gap_frames": gap}, hypotheses=five)) for gap in STRIDES
    ]
    rows += [Row(f"K = {k}", _with(config, hypotheses={"max_candidates": k})) for k in CANDIDATE_COUNTS]
    rows += [
        Row(f"s0 = {s0:g} px", _with(config, selector={"size_weighting": True, "size_ref_px": s0}))
        for s0 in SIZE_REFERENCES_PX
    ]
    rows.append(Row("no size weight", _with(config, selector={"size_weighting": False})))
    rows += [
        Row("D off" if angle == GATE_OFF_DEG else f"D = {angle:g} deg", _with(config, fusion={"gate_angle_deg": angle}))
        for angle in GATE_ANGLES_DEG
    ]
    rows += [Row(f"w = {w:g}", _with(config, fusion={"relative_weight": w})) for w in RELATIVE_WEIGHTS]
    return rows


def selector_rows(config: HatConfig) -> list[Row]:
    """The decoder against what could stand in its place (paper, Sec. "Continuous-State Filters")."""
    return [
        Row("best appearance", _with(config, selector=_BEST_APPEARANCE)),
        Row("forward Viterbi", config),
        Row("offline backtrace", config, offline=True),
    ]


def filter_rows(config: HatConfig) -> list[Row]:
    """The particle filter and the UKF under every setting of a search, so that each can show its best."""
    return [
        Row(
            f"{title}, motion {motion_deg:g} deg, candidates {candidate_deg:g} deg",
            config,
            selector=selector,
            noise=FilterNoise(motion_deg=motion_deg, candidate_deg=candidate_deg),
        )
        for selector, title in (("particles", "particle filter on SO(3)"), ("ukf", "UKF"))
        for motion_deg in FILTER_MOTION_DEG
        for candidate_deg in FILTER_CANDIDATE_DEG
    ]


def with_best_filters(selectors: Table, filters: Table) -> Table:
    """The table of selectors with the one setting of each filter whose anchors are closest to the truth."""
    best: dict[str, dict[str, Any]] = {}
    for row in filters.rows:
        kind = row["name"].split(",")[0]
        if kind not in best or row["anchor_deg_mean"] < best[kind]["anchor_deg_mean"]:
            best[kind] = row
    return replace(selectors, rows=[*selectors.rows, *best.values()])


def reference_rows(config: HatConfig) -> list[Row]:
    """Causal against offline on the same observations (paper, Table "Causal and offline HAT").

    Independent poses take candidates at every frame, the others at keyframes; the last two rows take them at every
    frame as well, so that nothing but the method differs.
    """
    every_frame = _with(config, keyframes={"gap_frames": 1})
    return [
        Row("independent", _with(every_frame, selector=_BEST_APPEARANCE, fusion={"relative_weight": 0.0})),
        Row("causal", config),
        Row("offline", config, offline=True),
        Row("causal, anchors at every frame", every_frame),
        Row("offline, anchors at every frame", every_frame, offline=True),
    ]


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


def _with(config: HatConfig, **sections: dict[str, Any]) -> HatConfig:
    return replace(config, **{name: replace(getattr(config, name), **values) for name, values in sections.items()})
