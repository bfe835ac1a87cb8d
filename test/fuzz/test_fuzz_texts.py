"""Text that people write or other programs do: YAML, labels, detections, poses."""

from __future__ import annotations

import json

import numpy as np
import trimesh
from mutator import mutated, spliced
from PIL import Image

from hat_ros.bench.datasets.calibration_file import read_camera_file
from hat_ros.bench.datasets.detections import load_detections
from hat_ros.bench.datasets.pose_files import read_poses
from hat_ros.bench.datasets.sequence import load_sequence
from hat_ros.config import HatConfig, commented_yaml, flat_options, load_config, preset_folder
from hat_ros.target.mesh_file import read_target_yaml

CAMERA = b"""image_width: 40
image_height: 30
distortion_model: plumb_bob
camera_matrix: {rows: 3, cols: 3, data: [60.0, 0, 19.5, 0, 60.0, 14.5, 0, 0, 1]}
distortion_coefficients: {rows: 1, cols: 5, data: [-0.1, 0.01, 0, 0, 0]}
projection_matrix: {rows: 3, cols: 4, data: [60.0, 0, 19.5, 0, 0, 60.0, 14.5, 0, 0, 0, 1, 0]}
"""
MESSAGE = b"width: 40\nheight: 30\nk: [60.0, 0, 19.5, 0, 60.0, 14.5, 0, 0, 1]\nd: []\n"
POSE = {"q_wxyz_cam_from_target": [1, 0, 0, 0], "t_cam_from_target_m": [0.0, 0.1, 5.0]}
LABELS = {
    "K": [[60.0, 0, 19.5], [0, 60.0, 14.5], [0, 0, 1]],
    "size": [40, 30],
    "mesh": "model.ply",
    "scale": 1.0,
    "frames": [{"file": f"{index}.png"} | POSE for index in range(2)],
}
RUNS = {"size": [4, 5], "counts": [3, 4, 13]}
DETECTIONS = [
    json.dumps([{"image_id": 0, "score": 0.5, "segmentation": RUNS}, {"image_id": 1, "bbox": [1, 1, 3, 2]}]).encode(),
    json.dumps({"0.png": [0, 0, 3, 3], "1": [1.5, 0, 4, 2]}).encode(),
    json.dumps([{"image_id": 1, "segmentation": {"size": [4, 5], "counts": "34=0"}}]).encode(),
]
TUM = b"# stamp x y z qx qy qz qw\n1.5 0 0.1 5 0 0 0 1\n1.6 0 0.1 5.1 0.6 0 0.8 0\n"
BOP = b"scene_id,im_id,obj_id,score,R,t,time\n1,0,2,0.5,1 0 0 0 1 0 0 0 1,0 0 5000,0.1\n"
MATRIX = b"1 0 0 0.1\n0 1 0 0.2\n0 0 1 5.0\n0 0 0 1\n"


def from_seeds(seeds):
    def make(rng):
        if rng.random() < 0.1:
            return spliced(rng.choice(seeds), rng.choice(seeds), rng)
        return mutated(rng.choice(seeds), rng, is_text=True)

    return make


def test_configurations(fuzz, tmp_path):
    whole = commented_yaml(HatConfig(), flat_options()).encode()
    pieces = [whole[:1500], whole[-1500:], *(path.read_bytes() for path in sorted(preset_folder().glob("*.yaml")))]

    def read(data):
        path = tmp_path / "config.yaml"
        path.write_bytes(data)
        return load_config(path)

    fuzz("config", from_seeds(pieces), read)


def test_target_yaml(fuzz, tmp_path):
    def read(data):
        path = tmp_path / "target.yaml"
        path.write_bytes(data)
        return read_target_yaml(path)

    fuzz("target_yaml", from_seeds([b"mesh: model.ply\nunit_scale: 0.001\nname: target\n", b"mesh: a/b.obj\n"]), read)


def test_camera_yaml(fuzz, tmp_path):
    def read(data):
        path = tmp_path / "camera.yaml"
        path.write_bytes(data)
        return read_camera_file(path, rectified=len(data) % 2 == 0)

    fuzz("camera_yaml", from_seeds([CAMERA, MESSAGE]), read)


def test_labels(fuzz, tmp_path):
    trimesh.creation.box((0.3, 0.4, 0.5)).export(tmp_path / "model.ply")
    (tmp_path / "images").mkdir()
    for index in range(2):
        Image.fromarray(np.full((30, 40), 9, np.uint8)).save(tmp_path / "images" / f"{index}.png")

    def read(data):
        (tmp_path / "labels.json").write_bytes(data)
        return [recorded.stamp_ns for recorded in load_sequence(tmp_path).files]

    fuzz("labels", from_seeds([json.dumps(LABELS).encode(), json.dumps(LABELS | {"scale": "auto"}).encode()]), read)


def test_detections(fuzz, tmp_path):
    def read(data):
        path = tmp_path / "detections.json"
        path.write_bytes(data)
        found = load_detections(path)
        return [found.given_mask(name, (4, 5)) for name in (0, 1)]

    fuzz("detections", from_seeds(DETECTIONS), read)


def test_poses(fuzz, tmp_path):
    (tmp_path / "matrices").mkdir()

    def read(data):
        name = "poses.csv" if data[:4] == BOP[:4] else "matrices/000003.txt" if data[:4] == MATRIX[:4] else "poses.tum"
        path = tmp_path / name
        path.write_bytes(data)
        return read_poses(path.parent if path.suffix == ".txt" else path)

    fuzz("poses", from_seeds([TUM, BOP, MATRIX]), read)
