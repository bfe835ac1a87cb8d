"""Clips are drawn by seed and number, each factor from its own stream, within what the tables promise."""

import json
from collections import Counter
from dataclasses import asdict, replace

import numpy as np
import pytest

from hat_ros.bench.campaign.draw import Cell, draw_clip
from hat_ros.bench.campaign.map import map_cells
from hat_ros.bench.synth.clips import trajectory
from hat_ros.bench.synth.models import build_target

CRAFTS = ("a", "b", "c")
CLIPS = [draw_clip(1, index, CRAFTS) for index in range(60)]


def test_the_same_seed_and_number_give_the_same_clip():
    assert [draw_clip(1, index, CRAFTS) for index in (17, 3)] == [CLIPS[17], CLIPS[3]]
    assert draw_clip(2, 17, CRAFTS).film != CLIPS[17].film
    assert len({clip.film.seed for clip in CLIPS}) == len(CLIPS)


def test_other_crafts_change_nothing_else():
    for index in range(10):
        other = draw_clip(1, index, ("x", "y"))
        assert replace(other, craft=CLIPS[index].craft) == CLIPS[index]


def test_a_clip_is_plain_values():
    assert json.loads(json.dumps(asdict(CLIPS[0])))["film"]["seed"] == CLIPS[0].film.seed


def test_shares_are_dealt():
    assert Counter(clip.background for clip in CLIPS) == {"sky": 24, "earth": 24, "limb": 12}
    assert Counter(clip.mismatch_kind for clip in CLIPS) == {"none": 36, "panels": 8, "missing": 8, "colours": 8}
    assert Counter(clip.craft for clip in CLIPS) == {"a": 20, "b": 20, "c": 20}
    assert sum(clip.film.monochrome for clip in CLIPS) == 30


def test_factors_lie_within_their_ranges():
    for factors in [clip.factors() for clip in CLIPS]:
        assert 70 <= factors["size_first_px"] <= 330
        assert 0.7 <= factors["size_last_px"] / factors["size_first_px"] <= 1.4
        assert 0.3 <= factors["rate_deg_per_frame"] <= 4
        assert abs(factors["precession_deg_per_frame"]) <= 0.5 * factors["rate_deg_per_frame"]
        assert factors["jpeg_quality"] == 0 or 60 <= factors["jpeg_quality"] <= 97
    precess = np.mean([draw_clip(5, index, CRAFTS).film.precession_deg_per_frame != 0 for index in range(300)])
    assert 0.25 < precess < 0.42


@pytest.mark.parametrize("kind", ["none", "panels", "missing", "colours"])
def test_a_mismatch_is_of_its_kind(kind):
    amounts = {
        (bool(clip.mismatch.panel_turn_deg), bool(clip.mismatch.missing), bool(clip.mismatch.recolor))
        for clip in CLIPS
        if clip.mismatch_kind == kind
    }
    assert amounts == {(kind == "panels", kind == "missing", kind == "colours")}


def test_the_earth_never_hides_the_sun():
    for clip in CLIPS:
        if clip.film.earth is None:
            assert clip.background == "sky"
            continue
        nadir = np.asarray(clip.film.earth.nadir_cam)
        disc = np.arcsin(6371 / (6371 + clip.film.earth.altitude_km))
        assert np.arccos(nadir @ np.asarray(clip.film.to_sun_cam)) > disc
        # The middle of the image looks past the limb only where the limb crosses the image.
        assert clip.background == "limb" or np.arccos(nadir[2]) < disc


def test_phase_angle_is_zero_with_the_sun_behind_the_camera():
    for clip in CLIPS:
        x, y, z = clip.film.to_sun_cam
        assert clip.phase_deg == pytest.approx(np.degrees(np.arctan2(np.hypot(x, y), -z)))


def test_the_craft_spans_what_was_drawn():
    target, clip = build_target("probe"), CLIPS[4]
    spec = clip.spec(target.diameter_m)
    poses = trajectory(replace(spec, drift=0.0), target)
    depth = poses[:, 2, 3] + (poses[:, :3, :3] @ target.center_m)[:, 2]
    spans = target.diameter_m * spec.focal_px / depth[[0, -1]]
    assert spans == pytest.approx(clip.size_px)


def test_a_place_of_the_map_is_kept():
    for index, cell in enumerate(map_cells()):
        clip = draw_clip(1, index, CRAFTS, cell=cell)
        assert clip.background == cell.background
        assert cell.size_px[0] <= clip.size_px[0] <= cell.size_px[1]
        assert cell.phase_deg[0] <= clip.phase_deg <= cell.phase_deg[1]


def test_a_place_changes_only_what_it_names():
    cell = Cell("sky", (30.0, 60.0), (0.0, 45.0))
    free, placed = draw_clip(1, 5, CRAFTS), draw_clip(1, 5, CRAFTS, cell=cell)
    assert placed.film.start_rotvec == free.film.start_rotvec
    assert placed.film.noise == free.film.noise
    assert placed.craft == free.craft
