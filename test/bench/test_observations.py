"""Recorded observations: exported from a run, read back, and malformed files."""

import zipfile
from dataclasses import replace

import numpy as np
import pytest
from observed_log import CONFIG, N, observations
from temporal_scene import make_scene, preset

from hat_ros.bench.methods.temporal import replay_temporal, run_temporal, save_result
from hat_ros.bench.observations import load_observations, observations_of, save_observations
from hat_ros.errors import InputError
from hat_ros.types import Candidates


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
        monkeypatch.setattr("hat_ros.bench.observations.MAX_UNPACKED_BYTES", 1000)
        path = tmp_path / "obs.npz"
        np.savez_compressed(path, **self._arrays())
        with pytest.raises(InputError, match="MiB"):
            load_observations(path)
        assert zipfile.is_zipfile(path)

    def test_an_unwritable_result_is_an_input_error(self, tmp_path):
        result = run_temporal(make_scene(5).observations, preset())
        with pytest.raises(InputError, match="cannot be written"):
            save_result(tmp_path / "no" / "such" / "folder.npz", result)
