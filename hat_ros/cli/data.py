"""Commands of the group data."""

from __future__ import annotations

from hat_ros.cli.options import Commands


def add_commands(commands: Commands) -> None:
    """Register this group."""
