"""Runs side by side have domains of their own."""

from __future__ import annotations

from hat_ros.ros.domain import reserved_domain


def test_reserved_domains_differ():
    with reserved_domain(None) as first, reserved_domain(None) as second:
        assert first != second
    with reserved_domain(42) as given:
        assert given == 42
