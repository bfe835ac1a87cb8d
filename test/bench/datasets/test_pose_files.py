"""Files of poses that other trackers write: what is read, and what is refused."""

import numpy as np
import pytest
from scripted import true_row

from hat_ros.bench.datasets.image_files import stamp_of
from hat_ros.bench.datasets.pose_files import read_poses
from hat_ros.errors import InputError
from hat_ros.geometry import lie

N = 6


def bop_line(image, row, score=1.0, time=-1.0, scene=1, obj=2):
    T = lie.matrix_from_row(row)
    R, t = (" ".join(repr(float(x)) for x in values) for values in (T[:3, :3].ravel(), 1000 * T[:3, 3]))
    return f"{scene},{image},{obj},{score},{R},{t},{time}\n"


def bop(path, *lines):
    path.write_text("scene_id,im_id,obj_id,score,R,t,time\n" + "".join(lines))
    return path


def test_bop_files_are_in_millimetres_and_the_best_score_counts(tmp_path):
    wrong = true_row(0) + [1, 0, 0, 0, 0, 0, 0]
    path = bop(
        tmp_path / "x.csv",
        bop_line(3, wrong, score=0.2, time=0.5),
        bop_line(3, true_row(0), score=0.9, time=0.5),
        bop_line(5, true_row(1), time=0.25),
    )
    poses = read_poses(path)
    assert sorted(poses.rows) == [stamp_of(3), stamp_of(5)]
    np.testing.assert_allclose(
        lie.matrix_from_row(poses.rows[stamp_of(3)]), lie.matrix_from_row(true_row(0)), atol=1e-9
    )
    assert sorted(poses.seconds) == [0.25, 0.5], "an image's time counts once"


def test_of_a_bop_file_with_several_objects_only_the_recordings_counts(tmp_path):
    path = bop(tmp_path / "x.csv", bop_line(3, true_row(0)), bop_line(3, true_row(1), obj=7, score=9.0))
    rows = read_poses(path, scene=(1, 7)).rows
    np.testing.assert_allclose(rows[stamp_of(3)][:3], true_row(1)[:3])
    with pytest.raises(InputError, match="2 scenes or objects"):
        read_poses(path)
    with pytest.raises(InputError, match="no pose of scene"):
        read_poses(path, scene=(9, 9))


def test_a_folder_of_matrices_is_read_by_frame_number(tmp_path):
    poses = tmp_path / "ob_in_cam"
    poses.mkdir()
    for i in range(N):
        np.savetxt(poses / f"{i:06d}.txt", lie.matrix_from_row(true_row(i)))
    rows = read_poses(poses).rows
    assert sorted(rows) == [stamp_of(i) for i in range(N)]
    np.testing.assert_allclose(rows[stamp_of(2)], true_row(2), atol=1e-12)
    np.savetxt(poses / "000003.txt", 2 * np.eye(4))
    with pytest.raises(InputError, match=r"000003.txt: the matrix is no rigid"):
        read_poses(poses)
    np.savetxt(poses / "000003.txt", np.eye(3))
    with pytest.raises(InputError, match="expected 16 finite numbers"):
        read_poses(poses)
    (poses / "000003.txt").rename(poses / "frame3.txt")
    with pytest.raises(InputError, match="must be the frame's number"):
        read_poses(poses)


@pytest.mark.parametrize(
    ("name", "text", "complaint"),
    [
        ("a.tum", "", "holds no pose"),
        ("a.tum", "1.0 0 0 5 0 0 0\n", "line 1: expected stamp"),
        ("a.tum", "1.0 0 0 5 0 0 0 2\n", "length 2.0000"),
        ("a.tum", "1.0 0 0 nan 0 0 0 1\n", "finite"),
        ("a.tum", "\n# x\nsoon 0 0 5 0 0 0 1\n", "line 3: 'soon' is no time"),
        ("a.csv", "im_id,R\n1,2\n", "expected the columns scene_id,im_id"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,x,2,1,0,0,0\n", "line 2: .*whole numbers"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,1,2,1,1 0 0,0 0 5,0\n", "expected 9 finite numbers"),
        ("a.csv", "scene_id,im_id,obj_id,score,R,t,time\n1,1,2,1,2 0 0 0 1 0 0 0 1,0 0 5,0\n", "not a rotation"),
    ],
)
def test_malformed_files_are_refused_with_the_line(tmp_path, name, text, complaint):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=complaint):
        read_poses(tmp_path / name)
