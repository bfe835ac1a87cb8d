"""What `hat doctor` finds."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.version import Version

from hat_ros.app import doctor
from hat_ros.app.doctor import TESTED, compare_version, installed_version

ROOT = Path(__file__).parents[2]


def test_the_tested_range_goes_from_the_lower_bound_to_the_pin():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    bounds = {need.name: str(need.specifier) for need in map(Requirement, project["dependencies"])}
    pins = (ROOT / "requirements.txt").read_text(encoding="utf-8").splitlines()
    for package, (oldest, newest) in TESTED.items():
        assert bounds[package] == f">={oldest}"
        assert f"{package}=={newest}" in pins


@pytest.mark.parametrize(
    ("version", "verdict"),
    [
        (None, None),
        ("4.5.9", "untested"),
        ("4.6.0", None),
        ("4.13.0.99", None),
        ("4.14.0", "untested"),
        ("5.0.0.1", "untested"),
    ],
)
def test_versions_outside_the_range_are_named(version, verdict):
    finding = compare_version("opencv-python-headless", version, "4.6.0.66", "4.13.0.92")
    assert (finding and finding.verdict) == verdict
    if finding is not None:
        assert f"{version}; tested with 4.6.0.66 to 4.13.0.92" in finding.found
        assert Version(version) not in Requirement(finding.found.split("'")[1]).specifier


def test_an_untested_version_is_a_line_of_the_table(monkeypatch):
    monkeypatch.setitem(TESTED, "numba", ("0.1", "0.2"))
    (finding,) = doctor._versions()
    assert (finding.what, finding.verdict) == ("numba", "untested")


def test_opencv_without_package_metadata_says_its_version_itself(monkeypatch):
    import cv2

    monkeypatch.setattr(doctor, "_version", lambda package: None)
    assert installed_version("opencv-python-headless") == cv2.__version__
    assert installed_version("numba") is None
