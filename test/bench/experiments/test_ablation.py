"""Temporal replay, the filters, and the ablation tables, on observations made by hand."""

from dataclasses import replace

import numpy as np
import pytest

from hat_ros.bench.evaluation.figures import image_bytes
from hat_ros.bench.evaluation.tables import Table
from hat_ros.bench.experiments import ablation, ablation_rows
from hat_ros.bench.experiments.ablation_figure import table_figure
from hat_ros.bench.experiments.filters import FilterNoise, ParticleSelector, UkfSelector
from hat_ros.bench.source import SourceSpec
from hat_ros.bench.temporal import load_observations, run_temporal
from hat_ros.bench.temporal_replay import (
    keyframes_of,
    observations_of,
    replay_offline,
    replay_temporal,
    save_observations,
)
from hat_ros.config import config_from_dict, config_to_dict, load_config
from hat_ros.core.selector import SelectorStage
from hat_ros.errors import ConfigError, UsageError
from hat_ros.geometry import lie
from hat_ros.io.run_log import RunLogBuilder
from hat_ros.types import Candidates, Estimate, Motion, TrackState

N = 80
# The published estimator; w, D and warm-up are not those of mega_hat, so that each row of a table differs from it.
CONFIG = load_config(
    "mega_hat", ("fusion.relative_weight=0.1", "fusion.gate_angle_deg=30", "selector.warmup_keyframes=1")
)
FLIP = lie.so3_exp(np.array([0.0, np.pi, 0.0]))


def true_pose(i, rate_deg=2.0):
    R = lie.so3_exp(np.radians([rate_deg * i, 0, 0])) @ lie.so3_exp(np.array([0.3, -0.5, 0.8]))
    return lie.transform(R, np.array([0.2 * np.sin(i / 9), 0.1, 6 + 0.02 * i]))


def observations(flip_every=0, noise_deg=0.5, seed=0, motion=True, n=N):
    """Right and half-turned candidates at every frame; at every ``flip_every``-th the wrong one looks better."""
    rng = np.random.default_rng(seed)
    gauge = lie.transform(lie.so3_exp(np.array([1.0, 2.0, 0.5])), np.array([3.0, -1.0, 2.0]))
    builder, truth = RunLogBuilder(), {}
    for i in range(n):
        T = true_pose(i)
        stamp = 1_000_000_000 + i * 100_000_000
        truth[stamp] = lie.row_from_matrix(T)
        noisy = T.copy()
        noisy[:3, :3] = lie.so3_exp(np.radians(noise_deg) * rng.standard_normal(3)) @ T[:3, :3]
        wrong = noisy.copy()
        wrong[:3, :3] = noisy[:3, :3] @ FLIP
        better = [0.0, 0.3] if flip_every and i % flip_every == flip_every - 1 else [0.3, 0.0]
        candidates = Candidates.from_matrices(np.array([noisy, wrong]), np.array(better), np.array([10, 10, 110, 110]))
        step = Motion.none()
        if motion:
            T_slam_cam = gauge @ lie.inverse(T)
            T_slam_cam[:3, 3] /= 2.5
            step = Motion(True, 0, lie.row_from_matrix(T_slam_cam))
        nothing = Estimate(stamp, TrackState.UNINITIALISED, np.full(7, np.nan), np.full((6, 6), np.nan), keyframe=True)
        builder.add(candidates, step, nothing)
    return builder.build(truth)


def pooled(log):
    return ablation.pooled([log])


def test_keyframes_follow_gap_and_k():
    log = observations()
    groups = keyframes_of(log, replace(CONFIG, hypotheses=replace(CONFIG.hypotheses, max_candidates=1)))
    assert [len(group) for group in groups[:9]] == [1, 0, 0, 0, 1, 0, 0, 0, 1]


def test_replay_is_hat_temporal_on_the_same_observations():
    log = observations(flip_every=3)
    due = np.array([len(group) > 0 for group in keyframes_of(log, CONFIG)])
    recorded = replace(observations_of(log), key=due)
    expected = run_temporal(recorded, CONFIG)
    replayed = replay_temporal(log, CONFIG)
    np.testing.assert_allclose(replayed.T_est, expected.T_cam_target, atol=1e-9)
    np.testing.assert_array_equal(replayed.anchor, expected.chosen)


def test_exported_observations_read_back_and_padding_never_wins(tmp_path):
    log = observations(flip_every=3)
    few = tuple(
        Candidates(group.pose_rows[: 1 + i % 2], group.log_score[: 1 + i % 2], group.box_xyxy)
        for i, group in enumerate(log.candidates)
    )
    log = replace(log, candidates=few, keyframe=np.ones(N, bool))
    save_observations(tmp_path / "o.npz", log)
    recorded = load_observations(tmp_path / "o.npz")
    assert recorded.poses.shape == (N, 2, 4, 4)
    result = run_temporal(recorded, replace(CONFIG, selector=replace(CONFIG.selector, running_gate=True)))
    assert set(result.chosen[::2]) == {0}, "frames with one candidate choose that one"
    expected = replay_temporal(log, replace(CONFIG, keyframes=replace(CONFIG.keyframes, gap_frames=1)))
    np.testing.assert_array_equal(run_temporal(recorded, CONFIG).chosen, expected.anchor)


def test_exported_motion_is_that_of_the_longest_epoch():
    log = observations()
    epoch = np.where(np.arange(N) < 20, 0, 1)
    slam = observations_of(replace(log, slam_epoch=epoch)).slam
    assert np.isnan(slam[:20]).all()
    assert np.isfinite(slam[20:]).all()


def test_every_frame_after_the_first_anchor_has_a_pose():
    log = observations()
    sparse = replace(
        CONFIG,
        keyframes=replace(CONFIG.keyframes, gap_frames=70),
        fusion=replace(CONFIG.fusion, coast_limit_frames=1),
    )
    assert pooled(replay_temporal(log, sparse))["coverage"] == 1.0


def test_selection_earns_its_place_where_appearance_flips():
    log = observations(flip_every=5)
    rows = {row.name: pooled(row.replay(log)) for row in ablation_rows.component_rows(CONFIG)}
    fusion_only, viterbi = (rows[name] for name in ("keyframe anchors + SLAM fusion", "+ Viterbi basin selection"))
    assert fusion_only["anchor_over_90_share"] == 0.2
    assert viterbi["anchor_over_90_share"] == 0.0
    assert viterbi["E_p_mean"] < 0.6 * fusion_only["E_p_mean"]


def test_offline_is_no_worse_than_causal_on_the_same_observations():
    log = observations(flip_every=2, noise_deg=2.0)
    causal, offline = pooled(replay_temporal(log, CONFIG)), pooled(replay_offline(log, CONFIG))
    assert offline["coverage"] == 1.0
    assert offline["E_p_mean"] <= causal["E_p_mean"]


@pytest.mark.parametrize("make", [ParticleSelector, UkfSelector, SelectorStage])
def test_selectors_resist_flips_and_answer_with_a_candidate(make):
    log = observations(flip_every=3)
    result = replay_temporal(log, CONFIG, make(CONFIG.selector))
    chosen = result.anchor[result.keyframe]
    assert set(chosen) <= {0, 1}
    assert np.nanmean(result.anchor_errors_deg()[20:] > 90) == 0.0


@pytest.mark.parametrize("make", [ParticleSelector, UkfSelector])
def test_filters_give_the_same_answer_every_time_and_do_not_depend_on_the_gauge(make):
    log = observations(flip_every=3)
    first = replay_temporal(log, CONFIG, make(CONFIG.selector))
    again = replay_temporal(log, CONFIG, make(CONFIG.selector))
    np.testing.assert_array_equal(first.pose_rows, again.pose_rows)
    other_gauge = lie.transform(lie.so3_exp(np.array([-1.0, 0.4, 2.0])), np.array([1.0, 1.0, 1.0]))
    rows = lie.row_from_matrix(other_gauge @ lie.matrix_from_row(log.motion_rows))
    moved = replay_temporal(replace(log, motion_rows=rows), CONFIG, make(CONFIG.selector))
    np.testing.assert_array_equal(first.anchor, moved.anchor)


@pytest.mark.parametrize("make", [ParticleSelector, UkfSelector])
def test_filters_go_on_without_motion_and_skip_empty_frames(make):
    log = observations(motion=False)
    selector = make(CONFIG.selector, FilterNoise(particles=200))
    assert selector.update(Candidates.none(), Motion.none()).selected == -1
    assert all(selector.update(group, Motion.none()).selected >= 0 for group in log.candidates)


def test_particles_stay_normalised_and_the_covariance_positive():
    log = observations(flip_every=3)
    particles, ukf = ParticleSelector(CONFIG.selector, FilterNoise(particles=300)), UkfSelector(CONFIG.selector)
    for i, group in enumerate(log.candidates):
        particles.update(group, log.motion(i))
        ukf.update(group, log.motion(i))
    assert particles._weight.sum() == pytest.approx(1.0)
    assert lie.is_rigid(lie.transform(particles._R, np.zeros((300, 3)))).all()
    assert np.linalg.eigvalsh(ukf._covariance).min() > 0


def test_sweeps_cover_the_papers_settings():
    names = [row.name for row in ablation_rows.sweep_rows(CONFIG)]
    for name in ("stride 5, K = 5", "stride 40, K = 5", "K = 10", "s0 = 300 px", "D off", "w = 0.5", "no size weight"):
        assert name in names


def test_table_pools_the_frames_of_all_clips():
    one, two = observations(n=20), observations(n=60, flip_every=2)
    table = ablation.table_of("t", [ablation_rows.Row("x", CONFIG)], [one, two])
    assert table.rows[0]["targets"] == 80


def test_clip_table_and_pooled_table_come_from_the_same_rows():
    logs = {"one": observations(flip_every=3), "two": observations(flip_every=4, noise_deg=2.0, seed=1)}
    rows = ablation_rows.reference_rows(CONFIG)
    by_clip, together = ablation.clip_table(rows, logs), ablation.table_of("t", rows, list(logs.values()))
    for row in together.rows:
        assert np.mean([line[row["name"]] for line in by_clip.rows]) == pytest.approx(row["E_p_mean"])
    for line in by_clip.rows:
        assert line["offline"] < line["causal"] < line["independent"]


def test_change_is_relative_to_the_row_above():
    table = ablation.with_change(Table("t", (), [{"E_p_mean": 0.4}, {"E_p_mean": 0.3}, {"E_p_mean": 0.33}]))
    assert [row["change"] for row in table.rows] == [None, pytest.approx(-0.25), pytest.approx(0.1)]


def test_the_inertial_row_differs_from_the_one_above_by_the_prior_alone():
    above, row = ablation_rows.component_rows(CONFIG)[-2:]
    assert above.config.fusion.inertial_weight == 0.0
    assert row.settings(above.config)["settings"] == {"fusion.inertial_weight": CONFIG.fusion.relative_weight}


def test_of_each_filter_the_best_setting_is_shown_and_all_are_told():
    log = observations(flip_every=3, n=30)
    rows = ablation_rows.table_rows(CONFIG)
    filters = ablation.table_of("f", rows["filters"], [log])
    shown = ablation.with_best_filters(ablation.table_of("s", rows["selectors"], [log]), filters).rows[-2:]
    for kind, row in zip(("particle filter on SO(3)", "UKF"), shown, strict=True):
        errors = [line["anchor_deg_mean"] for line in filters.rows if line["name"].startswith(kind)]
        assert len(errors) == 9
        assert row["anchor_deg_mean"] == min(errors)
    told = {str(row.settings(CONFIG)["noise"]) for row in rows["filters"]}
    assert len(told) == 9


def test_the_settings_of_a_row_make_its_configuration():
    for row in (row for rows in ablation_rows.table_rows(CONFIG).values() for row in rows):
        data = config_to_dict(CONFIG)
        for key, value in row.settings(CONFIG)["settings"].items():
            section, name = key.split(".")
            data[section][name] = value
        assert config_from_dict(data) == row.config


@pytest.mark.parametrize("table", ["rows", "clips"])
def test_figures_have_a_bar_per_figure_and_the_same_bytes_every_time(table):
    log = observations(n=20)
    drawn = ablation.table_of("t", [ablation_rows.Row("x", CONFIG), ablation_rows.Row("y", CONFIG)], [log])
    if table == "clips":
        drawn = ablation.clip_table(ablation_rows.reference_rows(CONFIG)[:3], {"one": log, "two": log})
    figure = table_figure(drawn)
    assert len(figure.axes[0].patches) == (2 if table == "rows" else 6)
    assert image_bytes(figure) == image_bytes(table_figure(drawn))


def test_plan_merges_presets_and_refuses_bad_ones(tmp_path):
    clip = tmp_path / "clip"
    clip.mkdir()
    temporal, front = tmp_path / "temporal.yaml", tmp_path / "front.yaml"
    temporal.write_text("fusion: {gate_angle_deg: 75.0}\nselector: {score_scale: 3.0}\n")
    front.write_text("hypotheses: {max_candidates: 5}\nselector: {score_scale: 0.5}\nfusion: {gate_angle_deg: 1.0}\n")
    plan = ablation.plan([(SourceSpec(clip), ())], tmp_path / "out", str(temporal), str(front))
    assert plan.config.fusion.gate_angle_deg == 75.0
    assert (plan.config.hypotheses.max_candidates, plan.config.selector.score_scale) == (5, 0.5)
    assert {job.mode for job in plan.jobs} == {"observe", "tracking"}
    before = [job.fingerprint() for job in plan.jobs]
    temporal.write_text("fusion: {gate_angle_deg: 30.0}\nkeyframes: {gap_frames: 20}\n")
    again = ablation.plan([(SourceSpec(clip), ())], tmp_path / "out", str(temporal), str(front))
    assert [job.fingerprint() for job in again.jobs] == before, "front ends run again only if they changed"
    with pytest.raises(ConfigError, match="fusion"):
        ablation.plan([(SourceSpec(clip), ())], tmp_path / "out", str(temporal), overrides=["fusion.nope=1"])
    with pytest.raises(UsageError, match="same name"):
        ablation.plan([(SourceSpec(clip), ())] * 2, tmp_path / "out", str(temporal))


def test_a_clips_own_settings_reach_its_front_ends_and_the_other_masking_is_run_beside_them(tmp_path):
    own = ("segmentation.backend=annotated", "slam.masked=false")
    plan = ablation.plan([(SourceSpec(tmp_path), own)], tmp_path / "out", "default")
    by_kind = {job.labels["kind"]: job for job in plan.jobs}
    assert all("segmentation.backend=annotated" in job.overrides for job in plan.jobs)
    assert by_kind[ablation.OBSERVED].labels["masked"] == "false"
    other = by_kind[ablation.MASKED_OTHERWISE]
    assert (other.labels["masked"], other.overrides[-1]) == ("true", "slam.masked=true")


def test_size_references_follow_the_configurations():
    config = replace(CONFIG, selector=replace(CONFIG.selector, size_ref_px=250.0))
    names = [row.name for row in ablation_rows.sweep_rows(config)]
    assert [name for name in names if name.startswith("s0")] == [f"s0 = {px} px" for px in (150, 200, 250, 300)]


def test_what_the_candidates_hold_clip_by_clip_and_by_range():
    log = observations(flip_every=4)
    row = ablation.candidate_table({"one": log}).rows[0]
    assert row["oracle_within_15_share"] == 1.0
    assert row["E_q_over_90_share"] == 0.25
    ranges = ablation.range_table([log, log])
    assert sum(line["frames"] for line in ranges.rows) == 2 * N
    assert {line["depth_from_m"] for line in ranges.rows} == {6.0}
    assert table_figure(ablation.candidate_table({"one": log})) is None
    assert image_bytes(table_figure(ranges)) == image_bytes(table_figure(ranges))
