"""What fusion publishes for users: the pose, its covariance, the transform, and the alignment when it changes."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np

from hat_ros.io import topics
from hat_ros.io.messages import Wire, message_class
from hat_ros.ros.endpoints import Endpoints
from hat_ros.types import Estimate


class PoseOutput:
    """Publishes estimates.

    Args:
        endpoints: where the publishers are created.
        wire: encodes messages.
        target_frame_id: name of the target (CAD) frame.
        publish_initialising: option ``graph.publish_initialising``.
        publish_tf: also as a transform on ``/tf``.

    Attributes:
        n_published: poses sent so far.
    """

    def __init__(
        self, endpoints: Endpoints, wire: Wire, target_frame_id: str, publish_initialising: bool, *, publish_tf: bool
    ) -> None:
        self._wire = wire
        self._target_frame_id = target_frame_id
        self._publish_initialising = publish_initialising
        self._version = 0
        self.n_published = 0
        self._pose = endpoints.output(topics.TARGET_POSE)
        self._with_covariance = endpoints.output(topics.TARGET_POSE_WITH_COVARIANCE)
        self._alignment = endpoints.output(topics.ALIGNMENT)
        self._alignment_transform = endpoints.output(topics.ALIGNMENT_TRANSFORM)
        self._tf = endpoints.output(topics.TF) if publish_tf and find_spec("tf2_msgs") else None

    def publish(self, frame_id: str, estimate: Estimate) -> None:
        """Publish the alignment if it changed, and the pose if it was confirmed or others are asked for."""
        self._publish_alignment(estimate)
        if estimate.state.is_published(self._publish_initialising):
            self._publish_pose(frame_id, estimate)

    def _publish_pose(self, frame_id: str, estimate: Estimate) -> None:
        self.n_published += 1
        stamp_ns, row, make = estimate.stamp_ns, estimate.pose_row, self._wire
        self._pose.publish(make.pose(stamp_ns, frame_id, row))
        self._with_covariance.publish(make.pose_with_covariance(stamp_ns, frame_id, row, estimate.covariance))
        if self._tf is not None:
            transform = make.transform(stamp_ns, frame_id, self._target_frame_id, row)
            self._tf.publish(message_class(topics.TYPES[topics.TF])(transforms=[transform]))

    def _publish_alignment(self, estimate: Estimate) -> None:
        alignment, stamp_ns = estimate.alignment, estimate.stamp_ns
        version = 0 if alignment is None else alignment.version
        if alignment is not None and version != self._version:
            slam_frame_id = f"slam_{alignment.epoch}"
            self._alignment.publish(self._wire.alignment(stamp_ns, slam_frame_id, alignment))
            row = np.concatenate([alignment.translation_m, alignment.quat_xyzw])
            transform = self._wire.transform(stamp_ns, self._target_frame_id, slam_frame_id, row)
            self._alignment_transform.publish(transform)
        self._version = version
