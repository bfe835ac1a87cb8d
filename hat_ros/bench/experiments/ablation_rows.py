"""The rows of the ablation tables: what each one is called, and which settings of Stages 3 and 4 it stands for."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Any

from hat_ros.bench.methods.filters import FilterNoise, ParticleSelector, UkfSelector
from hat_ros.bench.methods.temporal import replay_offline, replay_temporal
from hat_ros.config import HatConfig, flat_options
from hat_ros.io.run_log import RunLog

# No rotation disagrees by more: the gate is off.
GATE_OFF_DEG = 180.0
STRIDES = (5, 10, 20, 40)
CANDIDATE_COUNTS = (5, 10)
# Of the configuration's s0; the paper's 300 to 600 of 500 pixels, for images of any size.
SIZE_REFERENCE_FACTORS = (0.6, 0.8, 1.0, 1.2)
GATE_ANGLES_DEG = (45.0, 75.0, 120.0, GATE_OFF_DEG)
RELATIVE_WEIGHTS = (0.05, 0.1, 0.25, 0.5)
FILTER_MOTION_DEG = (1.0, 3.0, 10.0)
FILTER_CANDIDATE_DEG = (3.0, 10.0, 30.0)

# What may stand in Stage 3's place.
_SELECTORS = {"viterbi": None, "particles": ParticleSelector, "ukf": UkfSelector}
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
        """What differs from the configuration of the other runs, and what ran."""
        usual = {key: value for key, (value, _) in flat_options(base).items()}
        changed = {key: v for key, (v, _) in flat_options(self.config).items() if v != usual[key]}
        noise = None if self.noise is None else asdict(self.noise)
        ran = {"offline": self.offline, "selector": self.selector, "noise": noise}
        return {"name": self.name, **ran, "settings": changed}


def table_rows(config: HatConfig) -> dict[str, list[Row]]:
    """The rows that are made from the masked observations, by table."""
    return {
        "components": component_rows(config),
        "sensitivity": sweep_rows(config),
        "selectors": selector_rows(config),
        "filters": filter_rows(config),
        "offline": reference_rows(config),
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
    references_px = [factor * config.selector.size_ref_px for factor in SIZE_REFERENCE_FACTORS]
    rows += [
        Row(f"s0 = {s0:g} px", _with(config, selector={"size_weighting": True, "size_ref_px": s0}))
        for s0 in references_px
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


def _with(config: HatConfig, **sections: dict[str, Any]) -> HatConfig:
    return replace(config, **{name: replace(getattr(config, name), **values) for name, values in sections.items()})
