"""Every parameter of the system: typed, frozen, with its unit, range and meaning.

The dataclasses below are the single source: YAML presets override them, ``--set key=value`` overrides YAML, the nodes
declare the same names as ROS parameters, and each run writes back what it used. An unknown key, a wrong type or a
value out of range is a :class:`~hat_ros.errors.ConfigError` that names the key and the nearest known one.

Symbols in parentheses are the paper's. ``*_px`` are pixels, ``*_deg`` degrees, ``*_m`` metres, ``*_s`` seconds; frame
counts are input frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from hat_ros.errors import ConfigError


def option(
    default: Any, doc: str, *, low: float | None = None, high: float | None = None, choices: tuple[str, ...] = ()
) -> Any:
    """A parameter with its one-line description and what values it accepts."""
    return field(default=default, metadata={"doc": doc, "low": low, "high": high, "choices": choices})


@dataclass(frozen=True)
class KeyframeConfig:
    """When candidates are generated."""

    gap_frames: int = option(6, "frames from one anchor attempt to the next", low=1)
    settled_factor: int = option(1, "the gap is this many times as long while the track is settled", low=1)


@dataclass(frozen=True)
class ClassicalConfig:
    """Segmentation without weights."""

    sky_border_share: float = option(0.7, "share of dark image border from which the background is black sky", low=0)
    work_side_px: int = option(96, "longer side of the reduced crop of the region model", low=48, high=512)
    cold_side_px: int = option(144, "longer side of the reduced image of a search from nothing", low=48, high=320)
    check_interval_frames: int = option(20, "frames between independent checks of a tracked mask", low=1)
    min_prior_overlap: float = option(0.6, "overlap with the mask below which a prior is not used", low=0, high=1)
    min_shape_overlap: float = option(0.75, "overlap with the nearest CAD silhouette that a found mask needs", low=0)


@dataclass(frozen=True)
class Mask2FormerConfig:
    """COCO instance segmentation with a class-agnostic choice."""

    min_score: float = option(0.1, "instances below this score are ignored", low=0, high=1)
    temporal_weight: float = option(1.0, "weight of the overlap with the previous mask in the choice", low=0)
    compactness_weight: float = option(0.5, "weight of the mask filling its own convex hull in the choice", low=0)


@dataclass(frozen=True)
class SegmentationConfig:
    """Stage 1."""

    backend: str = option("classical", "classical, annotated or mask2former")
    box_padding: float = option(0.0, "share of width/height added on each side of a given box", low=0, high=1)
    min_area_px: int = option(60, "smallest mask that counts as a detection", low=1)
    classical: ClassicalConfig = field(default_factory=ClassicalConfig)
    mask2former: Mask2FormerConfig = field(default_factory=Mask2FormerConfig)


@dataclass(frozen=True)
class TemplateConfig:
    """Training-free hypotheses: view bank and refinement."""

    n_views: int = option(642, "view directions on the sphere: 162, 642 or 2562", low=162, high=2562)
    n_angles: int = option(72, "in-plane angles compared for each view", low=24, high=360)
    n_coarse: int = option(24, "distinct shape matches (x3 without a prior); a third is refined", low=1, high=256)
    n_coarse_lit: int = option(8, "distinct matches of brightness that are refined before a black sky", low=1, high=64)
    separation_deg: float = option(15.0, "candidates closer than this are one basin", low=1, high=90)
    render_px: int = option(96, "longer side of the views rendered for refinement and scoring", low=48, high=512)


@dataclass(frozen=True)
class MegaPoseConfig:
    """MegaPose (published settings), also the refiner of GigaPose."""

    refiner_iterations: int = option(5, "render-and-compare iterations per candidate", low=0, high=50)
    box_padding: float = option(0.2, "share of width/height added on each side of the detection box", low=0, high=1)
    batch_size: int = option(64, "images per network pass; memory against speed", low=1, high=4096)


@dataclass(frozen=True)
class PicoPoseConfig:
    """PicoPose (published settings), also the templates of GigaPose."""

    ransac_threshold_px: float = option(2.0, "reprojection error of a PnP inlier, image pixels", low=0.01)
    ransac_iterations: int = option(150, "PnP-RANSAC iterations", low=1)
    batch_size: int = option(16, "templates per transformer pass at start-up", low=1, high=1024)


@dataclass(frozen=True)
class HypothesesConfig:
    """Stage 2."""

    backend: str = option("template", "template, megapose, picopose or gigapose")
    max_candidates: int = option(10, "K: pose hypotheses per keyframe", low=1, high=64)
    guard: bool = option(False, "drop implausible candidates (score, depth, range) before selection")
    template: TemplateConfig = field(default_factory=TemplateConfig)
    megapose: MegaPoseConfig = field(default_factory=MegaPoseConfig)
    picopose: PicoPoseConfig = field(default_factory=PicoPoseConfig)


@dataclass(frozen=True)
class FeatureSlamConfig:
    """Training-free target-relative motion."""

    max_points: int = option(200, "point tracks kept alive", low=16, high=2000)
    spacing_px: float = option(4.0, "least distance between a new point and any other, px", low=1)
    window_frames: int = option(10, "frames adjusted together, spread over the span", low=8, high=64)
    window_span_frames: int = option(60, "age at which a frame leaves the window", low=8, high=1000)
    iterations: int = option(3, "bundle adjustment steps per frame", low=1, high=50)
    sigma_px: float = option(1.0, "standard deviation of a track: errors persist, so more than its jitter", low=0.01)
    cutoff_px: float = option(1.0, "scale of the redescending loss on tracks, px", low=0.1)
    turn_acceleration_deg_s2: float = option(1.0, "standard deviation of the angular acceleration", low=1e-3)
    move_acceleration_radii_s2: float = option(1.0, "of the linear acceleration, in target radii", low=1e-3)
    max_step_sigma_deg: float = option(1.0, "a step less certain than this is no motion", low=0.01)
    use_prior: bool = option(True, "let healthy priors bring CAD depth and rotation (masked only; needs prior.enabled)")
    surface_sigma: float = option(0.03, "uncertainty of CAD depth, share of the target's bounding radius", low=1e-3)
    prior_turn_sigma_deg: float = option(0.3, "uncertainty of a fused rotation relative to others", low=0.01)


@dataclass(frozen=True)
class DroidConfig:
    """DROID-SLAM; distances are flow in units of 8 pixels of the resized image."""

    input_area_px: int = option(196608, "image area after resizing, px (SwissCube: 393216)", low=4096, high=4194304)
    correlation: str = option(
        "auto",
        "stored volumes, on_the_fly (less memory, more work), or auto: stored while they fit in 4 GiB",
        choices=("auto", "stored", "on_the_fly"),
    )
    warmup_keyframes: int = option(8, "keyframes of the first bundle adjustment", low=5, high=64)
    filter_threshold: float = option(2.4, "mean flow from the last keyframe that makes a new one", low=0)
    keyframe_threshold: float = option(4.0, "a keyframe between two closer than twice this is removed", low=0)
    beta: float = option(0.3, "share of the full motion in frame distances; the rest is translation", low=0, high=1)
    frontend_threshold: float = option(16.0, "largest frame distance of a local edge", low=0)
    frontend_window: int = option(25, "keyframes that local edges reach back", low=8, high=256)
    frontend_radius: int = option(2, "neighbours in time that are always connected, less one", low=1, high=8)
    frontend_nms: int = option(1, "edges keep others this far away in the plane of frame pairs", low=0, high=8)
    motion_damping: float = option(0.0, "share of the last motion in the guess of the next pose", low=0, high=1)
    readout_updates: int = option(3, "motion-only updates of the pose of a frame that is no keyframe", low=1, high=32)
    readout_depths: bool = option(
        False,
        "let these updates move the depths of the last two keyframes too; helps where new surface turns into view",
    )
    as_released: bool = option(
        True,
        "like the released tracker: back-substitution without the first pose, context of the first frame, one fixed "
        "pose; false corrects the first two and holds the scale with a second one",
    )
    backend_threshold: float = option(22.0, "offline only: largest frame distance of a global edge", low=0)
    backend_radius: int = option(2, "offline only: neighbours in time that are always connected, less one", low=1)
    backend_nms: int = option(3, "offline only: suppression radius of global edges", low=0, high=8)


@dataclass(frozen=True)
class SlamConfig:
    """Target-relative motion."""

    backend: str = option("feature", "feature or droid")
    masked: bool = option(True, "suppress the background; false for a static scene seen by a moving camera")
    feature: FeatureSlamConfig = field(default_factory=FeatureSlamConfig)
    droid: DroidConfig = field(default_factory=DroidConfig)


@dataclass(frozen=True)
class SelectorConfig:
    """Stage 3: causal Viterbi selection."""

    score_scale: float = option(3.0, "alpha: scale of the appearance score", low=0)
    motion_weight_per_deg: float = option(0.3, "mu: penalty per degree of disagreement with the motion", low=0)
    max_motion_penalty: float = option(0.0, "limit of that penalty: earlier candidates may be wrong; 0: none", low=0)
    max_turn_deg_per_frame: float = option(0.0, "turn that costs nothing where motion is missing; 0: any", low=0)
    warmup_keyframes: int = option(1, "the decoder's choice counts from this keyframe on; appearance before", low=1)
    running_gate: bool = option(False, "fall back to appearance while the candidates look unreliable")
    gate_neighbourhood_deg: float = option(15.0, "candidates this close to the best one count as its support", low=0)
    gate_min_median_support: float = option(2.0, "running median of the support that the decoder needs", low=0)
    gate_max_override_share: float = option(0.7, "running share of overridden keyframes it may reach", low=0, high=1)
    size_weighting: bool = option(False, "weight appearance by apparent size, eq. (sizew)")
    size_ref_px: float = option(500.0, "s0: apparent size of unit weight", low=1e-6)
    size_exponent: float = option(2.0, "gamma of the size weight", low=0)
    size_weight_min: float = option(0.05, "w_min: floor of the size weight", low=0, high=1)


@dataclass(frozen=True)
class AlignmentConfig:
    """Stage 4a: Sim(3) from SLAM to metric target coordinates."""

    lever_m_per_rad: float = option(1.0, "lambda: metres per radian in all residuals", low=1e-9)
    min_observations: int = option(3, "joint anchor/SLAM observations of the first fit", low=3)
    refit_interval_frames: int = option(10, "frames between refits", low=1)
    max_observations: int = option(2048, "observations kept one by one; beyond it older inliers are folded", low=8)
    rejection_factor: float = option(3.0, "outliers lie beyond this factor of the inliers' median residual", low=1)
    first_rejection_rounds: int = option(3, "outlier rounds of the first fit", low=0)
    refit_rejection_rounds: int = option(1, "outlier rounds of a refit", low=0)
    reset_anchors: int = option(4, "coherent disagreeing anchors in a row that drop the alignment", low=1)


@dataclass(frozen=True)
class FusionConfig:
    """Stage 4b: the causal pose."""

    relative_weight: float = option(0.1, "w: weight of the relative-motion residual", low=0)
    inertial_weight: float = option(0.0, "weight of the inertial prior: constant rates; 0 = off, as published", low=0)
    gate_angle_deg: float = option(30.0, "D: anchor and aligned SLAM rotation disagree beyond this angle", low=0)
    gate_weight: float = option(0.05, "g of a disagreeing anchor", low=0, high=1)
    huber_delta_m: float = option(0.3, "delta: scale of the componentwise Huber loss", low=1e-9)
    loss: str = option("huber", "huber or linear (squared)", choices=("huber", "linear"))
    warmup_observations: int = option(4, "joint observations since the last reset before fusion runs", low=1)
    confidence: str = option("uniform", "uniform or detection_area", choices=("uniform", "detection_area"))
    confidence_exponent: float = option(1.0, "power of the relative detection area", low=0)
    gap_fill: str = option("hold", "hold, or rotate: SLAM rotation with held translation", choices=("hold", "rotate"))
    coast_limit_frames: int = option(60, "frames without a measurement after which the target is LOST", low=1)


@dataclass(frozen=True)
class RefinementConfig:
    """Refinement of every fused pose on its own image (the paper's dense refinement, causal)."""

    enabled: bool = option(False, "refine the fused pose on the current image")
    render_px: int = option(160, "longer side of the views rendered for the contour", low=48, high=512)
    max_points: int = option(300, "contour points used", low=50, high=5000)
    start_sigma_deg: float = option(5.0, "one sigma of the rotation that refinement starts from", low=0.01)
    max_rotation_deg: float = option(12.0, "a refinement that turns further left its basin: refused", low=0, high=180)
    max_shift: float = option(0.15, "and so is one that moves further, as a share of the range", low=0, high=1)
    min_overlap: float = option(0.6, "silhouette overlap with the mask that a supported pose needs", low=0, high=1)
    min_support: float = option(0.4, "share of the contour that must agree with the image", low=0, high=1)
    same_pose_deg: float = option(
        5.0, "a start this close to another one, or to a supported pose, is not refined", low=0, high=180
    )
    switch_margin: float = option(0.05, "lead in image evidence that a second start within a basin needs", low=0)
    arbitration_margin: float = option(0.15, "summed lead in image evidence that decides between basins", low=0)
    certain_share: float = option(0.9, "overlap and support that need no second anchor to be TRACKING", low=0, high=1)
    min_margin: float = option(4.0, "lead in path score over other basins that TRACKING needs", low=0)
    sure_margin: float = option(6.0, "such a lead that needs no second anchor to be TRACKING", low=0)


@dataclass(frozen=True)
class PriorConfig:
    """Fused poses of the past as a hint to the front ends (DESIGN 5.4)."""

    enabled: bool = option(False, "let segmentation, hypotheses and slam see past fused poses")
    delay_frames: int = option(4, "youngest fused pose they may see; never less than the credits W", low=1, high=64)


@dataclass(frozen=True)
class NetsConfig:
    """Where and how the learned backends run."""

    device: str = option("auto", "auto (cuda if there is one), cpu, cuda or cuda:N")
    precision: str = option(
        "auto",
        "of networks on cuda: auto (as released: DROID float16, others float32), float32, float16 or bfloat16",
        choices=("auto", "float32", "float16", "bfloat16"),
    )
    weights_folder: str = option("", "folder of the checkpoints; empty: HAT_WEIGHTS, else the user's data folder")


@dataclass(frozen=True)
class GraphConfig:
    """The ROS graph."""

    credits_replay: int = option(4, "W: frames in flight during replay", low=1, high=16)
    stage_timeout_s: float = option(30.0, "a stage that does not answer in this time is an error", low=0.1)
    startup_timeout_s: float = option(180.0, "a node that is not ready, nor says why, in this time is an error", low=1)
    debug_stage_delay_ms: float = option(0.0, "for latency studies: random extra time per frame, at most this", low=0)


@dataclass(frozen=True)
class HatConfig:
    """The whole configuration; one attribute per section of the YAML file."""

    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    segmentation: SegmentationConfig = field(default_factory=SegmentationConfig)
    hypotheses: HypothesesConfig = field(default_factory=HypothesesConfig)
    slam: SlamConfig = field(default_factory=SlamConfig)
    selector: SelectorConfig = field(default_factory=SelectorConfig)
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    fusion: FusionConfig = field(default_factory=FusionConfig)
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    nets: NetsConfig = field(default_factory=NetsConfig)
    graph: GraphConfig = field(default_factory=GraphConfig)

    def __post_init__(self) -> None:
        if self.prior.enabled and self.prior.delay_frames < self.graph.credits_replay:
            raise ConfigError(
                f"prior.delay_frames is {self.prior.delay_frames} but must be at least graph.credits_replay "
                f"({self.graph.credits_replay}): a prior may never depend on a frame still in flight"
            )
