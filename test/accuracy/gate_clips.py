"""The clips of the accuracy gate: craft x condition x seed, chosen before they were run, seeds in order."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from random_craft import random_craft

from hat_ros.array_types import Float
from hat_ros.bench.datasets.image_files import FRAME_STEP_NS
from hat_ros.bench.source import open_source
from hat_ros.bench.synth.backdrop import Earth
from hat_ros.bench.synth.clips import ClipSpec, render_clip, trajectory
from hat_ros.bench.synth.mismatch import Mismatch, apply_mismatch
from hat_ros.bench.synth.models import build_target
from hat_ros.geometry import lie
from hat_ros.target.model import Target
from hat_ros.types import Frame

DEMO_BAG = Path(__file__).parents[2] / "bags" / "demo"
# Names of random craft begin with this; their number is the seed of their shape.
RANDOM = "random"
# Of a synthetic clip.
FRAMES = 36
# Folder in which rendered clips are kept from run to run; unset: they are rendered each time. For tools/mutate.py.
KEEP_VARIABLE = "ACCURACY_CLIPS"


@dataclass(frozen=True, eq=False)
class Recording:
    """Frames and what is true of them.

    Attributes:
        target: the CAD model that the tracker is given.
        frames: in order.
        T_true: (N, 4, 4) ``T_cam_target``.
    """

    target: Target
    frames: tuple[Frame, ...]
    T_true: Float


NO_MISMATCH = Mismatch()


@dataclass(frozen=True)
class Clip:
    """A synthetic clip.

    Attributes:
        name: of the clip.
        craft: own model of ``hat synth``, or ``random`` and a number.
        seed: of attitude, spin axis, sun, noise, stars and clouds.
        condition: changes the usual view.
        span: what the craft's diameter spans of the image height, at the first and at the last frame.
        mismatch: how the craft differs from its CAD model.
    """

    name: str
    craft: str
    seed: int
    condition: Callable[[ClipSpec], ClipSpec]
    span: tuple[float, float] = (0.5, 0.75)
    mismatch: Mismatch = NO_MISMATCH

    def spec(self) -> ClipSpec:
        """How the clip is filmed: what the seed decides, then the condition."""
        rng = np.random.default_rng([self.seed, 21])
        start = lie.so3_log(lie.matrix_from_quat(rng.normal(size=4)))
        phase, azimuth = np.radians(rng.uniform(25, 75)), rng.uniform(0, 2 * np.pi)
        to_sun = np.array([np.sin(phase) * np.cos(azimuth), np.sin(phase) * np.sin(azimuth), -np.cos(phase)])
        usual = ClipSpec(
            frames=FRAMES,
            width=480,
            height=360,
            focal_px=750.0,
            start_rotvec=tuple(start.tolist()),
            spin_axis=tuple(rng.normal(size=3).tolist()),
            spin_deg_per_frame=1.0,
            to_sun_cam=tuple(to_sun.tolist()),
            star_count=30,
            seed=self.seed,
        )
        spec = self.condition(usual)
        reach = craft(self.craft).diameter_m * spec.focal_px / spec.height
        return replace(spec, range_m=(reach / self.span[0], reach / self.span[1]))

    def record(self) -> Recording:
        """Render the clip."""
        spec, target = self.spec(), craft(self.craft)
        poses = trajectory(spec, target)
        images = _kept(f"{self!r}{spec!r}{target.sha256}", lambda: self._render(spec, poses))
        stamps = (np.arange(spec.frames) + 1) * FRAME_STEP_NS
        frames = tuple(Frame(int(stamp), rgb, spec.camera) for stamp, rgb in zip(stamps, images, strict=True))
        return Recording(target, frames, poses)

    def _render(self, spec: ClipSpec, poses: Float) -> np.ndarray:
        seen = apply_mismatch(craft(self.craft), self.mismatch)
        return np.stack([frame.rgb for frame in render_clip(seen, spec, poses)])


def record_demo() -> Recording:
    """``bags/demo``, as ``hat track`` reads it."""
    source = open_source(DEMO_BAG)
    frames = tuple(frame for frame in source.frames(masks=False) if isinstance(frame, Frame))
    truth = source.truth_rows()
    return Recording(source.target, frames, lie.matrix_from_row(np.array([truth[f.stamp_ns] for f in frames])))


@cache
def craft(name: str) -> Target:
    """A CAD model by name."""
    return random_craft(int(name.removeprefix(RANDOM))) if name.startswith(RANDOM) else build_target(name)


def _kept(key: str, render: Callable[[], np.ndarray]) -> np.ndarray:
    folder = os.environ.get(KEEP_VARIABLE)
    if not folder:
        return render()
    path = Path(folder) / f"{hashlib.sha256(key.encode()).hexdigest()[:16]}.npy"
    if not path.is_file():
        path.parent.mkdir(parents=True, exist_ok=True)
        np.save(path, render())
    return np.load(path)


def usual(spec: ClipSpec) -> ClipSpec:
    """Black sky with stars, 1 degree per frame."""
    return spec


def before_earth(spec: ClipSpec) -> ClipSpec:
    """The Earth fills the image behind the craft."""
    return replace(spec, earth=Earth(nadir_cam=(0.1, 0.4, 1.0), seed=spec.seed))


def limb(spec: ClipSpec) -> ClipSpec:
    """The Earth's limb runs through the image."""
    return replace(spec, earth=Earth(nadir_cam=(0.2, 1.0, 0.4), seed=spec.seed))


def grey(spec: ClipSpec) -> ClipSpec:
    """A monochrome sensor."""
    return replace(spec, monochrome=True)


def grey_before_earth(spec: ClipSpec) -> ClipSpec:
    """Both; short, because a target that is not found is searched for in every frame, which takes time."""
    return replace(grey(before_earth(spec)), frames=FRAMES // 3)


def tumbling(spec: ClipSpec) -> ClipSpec:
    """4 degrees per frame."""
    return replace(spec, spin_deg_per_frame=4.0)


def grey_tumbling(spec: ClipSpec) -> ClipSpec:
    """Both."""
    return grey(tumbling(spec))


def tumbling_before_earth(spec: ClipSpec) -> ClipSpec:
    """Both."""
    return tumbling(before_earth(spec))


def half_dark(spec: ClipSpec) -> ClipSpec:
    """The sun stands sideways behind the craft: most of what is seen lies in shadow."""
    x, y, z = spec.to_sun_cam
    return replace(spec, to_sun_cam=(x, y, 0.3 * abs(z)), ambient=0.003)


def stray_light(spec: ClipSpec) -> ClipSpec:
    """The sun shines into the lens."""
    return replace(spec, glare=0.4)


def cut(spec: ClipSpec) -> ClipSpec:
    """So near and so far aside that the border cuts the craft."""
    return replace(spec, drift=0.5)


# The list was written before any of it was run; the seeds count up and were not changed after.
CLIPS = (
    Clip("black_observer", "observer", 1, usual),
    Clip("black_random1", "random1", 2, usual),
    Clip("earth_probe", "probe", 3, before_earth),
    Clip("earth_random2", "random2", 4, before_earth),
    Clip("limb_cubesat", "cubesat", 5, limb),
    Clip("grey_probe", "probe", 6, grey),
    Clip("grey_earth_observer", "observer", 7, grey_before_earth),
    Clip("tumble_observer", "observer", 8, tumbling),
    Clip("grey_tumble_random3", "random3", 9, grey_tumbling),
    Clip("far_probe", "probe", 10, usual, span=(0.12, 0.16)),
    Clip("far_random1", "random1", 11, usual, span=(0.12, 0.16)),
    Clip("panels_turned_observer", "observer", 12, usual, mismatch=Mismatch(panel_turn_deg=15.0, seed=12)),
    Clip("parts_missing_random2", "random2", 13, usual, mismatch=Mismatch(missing=0.3, recolor=0.5, seed=13)),
    Clip("half_dark_cubesat", "cubesat", 14, half_dark),
    Clip("stray_light_probe", "probe", 15, stray_light),
    Clip("cut_random3", "random3", 16, cut, span=(0.9, 1.3)),
    Clip("tumble_earth_random1", "random1", 17, tumbling_before_earth),
    Clip("small_probe", "probe", 18, usual, span=(0.2, 0.27)),
)
