"""The library without ROS: images and a CAD model in, one estimate per image out.

    python examples/library_use.py bags/demo 20

Here the images come from a bag. A camera of your own needs the same three things per image: a stamp in nanoseconds, an
RGB array, and the calibration.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from itertools import islice
from pathlib import Path

import numpy as np

from hat_ros import Camera, Estimate, Frame, HatTracker, load_config, load_target
from hat_ros.io.bag_reader import BagReader


def estimates(frames: Iterable[Frame], target_file: Path) -> Iterable[Estimate]:
    """One estimate per frame; nothing returned earlier is ever revised."""
    tracker = HatTracker(load_config("default"), load_target(target_file))
    for frame in frames:
        # The same by hand: Frame(stamp_ns, rgb, Camera(K, width, height)) with rgb (height, width, 3) uint8.
        yield tracker.step(frame).estimate


def main(bag_folder: str, n_frames: str = "20") -> None:
    """Track the first frames of a bag and print them."""
    bag = BagReader(bag_folder)
    camera: Camera = bag.camera
    print(f"{camera.width} x {camera.height} px, focal length {camera.K[0, 0]:.0f} px")
    for estimate in estimates(islice(bag.frames(), int(n_frames)), Path(bag_folder) / "target.yaml"):
        line = f"{estimate.stamp_ns / 1e9:.2f} s {estimate.state.name}"
        if estimate.state.has_pose:
            sigma_m = np.sqrt(np.diag(estimate.covariance)[:3])
            x, y, z = estimate.T_cam_target[:3, 3]
            line += f": x {x:+.3f} y {y:+.3f} z {z:.3f} m, sigma of z {sigma_m[2]:.3f} m"
        print(line)


if __name__ == "__main__":
    main(*sys.argv[1:])
