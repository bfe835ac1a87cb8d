import cv2
import numpy as np
import pytest
from segmentation_scene import HEIGHT, WIDTH, frame, overlap, prior

from hat_ros.config import HatConfig
from hat_ros.geometry import lie
from hat_ros.segmentation.ground import GroundEvidence, GroundMemory
from hat_ros.segmentation.search import Search
from hat_ros.segmentation.stage import SegmentationStage


@pytest.fixture
def stage(lopsided):
    return SegmentationStage(HatConfig(), lopsided)


def bias_px(found, truth):
    """Mean outward shift of the outline in pixels, from the pixels within three of it that differ."""
    outline = cv2.findContours(truth.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    far = cv2.distanceTransform((~truth).astype(np.uint8), cv2.DIST_L2, 5)
    return (np.count_nonzero(found & ~truth & (far < 3)) - np.count_nonzero(truth & ~found)) / sum(map(len, outline))


# Black sky ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.8, 2.0, 3.1, 4.4])
def test_a_lit_body_is_found_among_stars_and_noise(stage, scene, angle):
    T = scene.pose(angle)
    found = stage.update(frame(0, scene.image(T, noise=2.0, stars=60)), None)
    assert found.silhouette
    assert overlap(found.mask, scene.truth(T)) > 0.95


@pytest.mark.parametrize("gain", [0.15, 0.4, 1.0, 4.0])
def test_exposure_does_not_move_the_outline(stage, scene, gain):
    T = scene.pose(0.3)
    mask = stage.update(frame(0, scene.image(T, gain=gain, noise=1.0)), None).mask
    assert overlap(mask, scene.truth(T)) > 0.94
    assert abs(bias_px(mask, scene.truth(T))) < 0.3


def test_a_raised_black_level_is_still_black_sky(stage, scene):
    T = scene.pose(0.3)
    mask = stage.update(frame(0, scene.image(T, level=14.0, noise=3.0)), None).mask
    assert overlap(mask, scene.truth(T)) > 0.93


def test_a_far_target_keeps_its_size(stage, scene):
    T = scene.pose(0.3, z=16.0)
    mask = stage.update(frame(0, scene.image(T, stars=30)), None).mask
    assert np.ptp(np.flatnonzero(scene.truth(T).any(axis=0))) < 70
    assert overlap(mask, scene.truth(T)) > 0.85
    assert abs(bias_px(mask, scene.truth(T))) < 0.3


def test_a_camera_that_turns_fast_does_not_lose_a_lit_body(stage, scene):
    """However sure the prediction is: before a black sky nothing else looks like the target."""
    for i, x in enumerate((-1.0, -1.0, 0.6)):
        T = scene.pose(0.3, x=x)
        found = stage.update(frame(i, scene.image(T)), prior(scene.pose(0.3, x=-1.0)))
    assert overlap(found.mask, scene.truth(T)) > 0.93


def test_a_target_cut_by_the_border_is_found(stage, scene):
    T = scene.pose(0.3, x=-1.9)
    found = stage.update(frame(0, scene.image(T)), None)
    assert found.touches_border()
    assert overlap(found.mask, scene.truth(T)) > 0.94


def test_stars_alone_are_no_target(stage, scene):
    rgb = scene.image(scene.pose(z=1e4), stars=200)
    assert stage.update(frame(0, rgb), None) is None


@pytest.mark.parametrize("level", [0, 3, 255])
def test_blank_and_saturated_images_give_nothing(stage, level):
    assert stage.update(frame(0, np.full((HEIGHT, WIDTH, 3), level, np.uint8)), None) is None


@pytest.mark.parametrize(("level", "noise"), [(2, 2), (128, 20), (250, 10)])
def test_noise_gives_nothing(stage, level, noise):
    rng = np.random.default_rng(0)
    for i in range(3):
        rgb = np.clip(rng.normal(level, noise, (HEIGHT, WIDTH, 3)), 0, 255).astype(np.uint8)
        assert stage.update(frame(i, rgb), None) is None


def test_a_trusted_silhouette_adds_the_parts_in_shadow(stage, scene):
    T = scene.pose(0.3)
    truth = scene.truth(T)
    rgb = scene.image(T, noise=0.5)
    columns = np.flatnonzero(truth.any(axis=0))
    edge = int(columns[0] + 0.6 * np.ptp(columns))
    rgb[:, edge:] = scene.image(scene.pose(z=1e4), noise=0.5)[:, edge:]
    alone = stage.update(frame(0, rgb), None).mask
    helped = stage.update(frame(1, rgb), prior(T)).mask
    assert overlap(alone, truth) < 0.85 < 0.95 < overlap(helped, truth)
    distrusted = stage.update(frame(2, rgb), prior(T, healthy=False)).mask
    assert np.array_equal(distrusted, alone)


def test_a_wrong_prior_does_not_change_a_mask_before_black_sky(stage, scene):
    T = scene.pose(0.3)
    rgb = scene.image(T)
    alone = stage.update(frame(0, rgb), None).mask
    for index, wrong in enumerate((scene.pose(0.3, x=0.6), scene.pose(1.2), scene.pose(0.3, z=3.0))):
        assert overlap(stage.update(frame(1 + index, rgb), prior(wrong)).mask, alone) > 0.97


def test_a_mask_that_suddenly_leaves_a_sure_silhouette_is_not_believed_at_once(stage, scene):
    T = scene.pose(0.3, z=9.0)
    rgb = scene.image(T, noise=1.0)
    flooded = rgb.copy()
    flooded[HEIGHT // 2 :, 30:-30] = 200
    for i in range(3):
        assert overlap(stage.update(frame(i, rgb), prior(T)).mask, scene.truth(T)) > 0.9
    assert stage.update(frame(3, flooded), prior(T)) is None
    assert overlap(stage.update(frame(4, rgb), prior(T)).mask, scene.truth(T)) > 0.9
    lasting = [stage.update(frame(5 + i, flooded), prior(T)) for i in range(6)]
    assert lasting[0] is None
    assert lasting[-1] is not None


def planet(scene, T, center, radius):
    """The scene's picture with a bright mottled disc behind it."""
    rgb = scene.image(T)
    disc = cv2.circle(np.zeros((HEIGHT, WIDTH), np.uint8), center, radius, 1, -1)
    behind = (disc > 0) & ~cv2.dilate(scene.truth(T).astype(np.uint8), np.ones((3, 3))).astype(bool)
    rgb[behind] = scene.ground[:HEIGHT, :WIDTH][behind].astype(np.uint8)
    return rgb


@pytest.mark.parametrize("center", [(330, 260), (340, 120), (-10, 250)])
def test_a_planet_cut_by_the_border_is_not_the_target(stage, scene, center):
    T = scene.pose(0.3, x=0.5 if center[0] < 0 else -0.5, y=-0.3)
    found = stage.update(frame(0, planet(scene, T, center, 90)), None)
    assert overlap(found.mask, scene.truth(T)) > 0.85


# Textured, moving background ---------------------------------------------------------------------------------------


def run(stage, scene, priors, frames=12, start=0):
    """Overlap with the truth over a tumbling pass before moving ground; ``priors`` makes the hint of each frame."""
    overlaps = []
    for i in range(start, start + frames):
        T, rgb, truth = scene.passing(i)
        found = stage.update(frame(i, rgb), priors(T, i))
        overlaps.append(np.nan if found is None else overlap(found.mask, truth))
    return np.array(overlaps)


def test_found_from_nothing_before_moving_ground(stage, scene):
    assert (run(stage, scene, lambda T, i: None) > 0.9).all()


@pytest.mark.parametrize("angle", [0.0, 0.4, 0.8])
def test_a_small_target_before_broken_clouds_is_found_from_nothing(stage, scene, angle):
    """Their edges are stronger than the target's outline, and its shape is coarse at the scale of the search."""
    T = scene.pose(angle, x=0.2, y=0.1, z=12.0)
    truth = scene.truth(T)
    rng = np.random.default_rng(3)
    patches = cv2.resize(rng.random((12, 16)).astype(np.float32), (WIDTH, HEIGHT), interpolation=cv2.INTER_CUBIC)
    clouds = patches + 0.15 * cv2.GaussianBlur(rng.standard_normal((HEIGHT, WIDTH)).astype(np.float32), (0, 0), 1) > 0.6
    clouds &= np.hypot(*(np.mgrid[:HEIGHT, :WIDTH] - np.argwhere(truth).mean(axis=0)[:, None, None])) > 45
    ground = np.where(clouds[..., None], np.uint8(235), np.array([25, 60, 120], np.uint8))
    rgb = np.where(truth[..., None], scene.image(T), ground).astype(np.uint8)
    found = stage.update(frame(0, cv2.GaussianBlur(rgb, (0, 0), 0.6)), None)
    assert found is not None
    assert overlap(found.mask, truth) > 0.8


@pytest.mark.parametrize("healthy", [True, False])
def test_a_supported_prior_keeps_the_mask(stage, scene, healthy):
    assert (run(stage, scene, lambda T, i: prior(T, healthy, True) if i > 4 else None, frames=20) > 0.92).all()


@pytest.mark.parametrize("healthy", [True, False])
@pytest.mark.parametrize("kind", ["turned", "elsewhere", "nearer", "nan", "behind"])
def test_a_wrong_prior_neither_makes_nor_breaks_a_mask(stage, scene, kind, healthy):
    def wrong(T, i):
        T = T.copy()
        if kind == "turned":
            T[:3, :3] = T[:3, :3] @ lie.so3_exp(np.array([0, 0, np.pi]))
        elif kind == "elsewhere":
            T[0, 3] += 1.5
        elif kind == "nearer":
            T[2, 3] *= 0.6
        elif kind == "nan":
            T[:] = np.nan
        else:
            T[2, 3] = -5.0
        return prior(T, healthy)

    assert (run(stage, scene, wrong) > 0.85).all()


def test_a_prior_makes_no_mask_where_there_is_no_target(stage, scene):
    empty = scene.pose(z=1e4)
    for i in range(6):
        rgb = scene.image(empty, ground_shift=2 * i, seed=i)
        assert stage.update(frame(i, rgb), prior(scene.pose(0.3))) is None


def test_a_mask_locked_onto_the_ground_is_given_up(stage, scene):
    wrong = np.zeros((HEIGHT, WIDTH), np.uint8)
    cv2.circle(wrong, (60, 60), 40, 1, -1)
    stage._backend._masks = (wrong, wrong)
    assert (run(stage, scene, lambda T, i: None, frames=20)[-10:] > 0.9).all()


def test_a_quick_check_that_finds_something_else_leaves_the_search_to_the_next_frame(stage, scene, monkeypatch):
    checks, searches = [], []
    find = Search.find
    monkeypatch.setattr(GroundMemory, "evidence", lambda *_: None)  # a mask that the ground confirms is let alone
    monkeypatch.setattr(Search, "confirms", lambda *_: checks.append(i) or False)
    monkeypatch.setattr(Search, "find", lambda *args: searches.append(i) or find(*args))
    for i in range(50):
        T, rgb, truth = scene.passing(i % 12 if i % 24 < 12 else 11 - i % 12)
        found = stage.update(frame(i, rgb), prior(T) if i > 2 else None)
    assert overlap(found.mask, truth) > 0.9
    assert checks
    assert {i + 1 for i in checks} <= set(searches)
    assert not set(checks) & set(searches)


def test_unknown_ground_does_not_lose_a_tracked_mask(stage, scene, monkeypatch):
    """Everything new looks as if it stood before the ground; the mask goes on without that, and without a search."""
    before = run(stage, scene, lambda T, i: None, frames=4)

    def all_new(memory, window, length_px):
        nothing = np.zeros(window.rgb.shape[:2], np.uint8)
        return GroundEvidence(nothing + np.uint8(1), nothing, nothing)

    monkeypatch.setattr(GroundMemory, "evidence", all_new)
    monkeypatch.setattr(Search, "find", lambda search, rgb, open_sides: None)
    after = run(stage, scene, lambda T, i: None, frames=6, start=4)
    assert (before > 0.9).all()
    assert (after > 0.9).all()


def test_found_again_after_it_was_hidden(stage, scene):
    before = run(stage, scene, lambda T, i: None, frames=4)
    hidden = [
        stage.update(frame(4 + i, scene.image(scene.pose(z=1e4), ground_shift=8 + 2 * i, seed=i)), None)
        for i in range(5)
    ]
    after = run(stage, scene, lambda T, i: None, frames=16, start=9)
    assert (before > 0.9).all()
    assert hidden[-1] is None
    assert (after[-6:] > 0.9).all()


# Laws --------------------------------------------------------------------------------------------------------------


def test_same_frames_same_masks_and_a_reset_forgets(lopsided, scene):
    def masks(stage):
        out = []
        for i in range(8):
            T, rgb, _ = scene.passing(i)
            found = stage.update(frame(i, rgb), prior(T) if i > 4 else None)
            out.append(found.mask)
        return np.array(out)

    stage = SegmentationStage(HatConfig(), lopsided)
    first = masks(stage)
    cv2.setRNGSeed(12345)  # whatever others did to OpenCV's generator
    assert np.array_equal(first, masks(SegmentationStage(HatConfig(), lopsided)))
    stage.reset()
    assert np.array_equal(first, masks(stage))


def test_a_frame_is_left_as_it_was(stage, scene):
    for shift in (None, 3):
        rgb = scene.image(scene.pose(), ground_shift=shift)
        copy = rgb.copy()
        stage.update(frame(0, rgb), prior(scene.pose()))
        assert np.array_equal(rgb, copy)


@pytest.mark.parametrize("size", [(1, 1), (3, 5), (17, 9), (40, 300)])
def test_small_and_narrow_images_do_no_harm(stage, size):
    rng = np.random.default_rng(0)
    for i, scale in enumerate((3, 40, 255)):
        rgb = (rng.random((*size, 3)) * scale).astype(np.uint8)
        stage.update(frame(i, rgb), None)
