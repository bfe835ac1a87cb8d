"""Frames are admitted and counted as in a run, also where only some of them are decoded."""

from __future__ import annotations

import numpy as np
from checked_recording import write_bag, write_clip
from scripted import CAMERA, frame, stamp

from hat_ros.bench.check_frames import read_frames
from hat_ros.bench.source import Source, open_source
from hat_ros.io.bag_writer import BagWriter


def test_limit_leaves_the_rest_unread(tmp_path):
    found = read_frames(open_source(write_clip(tmp_path / "clip")), 2)
    assert len(found.stamps_ns) == 2 and sum(found.encodings.values()) == 2


def test_of_many_frames_a_few_are_decoded_and_all_stamps_are_looked_at(tmp_path, monkeypatch):
    bag = write_bag(tmp_path / "bag", [*range(20), 19, 3, 20])
    asked, frames_at = [], Source.frames_at
    monkeypatch.setattr(Source, "frames_at", lambda self, numbers: asked.append(numbers) or frames_at(self, numbers))
    found = read_frames(open_source(bag), most=4)
    assert asked == [{0, 7, 15, 22}]
    assert (len(found.stamps_ns), found.n_decoded, len(found.black)) == (23, 4, 4)
    assert found.refusals.total == 2, "a duplicate and a late one, whose images were not looked at"
    assert sorted(found.sizes_px) == [stamp(i) for i in (0, 7, 15, 20)]
    assert len(found.shown) == 3
    assert read_frames(open_source(bag), most=500).n_decoded == 23


def test_frames_that_cannot_be_decoded_are_refused_and_leave_their_stamp_free(tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        for index, size in ((0, 48), (9, 20), (1, 48), (2, 48)):
            writer.write_frame(stamp(index), np.ascontiguousarray(frame(index).rgb[:size]), CAMERA)
        writer.write_target(write_clip(tmp_path / "clip") / "target.glb")
    source = open_source(tmp_path / "bag")
    found = read_frames(source)
    assert found.refusals.total == 1 and "image is 64x20 px" in str(found.refusals)
    assert len(found.black) == 3
