"""Fixtures of the bags' tests."""

from __future__ import annotations

import pytest
from recording import write


@pytest.fixture
def bag(tmp_path):
    return write(tmp_path / "bag")
