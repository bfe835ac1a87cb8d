"""Parameters of the front ends: segmentation (Stage 1), hypotheses (Stage 2) and target-relative motion."""

from __future__ import annotations

from dataclasses import dataclass, field

from hat_ros.config.option import option


@dataclass(frozen=True)
class ClassicalConfig:
    """Segmentation without weights."""

    sky_border_share: float = option(0.7, "share of dark image border from which the background is black sky", low=0)
    work_side_px: int = option(96, "longer side of the reduced crop of the region model", unit="px", low=48, high=512)
    cold_side_px: int = option(
        144, "longer side of the reduced image of a search from nothing", unit="px", low=48, high=320
    )
    check_interval_frames: int = option(20, "frames between independent checks of a tracked mask", unit="frames", low=1)
    min_prior_overlap: float = option(0.6, "overlap with the mask below which a prior is not used", low=0, high=1)
    min_shape_overlap: float = option(0.75, "overlap with the nearest CAD silhouette that a found mask needs", low=0)


@dataclass(frozen=True)
class LearnedConfig:
    """Segmentation by a small network."""

    weights: str = option(
        "", "ONNX file from `hat train segmenter`; empty: the network that comes with the package", level="basic"
    )
    min_shape_overlap: float = option(
        0.35, "overlap with the nearest CAD silhouette that a mask found from nothing needs", low=0, high=1
    )


@dataclass(frozen=True)
class Mask2FormerConfig:
    """COCO instance segmentation with a class-agnostic choice."""

    min_score: float = option(0.1, "instances below this score are ignored", low=0, high=1)
    temporal_weight: float = option(1.0, "weight of the overlap with the previous mask in the choice", low=0)
    compactness_weight: float = option(0.5, "weight of the mask filling its own convex hull in the choice", low=0)


@dataclass(frozen=True)
class SegmentationConfig:
    """Stage 1."""

    backend: str = option("classical", "classical, learned, annotated or mask2former", level="basic")
    box_padding: float = option(
        0.0, "share of width/height added on each side of a given box, or pose_region's", level="basic", low=0, high=1
    )
    pose_region: str = option(
        "detection",
        "what hypotheses see of a silhouette: detection (all of it), or box (its box alone, padded by box_padding)",
        level="paper",
        choices=("detection", "box"),
    )
    min_area_px: int = option(60, "smallest mask that counts as a detection", level="basic", unit="px", low=1)
    classical: ClassicalConfig = field(default_factory=ClassicalConfig)
    learned: LearnedConfig = field(default_factory=LearnedConfig)
    mask2former: Mask2FormerConfig = field(default_factory=Mask2FormerConfig)


@dataclass(frozen=True)
class TemplateConfig:
    """Training-free hypotheses: view bank and refinement."""

    n_views: int = option(642, "view directions on the sphere: 162, 642 or 2562", low=162, high=2562)
    n_angles: int = option(72, "in-plane angles compared for each view", low=24, high=360)
    n_coarse: int = option(24, "distinct shape matches (x3 without a prior); a third is refined", low=1, high=256)
    n_coarse_lit: int = option(8, "distinct matches of brightness that are refined before a black sky", low=1, high=64)
    separation_deg: float = option(15.0, "candidates closer than this are one basin", unit="deg", low=1, high=90)
    render_px: int = option(
        96, "longer side of the views rendered for refinement and scoring", unit="px", low=48, high=512
    )


@dataclass(frozen=True)
class MegaPoseConfig:
    """MegaPose (published settings), also the refiner of GigaPose."""

    refiner_iterations: int = option(5, "render-and-compare iterations per candidate", level="paper", low=0, high=50)
    box_padding: float = option(
        0.1, "share of width/height added on each side of the detection box", level="paper", low=0, high=1
    )
    batch_size: int = option(64, "images per network pass; memory against speed", level="basic", low=1, high=4096)


@dataclass(frozen=True)
class PicoPoseConfig:
    """PicoPose (published settings), also the templates of GigaPose."""

    ransac_threshold_px: float = option(
        2.0, "reprojection error of a PnP inlier, image pixels", level="paper", unit="px", low=0.01
    )
    ransac_iterations: int = option(150, "PnP-RANSAC iterations", level="paper", low=1)
    batch_size: int = option(16, "templates per transformer pass at start-up", level="basic", low=1, high=1024)


@dataclass(frozen=True)
class HypothesesConfig:
    """Stage 2."""

    backend: str = option("template", "template, megapose, picopose or gigapose", level="basic")
    max_candidates: int = option(10, "pose hypotheses per keyframe", level="paper", symbol="K", low=1, high=64)
    guard: bool = option(False, "drop implausible candidates (score, depth, range) before selection", level="paper")
    template: TemplateConfig = field(default_factory=TemplateConfig)
    megapose: MegaPoseConfig = field(default_factory=MegaPoseConfig)
    picopose: PicoPoseConfig = field(default_factory=PicoPoseConfig)


@dataclass(frozen=True)
class FeatureSlamConfig:
    """Training-free target-relative motion."""

    max_points: int = option(200, "point tracks kept alive", low=16, high=2000)
    spacing_px: float = option(4.0, "least distance between a new point and any other", unit="px", low=1)
    window_frames: int = option(10, "frames adjusted together, spread over the span", unit="frames", low=8, high=64)
    window_span_frames: int = option(60, "age at which a frame leaves the window", unit="frames", low=8, high=1000)
    iterations: int = option(3, "bundle adjustment steps per frame", low=1, high=50)
    sigma_px: float = option(
        1.0, "standard deviation of a track: errors persist, so more than its jitter", unit="px", low=0.01
    )
    cutoff_px: float = option(1.0, "scale of the redescending loss on tracks", unit="px", low=0.1)
    turn_acceleration_deg_s2: float = option(
        1.0, "standard deviation of the angular acceleration", unit="deg/s^2", low=1e-3
    )
    move_acceleration_radii_s2: float = option(
        1.0, "standard deviation of the linear acceleration, in target radii", unit="radii/s^2", low=1e-3
    )
    max_step_sigma_deg: float = option(1.0, "a step less certain than this is no motion", unit="deg", low=0.01)
    use_prior: bool = option(True, "let healthy priors bring CAD depth and rotation (masked only; needs prior.enabled)")
    surface_sigma: float = option(0.03, "uncertainty of CAD depth, share of the target's bounding radius", low=1e-3)
    prior_turn_sigma_deg: float = option(
        0.3, "uncertainty of a fused rotation relative to others", unit="deg", low=0.01
    )


@dataclass(frozen=True)
class DroidConfig:
    """DROID-SLAM; distances are flow in units of 8 pixels of the resized image."""

    input_area_px: int = option(
        196608, "image area after resizing (SwissCube: 393216)", level="paper", unit="px", low=4096, high=4194304
    )
    correlation: str = option(
        "auto",
        "stored volumes, on_the_fly (less memory, more work), or auto: stored while they fit in 4 GiB",
        level="basic",
        choices=("auto", "stored", "on_the_fly"),
    )
    warmup_keyframes: int = option(
        8, "keyframes of the first bundle adjustment", level="paper", unit="keyframes", low=5, high=64
    )
    filter_threshold: float = option(
        2.4, "mean flow from the last keyframe that makes a new one", level="paper", unit="8 px", low=0
    )
    keyframe_threshold: float = option(
        4.0, "a keyframe between two closer than twice this is removed", level="paper", unit="8 px", low=0
    )
    beta: float = option(
        0.3, "share of the full motion in frame distances; the rest is translation", level="paper", low=0, high=1
    )
    frontend_threshold: float = option(
        16.0, "largest frame distance of a local edge", level="paper", unit="8 px", low=0
    )
    frontend_window: int = option(
        25, "keyframes that local edges reach back", level="paper", unit="keyframes", low=8, high=256
    )
    frontend_radius: int = option(
        2, "neighbours in time that are always connected, less one", level="paper", low=1, high=8
    )
    frontend_nms: int = option(
        1, "edges keep others this far away in the plane of frame pairs", level="paper", low=0, high=8
    )
    motion_damping: float = option(
        0.0, "share of the last motion in the guess of the next pose", level="paper", low=0, high=1
    )
    readout_updates: int = option(
        3, "motion-only updates of the pose of a frame that is no keyframe", level="paper", low=1, high=32
    )
    readout_depths: bool = option(
        False,
        "motion-only updates move the depths of the last two keyframes; helps where new surface turns into view",
    )
    as_released: bool = option(
        True,
        "like the released tracker: back-substitution without the first pose, context of the first frame, one fixed "
        "pose; false corrects the first two and holds the scale with a second one",
        level="paper",
    )
    backend_threshold: float = option(
        22.0, "offline only: largest frame distance of a global edge", level="paper", unit="8 px", low=0
    )
    backend_radius: int = option(
        2, "offline only: neighbours in time that are always connected, less one", level="paper", low=1
    )
    backend_nms: int = option(3, "offline only: suppression radius of global edges", level="paper", low=0, high=8)


@dataclass(frozen=True)
class SlamConfig:
    """Target-relative motion."""

    backend: str = option("feature", "feature or droid", level="basic")
    masked: bool = option(
        True, "suppress the background; false for a static scene seen by a moving camera", level="basic"
    )
    feature: FeatureSlamConfig = field(default_factory=FeatureSlamConfig)
    droid: DroidConfig = field(default_factory=DroidConfig)
