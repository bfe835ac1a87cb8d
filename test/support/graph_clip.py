"""What the graph's tests share: runs, and how two of them are compared bit by bit."""

from __future__ import annotations

import os
import re
from collections import defaultdict
from pathlib import Path

import numpy as np
from rosbags.rosbag2 import Reader

from hat_ros.config import HatConfig
from hat_ros.io import messages, topics
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.result_bag import ResultBagWriter
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.target.loading import load_target
from hat_ros.tracker import HatTracker

N_FRAMES = 14
FIRST_NS, STEP_NS = 1_000_000_007, 100_000_000
CONFIG_OVERRIDES = ("hypotheses.template.n_views=162", "keyframes.gap_frames=3")

TABLES = {
    topics.HYPOTHESES_SCORED: topics.CANDIDATE_COLUMNS,
    topics.SLAM_STATE: topics.MOTION_COLUMNS,
    topics.SELECTION: topics.SELECTION_COLUMNS,
    topics.ALIGNMENT: topics.ALIGNMENT_COLUMNS,
    topics.STATUS: topics.STATUS_COLUMNS,
    topics.ADMISSION: topics.ADMISSION_COLUMNS,
}
POSES = (topics.TARGET_POSE, topics.ANCHOR)


def run_in_process(bag: Path, config: HatConfig, out: Path, reset_before: int | None = None) -> dict[str, list]:
    """The whole method in this process; its result bag, read back."""
    reader = BagReader(bag)
    target = load_target(reader.target_path)
    tracker = HatTracker(config, target)
    with ResultBagWriter(out, reader.frame_id, target.name) as writer:
        for index, frame in enumerate(reader.frames()):
            if index == reset_before:
                tracker.reset()
            writer.write_step(tracker.step(frame), 0)
    return said(out)


def said(bag: Path) -> dict[str, list[tuple[int, str, bytes]]]:
    """Topic -> (stamp, frame, payload bits) of every message that carries numbers."""
    out = defaultdict(list)
    with Reader(bag) as reader:
        for connection, _, data in reader.messages():
            message = TYPESTORE.deserialize_cdr(data, connection.msgtype)
            payload = _payload(connection.topic, message)
            if payload is not None:
                out[connection.topic].append((messages.stamp_of(message), message.header.frame_id, payload))
    return {topic: sorted(items) for topic, items in out.items()}


def _payload(topic: str, message) -> bytes | None:
    if topic in TABLES:
        return messages.read_table(message, TABLES[topic]).tobytes()
    if topic in POSES:
        return messages.pose_row_from(message.pose).tobytes()
    if topic == topics.TARGET_POSE_WITH_COVARIANCE:
        return messages.pose_row_from(message.pose.pose).tobytes() + np.asarray(message.pose.covariance).tobytes()
    if topic == topics.HYPOTHESES:
        return b"".join(messages.pose_row_from(pose).tobytes() for pose in message.poses)
    if topic == topics.SLAM_ODOMETRY:
        return messages.pose_row_from(message.pose.pose).tobytes() + np.asarray(message.pose.covariance).tobytes()
    return None


def stamps(items) -> list[int]:
    return [stamp for stamp, _, _ in items]


def status_column(result: dict[str, list], column: str) -> list[float]:
    index = topics.STATUS_COLUMNS.index(column)
    return [np.frombuffer(payload)[index] for _, _, payload in result[topics.STATUS]]


def node_pid(name: str) -> int:
    """Process id of a node that this process started."""
    for folder in Path("/proc").iterdir():
        if not folder.name.isdigit():
            continue
        try:
            command = (folder / "cmdline").read_bytes()
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
        except (OSError, ValueError):
            continue
        if parent == os.getpid() and re.search(rf"hat_ros\.ros\.{name}(_node)?\0".encode(), command):
            return int(folder.name)
    raise LookupError(f"no process of node {name}")
