"""A pose estimator of one's own in one file, plugged in as the hypothesis backend.

    python examples/own_estimator.py bags/demo 40

A backend is a class with `generate` and `reset`, built from the configuration and the CAD model. One line registers it.
This one renders random views and compares silhouettes and colours: crude, but it is all that Stages 3 and 4 need, since
motion selects among the hypotheses and refinement sharpens them.
"""

from __future__ import annotations

import sys
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hat_ros import Camera, Detection, Frame, HatConfig, HatTracker, Target, load_config, load_target
from hat_ros.io.bag_reader import BagReader
from hat_ros.stages import BACKENDS
from hat_ros.target.rendering import create_renderer
from hat_ros.types import Candidates, PosePrior

N_VIEWS, N_BASINS, N_TRIALS, RENDER_PX = 600, 20, 24, 64
APART_DEG = 15.0
# Log-likelihood of silhouette overlap and colour agreement: one nat for five percent.
NATS_PER_SHARE = 20.0


class SilhouetteHypotheses:
    """Hypotheses from the shape of the mask and the colours within it."""

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._n_best = config.hypotheses.max_candidates
        self._target = target
        self._renderer = create_renderer("rays", target)
        self._views = Rotation.random(N_VIEWS, rng=np.random.default_rng(1))

    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """Up to K scored poses of different basins, best first."""
        rng = np.random.default_rng(frame.stamp_ns)  # the same frame gives the same answer
        looks = Look(frame, detection)
        scores = np.array([self._score(looks, rotation) for rotation in self._views])
        found: list[tuple[float, Rotation]] = []
        for index in np.argsort(-scores):
            if len(found) < N_BASINS and all(apart_deg(self._views[index], other) > APART_DEG for _, other in found):
                found.append((float(scores[index]), self._views[index]))
        found = sorted((self._improved(looks, *start, rng) for start in found), key=lambda item: -item[0])
        poses = np.array([self._pose(looks, rotation) for _, rotation in found[: self._n_best]])
        scores = np.array([NATS_PER_SHARE * score for score, _ in found[: self._n_best]])
        return Candidates.from_matrices(poses, scores, detection.box_xyxy)

    def reset(self) -> None:
        """Nothing is remembered from frame to frame."""

    def _improved(
        self, looks: Look, score: float, rotation: Rotation, rng: np.random.Generator
    ) -> tuple[float, Rotation]:
        """The best of random turns, smaller and smaller, about a start."""
        for trial in range(N_TRIALS):
            turn = Rotation.from_rotvec(np.radians(12.0) * (1 - trial / N_TRIALS) * rng.standard_normal(3))
            other = self._score(looks, turn * rotation)
            if other > score:
                score, rotation = other, turn * rotation
        return score, rotation

    def _score(self, looks: Look, rotation: Rotation) -> float:
        rendering = self._renderer.render(self._pose(looks, rotation), looks.camera)
        both = rendering.mask & looks.mask
        overlap = both.sum() / max(1, (rendering.mask | looks.mask).sum())
        if both.sum() < 10:
            return float(overlap)
        seen, drawn = looks.chroma[both], chroma(rendering.rgb)[both]
        agreement = np.corrcoef(seen, drawn)[0, 1] if np.ptp(seen) > 0 and np.ptp(drawn) > 0 else 0.0
        return float(overlap + 0.3 * agreement)

    def _pose(self, looks: Look, rotation: Rotation) -> NDArray[np.float64]:
        """(4, 4) pose whose bounding box is that of the mask: first the range, then the centre."""
        R = rotation.as_matrix()
        points = (self._target.vertices_m - self._target.center_m) @ R.T
        low, high = points[:, :2].min(axis=0), points[:, :2].max(axis=0)
        depth = np.hypot(*(high - low)) * looks.camera.K[0, 0] / np.hypot(*looks.box_size)
        ray = np.linalg.solve(looks.camera.K, np.append(looks.box_middle, 1.0))
        T_cam_target = np.eye(4)
        T_cam_target[:3, :3] = R
        T_cam_target[:3, 3] = depth * ray - np.append(0.5 * (low + high), 0.0) - R @ self._target.center_m
        return T_cam_target


class Look:
    """A small image of the target: mask, colour, and the camera that goes with it."""

    def __init__(self, frame: Frame, detection: Detection) -> None:
        x0, y0, x1, y1 = np.rint(detection.box_xyxy + [-1.5, -1.5, 2.5, 2.5]).astype(int)
        x0, y0, x1, y1 = max(x0, 0), max(y0, 0), min(x1, frame.camera.width), min(y1, frame.camera.height)
        scale = min(1.0, RENDER_PX / max(x1 - x0, y1 - y0))
        self.camera: Camera = frame.camera.crop(x0, y0, x1 - x0, y1 - y0, scale)
        rows = y0 + ((np.arange(self.camera.height) + 0.5) / scale).astype(int).clip(max=y1 - y0 - 1)
        columns = x0 + ((np.arange(self.camera.width) + 0.5) / scale).astype(int).clip(max=x1 - x0 - 1)
        self.mask = detection.mask[np.ix_(rows, columns)]
        self.chroma = chroma(frame.rgb[np.ix_(rows, columns)])
        inside = np.argwhere(self.mask)[:, ::-1]
        self.box_size = np.ptp(inside, axis=0) + 1.0
        self.box_middle = 0.5 * (inside.min(axis=0) + inside.max(axis=0))


def chroma(rgb: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Red minus blue: (..., 3) -> (...); it survives light and shadow better than brightness."""
    return rgb[..., 0].astype(np.float64) - rgb[..., 2]


def apart_deg(a: Rotation, b: Rotation) -> float:
    """Angle between two orientations."""
    return float(np.degrees((a * b.inv()).magnitude()))


def main(bag_folder: str, n_frames: str = "40") -> None:
    """Register the backend, track the first frames of a bag with it, and print the states."""
    BACKENDS["hypotheses"]["silhouette"] = f"{__name__}:SilhouetteHypotheses"
    config = load_config("default", ["hypotheses.backend=silhouette"])
    tracker = HatTracker(config, load_target(Path(bag_folder) / "target.yaml"))
    for frame in islice(BagReader(bag_folder).frames(), int(n_frames)):
        estimate = tracker.step(frame).estimate
        print(f"{estimate.stamp_ns / 1e9:.2f} s {estimate.state.name} {estimate.n_candidates} candidates")


if __name__ == "__main__":
    main(*sys.argv[1:])
