"""Frames in flight: every stage sees what a plain loop would show it, whatever the threads do."""

import random
import threading
import time
from functools import partial

import pytest
from scripted import ScriptedMethod, frame, stamp

from hat_ros.app.pipeline import Pipeline
from hat_ros.app.scheduler import Closed, StageScheduler
from hat_ros.bench.methods.modes import create_method
from hat_ros.bench.synth.clips import ClipSpec, render_clip
from hat_ros.bench.synth.models import build_target
from hat_ros.config import load_config
from hat_ros.errors import RunError
from hat_ros.types import Frame


class Stage:
    """Notes what it is called with, and that no other frame is inside."""

    def __init__(self, delays):
        self.delays, self.seen, self.inside = delays, [], threading.Lock()

    def update(self, value):
        assert self.inside.acquire(blocking=False), "two frames in one stage"
        time.sleep(self.delays.random() * 2e-3)
        self.seen.append(value)
        self.inside.release()
        return value


class ThreeStages(ScriptedMethod):
    """Three stages, the second only for every third frame; fails where told to."""

    concurrent = True

    def __init__(self, seed=0, fails_at=None):
        super().__init__()
        delays = random.Random(seed)
        self.stages = {name: Stage(delays) for name in ("segmentation", "hypotheses", "motion")}
        self.wrapped = self.stages
        self.before_first, self.fails_at = [], fails_at
        self.most_at_once, self._now = 0, 0

    def behind(self, wrap):
        self.wrapped = {name: wrap(name, stage) for name, stage in self.stages.items()}
        return self

    def step(self, seen):
        index = (seen.stamp_ns - stamp(0)) // (stamp(1) - stamp(0))
        self.before_first.append(index)
        self.wrapped["segmentation"].update(index)
        self._now += 1
        self.most_at_once = max(self.most_at_once, self._now)
        if index % 3 == 0:
            self.wrapped["hypotheses"].update(index)
        if index == self.fails_at:
            raise RunError(f"frame {index} broke the motion")
        self.wrapped["motion"].update(index)
        self._now -= 1
        return super().step(seen)


@pytest.mark.parametrize("credits", [1, 2, 4])
@pytest.mark.parametrize("seed", range(3))
def test_each_stage_sees_the_frames_one_by_one_in_order(credits, seed):
    method = ThreeStages(seed)
    done = list(Pipeline(method.behind, credits).run(frame(i) for i in range(20)))
    assert [d.step.estimate.stamp_ns for d in done] == [stamp(i) for i in range(20)]
    assert method.before_first == list(range(20))
    assert method.stages["segmentation"].seen == method.stages["motion"].seen == list(range(20))
    assert method.stages["hypotheses"].seen == list(range(0, 20, 3))
    assert done[1].stage_ms["hypotheses"] == 0.0 < done[3].stage_ms["hypotheses"]
    assert method.most_at_once <= credits
    assert credits == 1 or method.most_at_once > 1, "frames must really overlap"


def test_a_method_that_follows_its_own_last_answer_gets_one_frame_at_a_time():
    method = ThreeStages()
    method.concurrent = False
    list(Pipeline(method.behind, 4).run(frame(i) for i in range(10)))
    assert method.most_at_once == 1


@pytest.mark.parametrize("credits", [1, 4])
def test_frames_before_one_that_fails_are_answered_and_its_error_is_the_one_seen(credits):
    method = ThreeStages(fails_at=7)
    answered = []
    with pytest.raises(RunError, match="frame 7 broke"):
        for done in Pipeline(method.behind, credits).run(frame(i) for i in range(20)):
            answered.append(done.step.estimate.stamp_ns)
    assert answered == [stamp(i) for i in range(7)]
    assert method.stages["motion"].seen == list(range(7))


def test_closing_the_run_stops_the_threads():
    before = threading.active_count()
    run = Pipeline(ThreeStages().behind, 4).run(frame(i) for i in range(1000))
    next(run)
    run.close()
    assert threading.active_count() == before


def test_a_closed_scheduler_lets_no_frame_wait():
    scheduler = StageScheduler()
    scheduler.close(3)
    with scheduler.frame(0):
        pass
    with pytest.raises(Closed), scheduler.frame(3):
        pass


def test_poses_do_not_depend_on_the_frames_in_flight():
    """The real method, own masks, priors and refinement on: the same bits with one frame in flight and with four."""
    target = build_target("probe")
    spec = ClipSpec(frames=14, width=160, height=120, focal_px=250.0, range_m=(9.0, 8.0), spin_deg_per_frame=1.0)
    frames = [Frame(stamp(i), seen.rgb, spec.camera) for i, seen in enumerate(render_clip(target, spec))]
    config = load_config("default", ("hypotheses.template.n_views=162", "keyframes.gap_frames=3"))
    runs = {}
    for credits in (1, 4):
        pipeline = Pipeline(partial(create_method, "hat", config, target), credits)
        runs[credits] = [done.step for done in pipeline.run(frames)]
    for alone, among in zip(runs[1], runs[4], strict=True):
        assert alone.estimate.pose_row.tobytes() == among.estimate.pose_row.tobytes()
        assert alone.estimate.covariance.tobytes() == among.estimate.covariance.tobytes()
        assert alone.candidates.pose_rows.tobytes() == among.candidates.pose_rows.tobytes()
        assert alone.motion.pose_row.tobytes() == among.motion.pose_row.tobytes()
    assert sum(step.estimate.state.has_pose for step in runs[4]) >= 12
