"""``--mode``: the method that turns the front ends into poses, by name.

* ``hat``: the method of the paper.
* ``independent``: hypotheses at every frame; the best appearance is the output. No memory.
* ``tracking``: refine the previous pose on each image; the best appearance only to (re-)start. No decoder, no fusion.
* ``offline``: HAT's observations smoothed over the whole clip. Not causal: a reference.
* ``srt3d``: the region tracker of :mod:`hat_ros.bench.methods.srt3d`, started by the best appearance, never again.
* ``observe``: the front ends alone, candidates at every frame and no output: what ``hat ablate`` runs on.

Each offers what :class:`~hat_ros.tracker.HatTracker` offers, so the pipeline runs them all alike.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from hat_ros.errors import UsageError

if TYPE_CHECKING:  # the temporal stages alone (`hat temporal`) need no image processing
    from hat_ros.app.pipeline import Method
    from hat_ros.config import HatConfig
    from hat_ros.target.model import Target
    from hat_ros.tracker import StageWrapper

_METHODS = {
    "hat": "framewise:Hat",
    "independent": "framewise:Independent",
    "tracking": "framewise:Tracking",
    "offline": "offline:Offline",
    "srt3d": "srt3d:Srt3d",
    "observe": "framewise:Observe",
}
MODES = tuple(_METHODS)
# Methods that look at every image for itself: where a protocol names target images, they see these alone.
FRAMEWISE = ("independent",)


def create_method(mode: str, config: HatConfig, target: Target, wrap: StageWrapper) -> Method:
    """Build the method that ``--mode`` names; ``wrap`` as for :class:`~hat_ros.tracker.HatTracker`.

    Raises:
        UsageError: unknown mode.
        ConfigError: the configuration names an unknown backend.
    """
    if mode not in _METHODS:
        raise UsageError(f"mode '{mode}' is unknown, choose one of {', '.join(MODES)}")
    module, _, name = _METHODS[mode].partition(":")
    return getattr(import_module(f"hat_ros.bench.methods.{module}"), name)(config, target, wrap)
