"""The paper's dense refinement: the pose of every frame on its own image, in the basin of the anchors. Never causal.

A pose is refined by the hypothesis backend's own refiner where it has one (MegaPose's, GigaPose's), else on its
contour. Where the silhouette that is rendered there and the detected one diverge, coarse poses are taken anew from that
image, and the best of those in the basin takes its place if it explains the silhouette better. What lies further than
90 degrees from the anchors' pose is rejected. The paper does not say from which overlap on silhouettes diverge: here it
is the one that a supported pose needs anyway, ``refinement.min_overlap``.
"""

from __future__ import annotations

import numpy as np

from hat_ros.array_types import Float
from hat_ros.config import RefinementConfig
from hat_ros.geometry import lie
from hat_ros.hypotheses.stage import HypothesisStage
from hat_ros.refinement.contour_refiner import ContourRefiner
from hat_ros.target.model import Target
from hat_ros.tracking.image_fusion import is_supported, quality
from hat_ros.types import Detection, Estimate, Frame, Refined

# The paper's dense refinement rejects what lies further than this from the anchors.
SAME_BASIN_DEG = 90.0
_NOTHING = np.full((4, 4), np.nan), np.full((6, 6), np.nan)


class DenseRefinement:
    """Measures one pose per image.

    Args:
        config: of the refinement.
        target: the CAD model.
        hypotheses: where poses are taken anew, and whose refiner is used.
    """

    def __init__(self, config: RefinementConfig, target: Target, hypotheses: HypothesisStage) -> None:
        self._config = config
        self._hypotheses = hypotheses
        self._by_network = hypotheses.refiner is not None
        self._refiner = hypotheses.refiner or ContourRefiner(config, target)

    def measure(
        self, frame: Frame, detection: Detection | None, T_decided: Float, causal: Estimate
    ) -> tuple[Float, Float]:
        """The pose (4, 4) that the image supports near the decided one, and its covariance (6, 6); NaN: none.

        Args:
            frame: the image.
            detection: where the target is in it.
            T_decided: (4, 4) pose by the anchors of the whole clip, NaN when there is none.
            causal: what the causal method answered: what it measured in the decided basin stands, unless the image
                clearly prefers another pose there; it began closer, at the frame before. Not used with a network,
                which has measured nothing on this frame before.
        """
        starts = [T_decided] if np.isfinite(T_decided).all() else []
        T_causal = causal.T_cam_target if causal.state.has_pose and not self._by_network else None
        if starts and T_causal is not None and (apart_deg := _apart_deg(T_causal, T_decided)) < SAME_BASIN_DEG:
            was_measured = causal.gap_frames == 0
            if was_measured and apart_deg <= self._config.same_pose_deg:
                return T_causal, causal.covariance
            if apart_deg > self._config.same_pose_deg:
                starts.insert(0 if was_measured else 1, T_causal)
        best = None
        for T_start in starts:
            refined = self._refined(frame, detection, T_start, T_decided)
            margin = self._config.switch_margin if self._is_supported(best) else 0.0
            if quality(refined) > quality(best) + margin:
                best = refined
        if starts and detection is not None and detection.silhouette and self._diverges(best):
            best = self._taken_anew(frame, detection, T_decided, best)
        return (best.T_cam_target, best.covariance) if best is not None and self._is_supported(best) else _NOTHING

    def _refined(self, frame: Frame, detection: Detection | None, T_start: Float, T_decided: Float) -> Refined | None:
        """A pose refined; None beyond the basin of the anchors."""
        refined = self._refiner.refine(frame, detection, T_start)
        if refined is None or _apart_deg(refined.T_cam_target, T_decided) > SAME_BASIN_DEG:
            return None
        return refined

    def _taken_anew(self, frame: Frame, detection: Detection, T_decided: Float, best: Refined | None) -> Refined | None:
        """The best-scored new hypothesis in the basin, refined, where it fits the silhouette better."""
        candidates = self._hypotheses.generate(frame, detection, None)
        for T, score in zip(candidates.T_cam_target, candidates.log_score, strict=True):
            if np.isfinite(score) and _apart_deg(T, T_decided) <= SAME_BASIN_DEG:
                refined = self._refined(frame, detection, T, T_decided)
                better = refined is not None and (best is None or refined.overlap > best.overlap)
                return refined if better else best
        return best

    def _diverges(self, refined: Refined | None) -> bool:
        """Whether the silhouette of a pose is another than the detected one."""
        return refined is None or refined.overlap < self._config.min_overlap

    def _is_supported(self, refined: Refined | None) -> bool:
        """A network's answer is judged by its silhouette alone; without one to compare with it stands, as published."""
        if self._by_network:
            return refined is not None and not self._diverges(refined)
        return is_supported(refined, self._config)


def _apart_deg(T_a: Float, T_b: Float) -> float:
    return float(np.degrees(lie.angle_between(T_a[:3, :3], T_b[:3, :3])))
