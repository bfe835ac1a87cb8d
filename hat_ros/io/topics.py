"""Names, types and table columns of every topic (``docs/topics.md``); bags need them without any middleware.

Names are those in the default namespace and in bags; see :func:`relative`.
"""

from __future__ import annotations

IMAGE = "/image"
IMAGE_COMPRESSED = "/image/compressed"
CAMERA_INFO = "/camera_info"
DETECTION_MASK = "/detection/mask"
GROUND_TRUTH = "/ground_truth/target_pose"
INITIAL_POSE = "/initialpose"

HAT_CAMERA_INFO = "/hat/camera_info"
ADMISSION = "/hat/admission"
GIVEN_POSE = "/hat/initial_pose"
FRAME = "/hat/frame"
HYPOTHESES_SCORED = "/hat/hypotheses_scored"
HYPOTHESES = "/hat/hypotheses"
SLAM_STATE = "/hat/slam_state"
SLAM_ODOMETRY = "/hat/slam_odometry"
SELECTION = "/hat/selection"
ANCHOR = "/hat/anchor"
ALIGNMENT = "/hat/alignment"
ALIGNMENT_TRANSFORM = "/hat/alignment_transform"
STATUS = "/hat/status"
TARGET_POSE = "/target_pose"
TARGET_POSE_WITH_COVARIANCE = "/target_pose_with_covariance"
TF = "/tf"
OVERLAY = "/hat/overlay/compressed"
DIAGNOSTICS = "/diagnostics"
READY = "/hat/ready"
END_OF_STREAM = "/hat/end_of_stream"
RESET = "/hat/reset"

TYPES: dict[str, str] = {
    IMAGE: "sensor_msgs/msg/Image",
    IMAGE_COMPRESSED: "sensor_msgs/msg/CompressedImage",
    CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    DETECTION_MASK: "sensor_msgs/msg/Image",
    INITIAL_POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    HAT_CAMERA_INFO: "sensor_msgs/msg/CameraInfo",
    ADMISSION: "sensor_msgs/msg/PointCloud2",
    GIVEN_POSE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    FRAME: "sensor_msgs/msg/Image",
    HYPOTHESES_SCORED: "sensor_msgs/msg/PointCloud2",
    HYPOTHESES: "geometry_msgs/msg/PoseArray",
    SLAM_STATE: "sensor_msgs/msg/PointCloud2",
    SLAM_ODOMETRY: "nav_msgs/msg/Odometry",
    SELECTION: "sensor_msgs/msg/PointCloud2",
    ANCHOR: "geometry_msgs/msg/PoseStamped",
    ALIGNMENT: "sensor_msgs/msg/PointCloud2",
    ALIGNMENT_TRANSFORM: "geometry_msgs/msg/TransformStamped",
    STATUS: "sensor_msgs/msg/PointCloud2",
    TARGET_POSE: "geometry_msgs/msg/PoseStamped",
    TARGET_POSE_WITH_COVARIANCE: "geometry_msgs/msg/PoseWithCovarianceStamped",
    TF: "tf2_msgs/msg/TFMessage",
    OVERLAY: "sensor_msgs/msg/CompressedImage",
    DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    READY: "std_msgs/msg/Header",
    END_OF_STREAM: "std_msgs/msg/Header",
}

# Topics of the whole machine, the same in every namespace, as the tools that read them expect.
ABSOLUTE = (TF, DIAGNOSTICS)


def relative(topic: str) -> str:
    """The topic as a node asks for it: relative to its namespace, unless it is one of the whole machine."""
    return topic if topic in ABSOLUTE else topic.removeprefix("/")


# What a result bag holds: everything that the graph sends, images excepted.
RECORDED = (
    HAT_CAMERA_INFO,
    ADMISSION,
    GIVEN_POSE,
    HYPOTHESES_SCORED,
    HYPOTHESES,
    SLAM_STATE,
    SLAM_ODOMETRY,
    SELECTION,
    ANCHOR,
    ALIGNMENT,
    ALIGNMENT_TRANSFORM,
    STATUS,
    TARGET_POSE,
    TARGET_POSE_WITH_COVARIANCE,
    DIAGNOSTICS,
)

# Figure in the diagnostics of a stage's node: mean wall time per frame, milliseconds.
STEP_MS = "step_ms"
# Figure in the diagnostics of segmentation: JSON list of `count` and `first` sentence by reason.
REFUSED_REASONS = "refused_reasons"

# Columns of the table topics, in order; all FLOAT64.
POSE_COLUMNS = ("x", "y", "z", "qx", "qy", "qz", "qw")
CANDIDATE_COLUMNS = (*POSE_COLUMNS, "score", "rank", "bx0", "by0", "bx1", "by1")
SELECTION_COLUMNS = (*CANDIDATE_COLUMNS, "scaled_score", "path_score", "selected")
MOTION_COLUMNS = ("valid", "epoch", *POSE_COLUMNS, "n_keyframes")
ALIGNMENT_COLUMNS = ("version", "scale", "qx", "qy", "qz", "qw", "tx", "ty", "tz", "n_anchors", "rms", "epoch")
STATUS_COLUMNS = (
    "state",
    "seq",
    "keyframe",
    "n_candidates",
    "anchor",
    "gate_weight",
    "alignment_version",
    "slam_epoch",
    "gap_frames",
    "dropped_total",
    *POSE_COLUMNS,
    "reason",
    # Upper triangle, row by row.
    *(f"cov{i}{j}" for i in range(6) for j in range(i, 6)),
    "order",
    "free_axes",
)
# Those of the first release: columns are added at the end only, and readers accept fewer and more from here on.
N_STATUS_AT_FIRST = 17
ADMISSION_COLUMNS = ("seq", "dropped_total", "epoch", "resumed", "initial_pose")
