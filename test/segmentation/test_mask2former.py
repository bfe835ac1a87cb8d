"""The wrapper around the library's network: post-processing, choice, missing weights, a whole random network."""

import numpy as np
import pytest
import torch
from rule_weights import save_small_mask2former

from hat_ros.config import config_from_dict
from hat_ros.errors import WeightsError
from hat_ros.segmentation.mask2former import Mask2FormerSegmenter, choose, instances
from hat_ros.stages import create_backend
from hat_ros.types import Camera, Frame

CAMERA = Camera(np.array([[100.0, 0, 47.5], [0, 100.0, 31.5], [0, 0, 1]]), 96, 64)
SETTINGS = config_from_dict({}).segmentation.mask2former


def disc(x, y, radius):
    v, u = np.mgrid[:64, :96]
    return (u - x) ** 2 + (v - y) ** 2 < radius**2


def test_missing_weights_say_what_where_and_how(tmp_path):
    config = config_from_dict({"segmentation": {"backend": "mask2former"}, "nets": {"weights_folder": str(tmp_path)}})
    with pytest.raises(WeightsError, match="CC BY-NC"):
        create_backend("segmentation", config, None)


def test_an_incomplete_folder_is_named(tmp_path):
    folder = tmp_path / "mask2former-swin-large-coco-instance"
    folder.mkdir()
    (folder / "config.json").write_text("{}")
    config = config_from_dict({"nets": {"weights_folder": str(tmp_path)}})
    with pytest.raises(WeightsError, match="not a complete folder"):
        Mask2FormerSegmenter(config, None)


def test_instances_are_scored_by_class_and_mask_quality():
    classes = torch.tensor([[4.0, 0.0, 0.0], [0.0, 0.0, 6.0]])  # the second query says "no object"
    logits = torch.full((2, 16, 24), -8.0)
    logits[0, 4:8, 6:12] = 8.0
    masks, scores = instances(classes, logits, ((64, 96), (64, 96), (64, 96)), 0.1)
    assert masks.shape == (1, 64, 96), "the second query is left out"
    best = int(scores.argmax())
    expected = torch.zeros(64, 96, dtype=torch.bool)
    expected[16:32, 24:48] = True
    overlap = (masks[best] & expected).sum() / (masks[best] | expected).sum()
    assert overlap > 0.95
    assert 0.9 < float(scores[best]) < 1


def test_no_instance_at_all():
    classes = torch.tensor([[0.0, 0.0, 9.0]])
    masks, scores = instances(classes, torch.ones(1, 16, 24), ((64, 96), (64, 96), (48, 72)), 0.1)
    assert masks.shape == (0, 48, 72) and len(scores) == 0
    assert choose(masks.numpy(), scores.numpy(), None, SETTINGS) is None


def test_choice_prefers_the_previous_target_over_a_better_score():
    masks = np.stack([disc(20, 30, 10), disc(70, 30, 10)])
    scores = np.array([0.5, 0.7], np.float32)
    assert choose(masks, scores, None, SETTINGS)[30, 70]
    assert choose(masks, scores, disc(22, 30, 10), SETTINGS)[30, 20]


def test_choice_ignores_background_and_weak_instances():
    masks = np.stack([np.ones((64, 96), bool), disc(20, 30, 10), np.zeros((64, 96), bool)])
    assert choose(masks, np.array([0.9, 0.05, 0.9], np.float32), None, SETTINGS) is None


def test_compact_instance_beats_scattered_one():
    scattered = np.zeros((64, 96), bool)
    scattered[::8, ::8] = True
    masks = np.stack([scattered, disc(30, 30, 6)])
    assert choose(masks, np.array([0.5, 0.5], np.float32), None, SETTINGS)[30, 30]


def test_a_whole_network_runs_from_a_local_folder(tmp_path):
    save_small_mask2former(tmp_path)
    config = config_from_dict(
        {"segmentation": {"mask2former": {"min_score": 0.0}}, "nets": {"weights_folder": str(tmp_path)}}
    )
    segmenter = Mask2FormerSegmenter(config, None)
    rgb = np.random.default_rng(0).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    first = segmenter.update(Frame(1, rgb, CAMERA), None)
    segmenter.reset()
    again = segmenter.update(Frame(2, rgb, CAMERA), None)
    if first is None:
        assert again is None
    else:
        assert first.mask.shape == (64, 96)
        np.testing.assert_array_equal(first.mask, again.mask)
