"""Every altered bit is noticed."""

from __future__ import annotations

import json

import pytest

from hat_ros.errors import BagError
from hat_ros.io.bag_reader import BagReader
from hat_ros.io.manifest import MANIFEST


def test_altered_files_are_noticed_by_the_manifest(bag):
    file = bag / "bag.mcap"
    data = bytearray(file.read_bytes())
    data[len(data) // 2] ^= 1
    file.write_bytes(data)
    with pytest.raises(BagError, match="SHA-256 differs"):
        BagReader(bag)
    file.unlink()
    with pytest.raises(BagError, match=r"lacks bag\.mcap"):
        BagReader(bag)
    (bag / MANIFEST).write_text("[1]")
    with pytest.raises(BagError, match="not a manifest"):
        BagReader(bag)


def test_a_name_that_no_file_can_have_is_missing(bag):
    for name in ("x" * 300, "x/" * 3000 + "x"):
        (bag / MANIFEST).write_text(json.dumps({"sha256": {name: ""}}))
        with pytest.raises(BagError, match="lacks x"):
            BagReader(bag)
