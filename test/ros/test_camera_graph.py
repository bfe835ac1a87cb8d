"""What a camera sends goes through the graph as through one process: distortion, depth, masks, jitter, by the byte."""

from __future__ import annotations

import numpy as np
import pytest
from camera_info import info, through_lens
from graph_clip import FIRST_NS, STEP_NS, said, stamps

from hat_ros.bench.evaluation.metrics import pose_errors
from hat_ros.bench.source import open_source
from hat_ros.config import config_from_dict, config_to_dict
from hat_ros.errors import FrameError
from hat_ros.io import topics
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.messages import Wire
from hat_ros.io.result_bag import ResultBagWriter, read_result_bag
from hat_ros.io.rosbag import TYPESTORE
from hat_ros.ros.graph import replay
from hat_ros.tracker import HatTracker

pytestmark = pytest.mark.graph

WIRE = Wire.bag(TYPESTORE)
BARREL = (-0.25, 0.05, 0.001, -0.001, 0.0)
N, UNREADABLE, REPEATED = 8, 5, 3
COMPARED = (topics.HYPOTHESES_SCORED, topics.SLAM_STATE, topics.SELECTION, topics.TARGET_POSE)


@pytest.fixture(scope="module")
def raw_bag(clip, spec, model, tmp_path_factory):
    """A raw recording: 12 bits in 16, a lens, calibrations that are empty first and then jitter.

    One image has no usable encoding, and one comes again, white and in 16 bits: neither may count for the depth.
    """
    K, size = spec.camera.K, (spec.width, spec.height)
    path = tmp_path_factory.mktemp("raw") / "raw"
    with BagWriter(path) as writer:
        for index, frame in enumerate(clip[:N]):
            stamp_ns = FIRST_NS + index * STEP_NS
            k = np.zeros((3, 3)) if index < 2 else K * [[1 + 1e-8 * index] * 3, [1] * 3, [1] * 3]
            p = k if index < 2 else K * 0.9 + np.diag([0, 0, 0.1])
            calibration = info(k=k, d=BARREL, p=p, size=size, header=WIRE.header(stamp_ns, "cam"))
            writer.write_message("/cam/camera_info", calibration, stamp_ns)
            wide = through_lens(frame.rgb, K, "plumb_bob", BARREL, K).astype(np.uint16) << 4
            mask = through_lens(frame.mask.astype(np.uint8) * 255, K, "plumb_bob", BARREL, K) > 127
            mask = mask.astype(np.uint8) * np.uint8(255)
            writer.write_message("/detection/mask", WIRE.image(stamp_ns, "cam", "mono8", mask), stamp_ns)
            send(writer, stamp_ns, wide, "32FC1" if index == UNREADABLE else "rgb16")
            if index == REPEATED:
                send(writer, stamp_ns, np.full_like(wide, 65535), "rgb16")
        writer.write_target(model)
    return path


def send(writer, stamp_ns, wide, encoding):
    octets = wide.view(np.uint8).reshape(*wide.shape[:2], -1)
    writer.write_message("/cam/image_raw", WIRE.image(stamp_ns, "cam", encoding, octets), stamp_ns)


def changed(config, **sections):
    data = config_to_dict(config)
    for section, values in sections.items():
        data[section].update(values)
    return config_from_dict(data)


def in_process(bag, config, out, start):
    """What one process says to the frames that may enter."""
    source = open_source(bag, camera_config=config.camera)
    tracker, newest_ns = HatTracker(config, source.target), 0
    with ResultBagWriter(out, source.frame_id, source.target.name) as writer:
        for frame in source.frames(start):
            if not isinstance(frame, FrameError) and frame.stamp_ns > newest_ns:
                newest_ns = frame.stamp_ns
                writer.write_step(tracker.step(frame), 0)
    return said(out)


@pytest.mark.parametrize(("backend", "depth", "start"), [("classical", "auto", 0), ("annotated", "12", 1)])
def test_raw_recording_gives_the_bytes_of_one_process(raw_bag, config, tmp_path, backend, depth, start):
    config = changed(config, segmentation={"backend": backend}, camera={"image_depth": depth})
    expected = in_process(raw_bag, config, tmp_path / "expected", start)
    result = replay(raw_bag, config, raw_bag / "target.yaml", tmp_path / "out", graph="single", first_frame=start)
    found = said(tmp_path / "out")
    for topic in COMPARED:
        assert found[topic] == expected[topic], topic
    admitted = [FIRST_NS + index * STEP_NS for index in range(start, N) if index != UNREADABLE]
    assert stamps(found[topics.ADMISSION]) == admitted
    assert (result.answered, result.dropped) == (
        len(admitted),
        2 if backend == "classical" else 1 + (start <= REPEATED),
    )
    assert len(found[topics.TARGET_POSE]) > 3


@pytest.mark.parametrize(("option", "share"), [("true", 0.9), ("false", 1.0)])
def test_the_option_rectified_holds_in_the_graph_as_in_one_process(raw_bag, spec, config, tmp_path, option, share):
    config = changed(config, camera={"rectified": option})
    expected = in_process(raw_bag, config, tmp_path / "expected", 0)
    replay(raw_bag, config, raw_bag / "target.yaml", tmp_path / "out", graph="single", max_frames=4)
    found = said(tmp_path / "out")
    for topic in COMPARED:
        early = [item for item in expected[topic] if item[0] < FIRST_NS + 4 * STEP_NS]
        assert early, topic
        assert found[topic] == early, topic
    camera = open_source(raw_bag, camera_config=config.camera).recording.camera
    assert camera.K[0, 0] == pytest.approx(share * spec.focal_px)


def errors_of(bag, clip, config, out):
    """E_p of the first frames by stamp."""
    in_process(bag, config, out, 0)
    log = read_result_bag(out)
    index = ((log.stamp_ns - FIRST_NS) // STEP_NS).astype(int)
    errors = pose_errors(log.T_est, np.array([clip[i].T_cam_target for i in index])).pose
    return {i: error for i, error in zip(index, errors, strict=True) if i < N and i != UNREADABLE}


def test_poses_of_the_raw_recording_are_as_good_as_those_of_the_pinhole_camera(
    raw_bag, clean_bag, clip, config, tmp_path
):
    raw = errors_of(raw_bag, clip, config, tmp_path / "raw")
    clean = errors_of(clean_bag, clip, config, tmp_path / "clean")
    assert raw.keys() == clean.keys()
    assert np.mean(list(raw.values())) < 0.02 + np.mean(list(clean.values()))
