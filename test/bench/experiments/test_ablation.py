"""Temporal replay, the filters, and the ablation tables, on observations made by hand."""

from dataclasses import replace

import numpy as np
import pytest
from observed_log import CONFIG, N, observations

from hat_ros.bench.evaluation.figures import image_bytes
from hat_ros.bench.evaluation.tables import Table
from hat_ros.bench.experiments import ablation, ablation_rows
from hat_ros.bench.experiments.ablation_figure import table_figure
from hat_ros.bench.source import SourceSpec
from hat_ros.config import config_from_dict, config_to_dict
from hat_ros.errors import ConfigError, UsageError


def pooled(log):
    return ablation.pooled([log])


def test_selection_earns_its_place_where_appearance_flips():
    log = observations(flip_every=5)
    rows = {row.name: pooled(row.replay(log)) for row in ablation_rows.component_rows(CONFIG)}
    fusion_only, viterbi = (rows[name] for name in ("keyframe anchors + SLAM fusion", "+ Viterbi basin selection"))
    assert fusion_only["anchor_over_90_share"] == 0.2
    assert viterbi["anchor_over_90_share"] == 0.0
    assert viterbi["E_p_mean"] < 0.6 * fusion_only["E_p_mean"]


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


def test_figures_have_a_bar_per_row_and_the_same_bytes_every_time():
    log = observations(n=20)
    drawn = ablation.table_of("t", [ablation_rows.Row("x", CONFIG), ablation_rows.Row("y", CONFIG)], [log])
    figure = table_figure(drawn)
    assert len(figure.axes[0].patches) == 2
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
    assert table_figure(ablation.clip_table(ablation_rows.reference_rows(CONFIG)[:1], {"one": log})) is None
    assert image_bytes(table_figure(ranges)) == image_bytes(table_figure(ranges))
