import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")

from hat_ros.bench.training.model import Segmenter, export, folded_copy, joined  # noqa: E402
from hat_ros.segmentation import network  # noqa: E402
from hat_ros.segmentation.network import CHANNELS, SegmentationNetwork, network_input  # noqa: E402

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def model() -> Segmenter:
    """Untrained, with normalisations as if it had seen images."""
    torch.manual_seed(3)
    made = Segmenter()
    for module in made.modules():
        if isinstance(module, torch.nn.BatchNorm2d):
            torch.nn.init.uniform_(module.running_mean, -0.3, 0.3)
            torch.nn.init.uniform_(module.running_var, 0.5, 2.0)
            torch.nn.init.uniform_(module.weight, 0.5, 1.5)
    return made.eval()


@pytest.fixture(scope="module")
def inputs():
    rng = np.random.default_rng(1)
    rgb = rng.integers(0, 256, (96, 128, 3), np.uint8)
    return rgb, rng.random((48, 64), np.float32)


def outputs(model, rgb, prior):
    with torch.no_grad():
        return model(torch.from_numpy(network_input(rgb)), torch.from_numpy(prior - np.float32(0.5))[None, None])


def test_the_folded_copy_is_the_same_function_without_normalisations(model, inputs):
    folded = folded_copy(model)
    assert not any(isinstance(module, torch.nn.BatchNorm2d) for module in folded.modules())
    for one, other in zip(outputs(model, *inputs), outputs(folded, *inputs), strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=1e-4)
    assert any(isinstance(module, torch.nn.BatchNorm2d) for module in model.modules())


def test_cells_are_joined_as_at_run_time():
    cells = torch.arange(4 * 3 * 5, dtype=torch.float32).reshape(1, 4, 3, 5)
    pixels = joined(cells)
    assert pixels.shape == (1, 6, 10)
    np.testing.assert_array_equal(pixels[0].numpy(), network._joined(cells.numpy()))


def test_evidence_is_not_told_the_prior(model, inputs):
    rgb, prior = inputs
    evidence, tracked = outputs(model, rgb, prior)
    other_evidence, other_tracked = outputs(model, rgb, 1 - prior)
    torch.testing.assert_close(evidence, other_evidence, atol=0, rtol=0)
    assert (tracked != other_tracked).any()


def test_it_is_small(model):
    assert 1e5 < sum(parameter.numel() for parameter in model.parameters()) < 5e5
    assert network_input(np.zeros((32, 32, 3), np.uint8)).shape[1] == CHANNELS


def test_the_exported_network_is_the_trained_one_times_its_calibration(model, inputs, tmp_path, recwarn):
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    path = tmp_path / "segmenter.onnx"
    export(model, path, (1.5, 0.5), (-0.25, 0.75))
    assert not [warning for warning in recwarn if issubclass(warning.category, DeprecationWarning)]
    evidence, tracked = (joined(cells)[0].numpy() for cells in outputs(model, *inputs))
    loaded = SegmentationNetwork(path)
    found_evidence, found_tracked = loaded.with_prior(*inputs)
    np.testing.assert_allclose(found_evidence, 1.5 * evidence - 0.25, atol=1e-4)
    np.testing.assert_allclose(found_tracked, 0.5 * tracked + 0.75, atol=1e-4)
    np.testing.assert_allclose(loaded.evidence(inputs[0]), found_evidence, atol=1e-6)
