"""Every parameter of the system: typed, frozen, with its unit, range and meaning.

``HatConfig()`` is the ``default`` preset. Other presets and files state what differs from it, ``--set key=value``
overrides them, the nodes declare the same names as ROS parameters, and each run writes back what it used. An unknown
key, a wrong type or a value out of range is a :class:`~hat_ros.errors.ConfigError` that names the key and the nearest
known one.

``*_px`` are pixels, ``*_deg`` degrees, ``*_m`` metres, ``*_s`` seconds; frame counts are input frames.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from hat_ros.config.estimation import (
    AlignmentConfig,
    FusionConfig,
    KeyframeConfig,
    PriorConfig,
    RefinementConfig,
    SelectorConfig,
)
from hat_ros.config.front_ends import HypothesesConfig, SegmentationConfig, SlamConfig
from hat_ros.config.option import option
from hat_ros.errors import ConfigError


@dataclass(frozen=True)
class NetsConfig:
    """Where and how the learned backends run."""

    device: str = option(
        "auto",
        "auto (cuda if there is one), cpu, cuda or cuda:N; single networks elsewhere: auto,droid=cuda:1",
        level="basic",
    )
    precision: str = option(
        "auto",
        "precision on cuda: auto (as released: DROID float16, others float32), float32, float16 or bfloat16",
        level="basic",
        choices=("auto", "float32", "float16", "bfloat16"),
    )
    weights_folder: str = option(
        "", "folder of the checkpoints; empty: HAT_WEIGHTS, else the user's data folder", level="basic"
    )
    allow_unverified: bool = option(False, "take checkpoints of another checksum than the published one", level="basic")


@dataclass(frozen=True)
class CameraConfig:
    """What the messages of a camera do not say."""

    rectified: str = option(
        "auto",
        "which image camera_info describes: true (rectified: P), false (raw: K, and the distortion D is undone), "
        "auto (by the topic's name)",
        level="basic",
        choices=("auto", "true", "false"),
    )
    image_depth: str = option(
        "auto",
        "significant bits of 16-bit images: 8 to 16, or auto (the smallest of 10, 12, 14, 16 that holds all values "
        "seen so far)",
        level="basic",
        choices=("auto", "8", "9", "10", "11", "12", "13", "14", "15", "16"),
    )
    transport: str = option(
        "auto",
        "live: raw (the topic image), compressed (image/compressed), or auto (what is published; raw if both are)",
        choices=("auto", "raw", "compressed"),
    )


@dataclass(frozen=True)
class InitialPoseConfig:
    """Where a navigation solution expects the target in the first frame of a recording."""

    pose: str = option(
        "",
        "coarse pose of the target in the camera frame, 'x y z qx qy qz qw' (m, unit quaternion), that narrows the "
        "search until the target is found; empty: search everywhere",
        level="basic",
    )
    sigma: str = option(
        "",
        "its 1 sigma: 6 numbers, x y z (m) and rotation about the camera's x y z (rad), or the 36 of the covariance, "
        "row by row; large = unknown (from 1.05 rad on nothing is known of a rotation)",
        level="basic",
    )


@dataclass(frozen=True)
class GraphConfig:
    """The ROS graph."""

    credits_replay: int = option(
        4, "credits: frames in flight during replay", level="basic", unit="frames", low=1, high=16
    )
    publish_initialising: bool = option(
        False,
        "send poses of a target that was never confirmed (state INITIALISING) on target_pose, too; they are in status "
        "and in every record in any case",
        level="basic",
    )
    credits_live: int = option(
        1, "credits live: 2 frames in flight give more poses per second, each later", unit="frames", low=1, high=2
    )
    stage_timeout_s: float = option(
        30.0,
        "a stage that takes longer over a frame is an error; networks on a CPU need minutes",
        level="basic",
        unit="s",
        low=0.1,
    )
    live_timeout_s: float = option(
        1.0,
        "live: a frame without an answer for so long is given up and the next one enters; after each in a row twice as "
        "long, at most stage_timeout_s",
        level="basic",
        unit="s",
        low=0.1,
    )
    startup_timeout_s: float = option(
        180.0,
        "a node that takes longer to start, without an error of its own, is an error",
        level="basic",
        unit="s",
        low=1,
    )
    debug_stage_delay_ms: float = option(
        0.0, "for latency studies: random extra time per frame, at most this", unit="ms", low=0
    )


@dataclass(frozen=True)
class HatConfig:
    """The whole configuration; one attribute per section of the YAML file."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    initial_pose: InitialPoseConfig = field(default_factory=InitialPoseConfig)
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
        for name in ("credits_replay", "credits_live"):
            credits = getattr(self.graph, name)
            if self.prior.enabled and self.prior.delay_frames < credits:
                raise ConfigError(
                    f"prior.delay_frames is {self.prior.delay_frames} but must be at least graph.{name} "
                    f"({credits}): a prior may never depend on a frame still in flight"
                )
