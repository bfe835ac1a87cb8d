"""GigaPose followed by MegaPose's refiner: the paper's "GigaPose + ref." baseline as a hypothesis backend."""

from __future__ import annotations

import logging

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hat_ros.array_types import Bool, Float, UInt8
from hat_ros.cache import cached_arrays
from hat_ros.config import HatConfig
from hat_ros.hypotheses.megapose import MegaPose
from hat_ros.hypotheses.picopose import fingerprint
from hat_ros.hypotheses.picopose_templates import CROP_PX, TEMPLATE_K, TEMPLATE_SIZE, template_poses
from hat_ros.nets import gigapose as gp
from hat_ros.nets import picopose as pp
from hat_ros.nets.checkpoint import load_into, load_state
from hat_ros.target.model import Target
from hat_ros.target.network_views import NetworkViewRenderer
from hat_ros.types import Candidates, Detection, Frame, PosePrior, Refined, RotationPrior

LOG = logging.getLogger(__name__)

_FORMAT = 3


class GigaPoseHypotheses:
    """Stage 2 backend ``gigapose``.

    Raises:
        WeightsError: a checkpoint (GigaPose's, MegaPose's two) is missing or does not fit.
    """

    def __init__(self, config: HatConfig, target: Target) -> None:
        self._megapose = MegaPose(config, target, "gigapose")
        self._runtime = self._megapose.runtime
        self._n_candidates = config.hypotheses.max_candidates
        self._batch_size = config.hypotheses.picopose.batch_size
        state = load_state("gigapose", config.nets.weights_folder, config.nets.allow_unverified)
        self._net = gp.GigaPoseNet()
        load_into(self._net, state, "gigapose")
        self._runtime.place(self._net)
        self._describe = self._runtime.wrap(self._net.ae_net)
        self._describe_ist = self._runtime.wrap(self._net.ist_net.backbone)
        key = f"{_FORMAT}:{target.sha256}:{fingerprint(state)}"
        del state  # gigabytes that would lie beside the network while templates are encoded
        arrays = cached_arrays("gigapose", key, lambda: self._build(target))
        self._templates = {name: self._runtime.tensor(array) for name, array in arrays.items()}

    @torch.inference_mode()
    def _build(self, target: Target) -> dict[str, NDArray]:
        renderer, poses = NetworkViewRenderer(target), template_poses(target)
        LOG.info("rendering %d templates, once per CAD model", len(poses))
        crops, Ms = [], []
        for T in poses:
            view = renderer.render(T, TEMPLATE_K, TEMPLATE_SIZE)
            mask = np.asarray(view.any(axis=2))  # a black surface still has a normal
            Ms.append(letterbox(mask))
            crops.append(cut(view[..., :3], mask, Ms[-1]))
        features, ist = [], []
        for batch in self._runtime.batches(len(poses), self._batch_size):
            inputs = _network_input(self._runtime.tensor(np.stack(crops[batch])[..., :3]))
            features.append(self._describe(inputs).cpu().numpy())
            ist.append(self._describe_ist(inputs).cpu().numpy())
            LOG.info("encoded %d of %d templates, once per CAD model and checkpoint", batch.stop, len(poses))
        small = pp.patch_mask(torch.from_numpy(np.stack(crops)[..., 3].astype(np.float32))).numpy()
        arrays = {"features": np.concatenate(features), "ist": np.concatenate(ist), "masks": small}
        return arrays | {"M": np.stack(Ms), "T_cam_target": poses}

    @torch.inference_mode()
    def generate(self, frame: Frame, detection: Detection, prior: PosePrior | None) -> Candidates:
        """K poses refined by MegaPose, scored by its coarse logits; the prior is not used (published behaviour)."""
        tensor, bank = self._runtime.tensor, self._templates
        M = letterbox(detection.mask)
        crop = tensor(cut(frame.rgb, detection.mask, M))[None]
        batch, mask = _network_input(crop[..., :3]), pp.patch_mask(crop[..., 3])[0]
        matches = gp.match(self._describe(batch)[0], mask, bank["features"], bank["masks"])
        scores = torch.stack([m.similarity.sum() for m in matches])
        best = [int(i) for i in scores.topk(min(self._n_candidates, len(scores))).indices if scores[i] > 0]
        if not best:
            return Candidates.none()
        ist = self._describe_ist(batch)[0].flatten(1)
        affine = torch.stack([self._affine(ist, bank["ist"][i].flatten(1), matches[i]) for i in best])
        K = tensor(frame.camera.K)
        T = pp.affine_pose(affine, tensor(M), K, bank["T_cam_target"][best], bank["M"][best], tensor(TEMPLATE_K))
        return self._megapose.candidates(self._runtime.image(frame.rgb), K, T, detection)

    def refine(
        self, frame: Frame, detection: Detection | None, T_cam_target: Float, prior: RotationPrior | None = None
    ) -> Refined | None:
        """By MegaPose, see :class:`~hat_ros.stages.PoseRefiner`; the prior is not used."""
        return self._megapose.refined(frame, detection, T_cam_target)

    def reset(self) -> None:
        """Nothing is learned from earlier frames."""

    def _affine(self, image: Tensor, template: Tensor, matches: gp.Matches) -> Tensor:
        scale, inplane = self._net.ist_net.regressor(image[:, matches.image].T, template[:, matches.template].T)
        return gp.best_similarity(gp.patch_px(matches.template), gp.patch_px(matches.image), scale, inplane)[0]


def letterbox(mask: Bool) -> Float:
    """(3, 3) affine from image to crop pixels: the tight box, longer side 224, the shorter one centred."""
    rows, cols = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    size = np.array([cols[-1] + 1 - cols[0], rows[-1] + 1 - rows[0]])
    scale = CROP_PX / size.max()
    shift = (CROP_PX - size * CROP_PX // size.max()) // 2 - scale * np.array([cols[0], rows[0]])
    return np.array([[scale, 0, shift[0]], [0, scale, shift[1]], [0, 0, 1.0]])


def cut(image: UInt8, mask: Bool, M: Float) -> UInt8:
    """Masked crop by ``M`` with nearest sampling, zeros elsewhere: (H, W, 3) and (H, W) -> (224, 224, 4), mask last.

    Crop pixel i shows image pixel floor(M^-1 i), without the half pixel, as in the reference.
    """
    at = np.arange(CROP_PX) + 1e-9
    cols, rows = np.floor((at - M[0, 2]) / M[0, 0]).astype(int), np.floor((at - M[1, 2]) / M[1, 1]).astype(int)
    inside = ((rows >= 0) & (rows < image.shape[0]))[:, None] & ((cols >= 0) & (cols < image.shape[1]))[None]
    where = rows.clip(0, image.shape[0] - 1)[:, None], cols.clip(0, image.shape[1] - 1)[None]
    visible = mask[where] & inside
    return np.concatenate([image[where] * visible[..., None], visible[..., None]], axis=2, dtype=np.uint8)


def _network_input(crops_rgb: Tensor) -> Tensor:
    """(B, 224, 224, 3) 0..255 RGB -> normalised (B, 3, 224, 224)."""
    return pp.normalise_crops(crops_rgb.permute(0, 3, 1, 2) / 255)
