"""What the middleware reads from the environment before the first participant exists."""

from __future__ import annotations

import os
import sys
from pathlib import Path

PROFILE = "FASTRTPS_DEFAULT_PROFILES_FILE"
RANGE = "ROS_AUTOMATIC_DISCOVERY_RANGE"


def profile_path() -> Path | None:
    """The Fast DDS profile shipped with the package: in a checkout, in a prefix, or in a colcon install space."""
    here = Path(__file__).resolve()
    folders = [here.parents[2] / "config", Path(sys.prefix) / "share" / "hat_ros" / "config"]
    folders += [parent / "share" / "hat_ros" / "config" for parent in here.parents[4:]]
    return next((folder / "fastdds.xml" for folder in folders if (folder / "fastdds.xml").is_file()), None)


def prepare_environment() -> None:
    """Defaults for what the user has not set: our Fast DDS profile, and discovery on this machine only."""
    profile = profile_path()
    if profile is not None:
        os.environ.setdefault(PROFILE, str(profile))
    os.environ.setdefault(RANGE, "LOCALHOST")
