"""Exactly symmetric targets through the whole default tracker: TRACKING, and continuous."""

import numpy as np
import pytest
from symmetric_bodies import body

from hat_ros.bench.datasets.image_files import stamp_of
from hat_ros.bench.evaluation.symmetric import errors_to_nearest
from hat_ros.bench.synth.clips import ClipSpec, render_clip, trajectory
from hat_ros.config import load_config
from hat_ros.geometry import lie
from hat_ros.target.exact_symmetry import symmetry_of
from hat_ros.tracker import HatTracker
from hat_ros.types import Frame, TrackState

N_FRAMES, RATE_DEG = 20, 2.0


@pytest.mark.parametrize(("name", "group"), [("cube", (24, 0)), ("rocket", (1, 1))])
def test_a_symmetric_target_is_tracked_up_to_its_group(name, group):
    target = body(name)
    spec = ClipSpec(
        frames=N_FRAMES,
        width=320,
        height=240,
        focal_px=500.0,
        range_m=(4.0, 4.0),
        spin_deg_per_frame=RATE_DEG,
        jpeg_quality=0,
        seed=3,
    )
    T_true = trajectory(spec, target)
    tracker = HatTracker(load_config("default", ["hypotheses.template.n_views=162"]), target)
    frames = render_clip(target, spec, T_true)
    estimates = [tracker.step(Frame(stamp_of(i), f.rgb, spec.camera)).estimate for i, f in enumerate(frames)]
    states = [estimate.state for estimate in estimates]
    assert states.count(TrackState.TRACKING) >= N_FRAMES - 7, "from the second keyframe on at the latest"
    T = np.stack([estimate.T_cam_target for estimate in estimates])
    assert np.degrees(lie.angle_between(T[1:, :3, :3], T[:-1, :3, :3])).max() < RATE_DEG + 6.0
    errors = errors_to_nearest(T, T_true, symmetry_of(target))
    assert np.median(errors.pose) < 0.05
    assert {(estimate.order, estimate.free_axes) for estimate in estimates} == {group}
