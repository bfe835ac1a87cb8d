"""Fitting the segmentation network to composed images; its calibration and figures on craft kept aside."""

from __future__ import annotations

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits
from torch.utils.data import DataLoader, Dataset

from hat_ros.array_types import Float
from hat_ros.bench.training.model import Segmenter, joined
from hat_ros.bench.training.samples import Composer, Sample
from hat_ros.errors import RunError
from hat_ros.segmentation.network import network_input

Batch = tuple[Tensor, Tensor, Tensor, Tensor]
"""Images (N, CHANNELS, S, S), priors (N, 1, S / PRIOR_STRIDE, S / PRIOR_STRIDE), targets and weights (N, S, S)."""

# Share of the steps in which the learning rate rises, and its part of the highest one at the first step.
_WARM_SHARE, _FIRST_RATE = 0.04, 1e-3
_WEIGHT_DECAY = 1e-3
# Longest gradient; longer ones are shortened, so that one odd batch does not undo what was learned.
_MAX_GRADIENT = 1.0
# Steps between two calls of `watch`, and steps that the loss shown is the mean of.
_WATCH_STEPS, _MEAN_STEPS = 50, 100
# Seconds between two checkpoints: the most that a run that is stopped loses.
_SAVE_INTERVAL_S = 120.0
# Samples at a time where nothing is learned; more only fill the memory.
_EVALUATION_BATCH = 32
_NEWTON_STEPS = 20
# From where the curvature is small, a step may be too long by many powers of two.
_HALVINGS = 40
# Keeps Newton's method going where the log-odds tell nothing.
_RIDGE = 1e-6


@dataclass(frozen=True)
class Settings:
    """How long and how fast to learn.

    Attributes:
        steps: of the optimiser.
        batch: samples per step.
        rate: highest learning rate; reached after 4 % of the steps, then falling as a cosine to nothing.
        overlap_weight: of the loss of overlap, which counts small targets as much as large ones, beside cross-entropy.
        coarse_share: of the steps on smaller samples, before those of full size.
        workers: processes that compose samples; 0 = this one.
        seed: of the weights at the start.
    """

    steps: int = 9500
    batch: int = 32
    rate: float = 3e-3
    overlap_weight: float = 0.5
    coarse_share: float = 0.65
    workers: int = 1
    seed: int = 0


class _Numbered(Dataset[Batch]):
    """Samples by number, as tensors; the smaller ones come first."""

    def __init__(self, small: Composer, large: Composer, n_small: int, n_all: int) -> None:
        self._small, self._large, self._n_small, self._n_all = small, large, n_small, n_all

    def __len__(self) -> int:
        return self._n_all

    def __getitem__(self, number: int) -> Batch:
        return tensors((self._small if number < self._n_small else self._large).sample(number))


def tensors(sample: Sample) -> Batch:
    """Image, prior, target and weight of one sample."""
    image = torch.from_numpy(network_input(sample.rgb)[0])
    return image, torch.from_numpy(sample.prior)[None], torch.from_numpy(sample.target), torch.from_numpy(sample.weight)


def fit(
    small: Composer,
    large: Composer,
    settings: Settings,
    checkpoint: Path,
    watch: Callable[[int, float, float], None] | None = None,
) -> Segmenter:
    """Train from nothing, or go on from the checkpoint.

    Args:
        small: samples of the first, coarse share of the steps.
        large: samples of the others.
        settings: see there; those of a checkpoint must be the same.
        checkpoint: written every few minutes and at the end, read if it exists.
        watch: called now and then, and at the end, with the steps done, the mean loss of the last ones and the mean
            seconds per step of this call.

    Raises:
        RunError: the checkpoint cannot be used.
    """
    torch.manual_seed(settings.seed)
    model = Segmenter().to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # torch's stubs lack it
    optimiser = torch.optim.AdamW(model.parameters(), settings.rate, weight_decay=_WEIGHT_DECAY)
    done = _restore(checkpoint, model, optimiser)
    coarse = int(settings.coarse_share * settings.steps)
    data = _Numbered(small, large, coarse * settings.batch, settings.steps * settings.batch)
    numbers = range(done * settings.batch, len(data))
    loader = DataLoader(
        data,
        settings.batch,
        sampler=numbers,
        num_workers=settings.workers,
        prefetch_factor=3 if settings.workers else None,
        worker_init_fn=_prepare_worker,
    )
    with _one_opencv_thread():
        loss_mean = 0.0
        began = saved = time.monotonic()
        for step, batch in enumerate(loader, done):
            for group in optimiser.param_groups:
                group["lr"] = settings.rate * _schedule(step / settings.steps)
            loss = loss_of(model, batch, settings.overlap_weight)
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            torch.nn.utils.clip_grad_norm_(model.parameters(), _MAX_GRADIENT)
            optimiser.step()
            loss_mean += (loss.item() - loss_mean) / min(step - done + 1, _MEAN_STEPS)
            if watch is not None and ((step + 1) % _WATCH_STEPS == 0 or step + 1 == settings.steps):
                watch(step + 1, loss_mean, (time.monotonic() - began) / (step + 1 - done))
            if time.monotonic() - saved > _SAVE_INTERVAL_S:
                saved = time.monotonic()
                _save(checkpoint, step + 1, model, optimiser)
    _save(checkpoint, settings.steps, model, optimiser)
    return model


def loss_of(model: Segmenter, batch: Batch, overlap_weight: float) -> Tensor:
    """Cross-entropy in nats per pixel, and one minus the overlap, both decoders added."""
    image, prior, target, weight = batch
    image = image.to(memory_format=torch.channels_last)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        outputs = model(image, prior)
    total = torch.zeros(())
    for cells in outputs:
        logit = joined(cells.float())
        entropy = binary_cross_entropy_with_logits(logit, target, weight)
        probability = torch.sigmoid(logit) * weight
        common = (probability * target).sum((1, 2))
        union = (probability + target * weight - probability * target).sum((1, 2))
        holds = target.amax((1, 2)) > 0.5
        overlap = ((1.0 - (common + 1.0) / (union + 1.0)) * holds).mean()
        total = total + entropy + overlap_weight * overlap
    return total


def calibrate(
    model: Segmenter, composer: Composer, count: int
) -> tuple[tuple[float, float], tuple[float, float], Float]:
    """Factor and offset of the log-odds of both decoders that make them probabilities, by maximum likelihood.

    Args:
        model: trained.
        composer: of samples kept aside.
        count: the first so many of them.

    Returns:
        Scales and offsets (nats) of evidence and tracked mask; the calibration curve (10, 4) of the evidence after it:
        least probability stated in each bin, mean probability stated, share of its pixels that are target, pixels.
    """
    logits, truth, primed = [], [], []
    model.eval()
    with torch.no_grad():
        for batch in batches(composer, count, _EVALUATION_BATCH):
            image, prior, target, weight = batch
            known = (weight > 0) & (target != 0.5)
            pair = [joined(cells.float())[known] for cells in model(image, prior)]
            logits.append(torch.stack(pair))
            truth.append(target[known])
            primed.append(((prior != 0).any(3).any(2).any(1))[:, None, None].expand_as(known)[known])
    z, y, with_prior = torch.cat(logits, 1), torch.cat(truth), torch.cat(primed)
    fits = [_platt(z[0], y), _platt(z[1][with_prior], y[with_prior])]
    stated = torch.sigmoid(fits[0][0] * z[0] + fits[0][1])
    bins = torch.clamp((10 * stated).long(), max=9)
    counts = torch.bincount(bins, minlength=10)
    curve = [torch.bincount(bins, weights, minlength=10) / counts for weights in (stated.double(), y.double())]
    table = np.stack([np.arange(10) / 10, *(column.numpy() for column in curve), counts.numpy()], axis=1)
    return (fits[0][0], fits[1][0]), (fits[0][1], fits[1][1]), table


def batches(composer: Composer, count: int, size: int) -> Iterator[Batch]:
    """The first ``count`` samples in batches."""
    numbers = iter(range(count))
    while chunk := list(islice(numbers, size)):
        parts = [tensors(composer.sample(number)) for number in chunk]
        image, prior, target, weight = (torch.stack(column) for column in zip(*parts, strict=True))
        yield image, prior, target, weight


def overlaps(model: Segmenter, composer: Composer, count: int) -> Float:
    """(count, 2) intersection over union of both decoders' masks with the truth, NaN without a target."""
    out = []
    model.eval()
    with torch.no_grad():
        for image, prior, target, weight in batches(composer, count, _EVALUATION_BATCH):
            truth = (target > 0.5) & (weight > 0)
            row = []
            for cells in model(image, prior):
                mask = (joined(cells.float()) > 0) & (weight > 0)
                common, union = (mask & truth).sum((1, 2)), (mask | truth).sum((1, 2))
                row.append(torch.where(truth.any(2).any(1), common / union, torch.nan))
            out.append(torch.stack(row, 1).numpy())
    return np.concatenate(out).astype(np.float64)


def _platt(logit: Tensor, truth: Tensor) -> tuple[float, float]:
    """Scale and offset of least cross-entropy (Platt 1999), by Newton's method, its steps halved if need be."""
    x, y = logit.double(), truth.double()
    theta = torch.tensor([1.0, 0.0], dtype=torch.float64)
    least = _cross_entropy(x, y, theta)
    for _ in range(_NEWTON_STEPS):
        p = torch.sigmoid(theta[0] * x + theta[1])
        gradient = torch.stack([((p - y) * x).sum(), (p - y).sum()])
        curvature = p * (1 - p)
        mixed = (curvature * x).sum()
        hessian = torch.stack([(curvature * x * x).sum(), mixed, mixed, curvature.sum()]).reshape(2, 2)
        step = torch.linalg.solve(hessian + _RIDGE * torch.eye(2, dtype=torch.float64), gradient)
        for _ in range(_HALVINGS):
            entropy = _cross_entropy(x, y, theta - step)
            if entropy <= least:
                theta, least = theta - step, entropy
                break
            step = 0.5 * step
    return float(theta[0]), float(theta[1])


def _cross_entropy(x: Tensor, y: Tensor, theta: Tensor) -> float:
    """In nats, of all pixels together."""
    return float(binary_cross_entropy_with_logits(theta[0] * x + theta[1], y, reduction="sum"))


def _schedule(share: float) -> float:
    """Learning rate as a part of the highest one, after a share of the steps."""
    if share < _WARM_SHARE:
        return share / _WARM_SHARE + _FIRST_RATE
    return 0.5 * (1.0 + float(np.cos(np.pi * (share - _WARM_SHARE) / (1 - _WARM_SHARE))))


@contextmanager
def _one_opencv_thread() -> Iterator[None]:
    """Processes forked within can use OpenCV; its threads do not outlive a fork, and a child would wait for them."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _prepare_worker(number: int) -> None:
    """Ctrl-C is the parent's affair."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def _save(path: Path, step: int, model: Segmenter, optimiser: torch.optim.Optimizer) -> None:
    partial = path.with_suffix(".partial")
    torch.save({"step": step, "model": model.state_dict(), "optimiser": optimiser.state_dict()}, partial)
    partial.replace(path)


def _restore(path: Path, model: Segmenter, optimiser: torch.optim.Optimizer) -> int:
    if not path.exists():
        return 0
    try:
        kept = torch.load(path, weights_only=True)
        model.load_state_dict(kept["model"])
        optimiser.load_state_dict(kept["optimiser"])
        return int(kept["step"])
    except Exception:  # of any kind: torch's reader lets out whatever it meets in a damaged file
        raise RunError(f"{path} is no checkpoint of this training: remove it, and the training begins again") from None
