"""The examples run as they stand; the layouts are what their programs read."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from hat_ros.io import topics

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"


def output_of(*arguments: str) -> list[str]:
    done = subprocess.run(
        [sys.executable, *arguments],
        cwd=ROOT,
        capture_output=True,
        text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_library_use_prints_one_line_per_frame():
    camera, *lines = output_of("examples/library_use.py", "bags/demo", "4")
    assert camera == "640 x 480 px, focal length 1000 px"
    assert len(lines) == 4
    assert all("TRACKING: x" in line and "sigma of z" in line for line in lines[1:])


def test_an_estimator_of_ones_own_is_tracked():
    *_, last = output_of("examples/own_estimator.py", "bags/demo", "14")
    assert "TRACKING" in last


def test_rviz_shows_topics_of_ours_with_their_types():
    layout = yaml.safe_load((EXAMPLES / "hat.rviz").read_text(encoding="utf-8"))
    manager = layout["Visualization Manager"]
    shown = {display["Topic"]["Value"]: display for display in manager["Displays"] if "Topic" in display}
    assert topics.TARGET_POSE_WITH_COVARIANCE in shown
    assert topics.OVERLAY.removesuffix("/compressed") in {name.removesuffix("/compressed") for name in shown}
    known = set(topics.TYPES) | {topics.OVERLAY.removesuffix("/compressed")}
    assert set(shown) <= known
    assert {"rviz_default_plugins/TF", "rviz_default_plugins/Image"} <= {d["Class"] for d in manager["Displays"]}
    assert all(panel["Class"].startswith("rviz_common/") for panel in layout["Panels"])


def names_in(layout) -> list[str]:
    if isinstance(layout, str):
        return [layout]
    return [name for side in ("first", "second") for name in names_in(layout[side])]


def test_foxglove_places_every_panel_that_it_configures():
    layout = json.loads((EXAMPLES / "foxglove_layout.json").read_text(encoding="utf-8"))
    assert sorted(names_in(layout["layout"])) == sorted(layout["configById"])
    text = json.dumps(layout["configById"])
    for topic in (topics.OVERLAY, topics.TARGET_POSE, topics.STATUS, topics.DIAGNOSTICS):
        assert topic in text


@pytest.mark.parametrize("name", ["library_use", "own_estimator", "gnc_node"])
def test_examples_say_how_they_are_run(name):
    assert f"python examples/{name}.py" in (EXAMPLES / f"{name}.py").read_text(encoding="utf-8")
