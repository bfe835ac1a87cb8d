"""What makes a figure traceable."""

from dataclasses import replace

from hat_ros.config import HatConfig, config_from_dict
from hat_ros.io import provenance
from hat_ros.io.provenance import code_hash, code_version, config_hash, describe_run, input_hash


def test_config_hash_follows_values_not_the_way_they_were_given():
    default = HatConfig()
    assert config_hash(default) == config_hash(config_from_dict({}))
    assert config_hash(default) != config_hash(replace(default, keyframes=replace(default.keyframes, gap_frames=9)))


def test_input_hash_sees_contents_names_and_nothing_else(tmp_path):
    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "x").write_text("1")
    (tmp_path / "a" / "y").write_text("2")
    before = input_hash(tmp_path / "a")
    (tmp_path / "a").rename(tmp_path / "b")
    assert input_hash(tmp_path / "b") == before
    (tmp_path / "b" / "x").write_text("3")
    changed = input_hash(tmp_path / "b")
    assert changed != before
    (tmp_path / "b" / "x").write_text("1")
    (tmp_path / "b" / "y").rename(tmp_path / "b" / "z")
    assert input_hash(tmp_path / "b") not in (before, changed)
    assert input_hash(tmp_path / "b" / "x") != input_hash(tmp_path / "b" / "z")


def test_run_description_is_complete(tmp_path):
    run = describe_run(tmp_path, "abc", HatConfig(), mode="hat")
    assert run["source"] == str(tmp_path)
    assert (run["source_sha256"], run["mode"], run["code_sha256"]) == ("abc", "hat", code_hash())
    assert run["config_sha256"] == config_hash(HatConfig())
    assert run["code"] == code_version()
    assert "numpy" in run["packages"]


def test_code_is_sources_and_weights(tmp_path, monkeypatch):
    (tmp_path / "nets").mkdir()
    (tmp_path / "stage.py").write_text("LIMIT = 1\n", encoding="utf-8")
    monkeypatch.setattr(provenance, "_PACKAGE", tmp_path)

    def digest():
        code_hash.cache_clear()
        return code_hash()

    try:
        seen = [digest()]
        (tmp_path / "nets" / "segmenter.onnx").write_bytes(b"weights")
        seen.append(digest())
        (tmp_path / "nets" / "segmenter.onnx").write_bytes(b"better weights")
        seen.append(digest())
        (tmp_path / "stage.py").write_text("LIMIT = 2\n", encoding="utf-8")
        seen.append(digest())
        assert len(set(seen)) == 4
        (tmp_path / "notes.txt").write_text("no code", encoding="utf-8")
        assert digest() == seen[-1]
    finally:
        code_hash.cache_clear()
