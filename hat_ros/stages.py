"""The seams of the method: what a backend must offer, and the name -> backend map.

A backend is a class in a file of its own. It is imported only when its name is asked for, so that the
default preset runs without torch. To add one: write the class, add one line to :data:`BACKENDS`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib import import_module
from typing import Literal, Protocol, overload, runtime_checkable

from hat_ros.array_types import Float
from hat_ros.config import HatConfig
from hat_ros.errors import ConfigError, MissingDependencyError
from hat_ros.target.model import Target
from hat_ros.types import Candidates, Detection, Frame, Motion, PosePrior, Refined, RotationPrior


class Segmenter(Protocol):
    """Stage 1. Constructed as ``Backend(config: HatConfig, target: Target)``."""

    def update(self, frame: Frame, prior: PosePrior | None) -> Detection | None:
        """Find the target; None rather than a wrong mask."""
        ...

    def reset(self) -> None:
        """Forget everything learned from earlier frames."""
        ...


class HypothesisBackend(Protocol):
    """Stage 2's estimator. Constructed as ``Backend(config: HatConfig, target: Target)``."""

    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """Up to K scored poses for one image, best first; zero rows when nothing fits."""
        ...

    def reset(self) -> None:
        """Forget everything learned from earlier frames."""
        ...


class MotionEstimator(Protocol):
    """Target-relative SLAM. Constructed as ``Backend(config: HatConfig, target: Target)``."""

    def update(self, frame: Frame, detection: Detection | None, prior: PosePrior | None) -> Motion:
        """Advance by one frame; ``Motion.none(epoch)`` rather than a guess."""
        ...

    def reset(self) -> None:
        """Start a new epoch."""
        ...


@runtime_checkable
class PoseRefiner(Protocol):
    """Measures a pose on one image by moving it to the nearest optimum; used by Stage 4.

    A hypothesis backend with a refiner of its own is one: the methods that follow or refine poses then use that.
    """

    def refine(
        self, frame: Frame, detection: Detection | None, T_cam_target: Float, prior: RotationPrior | None = None
    ) -> Refined | None:
        """Refine a (4, 4) pose.

        Args:
            frame: the image.
            detection: its mask, None if the target was not found.
            T_cam_target: (4, 4) where to start.
            prior: what is known of the rotation; it counts as much as it is certain.

        Returns:
            The pose with the covariance of the image alone; None when the image supports no pose near the start, or
            one outside its basin only.
        """
        ...

    def reset(self) -> None:
        """Forget everything learned from earlier frames."""
        ...


BACKENDS: dict[str, dict[str, str]] = {
    "segmentation": {
        "classical": "hat_ros.segmentation.classical:ClassicalSegmenter",
        "learned": "hat_ros.segmentation.learned:LearnedSegmenter",
        "annotated": "hat_ros.segmentation.annotated:AnnotatedSegmenter",
        "mask2former": "hat_ros.segmentation.mask2former:Mask2FormerSegmenter",
    },
    "hypotheses": {
        "template": "hat_ros.hypotheses.template:TemplateHypotheses",
        "megapose": "hat_ros.hypotheses.megapose:MegaPoseHypotheses",
        "picopose": "hat_ros.hypotheses.picopose:PicoPoseHypotheses",
        "gigapose": "hat_ros.hypotheses.gigapose:GigaPoseHypotheses",
    },
    "slam": {
        "feature": "hat_ros.motion.feature:FeatureSlam",
        "droid": "hat_ros.motion.droid:DroidSlam",
    },
}

# slam backend -> its motion smoothed over the whole clip, for the non-causal reference; others have causal motion only.
WHOLE_CLIP_MOTIONS: dict[str, str] = {"droid": "hat_ros.motion.droid:whole_clip_motions"}

WholeClipMotions = Callable[[HatConfig, Sequence[tuple[Frame, Detection | None]]], list[Motion]]


def whole_clip_motions_of(config: HatConfig) -> WholeClipMotions | None:
    """The motion backend's smoothing over a whole clip; None if it has only its causal motion."""
    where = WHOLE_CLIP_MOTIONS.get(config.slam.backend)
    if where is None:
        return None
    module_name, function_name = where.split(":")
    return getattr(import_module(module_name), function_name)


@overload
def create_backend(stage: Literal["segmentation"], config: HatConfig, target: Target) -> Segmenter: ...
@overload
def create_backend(stage: Literal["hypotheses"], config: HatConfig, target: Target) -> HypothesisBackend: ...
@overload
def create_backend(stage: Literal["slam"], config: HatConfig, target: Target) -> MotionEstimator: ...
def create_backend(stage: str, config: HatConfig, target: Target) -> Segmenter | HypothesisBackend | MotionEstimator:
    """Build the backend that ``config.<stage>.backend`` names.

    Raises:
        ConfigError: the name is unknown.
        MissingDependencyError: the backend needs a package that is not installed.
    """
    name = getattr(config, stage).backend
    try:
        module_name, class_name = BACKENDS[stage][name].split(":")
    except KeyError:
        known = ", ".join(sorted(BACKENDS[stage]))
        raise ConfigError(f"{stage}.backend: unknown backend '{name}', known are {known}") from None
    try:
        module = import_module(module_name)
    except ModuleNotFoundError as error:
        if error.name and error.name.split(".")[0] == "hat_ros":
            raise
        raise MissingDependencyError(
            f"{stage}.backend '{name}' needs the package '{error.name}', which is not installed: "
            f"run `make install-nets` (or `pip install 'hat_ros[nets]'`)"
        ) from None
    return getattr(module, class_name)(config, target)
