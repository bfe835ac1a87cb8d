import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from hat_ros.bench.training import fit as module  # noqa: E402
from hat_ros.bench.training.fit import Settings, batches, calibrate, fit, loss_of, overlaps, tensors  # noqa: E402
from hat_ros.bench.training.model import Segmenter  # noqa: E402
from hat_ros.bench.training.samples import Composer, Sample  # noqa: E402
from hat_ros.errors import RunError  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")
SETTINGS = Settings(steps=4, batch=2, coarse_share=0.5, workers=0)


class Stopped(Exception):
    """Ctrl-C, at a place that the test chooses."""


class StoppingComposer(Composer):
    """Stops at a sample."""

    stop_at = 0

    def sample(self, number: int) -> Sample:
        if number >= self.stop_at:
            raise Stopped
        return super().sample(number)


@pytest.fixture(scope="module")
def composers(views, backgrounds):
    return Composer(views, backgrounds, 7, 32), Composer(views, backgrounds, 7, 64)


def weights(model):
    return torch.cat([value.flatten().double() for value in model.state_dict().values()])


def test_the_loss_falls_on_two_samples(composers):
    torch.manual_seed(0)
    model = Segmenter()
    optimiser = torch.optim.AdamW(model.parameters(), 1e-2)
    numbers = [number for number in range(20) if composers[1].sample(number).target.any()][:2]
    batch = tuple(
        torch.stack(column) for column in zip(*(tensors(composers[1].sample(n)) for n in numbers), strict=True)
    )
    losses = []
    for _ in range(8):
        loss = loss_of(model, batch, 0.5)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    assert losses[-1] < 0.7 * losses[0]


def test_a_training_that_was_stopped_ends_as_one_that_was_not(views, backgrounds, composers, tmp_path, monkeypatch):
    whole = fit(*composers, SETTINGS, tmp_path / "whole.pt")
    monkeypatch.setattr(module, "_SAVE_INTERVAL_S", -1.0)  # after every step
    stopping = StoppingComposer(views, backgrounds, 7, 64)
    stopping.stop_at = 6  # in the last of four steps of two
    with pytest.raises(Stopped):
        fit(composers[0], stopping, SETTINGS, tmp_path / "stopped.pt")
    assert torch.load(tmp_path / "stopped.pt")["step"] == 3
    steps = []
    resumed = fit(*composers, SETTINGS, tmp_path / "stopped.pt", lambda step, loss, seconds: steps.append(step))
    assert steps == [4]
    assert torch.equal(weights(resumed), weights(whole))


def test_a_finished_training_is_not_repeated(composers, tmp_path):
    first = fit(*composers, Settings(steps=1, batch=2, workers=0), tmp_path / "a.pt")
    steps = []
    again = fit(*composers, Settings(steps=1, batch=2, workers=0), tmp_path / "a.pt", lambda *told: steps.append(told))
    assert steps == []
    assert torch.equal(weights(again), weights(first))


def test_another_process_composes_the_same_samples(composers, tmp_path):
    one, other = (
        fit(*composers, Settings(steps=1, batch=2, workers=workers), tmp_path / f"{workers}.pt") for workers in (0, 1)
    )
    assert torch.equal(weights(one), weights(other))


@pytest.mark.parametrize("content", [b"", b"text", None])
def test_a_foreign_checkpoint_is_one_sentence(content, composers, tmp_path):
    path = tmp_path / "a.pt"
    if content is None:
        torch.save({"step": 1, "model": {"a": torch.zeros(1)}}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(RunError, match="no checkpoint of this training"):
        fit(*composers, SETTINGS, path)


def test_platt_recovers_scale_and_offset():
    rng = np.random.default_rng(2)
    logit = rng.normal(0, 3, 200_000)
    truth = rng.random(len(logit)) < 1 / (1 + np.exp(-(0.4 * logit - 0.7)))
    scale, offset = module._platt(torch.from_numpy(logit), torch.from_numpy(truth))
    assert scale == pytest.approx(0.4, abs=0.01)
    assert offset == pytest.approx(-0.7, abs=0.02)


def test_calibration_leaves_out_what_cannot_be_told(composers):
    torch.manual_seed(0)
    _, _, curve = calibrate(Segmenter(), composers[1], 8)
    known = sum(((weight > 0) & (target != 0.5)).sum().item() for _, _, target, weight in batches(composers[1], 8, 3))
    assert curve.shape == (10, 4)
    assert curve[:, 3].sum() == known
    held = curve[:, 3] > 0
    assert (np.abs(curve[held, 1] - curve[held, 0] - 0.05) <= 0.05 + 1e-6).all()
    shares = curve[held, 2]
    assert (shares >= 0).all()
    assert (shares <= 1).all()


def test_overlap_of_a_perfect_model_is_one(composers, monkeypatch):
    truth = {}

    class Perfect(torch.nn.Module):
        def forward(self, image, prior):
            cells = torch.nn.functional.pixel_unshuffle(10 * (truth["target"] - 0.5)[:, None], 2)
            return cells, -cells

    original = module.batches

    def remembered(composer, count, size):
        for batch in original(composer, count, size):
            truth["target"] = batch[2]
            yield batch

    monkeypatch.setattr(module, "batches", remembered)
    found = overlaps(Perfect(), composers[1], 12)
    held = np.isfinite(found[:, 0])
    assert held.sum() > 6
    assert found[held, 0].min() > 0.9
    assert found[held, 1].max() == 0
