"""The backend `droid`: what goes in, what comes out, and what bad input does."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from flow_oracle import SMALL, FlowOracle, make_clip, oracle_config, similarity_errors
from rule_weights import save_rule_weights

from hat_ros.config import DroidConfig, HatConfig, NetsConfig, SlamConfig
from hat_ros.errors import ConfigError, RunError, WeightsError
from hat_ros.geometry import lie
from hat_ros.motion.droid import (
    DroidSlam,
    keep_volumes,
    prepare,
    slam_rows,
    whole_clip_motions,
)
from hat_ros.nets.droid import DroidNet
from hat_ros.stages import create_backend
from hat_ros.types import Camera, Detection, Frame


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Small tensors gain nothing from a second thread, and two of them spin when the machine is busy."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def clip():
    return make_clip(52, **SMALL)


def frame_of(width, height, stamp_ns=1, K=None):
    rng = np.random.default_rng(stamp_ns)
    K = np.array([[1000.0, 0, 700], [0, 1100, 500], [0, 0, 1]]) if K is None else K
    return Frame(stamp_ns, rng.integers(0, 255, (height, width, 3), dtype=np.uint8), Camera(K, width, height))


def test_missing_weights_say_where_to_put_them(tmp_path, monkeypatch):
    monkeypatch.setenv("HAT_WEIGHTS", str(tmp_path))
    config = HatConfig(slam=SlamConfig(backend="droid"))
    with pytest.raises(WeightsError, match=rf"droid\.pth.*is in {tmp_path}.*46476ef6"):
        create_backend("slam", config, None)


def test_runs_from_a_weights_folder(tmp_path, monkeypatch):
    """Weights that mean nothing still give a motion or none, never a guess that is not finite."""
    save_rule_weights(tmp_path, "droid", DroidNet())
    monkeypatch.setenv("HAT_WEIGHTS", str(tmp_path))
    settings = DroidConfig(input_area_px=4096 + 1024, filter_threshold=0.0, warmup_keyframes=5)
    config = HatConfig(slam=SlamConfig(backend="droid", droid=settings), nets=NetsConfig(device="cpu"))
    slam = create_backend("slam", config, None)
    K = np.array([[90.0, 0, 40], [0, 90, 32], [0, 0, 1]])
    seen = Detection(np.ones((64, 80), dtype=bool))
    motions = [slam.update(frame_of(80, 64, stamp, K), seen, None) for stamp in range(1, 8)]
    assert not any(motion.valid for motion in motions[:4])
    assert motions[4].valid or motions[4].epoch == 1
    assert all(np.isfinite(motion.pose_row).all() for motion in motions if motion.valid)


@pytest.mark.parametrize(
    ("size", "area", "expected"),
    [
        ((1440, 1080), 196608, (384, 512)),  # SPARK
        ((640, 480), 196608, (384, 512)),  # YCB-Video
        ((1024, 1024), 393216, (624, 624)),  # SwissCube
        ((1920, 1200), 196608, (344, 560)),  # SHIRT
    ],
)
def test_input_size_and_intrinsics_as_published(size, area, expected):
    frame = frame_of(*size)
    image, intrinsics = prepare(frame, DroidConfig(input_area_px=area))
    assert image.shape == (1, 3, *expected) and image.dtype == np.uint8
    scale = np.sqrt(area / (size[0] * size[1]))
    K = frame.camera.K
    assert np.allclose(intrinsics, scale * np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), rtol=3e-3)
    assert image.flags.c_contiguous


def test_channels_go_in_as_bgr():
    frame = frame_of(128, 128)
    frame = replace(frame, rgb=np.broadcast_to(np.array([10, 20, 30], np.uint8), (128, 128, 3)))
    image, _ = prepare(frame, DroidConfig(input_area_px=128 * 128))
    assert [int(channel.max()) for channel in image[0]] == [30, 20, 10]


def test_odd_sizes_are_cropped_right_and_bottom():
    frame = frame_of(101, 93)
    image, intrinsics = prepare(frame, DroidConfig(input_area_px=101 * 93))
    assert image.shape == (1, 3, 88, 96)
    assert np.array_equal(image[0].transpose(1, 2, 0)[..., ::-1], frame.rgb[:88, :96])
    assert np.allclose(intrinsics, [1000, 1100, 700, 500])


def test_too_small_an_input_area_is_named():
    with pytest.raises(ConfigError, match="input_area_px 4096"):
        prepare(frame_of(640, 200), DroidConfig(input_area_px=4096))


def test_volumes_are_stored_while_they_fit():
    auto = DroidConfig()
    assert keep_volumes(auto, (48, 64), torch.float16) and keep_volumes(auto, (48, 64), torch.float32)
    assert not keep_volumes(auto, (78, 78), torch.float16)
    assert keep_volumes(DroidConfig(correlation="stored"), (78, 78), torch.float32)
    assert not keep_volumes(DroidConfig(correlation="on_the_fly"), (8, 8), torch.float32)


def test_poses_are_inverted_once():
    rows = lie.row_from_matrix(lie.transform(lie.so3_exp(np.array([[0.3, 0.2, -1.0]])), np.array([[1.0, 2, 3]])))
    product = lie.matrix_from_row(slam_rows(rows)) @ lie.matrix_from_row(rows)
    assert np.allclose(product, np.eye(4), atol=1e-12)


def test_frames_without_a_mask_do_not_reach_the_tracker(clip):
    """No mask and an empty one: no motion, and the frames around them are as if they had not been."""
    config = oracle_config(clip)
    plain, gappy = (DroidSlam(config, None, FlowOracle(clip)) for _ in range(2))
    empty = Detection(np.zeros_like(clip.detections[0].mask))
    for i, (frame, seen) in enumerate(zip(clip.frames, clip.detections, strict=True)):
        missing = i % 5 == 2
        motion = gappy.update(frame, (None if i % 2 else empty) if missing else seen, None)
        if missing:
            assert not motion.valid and np.isnan(motion.pose_row).all()
            continue
        expected = plain.update(frame, seen, None)
        assert motion.valid == expected.valid
        assert np.array_equal(motion.pose_row, expected.pose_row, equal_nan=True)
    assert motion.valid


def test_unmasked_scenes_need_no_detection(clip):
    config = oracle_config(clip)
    config = replace(config, slam=replace(config.slam, masked=False))
    slam = DroidSlam(config, None, FlowOracle(clip))
    motions = [slam.update(frame, None, None) for frame in clip.frames[:45]]
    assert motions[-1].valid


class Broken(FlowOracle):
    """Answers numbers that are not finite from some call on."""

    calls = 0

    def refine(self, hidden, inp, lookup, motion):
        hidden, delta, weight = super().refine(hidden, inp, lookup, motion)
        self.calls += motion is not None
        return hidden, delta * (float("nan") if self.calls == 40 else 1.0), weight


def test_a_result_that_is_not_finite_starts_a_new_epoch(clip):
    slam = DroidSlam(oracle_config(clip), None, Broken(clip))
    motions = [slam.update(frame, seen, None) for frame, seen in zip(clip.frames, clip.detections, strict=True)]
    assert all(np.isfinite(motion.pose_row).all() for motion in motions if motion.valid)
    epochs = [motion.epoch for motion in motions]
    assert epochs == sorted(epochs)
    assert slam._model.calls >= 40 and epochs[-1] == 1


def test_reset_and_camera_change_start_a_new_epoch(clip):
    slam = DroidSlam(oracle_config(clip), None, FlowOracle(clip))
    frame, seen = clip.frames[0], clip.detections[0]
    slam.reset()
    assert slam.update(frame, seen, None).epoch == 0  # nothing to forget yet
    slam.reset()
    assert slam.update(frame, seen, None).epoch == 1
    zoomed = Camera(frame.camera.K @ np.diag([1.1, 1.1, 1.0]), frame.camera.width, frame.camera.height)
    motion = slam.update(Frame(frame.stamp_ns + 1, frame.rgb, zoomed), seen, None)
    assert motion.epoch == 2 and motion.n_keyframes == 1


def test_offline_reference_gives_every_frame_a_pose(clip):
    pairs = list(zip(clip.frames, clip.detections, strict=True))
    pairs[7] = (pairs[7][0], None)
    motions = whole_clip_motions(oracle_config(clip), pairs, FlowOracle(clip))
    assert [motion.valid for motion in motions] == [i != 7 for i in range(len(pairs))]
    T_slam_cam = np.stack([motion.T_slam_cam for motion in motions if motion.valid])
    rotation_deg, translation, _ = similarity_errors(T_slam_cam, np.delete(clip.T_cam_target, 7, axis=0))
    # Frames between keyframes are read out with fixed depths; keyframes themselves are much better.
    assert np.median(rotation_deg) < 0.1 and rotation_deg.max() < 1.5
    assert np.median(translation) < 0.005 and translation.max() < 0.02


def test_offline_reference_needs_motion(clip):
    pairs = [(clip.frames[0], clip.detections[0])] * 3
    with pytest.raises(RunError, match="warm-up needs 8"):
        whole_clip_motions(oracle_config(clip), pairs, FlowOracle(clip))
    assert whole_clip_motions(oracle_config(clip), [(clip.frames[0], None)], FlowOracle(clip))[0].valid is False


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA")
def test_gpu_agrees_with_cpu_in_float32(tmp_path, monkeypatch):
    save_rule_weights(tmp_path, "droid", DroidNet())
    monkeypatch.setenv("HAT_WEIGHTS", str(tmp_path))
    images = torch.randint(0, 255, (2, 3, 128, 160), dtype=torch.uint8, generator=torch.Generator().manual_seed(1))
    answers = []
    for device in ("cpu", "cuda"):
        net, batch = DroidNet.from_checkpoint(device=device), images.to(device)
        with torch.inference_mode():
            features, (hidden, inp) = net.features(batch), net.context(batch)
            y, x = torch.meshgrid(torch.arange(16.0), torch.arange(20.0), indexing="ij")
            coords = torch.stack([x, y], -1)[None].to(device) + 0.3
            lookup = net.correlation(features[:1], features[1:]).lookup(coords)
            answers.append(net.refine(hidden[:1], inp[:1], lookup, None)[1].cpu())
    assert torch.allclose(*answers, atol=2e-2)
