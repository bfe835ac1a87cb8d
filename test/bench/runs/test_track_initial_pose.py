"""`hat track` told where the target is: it takes that one of two craft, and that one of two attitudes."""

import numpy as np
import pytest
from two_craft import FIRST_NS, STEP_NS, as_text, block_at, craft_at, write_block, write_two_craft

from hat_ros.cli import main
from hat_ros.geometry import lie

N_FRAMES = 9  # past the first frames at which a fused pose takes the place of the given one
# Half a metre off in range, 0.14 m in bearing.
OFF_M, SIGMA = (0.1, -0.1, 0.5), "0.2 0.2 1"
UNKNOWN, KNOWN = "3 3 3", "0.2 0.2 0.2"


@pytest.fixture(scope="module")
def two_craft(tmp_path_factory):
    return write_two_craft(tmp_path_factory.mktemp("two") / "bag", N_FRAMES)


@pytest.fixture(scope="module")
def block(tmp_path_factory):
    return write_block(tmp_path_factory.mktemp("block") / "bag", 3)


def tracked(bag, out, *overrides):
    """Poses (N, 4, 4) by frame index, from the TUM file of a run."""
    options = [word for text in ("hypotheses.template.n_views=162", *overrides) for word in ("--set", text)]
    command = ["track", str(bag), "--out", str(out), "--quiet", "--no-video", "--no-report", *options]
    assert main(command) == 0
    rows = np.array([line.split() for line in (out / "poses.tum").read_text().splitlines()], float).reshape(-1, 8)
    index = np.rint((rows[:, 0] * 1e9 - FIRST_NS) / STEP_NS).astype(int)
    return dict(zip(index.tolist(), lie.matrix_from_row(rows[:, 1:]), strict=True))


def degrees_off(poses, truth):
    return {i: np.degrees(lie.angle_between(T[:3, :3], truth(i)[:3, :3])) for i, T in poses.items()}


@pytest.mark.parametrize("backend", ["classical", "learned"])
def test_of_two_craft_the_one_that_navigation_means_is_tracked(two_craft, tmp_path, backend):
    chosen = f"segmentation.backend={backend}"
    free = tracked(two_craft, tmp_path / "free", chosen)
    assert len(free) == N_FRAMES
    assert all(T[0, 3] < 0 for T in free.values()), "the search takes the left one by itself"

    given = f"initial_pose.pose={as_text(lie.transform(np.eye(3), craft_at(1, 0)[:3, 3]), OFF_M)}"
    poses = tracked(two_craft, tmp_path / "given", chosen, given, f"initial_pose.sigma={SIGMA} {UNKNOWN}")
    assert sorted(poses) == list(range(N_FRAMES))
    assert max(degrees_off(poses, lambda i: craft_at(1, i)).values()) < 3
    assert max(np.linalg.norm(T[:3, 3] - craft_at(1, 0)[:3, 3]) for T in poses.values()) < 0.2


def test_of_two_attitudes_the_one_that_navigation_means_is_taken(block, tmp_path):
    free = tracked(block, tmp_path / "free")
    assert degrees_off(free, block_at)[0] > 150, "the search takes the wrong end by itself"

    given = (f"initial_pose.pose={as_text(block_at(0), OFF_M)}", f"initial_pose.sigma={SIGMA} {KNOWN}")
    poses = tracked(block, tmp_path / "given", *given)
    assert sorted(poses) == [0, 1, 2]
    assert max(degrees_off(poses, block_at).values()) < 3


def test_where_navigation_rules_everything_out_nothing_is_found(two_craft, tmp_path):
    nowhere = f"initial_pose.pose={as_text(lie.transform(np.eye(3), np.array([0.0, 0.0, 60.0])))}"
    poses = tracked(two_craft, tmp_path / "none", nowhere, f"initial_pose.sigma={SIGMA} {UNKNOWN}")
    assert not poses


@pytest.mark.parametrize(
    ("pose", "sigma", "sentence"),
    [
        ("0 0 5", "1 1 1 1 1 1", "initial_pose.pose: expected 7 numbers, found 3"),
        ("0 0 five 0 0 0 1", "1 1 1 1 1 1", "initial_pose.pose: expected numbers separated by blanks"),
        ("0 0 5 0 0 0 2", "1 1 1 1 1 1", "the quaternion must have norm 1, found 2"),
        ("0 0 -50 0 0 0 1", "1 1 1 1 1 1", "behind the camera"),
        ("0 0 5 0 0 0 1", "1 1 1 1 1", "initial_pose.sigma: expected 6 or 36 numbers, found 5"),
        ("0 0 5 0 0 0 1", "1 1 1 0 0 1", "the covariance of the rotation must be positive definite"),
        ("0 0 5 0 0 0 1", "1 1 1 1 1 nan", "6 x 6 and finite"),
        ("", "1 1 1 1 1 1", "initial_pose.sigma is given without initial_pose.pose"),
    ],
)
def test_bad_numbers_end_in_one_sentence(two_craft, tmp_path, capsys, pose, sigma, sentence):
    options = ["--set", f"initial_pose.pose='{pose}'", "--set", f"initial_pose.sigma='{sigma}'"]
    assert main(["track", str(two_craft), "--out", str(tmp_path / "out"), "--quiet", *options]) == 2
    error = capsys.readouterr().err
    assert sentence in error
    assert len(error.strip().splitlines()) == 1
