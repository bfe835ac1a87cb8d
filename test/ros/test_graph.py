"""The guarantees of ``docs/architecture.md`` on real nodes: same bytes however the graph runs, nothing revised."""

from __future__ import annotations

import os
import signal

import numpy as np
import pytest
import rclpy
from graph_clip import FIRST_NS, N_FRAMES, STEP_NS, node_pid, run_in_process, said, stamps, status_column
from std_srvs.srv import Trigger

from hat_ros.config import config_from_dict, config_to_dict
from hat_ros.errors import BagError, ConfigError, InputError, RunError, StageTimeoutError
from hat_ros.io import messages, topics
from hat_ros.io.result_bag import read_result_bag, read_stage_ms
from hat_ros.ros.domain import reserved_domain
from hat_ros.ros.graph import replay
from hat_ros.types import Camera, TrackState

pytestmark = pytest.mark.graph

ALL_STAMPS = [FIRST_NS + index * STEP_NS for index in range(N_FRAMES)]
DELAYS_MS = {"segmentation": 15, "hypotheses": 60, "slam": 90, "selector": 30, "fusion": 25}
ONE_PER_FRAME = (topics.ADMISSION, topics.HYPOTHESES_SCORED, topics.SLAM_STATE, topics.SELECTION, topics.STATUS)


def changed(config, **sections):
    data = config_to_dict(config)
    for section, values in sections.items():
        data[section].update(values)
    return config_from_dict(data)


def play(bag, config, out, **options):
    result = replay(bag, config, bag / "target.yaml", out, **options)
    return result, said(out)


@pytest.mark.parametrize(
    ("graph", "credits", "delays_ms"),
    [("processes", 4, DELAYS_MS), ("processes", 1, DELAYS_MS), ("single", 4, {})],
)
def test_graph_gives_the_bytes_of_one_process(clean_bag, config, in_process, tmp_path, graph, credits, delays_ms):
    measured, found = play(clean_bag, config, tmp_path / "out", graph=graph, credits=credits, stage_delays_ms=delays_ms)
    for topic, expected in in_process.items():
        assert found[topic] == expected, topic
    assert (measured.played, measured.answered, measured.dropped) == (N_FRAMES, N_FRAMES, 0)
    for topic in ONE_PER_FRAME:
        assert stamps(found[topic]) == ALL_STAMPS, f"{topic}: one message per admitted frame, in stamp order"
    states = [TrackState(int(state)) for state in status_column(found, "state")]
    without = sum(not state.is_published(False) for state in states)
    assert len(found.get(topics.TARGET_POSE, ())) + without == N_FRAMES
    assert stamps(found.get(topics.TARGET_POSE, ())) == stamps(found.get(topics.TARGET_POSE_WITH_COVARIANCE, ()))
    assert status_column(found, "seq") == list(range(N_FRAMES))
    log = read_result_bag(tmp_path / "out")
    assert np.isfinite(log.truth_rows).all(), "the truth stands in the record, put there past the nodes"
    took_ms = read_stage_ms(tmp_path / "out")
    assert set(took_ms) == set(DELAYS_MS) and all(0 < ms < 1e3 for ms in took_ms.values()), took_ms


def test_corrupt_later_frames_change_nothing_earlier(write_bag, config, in_process, tmp_path):
    first_bad = 8

    def corrupt(writer, index, stamp_ns, rgb):
        rng = np.random.default_rng(index)
        return rng.integers(0, 256, rgb.shape, dtype=np.uint8) if index >= first_bad else rgb

    bag = write_bag("corrupt", corrupt)
    _, found = play(bag, config, tmp_path / "out", graph="single")
    for topic, expected in in_process.items():
        early = [item for item in expected if item[0] < ALL_STAMPS[first_bad]]
        assert found.get(topic, [])[: len(early)] == early, topic


def test_first_frames_alone_give_the_first_answers(clean_bag, config, in_process, tmp_path):
    n = 6
    _, found = play(clean_bag, config, tmp_path / "out", graph="single", max_frames=n)
    for topic, expected in in_process.items():
        assert found.get(topic, []) == [item for item in expected if item[0] < ALL_STAMPS[n]], topic


def test_rejected_frames_are_counted_and_change_nothing(write_bag, config, in_process, tmp_path):
    other = Camera(np.array([[260.0, 0, 79.5], [0, 260.0, 59.5], [0, 0, 1]]), 160, 120)

    def spoil(writer, index, stamp_ns, rgb):
        if index in (3, N_FRAMES - 1):  # the same stamp twice, and one that lies in the past
            writer.write_frame(stamp_ns - STEP_NS, rgb, other)
            writer.write_frame(stamp_ns - 2 * STEP_NS, rgb, other)
        if index == 5:  # an image that is not the size that camera_info says
            writer.write_frame(stamp_ns - 1, rgb[:50], other)
        if index == 0:  # no time at all
            writer.write_frame(0, rgb, other)
        return rgb

    measured, found = play(write_bag("dirty", spoil), config, tmp_path / "out", graph="single")
    assert (measured.played, measured.answered, measured.dropped) == (N_FRAMES + 6, N_FRAMES, 6)
    reasons = {record["first"].split(": ", 1)[1][:24]: record["count"] for record in measured.refusals.records()}
    assert reasons == {"header.stamp must be pos": 1, "header.stamp must increa": 4, "image is 160x50 px but c": 1}
    for topic in set(in_process) - {topics.STATUS, topics.ADMISSION}:
        assert found[topic] == in_process[topic], topic
    assert status_column(found, "dropped_total")[-1] == 6


def test_given_masks_compressed_images_and_no_refinement(write_bag, config, tmp_path):
    bag = write_bag("given", masks=True, image_format="png")
    plain = changed(
        config,
        segmentation={"backend": "annotated"},
        refinement={"enabled": False},  # fusion sees no image
        fusion={"confidence": "detection_area"},
        prior={"enabled": False},
        graph={"credits_replay": 16},
    )
    expected = run_in_process(bag, plain, tmp_path / "in_process")
    _, found = play(bag, plain, tmp_path / "out", graph="single", stage_delays_ms={"slam": 20})
    for topic in expected:
        assert found[topic] == expected[topic], topic


def test_reset_service_starts_every_stage_afresh_at_one_frame(clean_bag, config, tmp_path):
    called = []

    def reset(progress):
        if progress.done >= 5 and not called:
            called.append(call_reset(domain_id=117))

    _, found = play(clean_bag, config, tmp_path / "out", graph="single", domain_id=117, credits=2, on_progress=reset)
    epochs = [np.frombuffer(payload)[2] for _, _, payload in found[topics.ADMISSION]]
    first = epochs.index(1.0)
    assert epochs == [0.0] * first + [1.0] * (N_FRAMES - first)
    expected = run_in_process(clean_bag, config, tmp_path / "in_process", reset_before=first)
    for topic in set(expected) - {topics.ADMISSION}:
        assert found[topic] == expected[topic], topic


def call_reset(domain_id):
    context = rclpy.Context()
    rclpy.init(args=[], context=context, domain_id=domain_id)
    node = rclpy.create_node("operator", context=context)
    try:
        client = node.create_client(Trigger, topics.RESET)
        assert client.wait_for_service(timeout_sec=10)
        executor = rclpy.executors.SingleThreadedExecutor(context=context)
        executor.add_node(node)
        future = client.call_async(Trigger.Request())
        executor.spin_until_future_complete(future, timeout_sec=10)
        assert future.result().success
        return future.result().message
    finally:
        node.destroy_node()
        context.shutdown()


def test_live_admits_the_newest_and_counts_every_drop(clean_bag, config, tmp_path):
    measured, found = play(clean_bag, config, tmp_path / "out", live=True, rate=4.0, stage_delays_ms={"selector": 200})
    assert measured.played == N_FRAMES
    assert measured.dropped > 0
    assert measured.answered + measured.dropped == N_FRAMES
    admitted = stamps(found[topics.ADMISSION])
    assert admitted == sorted(set(admitted))
    assert admitted[-1] == ALL_STAMPS[-1], "the newest frame is never the one that is dropped"
    assert stamps(found[topics.STATUS]) == admitted


def test_a_node_that_dies_ends_the_replay_and_leaves_a_readable_result(clean_bag, config, tmp_path):
    killed = []

    def kill(progress):
        if progress.done >= 4 and not killed:
            killed.append(node_pid("slam"))
            os.kill(killed[0], signal.SIGKILL)

    with pytest.raises(RunError, match=r"node 'slam' was killed by SIGKILL after \d+ frames") as caught:
        play(clean_bag, config, tmp_path / "out", on_progress=kill)
    assert caught.value.exit_code == 1
    assert len(read_result_bag(tmp_path / "out")) >= 4


def test_interrupting_leaves_a_readable_result_and_no_process(clean_bag, config, tmp_path):
    pids = []

    def interrupt(progress):
        if progress.done >= 3:
            pids.append(node_pid("single"))
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        play(clean_bag, config, tmp_path / "out", graph="single", on_progress=interrupt)
    assert len(read_result_bag(tmp_path / "out")) >= 3
    with pytest.raises(ProcessLookupError):
        os.kill(pids[0], 0)


def test_a_stage_that_hangs_is_named(clean_bag, config, tmp_path):
    def stop(progress):
        if progress.done >= 3:  # an answer may bring several statuses with it, so 3 itself may be skipped
            os.kill(node_pid("hypotheses"), signal.SIGSTOP)

    impatient = changed(config, graph={"stage_timeout_s": 6.0})
    with pytest.raises(StageTimeoutError, match="stage 'hypotheses' has answered"):
        play(clean_bag, impatient, tmp_path / "out", on_progress=stop)
    assert len(read_result_bag(tmp_path / "out")) >= 3


def test_live_goes_on_after_a_stage_hung_and_forgets_nothing(clean_bag, config, tmp_path):
    patient = changed(config, graph={"live_timeout_s": 1.0})
    pid = []

    def watch(progress):
        if progress.done >= 3 and not pid:
            pid.append(node_pid("selector"))
            os.kill(pid[0], signal.SIGSTOP)
            signal.signal(signal.SIGALRM, lambda *_: os.kill(pid[0], signal.SIGCONT))
            signal.setitimer(signal.ITIMER_REAL, 3.0)

    _, found = play(clean_bag, patient, tmp_path / "out", live=True, rate=0.25, on_progress=watch)
    assert {np.frombuffer(payload)[2] for _, _, payload in found[topics.ADMISSION]} == {0.0}, "one epoch"
    assert stamps(found[topics.STATUS]) == stamps(found[topics.ADMISSION]), "late answers are answers, too"
    assert stamps(found[topics.STATUS])[-1] == ALL_STAMPS[-1]


# ------------------------------------------------------------------ bad input


def test_a_second_camera_on_the_same_topic_is_named(clean_bag, config, tmp_path):
    context = rclpy.Context()
    slow = {"segmentation": 400.0}  # longer than a second in all: participants need time to find each other
    with reserved_domain(None) as domain:
        rclpy.init(context=context, domain_id=domain)
        other = rclpy.create_node("other_camera", context=context)
        kind = messages.message_class(topics.TYPES[topics.IMAGE])
        other.create_publisher(kind, topics.IMAGE, 1)
        try:
            with pytest.raises(RunError, match=r"/image has 2 publishers \(/hat_player, /other_camera\): stop"):
                replay(
                    clean_bag,
                    config,
                    clean_bag / "target.yaml",
                    tmp_path / "out",
                    graph="single",
                    domain_id=domain,
                    stage_delays_ms=slow,
                )
        finally:
            other.destroy_node()
            context.try_shutdown()


def test_a_bad_target_is_one_sentence_from_the_node(clean_bag, config, tmp_path):
    bad = tmp_path / "cad.obj"
    bad.write_text("v 0 0 0\n")
    with pytest.raises(InputError, match="CAD model cad") as caught:
        replay(clean_bag, config, bad, tmp_path / "out")
    assert "\n" not in str(caught.value)


def test_a_missing_bag_is_found_before_anything_is_played(config, clean_bag, tmp_path):
    with pytest.raises(BagError, match="does not exist"):
        replay(tmp_path / "nothing", config, clean_bag / "target.yaml", tmp_path / "out")


def test_unknown_ways_to_run_are_refused(clean_bag, config, tmp_path):
    with pytest.raises(ConfigError, match="graph must be"):
        replay(clean_bag, config, clean_bag / "target.yaml", tmp_path / "out", graph="threads")
    with pytest.raises(ConfigError, match="unknown stage 'slamm'"):
        replay(clean_bag, config, clean_bag / "target.yaml", tmp_path / "out", stage_delays_ms={"slamm": 1})
