"""What takes long to compile is compiled when a backend is made, not at a frame of a running clip."""

import os
import subprocess
import sys

# In a process of its own: elsewhere other tests have compiled everything before.
CODE = """
from speckled_clip import speckled_clip

from hat_ros.config import HatConfig, PriorConfig, RefinementConfig
from hat_ros.refinement import create_refiner
from hat_ros.refinement.solver import fit_contour
from hat_ros.slam.bundle import adjust_window
from hat_ros.slam.feature import FeatureSlam
from hat_ros.slam.reprojection import refine_pose

clip = speckled_clip(8)
config = HatConfig(prior=PriorConfig(enabled=True), refinement=RefinementConfig(enabled=True))
slam, refiner = FeatureSlam(config, clip.target), create_refiner(config, clip.target)
functions = adjust_window, refine_pose, fit_contour
before = [function.signatures for function in functions]
assert all(before), before
for i, (frame, detection) in enumerate(zip(clip.frames, clip.detections)):
    assert slam.update(frame, detection, clip.prior(i)) is not None
    assert refiner.refine(frame, detection, clip.T_cam_target[i]) is not None
assert [function.signatures for function in functions] == before
"""


def test_frames_find_everything_compiled():
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    done = subprocess.run([sys.executable, "-c", CODE], env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
