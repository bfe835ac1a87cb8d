"""The published protocols: how the authors' benchmark reads and scores each data set, one named profile each.

``hat bench --dataset NAME`` and ``hat ablate`` use them, ``--protocol published`` brings them into other commands. A
profile has two parts: settings on top of the preset, and how the recordings are read.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hat_ros.bench.datasets.image_files import ImageRecording


@dataclass(frozen=True)
class Protocol:
    """One data set's profile.

    Attributes:
        about: one sentence for people.
        settings: ``key=value`` on top of the preset, below what the user sets.
        sequences: the published split; empty = all that the data set's reader finds.
        undistorted: lens distortion is removed; False: images and camera matrix are used as they are.
        corner_boxes: boxes from the labels are those of the eight corners of the CAD model's bounding box, not of its
            vertices.
        targets_only: only labelled frames are scored, and fusion advances at these alone; motion sees every frame.
    """

    about: str
    settings: tuple[str, ...] = ()
    sequences: tuple[str, ...] = ()
    undistorted: bool = True
    corner_boxes: bool = False
    targets_only: bool = False

    def read(self, recording: ImageRecording) -> ImageRecording:
        """The recording as the authors' benchmark has it."""
        if not self.undistorted:
            recording = replace(recording, distortion=np.zeros(0))
        return replace(recording, targets_only=self.targets_only)


PROTOCOLS = {
    "spark": Protocol(
        "SPARK-2024, stream 2: RT500 to RT599, own segmentation, motion from the masked image.",
        sequences=tuple(f"RT{number}" for number in range(500, 600)),
    ),
    "ycbv": Protocol(
        "YCB-Video: motion from every unmasked frame, fusion and frame-wise methods at the BOP-19 targets of the "
        "objects without symmetry, detections at the targets only (--detections).",
        settings=("segmentation.backend=annotated", "slam.masked=false"),
        targets_only=True,
    ),
    "swisscube": Protocol(
        "SwissCube: seq_000400 to seq_000499; hypotheses see the box of the mask, padded by 15 % on each side, motion "
        "the masked image at twice the usual size.",
        settings=(
            "segmentation.backend=annotated",
            "segmentation.pose_region=box",
            "segmentation.box_padding=0.15",
            "slam.droid.input_area_px=393216",
        ),
        sequences=tuple(f"seq_{number:06d}" for number in range(400, 500)),
    ),
    "shirt": Protocol(
        "SHIRT: both trajectories, both domains; hypotheses see the box of the CAD model's eight corners, padded by "
        "20 % on each side, motion the whole image; lens distortion stays.",
        settings=("segmentation.backend=annotated", "segmentation.box_padding=0.2", "slam.masked=false"),
        undistorted=False,
        corner_boxes=True,
    ),
}
# A data set that has no published protocol is read as it is.
NONE = Protocol("As the data set is.")


def protocol_of(dataset: str) -> Protocol:
    """The published profile of a data set; one that changes nothing where there is none."""
    return PROTOCOLS.get(dataset, NONE)
