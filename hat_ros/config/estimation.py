"""Parameters of the estimator: keyframes, selection (Stage 3), alignment and fusion (Stage 4), refinement, priors."""

from __future__ import annotations

from dataclasses import dataclass

from hat_ros.config.option import option


@dataclass(frozen=True)
class KeyframeConfig:
    """When candidates are generated."""

    gap_frames: int = option(6, "from one anchor attempt to the next", level="paper", unit="frames", low=1)
    settled_factor: int = option(
        3, "the gap is this many times as long while the track is settled (needs prior.enabled); 1: as published", low=1
    )


@dataclass(frozen=True)
class SelectorConfig:
    """Stage 3: causal Viterbi selection."""

    score_scale: float = option(1.0, "scale of the appearance score", level="paper", symbol="alpha", low=0)
    motion_weight_per_deg: float = option(
        0.3, "penalty per degree of disagreement with the motion", level="paper", symbol="mu", unit="1/deg", low=0
    )
    max_motion_penalty: float = option(
        8.0, "limit of the motion penalty: earlier candidates may be wrong; 0: none, as published", low=0
    )
    max_turn_deg_per_frame: float = option(
        5.0, "turn that costs nothing where motion is missing; 0: any, as published", unit="deg/frame", low=0
    )
    warmup_keyframes: int = option(
        1,
        "warm-up: the decoder's choice counts from this keyframe on; appearance before",
        level="paper",
        unit="keyframes",
        low=1,
    )
    running_gate: bool = option(False, "fall back to appearance while the candidates look unreliable", level="paper")
    gate_neighbourhood_deg: float = option(
        15.0, "candidates this close to the best one count as its support", level="paper", unit="deg", low=0
    )
    gate_min_median_support: float = option(
        2.0, "running median of the support that the decoder needs", level="paper", low=0
    )
    gate_max_override_share: float = option(
        0.7, "running share of overridden keyframes that it may reach", level="paper", low=0, high=1
    )
    size_weighting: bool = option(
        False, "weight appearance by apparent size (the paper's size weight w_j)", level="paper"
    )
    size_ref_px: float = option(500.0, "apparent size of unit weight", level="paper", symbol="s0", unit="px", low=1e-6)
    size_exponent: float = option(2.0, "exponent of the size weight", level="paper", symbol="gamma", low=0)
    size_weight_min: float = option(0.05, "floor of the size weight", level="paper", symbol="w_min", low=0, high=1)


@dataclass(frozen=True)
class AlignmentConfig:
    """Stage 4a: Sim(3) from SLAM to metric target coordinates."""

    lever_m_per_rad: float = option(
        1.0,
        "weight of rotation against translation in all residuals",
        level="paper",
        symbol="lambda",
        unit="m/rad",
        low=1e-9,
    )
    min_observations: int = option(3, "joint anchor/SLAM observations of the first fit", level="paper", low=3)
    refit_interval_frames: int = option(10, "from one refit to the next", level="paper", unit="frames", low=1)
    max_observations: int = option(2048, "observations kept one by one; beyond it older inliers are folded", low=8)
    rejection_factor: float = option(
        3.0, "outliers lie beyond this factor of the inliers' median residual", level="paper", low=1
    )
    first_rejection_rounds: int = option(
        3, "rejections of outliers in the first fit, a fit after each; 2: as published", level="paper", low=0
    )
    refit_rejection_rounds: int = option(
        1, "rejections of outliers in a refit, a fit after each; 0: one plain fit, as published", level="paper", low=0
    )
    reset_anchors: int = option(
        4, "coherent disagreeing anchors in a row that drop the alignment", level="paper", low=1
    )


@dataclass(frozen=True)
class FusionConfig:
    """Stage 4b: the causal pose."""

    relative_weight: float = option(0.1, "weight of the relative-motion residual", level="paper", symbol="w", low=0)
    inertial_weight: float = option(
        0.0, "weight of the inertial prior: constant rates; 0: off, as published", level="paper", low=0
    )
    gate_angle_deg: float = option(
        30.0,
        "anchor and aligned SLAM rotation disagree beyond this angle",
        level="paper",
        symbol="D",
        unit="deg",
        low=0,
    )
    gate_weight: float = option(0.05, "weight of a disagreeing anchor", level="paper", symbol="g", low=0, high=1)
    huber_delta_m: float = option(
        0.3, "scale of the componentwise Huber loss", level="paper", symbol="delta", unit="m", low=1e-9
    )
    loss: str = option("huber", "huber or linear (squared)", level="paper", choices=("huber", "linear"))
    warmup_observations: int = option(
        4, "warm-up: joint observations since the last reset before fusion runs", level="paper", low=1
    )
    confidence: str = option(
        "uniform",
        "confidence of an anchor: uniform, or by detection_area",
        level="paper",
        choices=("uniform", "detection_area"),
    )
    confidence_exponent: float = option(1.0, "power of the relative detection area", level="paper", low=0)
    gap_fill: str = option(
        "hold",
        "hold the last pose, or rotate: SLAM rotation with held translation",
        level="paper",
        choices=("hold", "rotate"),
    )
    coast_limit_frames: int = option(
        60,
        "time without a measurement after which the target is LOST; 0: never, the last pose is held, as published",
        level="basic",
        unit="frames",
        low=0,
    )


@dataclass(frozen=True)
class RefinementConfig:
    """Refinement of every fused pose on its own image (the paper's dense refinement, causal)."""

    enabled: bool = option(True, "refine the fused pose on the current image", level="basic")
    render_px: int = option(160, "longer side of the views rendered for the contour", unit="px", low=48, high=512)
    max_points: int = option(300, "contour points used", low=50, high=5000)
    start_sigma_deg: float = option(5.0, "one sigma of the rotation that refinement starts from", unit="deg", low=0.01)
    max_rotation_deg: float = option(
        12.0, "a refinement that turns further left its basin: rejected", unit="deg", low=0, high=180
    )
    max_shift: float = option(
        0.15, "a refinement that shifts further, as a share of the range, is rejected too", low=0, high=1
    )
    min_overlap: float = option(0.6, "silhouette overlap with the mask that a supported pose needs", low=0, high=1)
    min_support: float = option(0.4, "share of the contour that must agree with the image", low=0, high=1)
    same_pose_deg: float = option(
        5.0,
        "a start this close to another one, or to a supported pose, is not refined",
        unit="deg",
        low=0,
        high=180,
    )
    switch_margin: float = option(
        0.05, "hysteresis: lead in image evidence that a second start within a basin needs", low=0
    )
    arbitration_margin: float = option(0.15, "summed lead in image evidence that decides between basins", low=0)
    certain_share: float = option(
        0.9, "overlap and support from which TRACKING needs no confirmation by a second anchor", low=0, high=1
    )
    min_margin: float = option(4.0, "lead in path score over competing basins that TRACKING needs", low=0)
    sure_margin: float = option(
        6.0, "lead in path score from which TRACKING needs no confirmation by a second anchor", low=0
    )


@dataclass(frozen=True)
class PriorConfig:
    """Fused poses of the past as a hint to the front ends."""

    enabled: bool = option(True, "let segmentation, hypotheses and slam see past fused poses", level="basic")
    delay_frames: int = option(
        4,
        "age of the youngest fused pose that they may see; at least graph.credits_replay",
        unit="frames",
        low=1,
        high=64,
    )
