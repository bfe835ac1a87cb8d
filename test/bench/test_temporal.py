"""Stages 3 and 4 over recorded observations: the published schedule, invariances, causality, bad files."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
from temporal_scene import HALF_TURN, make_scene, preset, rotation_error_deg

from hat_ros.bench.temporal import Observations, load_observations, run_offline, run_temporal, save_result
from hat_ros.errors import CandidateError, InputError
from hat_ros.geometry import lie

PRESETS = ("mega_hat", "pico_hat", "mega_hat_spark")


@pytest.fixture(scope="module")
def scene():
    return make_scene()


def _changed(observations, **arrays):
    return replace(observations, **arrays)


def _perfect(n=60, **options):
    """No noise: the anchors that are right are exact, and so must every fused pose be."""
    scene = make_scene(n, noise_deg=0, noise_m=0, rival_score=0.1, **options)
    return scene.T_cam_target, scene.observations


@pytest.mark.parametrize("name", PRESETS)
def test_prefix_the_first_frames_give_the_first_outputs(name, scene):
    config, whole = preset(name), run_temporal(scene.observations, preset(name))
    for n in (1, 9, 41, 100):
        part = run_temporal(_cut(scene.observations, n), config)
        assert part.T_cam_target.tobytes() == whole.T_cam_target[:n].tobytes()
        assert part.chosen.tolist() == whole.chosen[:n].tolist()
        assert part.accepted.tolist() == whole.accepted[:n].tolist()
        assert part.resets.tolist() == [frame for frame in whole.resets if frame < n]


@pytest.mark.parametrize("name", PRESETS)
def test_corrupting_later_frames_changes_nothing_earlier(name, scene):
    config, o = preset(name), scene.observations
    poses, slam = o.poses.copy(), o.slam.copy()
    poses[60:] = poses[60:, ::-1]
    slam[60:] = np.nan
    a = run_temporal(o, config)
    b = run_temporal(_changed(o, poses=poses, slam=slam), config)
    assert a.T_cam_target[:60].tobytes() == b.T_cam_target[:60].tobytes()
    assert a.T_cam_target[60:].tobytes() != b.T_cam_target[60:].tobytes()


def _cut(o, n):
    return Observations(o.slam[:n], o.key[:n], o.poses[:n], o.scores[:n], o.box_area_px[:n])


@pytest.mark.parametrize("name", PRESETS)
def test_slam_gauge_and_scale_change_nothing(name, scene):
    o = scene.observations
    slam = lie.transform(lie.so3_exp(np.array([2.0, -0.5, 1.0])), np.array([5.0, 2, -3])) @ o.slam
    slam[:, :3, 3] *= 0.21
    a, b = run_temporal(o, preset(name)), run_temporal(_changed(o, slam=slam), preset(name))
    np.testing.assert_array_equal(a.chosen, b.chosen)
    np.testing.assert_allclose(a.T_cam_target, b.T_cam_target, atol=1e-7)


@pytest.mark.parametrize("name", ["mega_hat", "mega_hat_spark"])
def test_a_score_offset_changes_nothing(name, scene):
    o = scene.observations
    scores = o.scores + np.linspace(-4, 9, len(o))[:, None]
    a, b = run_temporal(o, preset(name)), run_temporal(_changed(o, scores=scores), preset(name))
    np.testing.assert_array_equal(a.chosen, b.chosen)
    np.testing.assert_allclose(a.T_cam_target, b.T_cam_target, atol=1e-9)


@pytest.mark.parametrize("name", PRESETS)
def test_permuted_candidates_give_permuted_choices_and_the_same_poses(name, scene):
    o, rng = scene.observations, np.random.default_rng(0)
    orders = np.stack([rng.permutation(o.poses.shape[1]) for _ in range(len(o))])
    rows = np.arange(len(o))[:, None]
    a = run_temporal(o, preset(name))
    b = run_temporal(_changed(o, poses=o.poses[rows, orders], scores=o.scores[rows, orders]), preset(name))
    np.testing.assert_array_equal(a.T_cam_target, b.T_cam_target)
    keys = np.flatnonzero(a.chosen >= 0)
    np.testing.assert_array_equal(orders[keys, b.chosen[keys]], a.chosen[keys])


@pytest.mark.parametrize("name", ["mega_hat", "pico_hat"])
def test_offline_poses_do_not_depend_on_the_gauge_and_are_closer_to_the_truth(name):
    scene = make_scene(100, noise_deg=3)
    config = preset(name, selector={"running_gate": False})
    offline = run_offline(scene.observations, config)
    gauge = lie.transform(lie.so3_exp(np.array([0.4, -2.0, 1.0])), np.array([3.0, 1.0, -2.0]))
    moved = run_offline(replace(scene.observations, slam=gauge @ scene.observations.slam), config)
    np.testing.assert_allclose(moved.T_cam_target, offline.T_cam_target, atol=1e-6)
    np.testing.assert_array_equal(moved.chosen, offline.chosen)
    assert set(np.flatnonzero(offline.accepted)) <= set(np.flatnonzero(scene.observations.key))
    causal = run_temporal(scene.observations, config)
    errors = [rotation_error_deg(r.T_cam_target, scene.T_cam_target).mean() for r in (offline, causal)]
    assert errors[0] <= errors[1]


def test_hat_follows_the_truth_where_appearance_flips():
    scene = make_scene(240, seed=3)
    result = run_temporal(scene.observations, preset())
    error = rotation_error_deg(result.T_cam_target, scene.T_cam_target)
    keys = np.flatnonzero(scene.observations.key)
    best = np.nanargmax(scene.observations.scores[keys], axis=1)
    independent = rotation_error_deg(scene.observations.poses[keys, best], scene.T_cam_target[keys])
    assert np.mean(independent > 90) > 0.1
    assert (error[60:] < 15).all()


class TestSchedule:
    def test_without_noise_every_frame_after_the_warm_up_is_exact(self):
        T, observations = _perfect()
        result = run_temporal(observations, preset())
        np.testing.assert_allclose(result.T_cam_target[12:], T[12:], atol=1e-9)
        assert not result.held[12:].any()

    def test_before_fusion_an_anchor_frame_outputs_its_anchor_and_others_hold_it(self):
        scene = make_scene(30)
        result = run_temporal(scene.observations, preset())
        for frame in range(12):
            key = frame - frame % 4
            anchor = scene.observations.poses[key, result.chosen[key]]
            np.testing.assert_allclose(result.T_cam_target[frame], anchor, atol=1e-12)
            assert result.held[frame] == (frame % 4 != 0)
        assert not result.held[12:].any()

    def test_chosen_is_minus_one_between_keyframes_and_accepted_from_the_third_on(self):
        result = run_temporal(make_scene(40).observations, preset())
        keys = np.arange(40) % 4 == 0
        assert (result.chosen[~keys] == -1).all()
        assert (result.chosen[keys] >= 0).all()
        assert np.flatnonzero(result.accepted).tolist() == list(range(8, 40, 4))

    def test_before_the_first_anchor_there_is_no_pose(self):
        scene = make_scene(40)
        key = scene.observations.key.copy()
        key[:8] = False
        result = run_temporal(_changed(scene.observations, key=key), preset())
        assert np.isnan(result.T_cam_target[:8]).all()
        assert np.isfinite(result.T_cam_target[8:]).all()
        assert not result.held[:8].any()

    def test_a_pose_is_held_without_limit(self):
        scene = make_scene(200)
        o = scene.observations
        key, slam = o.key.copy(), o.slam.copy()
        key[40:], slam[40:] = False, np.nan
        result = run_temporal(_changed(o, key=key, slam=slam), preset())
        np.testing.assert_allclose(result.T_cam_target[40:], result.T_cam_target[[39] * 160], atol=1e-14)
        assert result.held[40:].all()

    def test_where_slam_is_missing_an_anchor_stands_alone_and_the_rest_is_held(self):
        scene = make_scene(60)
        slam = scene.observations.slam.copy()
        slam[30:38] = np.nan
        result = run_temporal(_changed(scene.observations, slam=slam), preset())
        anchor = scene.observations.poses[32, result.chosen[32]]
        np.testing.assert_allclose(result.T_cam_target[32], anchor, atol=1e-12)
        assert np.flatnonzero(result.held[13:]).tolist() == [30 - 13, 31 - 13, 33 - 13, 34 - 13, 35 - 13, 37 - 13]

    def test_after_a_gap_the_aligned_slam_pose_takes_over(self):
        """Noise-free anchors until the gap: there the aligned SLAM pose is the truth."""
        T, observations = _perfect(60)
        slam, key = observations.slam.copy(), observations.key.copy()
        slam[30:33], key[30:] = np.nan, False
        result = run_temporal(_changed(observations, slam=slam, key=key), preset())
        assert result.held[30:33].all()
        np.testing.assert_allclose(result.T_cam_target[33:], T[33:], atol=1e-9)

    def test_rotating_gap_fill_follows_slam_about_a_held_position(self):
        T, observations = _perfect(20)
        result = run_temporal(observations, preset("mega_hat", fusion={"gap_fill": "rotate"}))
        np.testing.assert_allclose(result.T_cam_target[:, :3, :3], T[:, :3, :3], atol=1e-9)
        np.testing.assert_allclose(result.T_cam_target[1:4, :3, 3], T[[0, 0, 0], :3, 3], atol=1e-12)


class TestReset:
    @staticmethod
    def _flipped_from(start):
        """From one frame on the front end only knows the half-turned basin."""
        T, o = _perfect(100, k=1)
        poses = o.poses.copy()
        poses[start:, :, :3, :3] = T[start:, None, :3, :3] @ HALF_TURN
        return T, _changed(o, poses=poses)

    def test_four_coherent_dissenting_anchors_drop_the_alignment(self):
        T, observations = self._flipped_from(40)
        result = run_temporal(observations, preset())
        assert result.resets.tolist() == [52]
        error = rotation_error_deg(result.T_cam_target, T)
        # Until the reset the weakened anchors barely pull; from the triggering frame onward the new basin rules.
        np.testing.assert_allclose(error[52::4], 180.0, atol=1e-3)
        assert (error[13:40] < 1e-6).all()

    def test_after_a_reset_the_warm_up_starts_over_with_the_triggering_frame(self):
        _, observations = self._flipped_from(40)
        result = run_temporal(observations, preset())
        assert np.flatnonzero(result.held[50:]).tolist() == [3, 4, 5, 7, 8, 9, 11, 12, 13]

    def test_three_are_not_enough_and_an_agreeing_one_clears_the_count(self):
        T, o = _perfect(100, k=1)
        poses = o.poses.copy()
        for key in (40, 44, 48, 56, 60, 64, 72):
            poses[key, :, :3, :3] = T[key, :3, :3] @ HALF_TURN
        assert run_temporal(_changed(o, poses=poses), preset()).resets.tolist() == []

    def test_incoherent_dissenters_never_add_up(self):
        T, o = _perfect(140, k=1)
        poses, turns = o.poses.copy(), lie.so3_exp(np.array([[0, np.pi, 0], [np.pi, 0, 0], [0, 0, np.pi]]))
        for i, key in enumerate(range(40, 140, 4)):
            poses[key, :, :3, :3] = T[key, :3, :3] @ turns[i % 3]
        assert run_temporal(_changed(o, poses=poses), preset()).resets.tolist() == []

    def test_rival_anchors_are_weakened_not_followed(self):
        T, o = _perfect(100, k=1)
        poses = o.poses.copy()
        poses[40, :, :3, :3] = T[40, :3, :3] @ HALF_TURN
        result = run_temporal(_changed(o, poses=poses), preset("pico_hat"))
        error = rotation_error_deg(result.T_cam_target, T)
        assert 10 < error[40] < 60
        assert error[48] < 1.0


class TestGuardInTheLoop:
    def test_pico_keeps_running_where_all_candidates_are_dropped(self):
        scene = make_scene(60)
        scores = scene.observations.scores.copy()
        scores[24] = -1.0
        result = run_temporal(_changed(scene.observations, scores=scores), preset("pico_hat"))
        assert result.chosen[24] == -1
        assert not result.accepted[24]
        assert np.isfinite(result.T_cam_target[24]).all()
        assert result.chosen[28] >= 0

    def test_pico_accepts_padding_with_nan(self):
        scene = make_scene(40)
        poses, scores = scene.observations.poses.copy(), scene.observations.scores.copy()
        poses[8, 3:], scores[8, 3:] = np.nan, np.nan
        result = run_temporal(_changed(scene.observations, poses=poses, scores=scores), preset("pico_hat"))
        assert 0 <= result.chosen[8] < 3

    @pytest.mark.parametrize("what", ["score", "pose"])
    def test_mega_names_frame_and_candidate(self, what):
        scene = make_scene(40)
        poses, scores = scene.observations.poses.copy(), scene.observations.scores.copy()
        if what == "score":
            scores[8, 2] = np.nan
        else:
            poses[8, 2, 0, 0] = 7.0
        with pytest.raises(CandidateError, match="frame 8, candidate 2"):
            run_temporal(_changed(scene.observations, poses=poses, scores=scores), preset())


def test_opposite_ends_of_the_half_turn_are_no_trouble():
    """A target at almost 180 degrees all along: no jump of the sign or of the angle."""
    gauge = lie.transform(HALF_TURN, np.zeros(3))
    scene = make_scene(60, noise_deg=0, noise_m=0, rival_score=0.1, gauge=gauge, rate_deg=0.01)
    result = run_temporal(scene.observations, preset())
    np.testing.assert_allclose(result.T_cam_target[12:], scene.T_cam_target[12:], atol=1e-9)


class TestFiles:
    @staticmethod
    def _arrays(n=6, k=2):
        o = make_scene(n, k).observations
        return {"slam": o.slam, "key": o.key, "poses": o.poses, "scores": o.scores, "box_area_px": o.box_area_px}

    def _load(self, tmp_path, arrays):
        path = tmp_path / "obs.npz"
        np.savez(path, **arrays)
        return load_observations(path)

    def test_a_good_file_and_its_result_survive_the_disk(self, tmp_path):
        observations = self._load(tmp_path, self._arrays())
        result = run_temporal(observations, preset())
        save_result(tmp_path / "out.npz", result)
        with np.load(tmp_path / "out.npz") as data:
            assert {"T_cam_target", "chosen", "accepted", "resets"} <= set(data)
            np.testing.assert_array_equal(data["T_cam_target"], result.T_cam_target)
            assert data["chosen"].shape == data["accepted"].shape == (6,)
            assert data["resets"].ndim == 1
        assert [path.name for path in tmp_path.iterdir() if "partial" in path.name] == []

    def test_single_precision_is_accepted(self, tmp_path):
        arrays = {name: a if name == "key" else a.astype(np.float32) for name, a in self._arrays().items()}
        assert self._load(tmp_path, arrays).slam.dtype == np.float64

    def test_the_box_area_is_optional(self, tmp_path):
        arrays = self._arrays()
        del arrays["box_area_px"]
        assert self._load(tmp_path, arrays).box_area_px is None

    @pytest.mark.parametrize("name", ["slam", "key", "poses", "scores"])
    def test_a_missing_array_is_named(self, name, tmp_path):
        arrays = self._arrays()
        del arrays[name]
        with pytest.raises(InputError, match=f"'{name}' is missing"):
            self._load(tmp_path, arrays)

    @pytest.mark.parametrize(
        ("name", "change", "message"),
        [
            ("slam", lambda a: a[:-1], r"slam: expected shape \(6, 4, 4\)"),
            ("slam", lambda a: a[:, :3], r"slam: expected shape"),
            ("key", lambda a: a.astype(int), "key: expected dtype bool, found int64"),
            ("key", lambda a: a[:0], "N >= 1"),
            ("key", lambda a: a[:, None], r"key: expected shape \(N,\)"),
            ("poses", lambda a: a[:, 0], "poses: expected shape"),
            ("poses", lambda a: a[:, :, :, :3], "poses: expected shape"),
            ("scores", lambda a: a[:, :1], r"scores: expected shape \(6, 2\)"),
            ("scores", lambda a: a.astype(np.complex128), "scores: expected a floating-point dtype"),
            ("scores", lambda a: np.zeros(a.shape, dtype=np.int64), "scores: expected a floating-point dtype"),
            ("box_area_px", lambda a: a[:2], "box_area_px: expected shape"),
            ("box_area_px", lambda a: -a, "box_area_px: must be zero or more"),
        ],
    )
    def test_wrong_shapes_and_types_are_named(self, name, change, message, tmp_path):
        arrays = self._arrays()
        arrays[name] = change(arrays[name])
        with pytest.raises(InputError, match=message):
            self._load(tmp_path, arrays)

    def test_no_candidates_per_frame_is_an_error(self, tmp_path):
        arrays = self._arrays()
        arrays["poses"], arrays["scores"] = np.zeros((6, 0, 4, 4)), np.zeros((6, 0))
        with pytest.raises(InputError, match="K = 0"):
            self._load(tmp_path, arrays)

    def test_a_slam_pose_that_is_neither_rigid_nor_nan_is_named(self, tmp_path):
        for value in (np.nan, 3.0, np.inf):
            arrays = self._arrays()
            arrays["slam"] = arrays["slam"].copy()
            arrays["slam"][4, 0, 0] = value
            with pytest.raises(InputError, match="slam: frame 4"):
                self._load(tmp_path, arrays)

    @pytest.mark.parametrize("content", [b"", b"not a zip", b"PK\x03\x04 cut short"])
    def test_a_file_that_is_no_archive(self, content, tmp_path):
        path = tmp_path / "obs.npz"
        path.write_bytes(content)
        with pytest.raises(InputError, match=r"not a readable \.npz"):
            load_observations(path)

    def test_a_truncated_archive(self, tmp_path):
        path = tmp_path / "obs.npz"
        np.savez(path, **self._arrays())
        path.write_bytes(path.read_bytes()[:-200])
        with pytest.raises(InputError):
            load_observations(path)

    def test_a_missing_file(self, tmp_path):
        with pytest.raises(InputError, match="no such file"):
            load_observations(tmp_path / "nowhere.npz")

    def test_pickled_objects_are_refused(self, tmp_path):
        arrays = self._arrays()
        arrays["poses"] = np.array([{"a": 1}] * 6, dtype=object)
        path = tmp_path / "obs.npz"
        np.savez(path, allow_pickle=True, **arrays)
        with pytest.raises(InputError):
            load_observations(path)

    def test_a_compression_bomb_is_refused_before_it_unpacks(self, tmp_path, monkeypatch):
        monkeypatch.setattr("hat_ros.bench.temporal.MAX_UNPACKED_BYTES", 1000)
        path = tmp_path / "obs.npz"
        np.savez_compressed(path, **self._arrays())
        with pytest.raises(InputError, match="MiB"):
            load_observations(path)
        assert zipfile.is_zipfile(path)

    def test_an_unwritable_result_is_an_input_error(self, tmp_path):
        result = run_temporal(make_scene(5).observations, preset())
        with pytest.raises(InputError, match="cannot be written"):
            save_result(tmp_path / "no" / "such" / "folder.npz", result)
