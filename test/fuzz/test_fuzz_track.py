"""Whole runs over changed inputs: a result or one sentence, and no wrong pose that is called TRACKING.

One case for fifty of the readers: 200 of each format where those have 10,000.
"""

from __future__ import annotations

import csv
import shutil

import cv2
import numpy as np
import pytest
from decoder_words import words_on_stderr
from mutator import mutated
from test_fuzz_meshes import SEEDS

from hat_ros.bench.datasets.sequence import write_labels
from hat_ros.bench.evaluation.metrics import pose_errors
from hat_ros.bench.runs.track import TrackOptions, track
from hat_ros.bench.source import SourceSpec
from hat_ros.bench.synth.clips import ClipSpec, render_clip
from hat_ros.bench.synth.models import write_model
from hat_ros.config import load_config
from hat_ros.geometry import lie
from hat_ros.io.bag_writer import BagWriter
from hat_ros.io.manifest import MANIFEST
from hat_ros.target.loading import load_target

pytestmark = pytest.mark.slow

ONE_IN, LIMIT_S = 50, 120.0
WRONG = 0.1
SPEC = ClipSpec(
    frames=3, width=320, height=240, focal_px=520.0, range_m=(8.0, 7.9), supersample=2, spin_deg_per_frame=2.0
)
FEW_VIEWS = b"hypotheses:\n  template:\n    n_views: 162\n"
OPTIONS = TrackOptions(video=False, report=False, overwrite=True, credits=1)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """A clip as ``clip`` (images, labels) and as ``bag``; and stamp -> true pose."""
    folder = tmp_path_factory.mktemp("recorded")
    clip, model = folder / "clip", folder / "cad.glb"
    write_model("observer", model)
    (clip / "images").mkdir(parents=True)
    shutil.copy(model, clip)
    frames, names = list(render_clip(load_target(model), SPEC)), []
    with BagWriter(folder / "bag") as writer:
        for index, frame in enumerate(frames):
            writer.write_frame(10**9 + index * 10**8, frame.rgb, SPEC.camera, T_cam_target=frame.T_cam_target)
            names.append(f"{index:06d}.jpg")
            cv2.imwrite(str(clip / "images" / names[-1]), cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2BGR))
        writer.write_target(model)
    poses = np.stack([frame.T_cam_target for frame in frames])
    write_labels(clip, SPEC.camera, model.name, "synthetic", poses, names)
    return folder, {10**9 + index * 10**8: pose for index, pose in enumerate(poses)}


@pytest.fixture
def runs(recorded, tmp_path):
    """``runs(kind)``: copies ``clip`` or ``bag``; gives the copy and ``run``, which returns the states.

    ``run(config, right)``: the text of a configuration, and of which frames the poses that are called TRACKING must be
    right (they need not be where the input says another camera, another target, or shows another picture).
    """
    folder, truth = recorded

    def prepare(kind):
        place = tmp_path / kind
        shutil.copytree(folder / kind, place)
        (place / MANIFEST).unlink(missing_ok=True)  # it would refuse every change

        def run(config=FEW_VIEWS, right=lambda _stamp: True):
            given = tmp_path / "given.yaml"
            given.write_bytes(config)
            out = track(SourceSpec(place), tmp_path / "out", load_config(str(given)), OPTIONS)
            with (out / "poses.csv").open() as stream:
                rows = list(csv.DictReader(stream))
            for row in rows:
                if row["state"] == "TRACKING" and int(row["stamp_ns"]) in truth and right(int(row["stamp_ns"])):
                    pose = [float(row[key]) for key in ("x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")]
                    found = lie.matrix_from_row(np.array([pose]))
                    error = pose_errors(found, truth[int(row["stamp_ns"])][None]).pose[0]
                    assert error < WRONG, f"frame {row['stamp_ns']} is TRACKING with E_p {error:.3f}"
            return [row["state"] for row in rows]

        return place, run

    return prepare


def nowhere(_stamp):
    """For ``right``: the input says something else than the truth, and nothing can tell that it does."""
    return False


def is_another_picture(whole, changed):
    """Whether a JPEG decodes without a word of libjpeg, and to other pixels.

    Its bits carry no checksum: then they are those of another picture as an encoder writes it, and no reader can tell.
    Where libjpeg says a word, or decodes the picture that was written, there is no such excuse.
    """
    flags = cv2.IMREAD_COLOR
    with words_on_stderr() as said:
        image = cv2.imdecode(np.frombuffer(changed, np.uint8), flags) if changed else None
    true = cv2.imdecode(np.frombuffer(whole, np.uint8), flags)
    return image is not None and not said[0] and not np.array_equal(image, true)


def fuzz_file(fuzz, reader, path, run, *, is_text=False, **options):
    """Change the file at ``path`` and run."""
    whole = path.read_bytes()

    def read(data):
        path.write_bytes(data)
        return run(**options)

    fuzz(f"track_{reader}", lambda rng: mutated(whole, rng, is_text=is_text), read, ONE_IN, LIMIT_S)


@pytest.mark.parametrize("kind", ["bag", "clip"])
def test_what_is_not_changed_is_tracked(runs, kind):
    _, run = runs(kind)
    assert run().count("TRACKING") >= 2, "else no wrong pose could be noticed"


def test_bags(fuzz, runs):
    place, run = runs("bag")
    fuzz_file(fuzz, "mcap", place / "bag.mcap", run)


def test_target_yaml(fuzz, runs):
    place, run = runs("bag")
    fuzz_file(fuzz, "target_yaml", place / "target.yaml", run, is_text=True, right=nowhere)


def test_images(fuzz, runs):
    place, run = runs("clip")
    path = place / "images" / "000001.jpg"
    whole = path.read_bytes()

    def right(stamp_ns):
        return stamp_ns != 10**9 + 10**8 or not is_another_picture(whole, path.read_bytes())

    fuzz_file(fuzz, "jpeg", path, run, right=right)


def test_labels(fuzz, runs):
    place, run = runs("clip")
    fuzz_file(fuzz, "labels", place / "labels.json", run, is_text=True, right=nowhere)


def test_configurations(fuzz, runs):
    _, run = runs("clip")

    def make(rng):
        return mutated(FEW_VIEWS, rng, is_text=True)

    fuzz("track_config", make, lambda data: run(config=data, right=nowhere), ONE_IN, LIMIT_S)


@pytest.mark.parametrize("suffix", SEEDS)
def test_cad(fuzz, runs, suffix):
    place, run = runs("bag")
    (place / "target.yaml").write_text(f"mesh: model.{suffix}\n")
    path = place / f"model.{suffix}"
    path.write_bytes(SEEDS[suffix][0])
    fuzz_file(fuzz, suffix, path, run, is_text=suffix == "obj", right=nowhere)
