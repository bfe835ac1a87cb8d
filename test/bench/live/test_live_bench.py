"""The live bench against real processes: minutes, so on request."""

from __future__ import annotations

import pytest

from hat_ros.bench.live.tables import LiveBench
from hat_ros.bench.synth.clips import ClipSpec, render_clip
from hat_ros.bench.synth.models import write_model
from hat_ros.cli import main
from hat_ros.config import load_config
from hat_ros.io.bag_writer import BagWriter
from hat_ros.target.loading import load_target

SPEC = ClipSpec(
    frames=30, width=160, height=120, focal_px=260.0, range_m=(8.0, 7.5), supersample=1, spin_deg_per_frame=0.5
)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    folder = tmp_path_factory.mktemp("live")
    write_model("observer", folder / "cad.glb")
    with BagWriter(folder / "bag") as writer:
        for index, frame in enumerate(render_clip(load_target(folder / "cad.glb"), SPEC)):
            writer.write_frame(10**9 + index * 10**8, frame.rgb, SPEC.camera)
        writer.write_target(folder / "cad.glb")
    return folder / "bag"


@pytest.mark.graph
@pytest.mark.slow
@pytest.mark.live
def test_poses_come_again_after_every_fault(bag):
    bench = LiveBench(bag, load_config("default", ("hypotheses.template.n_views=162",)), "processes", 4.0)
    rates = bench.rates([5.0])
    in_process, graph = rates.rows
    assert in_process["cpu_ms"] > 0
    assert graph["poses_hz"] > 0
    assert graph["out_of_order"] == 0
    faults = {row["fault"]: row for row in bench.faults(5.0).rows}
    assert len(faults) == 10
    assert "slam: started again" in faults["kill -9 slam"]["said"]
    assert all(row["gap_s"] < 60 for row in faults.values())


@pytest.mark.parametrize("words", [["--live", "--out", "o"], ["--live", "bag", "--rates", "0,5", "--out", "o"]])
def test_what_the_live_bench_needs_is_said(words, capsys):
    assert main(["bench", *words]) == 2
    assert "--live takes one bag and rates of at least 1 Hz" in capsys.readouterr().err
