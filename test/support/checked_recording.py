"""Small recordings for what ``hat check`` tells."""

from __future__ import annotations

import json

import cv2
import numpy as np
from scripted import CAMERA, frame, mask, stamp, true_row

from hat_ros.bench.synth.models import write_model
from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter


class AsWritten(BagWriter):
    """The bag's time is the order of writing, whatever the stamps are."""

    def write_cdr(self, topic, kind, data, log_ns):
        self.count = getattr(self, "count", 0) + 1
        super().write_cdr(topic, kind, data, self.count)


def write_bag(folder, indices, masks=True, truth=True, pose=lambda i: lie.matrix_from_row(true_row(i))):
    model = folder.parent / "cubesat.glb"
    write_model("cubesat", model)
    with AsWritten(folder, image_format="png") as writer:
        for i in indices:
            given = mask().astype(np.uint8) * np.uint8(255) if masks else None
            T = pose(i) if truth else None
            writer.write_frame(stamp(i), frame(i).rgb, CAMERA, mask=given, T_cam_target=T)
        writer.write_target(model)
    return folder


def behind(index):
    return lie.transform(np.eye(3), np.array([0.0, 0.0, -5.0 - index]))


def write_clip(folder, count=4, size=(64, 48)):
    (folder / "images").mkdir(parents=True)
    write_model("cubesat", folder / "target.glb")
    for i in range(count):
        image = np.zeros((48, 64, 3), np.uint8)
        image[:, :16] = 255
        cv2.imwrite(str(folder / "images" / f"{i}.png"), image)
    names = [{"file": f"{i}.png"} for i in range(count)]
    labels = {"K": CAMERA.K.tolist(), "size": list(size), "mesh": "target.glb", "frames": names}
    (folder / "labels.json").write_text(json.dumps(labels))
    return folder
