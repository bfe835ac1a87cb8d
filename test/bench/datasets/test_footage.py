"""Films and folders of images become bags with stamps, calibration and CAD model; what does not fit is one sentence."""

import cv2
import numpy as np
import pytest
import trimesh
import yaml

from hat_ros.bench.datasets.calibration_file import read_camera_file
from hat_ros.bench.datasets.footage import Footage, import_footage
from hat_ros.cli import main
from hat_ros.errors import DatasetError, UsageError
from hat_ros.io.bag_reader import BagReader
from hat_ros.target.loading import load_target

K4 = (300.0, 310.0, 79.0, 60.0)


def picture(index):
    v, u = np.mgrid[:120, :160]
    return np.stack([u, v, np.full_like(u, 20 * index)], axis=-1).astype(np.uint8)


@pytest.fixture
def model(tmp_path):
    trimesh.creation.box((1000.0, 600.0, 300.0)).export(tmp_path / "cad.stl")
    (tmp_path / "target.yaml").write_text("mesh: cad.stl\nunit_scale: 0.001\nname: crate\n")
    return tmp_path / "target.yaml"


@pytest.fixture
def images(tmp_path):
    folder = tmp_path / "frames"
    folder.mkdir()
    for index in (0, 1, 2, 9, 10):
        cv2.imwrite(str(folder / f"img{index}.png"), picture(index)[..., ::-1])
    (folder / "notes.txt").write_text("not an image")
    return folder


def film(path, codec, count=5, fps=8.0):
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*codec), fps, (160, 120))
    for index in range(count):
        writer.write(picture(index)[..., ::-1])
    writer.release()
    return path


def calibration(path, **more):
    content = {
        "image_width": 160,
        "image_height": 120,
        "camera_matrix": {"rows": 3, "cols": 3, "data": [300.0, 0, 79, 0, 310, 60, 0, 0, 1]},
        "distortion_model": "plumb_bob",
        "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.2, 0.05, 0.001, 0, 0]},
        "projection_matrix": {"rows": 3, "cols": 4, "data": [280.0, 0, 80, 0, 0, 290, 61, 0, 0, 0, 1, 0]},
        **more,
    }
    path.write_text(yaml.safe_dump(content))
    return path


def test_a_folder_of_images_in_the_order_of_their_numbers(images, model, tmp_path):
    bag = import_footage(Footage("images", images, model, K4, fps=4.0), tmp_path / "bag")
    reader = BagReader(bag)
    frames = list(reader.frames())
    assert [frame.stamp_ns for frame in frames] == [1_000_000_000 + 250_000_000 * k for k in range(5)]
    for frame, index in zip(frames, (0, 1, 2, 9, 10), strict=True):
        np.testing.assert_array_equal(frame.rgb, picture(index))
    np.testing.assert_array_equal(reader.camera.K, [[300, 0, 79], [0, 310, 60], [0, 0, 1]])
    assert np.ptp(load_target(reader.target_path).vertices_m[:, 0]) == pytest.approx(1.0)
    assert reader.truth_rows() == {}


@pytest.mark.parametrize(("name", "codec"), [("a.avi", "MJPG"), ("a.mp4", "mp4v")])
@pytest.mark.parametrize("fps", [None, 30.0])
def test_a_film_keeps_its_times_unless_told_a_rate(model, tmp_path, name, codec, fps):
    source = film(tmp_path / name, codec)
    bag = import_footage(Footage("video", source, model, K4, fps=fps), tmp_path / "bag")
    frames = list(BagReader(bag).frames())
    stamps = np.array([frame.stamp_ns for frame in frames])
    assert len(frames) == 5 and stamps[0] == 1_000_000_000
    np.testing.assert_allclose(np.diff(stamps) * 1e-9, 1 / (fps or 8.0), atol=1e-6)
    assert np.abs(frames[3].rgb.astype(int) - picture(3)).mean() < 8


def test_distortion_coefficients_stay_in_the_camera_info(images, model, tmp_path):
    camera = calibration(tmp_path / "camera.yaml")
    reader = BagReader(import_footage(Footage("images", images, model, None, camera), tmp_path / "bag"))
    assert reader.calibration.lens is not None
    np.testing.assert_allclose(reader.calibration.lens.coefficients[:3], [-0.2, 0.05, 0.001])
    np.testing.assert_array_equal(next(reader.frames()).rgb, reader.calibration.lens.undistort(picture(0)))
    flat = import_footage(Footage("images", images, model, None, camera, rectified=True), tmp_path / "flat")
    assert BagReader(flat).calibration.lens is None and BagReader(flat).camera.K[0, 0] == 280


def test_a_camera_info_message_as_yaml(tmp_path):
    path = tmp_path / "info.yaml"
    message = {"width": 160, "height": 120, "k": [300.0, 0, 79, 0, 310, 60, 0, 0, 1], "d": [0.1, 0, 0, 0]}
    path.write_text(yaml.safe_dump({**message, "distortion_model": "equidistant"}))
    found = read_camera_file(path)
    assert found.lens.model == "equidistant" and found.camera.K[1, 1] == 310


@pytest.mark.parametrize(
    ("more", "says"),
    [
        ({"camera_matrix": None}, "camera_matrix must be 9 finite numbers"),
        ({"camera_matrix": {"data": [0.0] * 9}}, "camera matrix K must be"),
        ({"distortion_model": "bent"}, "'bent' is not supported"),
        ({"distortion_coefficients": {"data": "x"}}, "distortion_coefficients must be a list of finite numbers"),
        ({"image_width": "wide"}, "image_width must be 1 finite numbers"),
        ({"image_width": 320}, "160x120 px, the calibration is for 320x120"),
    ],
)
def test_bad_calibrations(images, model, tmp_path, more, says):
    camera = calibration(tmp_path / "camera.yaml", **more)
    with pytest.raises(DatasetError, match=says):
        import_footage(Footage("images", images, model, None, camera), tmp_path / "bag")
    assert not (tmp_path / "bag").exists()


def test_what_cannot_be_imported_is_one_sentence(images, model, tmp_path):
    out = tmp_path / "bag"
    (tmp_path / "empty").mkdir()
    (tmp_path / "noise.mp4").write_bytes(bytes(range(256)) * 20)
    for footage, error, says in (
        (Footage("images", images, model), UsageError, "calibration once"),
        (Footage("images", images, model, K4, tmp_path / "camera.yaml"), UsageError, "calibration once"),
        (Footage("images", images, model, (0, 1, 2, 3)), UsageError, "--K"),
        (Footage("images", images, model, K4, fps=0.0), UsageError, "--fps must be between"),
        (Footage("images", tmp_path / "gone", model, K4), DatasetError, "no such folder"),
        (Footage("images", tmp_path / "empty", model, K4), DatasetError, "no image"),
        (Footage("video", tmp_path / "gone.mp4", model, K4), DatasetError, "no such film"),
        (Footage("video", tmp_path / "noise.mp4", model, K4), DatasetError, "not a film"),
    ):
        with pytest.raises(error, match=says):
            import_footage(footage, out)
        assert not out.exists()
    cv2.imwrite(str(images / "img5.png"), np.zeros((60, 80, 3), np.uint8))
    with pytest.raises(DatasetError, match="image 4: 80x60 px, the calibration is for 160x120"):
        import_footage(Footage("images", images, model, K4), out)
    (images / "img5.png").write_bytes(b"no image")
    with pytest.raises(DatasetError, match=r"img5\.png: not an image"):
        import_footage(Footage("images", images, model, K4), out)


def test_on_the_command_line(images, model, tmp_path, capsys):
    out = tmp_path / "bag"
    options = ["--model", str(model), "--K", "300", "310", "79", "60", "--quiet"]
    assert main(["import", "images", str(images), "--out", str(out), *options, "--unit-scale", "0.5"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    assert np.ptp(load_target(out / "target.yaml").vertices_m[:, 0]) == pytest.approx(0.5)
    assert main(["import", "images", str(images), "--out", str(out), *options]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["import", "sequence", str(images), "--out", str(out), "--fps", "3"]) == 2
    assert "--fps is for" in capsys.readouterr().err
    assert main(["import", "video", str(images), "--out", str(tmp_path / "b"), "--K", "1", "1", "1", "1"]) == 2
    assert "--model" in capsys.readouterr().err
