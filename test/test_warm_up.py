"""What takes long to compile is compiled when the stages are made, not at a frame of a running clip."""

import os
import subprocess
import sys

import pytest

# In a process of its own: elsewhere other tests have compiled everything before.
CODE = """
import gc
import sys

from numba.core.dispatcher import Dispatcher

from hat_ros.config import load_config
from hat_ros.bench.synth.backdrop import Earth
from hat_ros.bench.synth.models import build_target
from hat_ros.bench.synth.clips import ClipSpec, render_clip
from hat_ros.tracker import HatTracker
from hat_ros.types import Frame

earth = Earth() if sys.argv[1] == "earth" else None
spec = ClipSpec(frames=16, width=320, height=240, focal_px=500, range_m=(6, 6), supersample=1, earth=earth)
target = build_target("probe")
frames = [Frame((i + 1) * 100_000_000, seen.rgb, spec.camera) for i, seen in enumerate(render_clip(target, spec))]
tracker = HatTracker(load_config("default"), target)


def compiled():
    functions = [f for f in gc.get_objects() if isinstance(f, Dispatcher) and f.__module__.startswith("hat_ros.")]
    return {f"{f.__module__}.{f.__qualname__}": len(f.signatures) for f in functions}


before = compiled()
assert before["hat_ros.refinement.solver.fit_contour"] == 1, before
assert any(tracker.step(frame).estimate.state.has_pose for frame in frames)
late = {name for name, count in compiled().items() if count != before.get(name, 0)}
assert not late, late
"""


@pytest.mark.parametrize("background", ["sky", "earth"])
def test_frames_find_everything_compiled(background):
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    command = [sys.executable, "-c", CODE, background]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
