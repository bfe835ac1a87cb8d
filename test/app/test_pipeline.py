"""The in-process pipeline: admission, order, errors of reading; independent of any backend."""

import threading

import numpy as np
import pytest
from scripted import CAMERA, ScriptedMethod, frame, stamp

from hat_ros.app.pipeline import Pipeline
from hat_ros.bench.source import open_source
from hat_ros.bench.synth.models import write_model
from hat_ros.errors import BagError, FrameError, UsageError
from hat_ros.io.bag_writer import BagWriter


def run(frames):
    method = ScriptedMethod()
    pipeline = Pipeline(lambda wrap: method)
    return list(pipeline.run(frames)), pipeline, method


def test_frames_pass_in_order():
    done, pipeline, method = run(frame(i) for i in range(5))
    assert [d.step.estimate.stamp_ns for d in done] == [stamp(i) for i in range(5)]
    assert pipeline.refusals.total == 0
    assert len(method.seen) == 5


def test_duplicate_backward_and_malformed_frames_are_counted_and_change_nothing():
    clean, _, _ = run(frame(i) for i in range(4))
    dirty = [frame(0), frame(0), FrameError("black"), frame(1), frame(0), frame(2), frame(1), frame(3)]
    done, pipeline, _ = run(dirty)
    stale, black = pipeline.refusals.records()
    assert stale["count"] == 3
    assert stale["first"].startswith(f"frame {stamp(0)}: header.stamp must increase")
    assert black == {"count": 1, "first": "black"}
    for a, b in zip(clean, done, strict=True):
        np.testing.assert_array_equal(a.step.estimate.pose_row, b.step.estimate.pose_row)


@pytest.mark.parametrize("bad_stamp", [0, -5])
def test_stamp_that_is_no_time_is_rejected(bad_stamp):
    first = frame(0)
    object.__setattr__(first, "stamp_ns", bad_stamp)
    done, pipeline, _ = run([first, frame(1)])
    assert (len(done), pipeline.refusals.total) == (1, 1)


def test_frames_are_read_by_one_thread_and_an_error_of_reading_ends_the_run():
    threads = set()

    def recording():
        try:
            for i in range(3):
                threads.add(threading.get_ident())
                yield frame(i)
            raise BagError("breaks off")
        finally:
            threads.add(threading.get_ident())

    done = []
    with pytest.raises(BagError, match="breaks off"):
        for answer in Pipeline(lambda wrap: ScriptedMethod(), credits=2).run(recording()):
            done.append(answer.step.estimate.stamp_ns)
    assert done == [stamp(i) for i in range(3)]
    assert len(threads) == 1
    threads.clear()
    abandoned = Pipeline(lambda wrap: ScriptedMethod()).run(recording())
    next(abandoned)
    abandoned.close()
    assert len(threads) == 1, "closed by the thread that read it"
    assert threading.get_ident() not in threads


@pytest.fixture
def bag(tmp_path):
    model = tmp_path / "cubesat.glb"
    write_model("cubesat", model)
    with BagWriter(tmp_path / "clip", frame_id="nav_cam", image_format="png") as writer:
        for i in range(4):
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, T_cam_target=np.eye(4))
        writer.write_frame(stamp(4), b"\xff\xd8 no picture", CAMERA)
        writer.write_frame(stamp(5), frame(5).rgb, CAMERA)
        writer.write_target(model)
    return tmp_path / "clip"


def test_bag_is_a_source_and_a_broken_image_does_not_end_it(bag):
    source = open_source(bag)
    assert source.frame_id == "nav_cam"
    assert source.target.name == "cubesat"
    assert sorted(source.truth_rows()) == [stamp(i) for i in range(4)]
    done, pipeline, _ = run(source.frames())
    assert [d.step.estimate.stamp_ns for d in done] == [stamp(i) for i in (0, 1, 2, 3, 5)]
    assert pipeline.refusals.total == 1


def test_start_and_limit_pick_frames(bag):
    source = open_source(bag)
    stamps = [item.stamp_ns for item in source.frames(1, 2)]
    assert stamps == [stamp(1), stamp(2)]
    assert source.count(1, 2) == 2
    assert source.count(5) == 1
    assert source.count(50) == 0


def test_what_is_no_recording_is_refused(tmp_path, bag):
    with pytest.raises(UsageError, match="no such file"):
        open_source(tmp_path / "nothing")
    with pytest.raises(UsageError, match="neither a bag"):
        open_source(tmp_path)
    (bag / "target.yaml").unlink()
    (bag / "manifest.json").unlink()
    with pytest.raises(BagError, match=r"target\.yaml"):
        open_source(bag)
