"""The result bag: the answer of every stage to every frame, images excepted, with the ground truth where known.

``hat track`` writes it here, frame by frame; ``hat replay`` records the same messages from the graph. Both are read
back into one :class:`~hat_ros.io.run_log.RunLog`. Bag time is the exposure stamp.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.array_types import Float
from hat_ros.errors import BagError
from hat_ros.io import messages, topics
from hat_ros.io.bag_files import METADATA_FILE, BagFiles
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.manifest import check_manifest
from hat_ros.io.rosbag import TYPESTORE, deserialize
from hat_ros.io.run_log import RunLog, RunLogBuilder
from hat_ros.tracker import Step
from hat_ros.types import Alignment, Camera, Candidates, Estimate, Motion


class ResultBagWriter:
    """Writes a result bag; a context manager that leaves a readable bag however the run ends.

    Args:
        path: folder to create.
        frame_id: ``header.frame_id`` of the images.
        target_frame_id: name of the target frame, child of the alignment's.
        publish_initialising: option ``graph.publish_initialising``.
    """

    def __init__(self, path: Path, frame_id: str, target_frame_id: str, publish_initialising: bool = False) -> None:
        self._bag = BagWriter(path, frame_id=frame_id)
        self._wire = messages.Wire.bag(TYPESTORE)
        self._frame_id = frame_id
        self._target_frame_id = target_frame_id
        self._publish_initialising = publish_initialising
        self._alignment: Alignment | None = None
        self._seq = 0
        self._first_stamp_ns: int | None = None
        self._last_stamp_ns = 0

    def __enter__(self) -> ResultBagWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self._bag.close()

    def write_context(self, camera: Camera, truth_rows: Mapping[int, Float]) -> None:
        """What belongs beside the run: the calibration, and the truth from its first frame to its last."""
        if self._first_stamp_ns is None:
            return
        first, last = self._first_stamp_ns, self._last_stamp_ns
        self._write(topics.HAT_CAMERA_INFO, self._wire.camera_info(first, self._frame_id, camera), first)
        for stamp_ns, row in sorted(truth_rows.items()):
            if first <= stamp_ns <= last:
                self._write(topics.GROUND_TRUTH, self._wire.pose(stamp_ns, self._frame_id, row), stamp_ns)

    def write_step(self, step: Step, dropped_total: int) -> None:
        """All messages of one admitted frame, as the five nodes publish them."""
        stamp, frame_id, make = step.estimate.stamp_ns, self._frame_id, self._wire
        if self._first_stamp_ns is None:
            self._first_stamp_ns = stamp
        self._last_stamp_ns = stamp
        admitted = messages.Admitted(self._seq, dropped_total, 0)
        self._seq += 1
        self._write(topics.ADMISSION, make.admission(stamp, frame_id, admitted), stamp)
        self._write(topics.HYPOTHESES_SCORED, make.candidates(stamp, frame_id, step.candidates), stamp)
        if len(step.candidates):
            self._write(topics.HYPOTHESES, make.pose_array(stamp, frame_id, step.candidates.pose_rows), stamp)
        self._write(topics.SLAM_STATE, make.motion(stamp, frame_id, step.motion), stamp)
        if step.motion.valid:
            self._write(topics.SLAM_ODOMETRY, make.odometry(stamp, frame_id, step.motion), stamp)
        self._write(topics.SELECTION, make.selection(stamp, frame_id, step.selection), stamp)
        if step.selection.selected >= 0:
            row = step.selection.candidates.pose_rows[step.selection.selected]
            self._write(topics.ANCHOR, make.pose(stamp, frame_id, row), stamp)
        self._write_estimate(step.estimate, admitted)

    def _write_estimate(self, estimate: Estimate, admitted: messages.Admitted) -> None:
        stamp, frame_id, make = estimate.stamp_ns, self._frame_id, self._wire
        alignment = estimate.alignment
        if alignment is not None and (self._alignment is None or alignment.version != self._alignment.version):
            slam_frame_id = f"slam_{alignment.epoch}"
            row = np.concatenate([alignment.translation_m, alignment.quat_xyzw])
            self._write(topics.ALIGNMENT, make.alignment(stamp, slam_frame_id, alignment), stamp)
            transform = make.transform(stamp, self._target_frame_id, slam_frame_id, row)
            self._write(topics.ALIGNMENT_TRANSFORM, transform, stamp)
        self._alignment = alignment
        self._write(topics.STATUS, make.status(frame_id, estimate, admitted), stamp)
        if estimate.state.is_published(self._publish_initialising):
            row, covariance = estimate.pose_row, estimate.covariance
            self._write(topics.TARGET_POSE, make.pose(stamp, frame_id, row), stamp)
            message = make.pose_with_covariance(stamp, frame_id, row, covariance)
            self._write(topics.TARGET_POSE_WITH_COVARIANCE, message, stamp)

    def _write(self, topic: str, message: Any, stamp_ns: int) -> None:
        self._bag.write_message(topic, message, stamp_ns)


def read_result_bag(path: Path) -> RunLog:
    """The run that a result bag holds.

    Raises:
        BagError: missing, damaged, or without the topics of a result bag.
    """
    by_topic = _messages(path)
    statuses = {stamp: messages.status_from(message) for stamp, message in by_topic[topics.STATUS].items()}
    candidates = {stamp: messages.candidates_from(m) for stamp, m in by_topic[topics.HYPOTHESES_SCORED].items()}
    motions = {stamp: messages.motion_from(message) for stamp, message in by_topic[topics.SLAM_STATE].items()}
    covariances = {
        stamp: np.array(message.pose.covariance, dtype=np.float64).reshape(6, 6)
        for stamp, message in by_topic[topics.TARGET_POSE_WITH_COVARIANCE].items()
    }
    truth = {stamp: messages.pose_row_from(message.pose) for stamp, message in by_topic[topics.GROUND_TRUTH].items()}
    builder = RunLogBuilder()
    for stamp, status in sorted(statuses.items()):
        builder.add(
            candidates.get(stamp, Candidates.none()),
            motions.get(stamp, Motion.none()),
            replace(status.estimate, covariance=covariances.get(stamp, status.estimate.covariance)),
            status.alignment_version,
        )
        builder.dropped_total = status.dropped_total
    return builder.build(truth)


def read_stage_ms(path: Path) -> dict[str, float]:
    """Node name -> mean wall time per frame in milliseconds, as last reported in the diagnostics of the nodes.

    Empty for a bag that no graph has written, or where the graph had only begun.

    Raises:
        BagError: missing or damaged.
    """
    out = {}
    for message in _read(path, (topics.DIAGNOSTICS,))[topics.DIAGNOSTICS]:
        for status in message.status:
            for item in status.values:
                if item.key == topics.STEP_MS:
                    out[status.name.removeprefix("hat: ")] = float(item.value)
    return out


_READ = (
    topics.STATUS,
    topics.HYPOTHESES_SCORED,
    topics.SLAM_STATE,
    topics.TARGET_POSE_WITH_COVARIANCE,
    topics.GROUND_TRUTH,
)


def _messages(path: Path) -> dict[str, dict[int, Any]]:
    """Topic -> stamp -> message, of the topics that an evaluation needs."""
    found = _read(path, _READ)
    if not found[topics.STATUS]:
        raise BagError(f"{path} is no result bag: it has no message on {topics.STATUS}")
    return {topic: {messages.stamp_of(message): message for message in listed} for topic, listed in found.items()}


def _read(path: Path, names: Collection[str]) -> dict[str, list[Any]]:
    """Topic -> messages in order."""
    if not (path / METADATA_FILE).is_file():
        raise BagError(f"{path} is no result bag: it has no metadata.yaml (a run that was killed?)")
    check_manifest(path)
    out: dict[str, list[Any]] = {topic: [] for topic in names}
    for message in BagFiles(path).messages(names):
        out[message.topic].append(deserialize(message.data, message.kind, path))
    return out
