"""QoS profiles, one per topic (``docs/topics.md``)."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from hat_ros.io import topics


def _profile(reliability: ReliabilityPolicy, depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability)


_RELIABLE, _VOLATILE = ReliabilityPolicy.RELIABLE, DurabilityPolicy.VOLATILE

IN_LIVE = _profile(ReliabilityPolicy.BEST_AVAILABLE, 1, _VOLATILE)
IN_REPLAY = _profile(_RELIABLE, 16, _VOLATILE)
STAGE = _profile(_RELIABLE, 16, _VOLATILE)
LATCH = _profile(_RELIABLE, 1, DurabilityPolicy.TRANSIENT_LOCAL)
OUT = _profile(_RELIABLE, 10, _VOLATILE)
DEBUG = _profile(ReliabilityPolicy.BEST_EFFORT, 1, _VOLATILE)

# A reader that has to keep the latched messages of several writers, or must never be the one that loses.
LATCH_READER = _profile(_RELIABLE, 16, DurabilityPolicy.TRANSIENT_LOCAL)
RECORDER = _profile(_RELIABLE, 256, _VOLATILE)
RECORDER_LATCH = _profile(_RELIABLE, 256, DurabilityPolicy.TRANSIENT_LOCAL)

_OF = {
    topics.INITIAL_POSE: OUT,
    topics.GIVEN_POSE: STAGE,
    **dict.fromkeys((topics.HAT_CAMERA_INFO, topics.ALIGNMENT, topics.ALIGNMENT_TRANSFORM), LATCH),
    **dict.fromkeys((topics.READY, topics.END_OF_STREAM), LATCH),
    **dict.fromkeys((topics.ADMISSION, topics.FRAME, topics.HYPOTHESES_SCORED, topics.SLAM_STATE), STAGE),
    **dict.fromkeys((topics.SELECTION, topics.STATUS), STAGE),
    **dict.fromkeys((topics.HYPOTHESES, topics.SLAM_ODOMETRY, topics.ANCHOR, topics.TARGET_POSE), OUT),
    **dict.fromkeys((topics.TARGET_POSE_WITH_COVARIANCE, topics.DIAGNOSTICS), OUT),
    topics.TF: _profile(_RELIABLE, 100, _VOLATILE),
    topics.OVERLAY: DEBUG,
}


def camera_profile(live: bool, best_effort: bool) -> QoSProfile:
    """What a camera's topic is read with: live, as reliable as the camera is."""
    if not live:
        return IN_REPLAY
    return DEBUG if best_effort else _profile(_RELIABLE, 1, _VOLATILE)


def profile_of(topic: str, live: bool = False) -> QoSProfile:
    """Profile of a topic as its publisher offers it; cameras' topics depend on the mode."""
    return _OF.get(topic, IN_LIVE if live else IN_REPLAY)


def is_latched(topic: str) -> bool:
    """Whether late joiners get the last message."""
    return profile_of(topic).durability == DurabilityPolicy.TRANSIENT_LOCAL
