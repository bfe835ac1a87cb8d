"""A clip in memory: what is filmed, what is told to the tracker, what is compared."""

import numpy as np
import pytest

from hat_ros.bench.campaign import play
from hat_ros.bench.campaign.draw import View, draw_clip
from hat_ros.bench.campaign.play import film_clip, play_clip
from hat_ros.bench.synth.models import build_target
from hat_ros.config import load_config
from hat_ros.target.masks import overlap

TARGET = build_target("probe")
CLIP = draw_clip(1, 5, ("probe",), View(4, 320, 240, 500.0))


@pytest.fixture(scope="module")
def film():
    return film_clip(CLIP, TARGET)


@pytest.fixture(scope="module")
def told(film):
    return play_clip(film, TARGET, load_config("default", ["segmentation.backend=annotated"]), True)


def test_film(film):
    assert len(film.frames) == len(film.T_true) == 4
    assert set(np.unique(film.frames[0].given_mask)) == {0, 255}
    center = film.frames[0].camera.project((film.T_true[0] @ [*TARGET.center_m, 1])[:3])
    y, x = np.nonzero(film.frames[0].given_mask)
    assert np.linalg.norm(center - (x.mean(), y.mean())) < 0.25 * CLIP.size_px[0]


def test_given_masks_are_the_true_ones(told):
    assert (told.mask_iou == 1).all()


def test_own_masks_are_not_told_the_truth(film, monkeypatch):
    seen = []

    class Blind:
        causal, concurrent = True, False

        def __init__(self, config, target, wrap):
            self.inner = play_hat(config, target, wrap)

        def step(self, frame):
            seen.append(frame.given_mask)
            return self.inner.step(frame)

    play_hat = play.Hat
    monkeypatch.setattr(play, "Hat", Blind)
    played = play_clip(film, TARGET, load_config("default", ["segmentation.backend=annotated"]), False)
    assert seen == [None] * 4
    assert (played.mask_iou == 0).all()  # an annotated clip without masks: every mask is missing
    assert np.isnan(played.e_p).all()
    assert np.isnan(played.best_deg).all()


def test_errors_are_those_of_computed_poses(told):
    has = np.isfinite(told.e_p)
    assert has.any()
    assert np.array_equal(has, np.isfinite(told.rotation_deg))
    assert (told.e_p[has] >= np.radians(told.rotation_deg[has]) - 1e-9).all()
    assert len(told.segmentation_ms) == 4
    assert (told.segmentation_ms <= told.frame_ms).all()
    best = told.best_deg[np.isfinite(told.best_deg)]
    assert len(best)
    assert ((best >= 0) & (best <= 180)).all()


def test_overlap_counts_where_the_craft_is_large_enough(film, told, monkeypatch):
    assert overlap(film.frames[0].given_mask > 0, film.frames[0].given_mask > 0) == 1
    monkeypatch.setattr(play, "MIN_SIDE_PX", 1000)
    config = load_config("default", ["segmentation.backend=annotated"])
    assert np.isnan(play_clip(film, TARGET, config, True).mask_iou).all()
