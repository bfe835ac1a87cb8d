"""What a node owns from configure to cleanup, as one object that is whole once it exists."""

from __future__ import annotations

from typing import Any


class Session:
    """Built by a node's ``open_session`` and closed in its cleanup; creates its endpoints when it is constructed.

    A node without a session is unconfigured and receives nothing, so a session never asks whether it is complete.
    """

    def values(self) -> dict[str, Any]:
        """Figures for diagnostics."""
        return {}

    def every_second(self) -> None:
        """Called once a second while the node is active."""

    def close(self) -> None:
        """Close files, timers and services; once. Publishers and subscriptions go by themselves."""
