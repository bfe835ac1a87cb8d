"""Hypothesis-Anchored Tracking: the causal 6-DoF pose of an uncooperative spacecraft from one camera and a CAD model.

The library in three lines::

    from hat_ros import Camera, Frame, HatTracker, load_config, load_target
    tracker = HatTracker(load_config("default"), load_target("target.glb"))
    step = tracker.step(Frame(stamp_ns, rgb, Camera(K, width, height)))

Start reading at :mod:`hat_ros.tracker`, the method on one page. ``hat --help`` lists the commands.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hat_ros.config import HatConfig, load_config
    from hat_ros.target.loading import load_target
    from hat_ros.target.model import Target
    from hat_ros.tracker import HatTracker, Step
    from hat_ros.types import Camera, Detection, Estimate, Frame, TrackState

__version__ = "0.1.0"

# Public name -> module, imported when first asked for: `import hat_ros` alone loads neither OpenCV nor numpy.
_EXPORTS = {
    "Camera": "types",
    "Detection": "types",
    "Estimate": "types",
    "Frame": "types",
    "HatConfig": "config",
    "HatTracker": "tracker",
    "Step": "tracker",
    "Target": "target.model",
    "TrackState": "types",
    "load_config": "config",
    "load_target": "target.loading",
}

__all__ = [
    "Camera",
    "Detection",
    "Estimate",
    "Frame",
    "HatConfig",
    "HatTracker",
    "Step",
    "Target",
    "TrackState",
    "load_config",
    "load_target",
]


def __getattr__(name: str) -> Any:
    if name not in _EXPORTS:
        raise AttributeError(f"module 'hat_ros' has no attribute '{name}'")
    return getattr(import_module(f"hat_ros.{_EXPORTS[name]}"), name)
