import cv2
import numpy as np
import pytest

from hat_ros.config import load_config
from hat_ros.errors import WeightsError
from hat_ros.segmentation.learned import LearnedSegmenter
from hat_ros.segmentation.network import CHANNELS, SegmentationNetwork, _joined, network_input


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """An untrained network in a file."""
    torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    from hat_ros.bench.training.model import Segmenter, export

    torch.manual_seed(1)
    path = tmp_path_factory.mktemp("weights") / "own.onnx"
    export(Segmenter(), path, (1.0, 1.0), (0.0, 0.0))
    return path


def test_input_is_colours_and_brightness_on_a_logarithmic_scale():
    rgb = np.zeros((32, 64, 3), np.uint8)
    rgb[0, 0] = (10, 20, 30)
    rgb[0, 1] = 255
    x = network_input(rgb)
    assert x.shape == (1, CHANNELS, 32, 64)
    assert x.dtype == np.float32
    np.testing.assert_allclose(x[0, :3, 0, 0], (np.array([10, 20, 30]) / 255 - 0.35) / 0.3, rtol=1e-5)
    assert x[0, 3, 5, 5] == -2
    assert x[0, 3, 0, 1] == pytest.approx(2)
    grey = float(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)[0, 0])
    assert x[0, 3, 0, 0] == pytest.approx(4 * np.log1p(grey) / np.log(256) - 2, abs=1e-5)


def test_each_cell_holds_four_pixels():
    cells = np.arange(4, dtype=np.float32).reshape(1, 4, 1, 1) + np.zeros((1, 4, 2, 3), np.float32)
    pixels = _joined(cells)
    assert pixels.shape == (4, 6)
    np.testing.assert_array_equal(pixels[:2, :2], [[0, 1], [2, 3]])


def test_sizes_may_change_between_images(exported):
    network = SegmentationNetwork(exported)
    rng = np.random.default_rng(0)
    for height, width in ((160, 160), (96, 128), (192, 256), (160, 160)):
        rgb = rng.integers(0, 256, (height, width, 3), np.uint8)
        evidence, tracked = network.with_prior(rgb, np.ones((height // 2, width // 2), np.float32))
        assert evidence.shape == tracked.shape == (height, width)
        np.testing.assert_allclose(network.evidence(rgb), evidence, atol=1e-6)
        assert np.isfinite(evidence).all()


def test_the_evidence_is_not_told_the_prior_and_the_mask_is(exported):
    network = SegmentationNetwork(exported)
    rgb = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    prior = np.zeros((32, 32), np.float32)
    one = network.with_prior(rgb, prior)
    prior[8:24, 8:24] = 1
    other = network.with_prior(rgb, prior)
    np.testing.assert_array_equal(one[0], other[0])
    assert (one[1] != other[1]).any()


def test_the_same_image_gives_the_same_bytes(exported):
    rgb = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8)
    assert (
        SegmentationNetwork(exported).evidence(rgb).tobytes() == SegmentationNetwork(exported).evidence(rgb).tobytes()
    )


@pytest.mark.parametrize("content", [b"", b"no network", None])
def test_a_wrong_file_is_one_sentence(content, exported, tmp_path, capfd):
    path = tmp_path / "wrong.onnx"
    path.write_bytes(exported.read_bytes()[:300_000] if content is None else content)
    with pytest.raises(WeightsError, match=r"wrong\.onnx: no segmentation network: segmentation\.learned\.weights"):
        SegmentationNetwork(path)
    assert capfd.readouterr().err == ""


def test_another_network_is_one_sentence(tmp_path):
    torch = pytest.importorskip("torch", reason="the extra 'train' is not installed")
    pytest.importorskip("onnx", reason="the extra 'train' is not installed")
    path = tmp_path / "other.onnx"
    layer = torch.nn.Conv2d(3, 1, 3)
    with pytest.warns(DeprecationWarning):
        torch.onnx.export(layer, (torch.zeros(1, 3, 64, 64),), str(path), opset_version=11, dynamo=False)
    with pytest.raises(WeightsError, match="no segmentation network"):
        SegmentationNetwork(path)


def test_a_missing_file_is_one_sentence(tmp_path):
    with pytest.raises(WeightsError, match=r"nothing\.onnx: no such file"):
        SegmentationNetwork(tmp_path / "nothing.onnx")


def test_the_configuration_names_the_file(exported, lopsided, tmp_path):
    def segmenter(path):
        config = load_config("default", ["segmentation.backend=learned", f"segmentation.learned.weights={path}"])
        return LearnedSegmenter(config, lopsided)

    assert segmenter(exported)._network is not None
    with pytest.raises(WeightsError, match="no such file"):
        segmenter(tmp_path / "nothing.onnx")
