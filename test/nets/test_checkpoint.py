"""Weights on disk: where they are looked for, what is refused, and that reading a pickle runs nothing."""

import os
import pickle

import pytest
import torch
from rule_weights import save_small_mask2former
from safetensors.torch import load_file, save_file

from hat_ros.errors import WeightsError
from hat_ros.nets import checkpoint
from hat_ros.nets.checkpoint import CHECKPOINTS, convert, find, load_into, load_state, weights_folder
from hat_ros.nets.checkpoint_check import _NETWORKS, check
from hat_ros.nets.droid import DroidNet


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HAT_WEIGHTS", str(tmp_path))
    return tmp_path


@pytest.fixture
def toy(monkeypatch):
    """Register a small checkpoint 'toy' whose checksum is that of whatever file was written last."""

    def register(path=None, **fields):
        digest = checkpoint.sha256_of(path) if path else "0" * 64
        entry = checkpoint.Checkpoint("toy", "toy.pth", "https://example.org", "MIT", **({"sha256": digest} | fields))
        monkeypatch.setitem(CHECKPOINTS, "toy", entry)
        return entry

    return register


def test_folder_is_argument_then_environment_then_user_data(monkeypatch, tmp_path):
    monkeypatch.setenv("HAT_WEIGHTS", str(tmp_path / "env"))
    assert weights_folder(tmp_path / "given") == tmp_path / "given"
    assert weights_folder() == tmp_path / "env"
    monkeypatch.delenv("HAT_WEIGHTS")
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert weights_folder() == tmp_path / "data" / "hat_ros" / "weights"


@pytest.mark.parametrize("name", CHECKPOINTS)
def test_missing_file_error_says_all_that_one_needs(folder, name):
    entry = CHECKPOINTS[name]
    with pytest.raises(WeightsError) as caught:
        find(name)
    message = str(caught.value)
    for part in (entry.filename, entry.source, entry.sha256 or "none published", entry.licence, str(folder)):
        assert part in message
    assert "\n" not in message
    status = check(name)
    assert not status.usable and status.path is None and status.message == message


def test_unknown_name_lists_the_known():
    with pytest.raises(WeightsError, match="known are droid, megapose_coarse"):
        find("droidd")


def test_altered_file_is_refused_before_it_is_opened(folder):
    (folder / "droid.pth").write_bytes(pickle.dumps(_Bomb(folder / "ran")))
    with pytest.raises(WeightsError, match="published is 46476ef6"):
        load_state("droid")
    with pytest.raises(WeightsError, match="published is 46476ef6"):
        convert("droid")
    assert not check("droid").usable
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("legacy", [False, True])
def test_load_strips_opens_and_cuts(folder, toy, legacy):
    weight = torch.arange(12.0).reshape(3, 4)
    torch.save(
        {"state_dict": {"module.a.weight": weight, "other": torch.ones(2)}},
        folder / "toy.pth",
        _use_new_zipfile_serialization=not legacy,
    )
    toy(folder / "toy.pth", container="state_dict", renames=(("module.", ""),), cut_rows=(("a.weight", 2),))
    state = load_state("toy")
    assert set(state) == {"a.weight", "other"}
    assert torch.equal(state["a.weight"], weight[:2])
    converted = convert("toy")
    assert converted == folder / "toy.safetensors" and find("toy") == converted
    again = load_state("toy")
    assert set(again) == set(state) and all(torch.equal(again[k], state[k]) for k in state)


class _Bomb:
    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return os.mkdir, (str(self.path),)


class _Settings(dict):
    pass


@pytest.mark.parametrize("legacy", [False, True])
def test_pickled_extras_are_never_run(folder, toy, legacy):
    """A file with more than tensors is not opened directly; conversion keeps the tensors and drops the rest."""
    weight = torch.linspace(0, 1, 7)
    extras = {"bomb": _Bomb(folder / "ran"), "settings": _Settings(a=[1, 2]), "shape": torch.Size([2])}
    torch.save(
        {"state_dict": {"network.w": weight}, "hyper_parameters": extras},
        folder / "toy.pth",
        _use_new_zipfile_serialization=not legacy,
    )
    toy(folder / "toy.pth", container="state_dict", renames=(("network.", ""),))
    with pytest.raises(WeightsError, match="hat weights convert toy"):
        load_state("toy")
    convert("toy")
    assert torch.equal(load_state("toy")["w"], weight)
    assert not (folder / "ran").exists()


@pytest.mark.parametrize("content", [b"", b"\x00" * 100, b"PK\x03\x04junk", pickle.dumps([1, 2])])
def test_rubbish_is_one_clear_error(folder, toy, content):
    (folder / "toy.pth").write_bytes(content)
    toy(folder / "toy.pth")
    for action in (load_state, convert):
        with pytest.raises(WeightsError):
            action("toy")
    (folder / "toy.safetensors").write_bytes(content)
    with pytest.raises(WeightsError, match="not a readable safetensors"):
        load_state("toy")


def test_no_state_dict_inside_is_an_error(folder, toy):
    torch.save({"model": {"a": torch.ones(1)}}, folder / "toy.pth")
    toy(folder / "toy.pth", container="state_dict")
    with pytest.raises(WeightsError, match="under 'state_dict'"):
        load_state("toy")


def test_missing_companion_is_reported(folder, toy):
    torch.save({"a": torch.ones(1)}, folder / "toy.pth")
    toy(folder / "toy.pth", companions=(("config.yaml", "1" * 64),))
    assert "config.yaml is missing" in check("toy").message
    (folder / "config.yaml").write_text("x: 1")
    assert "published is 1111" in check("toy").message


def test_load_into_is_strict():
    module = torch.nn.Linear(3, 2)
    state = {"weight": torch.ones(2, 3), "bias": torch.zeros(2)}
    load_into(module, state, "toy")
    assert torch.equal(module.weight, torch.ones(2, 3))
    for wrong, text in (
        ({"weight": state["weight"]}, r"1 tensors missing \(bias\)"),
        (state | {"weight": torch.ones(3, 3)}, r"shape \(2, 3\), found \(3, 3\)"),
        (state | {"bias": torch.tensor([0.0, float("nan")])}, "not finite"),
    ):
        with pytest.raises(WeightsError, match=text):
            load_into(module, wrong, "toy")


def test_what_a_publisher_stored_beside_the_network_is_left_out():
    module = torch.nn.Linear(3, 2)
    load_into(
        module, {"weight": torch.ones(2, 3), "bias": torch.zeros(2), "head.w": torch.full((1,), torch.nan)}, "toy"
    )
    assert torch.equal(module.weight, torch.ones(2, 3))


def test_another_checksum_says_how_to_go_on(folder, toy, caplog):
    torch.save({"a": torch.ones(1)}, folder / "toy.pth")
    toy(folder / "toy.pth")
    torch.save({"a": torch.zeros(1)}, folder / "toy.pth")
    for action in (load_state, convert):
        with pytest.raises(WeightsError, match="--allow-unverified"):
            action("toy")
    assert load_state("toy", None, allow_unverified=True)["a"] == 0
    assert "taken all the same" in caplog.text


@pytest.mark.parametrize("place", ["megapose-models/", "a/b/"])
def test_checkpoints_are_found_in_the_publishers_folders(folder, place):
    path = folder / place / "coarse-rgb-906902141" / "checkpoint.pth.tar"
    path.parent.mkdir(parents=True)
    path.touch()
    assert find("megapose_coarse") == path


def test_mask2former_is_found_where_the_hub_keeps_it(folder):
    path = folder / "models--facebook--mask2former-swin-large-coco-instance" / "snapshots" / "0123abc"
    path.mkdir(parents=True)
    (path / "config.json").write_text("{}")
    assert find("mask2former") == path


def test_registry_is_consistent():
    for name, entry in CHECKPOINTS.items():
        assert entry.name == name
        assert entry.sha256 == "" or len(entry.sha256) == 64
        assert all(len(digest) == 64 for _, digest in entry.companions)


class _Script(torch.nn.Module):
    """A module whose ``__setstate__`` runs when its archive is opened."""

    def __init__(self):
        super().__init__()
        self.w = torch.nn.Parameter(torch.ones(2))

    @torch.jit.export
    def __getstate__(self):
        return (self.w, self.training)

    @torch.jit.export
    def __setstate__(self, state: tuple[torch.Tensor, bool]):
        print("the archive's code ran")
        self.w = state[0]
        self.training = state[1]

    def forward(self, x):
        return x * self.w


def test_a_torchscript_archive_is_refused_before_anything_in_it_runs(folder, toy, capfd):
    torch.jit.save(torch.jit.script(_Script()), str(folder / "toy.pth"))
    torch.jit.load(str(folder / "toy.pth"))
    assert "code ran" in capfd.readouterr().out, "opened as such, it does run"
    for digest in ({}, {"sha256": ""}):
        toy(folder / "toy.pth", **digest)
        for action in (load_state, convert):
            with pytest.raises(WeightsError, match="TorchScript archive"):
                action("toy")
    assert "code ran" not in capfd.readouterr().out


def test_an_archive_whose_names_are_no_text_is_one_sentence(folder, toy):
    path = folder / "toy.pth"
    torch.save({"w": torch.ones(2)}, path)
    path.write_bytes(path.read_bytes().replace(b"/data.pkl", b"/d\xe8ta.pkl"))
    toy(path, sha256="")
    for action in (load_state, convert):
        with pytest.raises(WeightsError, match=r"toy\.pth: is not a readable torch file \("):
            action("toy")


@pytest.fixture(scope="module")
def good_droid():
    return {key: torch.zeros_like(value) for key, value in DroidNet(None).state_dict().items()}


def test_check_says_ok_of_what_the_network_takes_and_of_nothing_else(folder, good_droid):
    path = folder / "droid.safetensors"
    save_file(good_droid, str(path))
    assert check("droid").usable and "all fit" in check("droid").message
    name = next(iter(good_droid))
    for spoiled, text in (
        ({}, "tensors missing"),
        ({k: v for k, v in good_droid.items() if k != name}, "1 tensors missing"),
        (good_droid | {name: good_droid[name][:1]}, "must have shape"),
        (good_droid | {name: torch.full_like(good_droid[name], float("inf"))}, "not finite"),
    ):
        save_file({key: value.contiguous() for key, value in spoiled.items()}, str(path))
        status = check("droid")
        assert not status.usable and text in status.message and status.path == path
    for garbage in (b"", b"{}", b"\x02\0\0\0\0\0\0\0{}", os.urandom(500)):
        path.write_bytes(garbage)
        assert not check("droid").usable


def test_check_reads_the_folder_of_the_library_too(folder):
    save_small_mask2former(folder)
    assert check("mask2former").usable
    tensors = folder / CHECKPOINTS["mask2former"].filename / "model.safetensors"
    state = load_file(str(tensors))
    state.pop(sorted(state)[0])
    for content in (state, {}):
        save_file(content, str(tensors), metadata={"format": "pt"})
        status = check("mask2former")
        assert not status.usable and "lacks" in status.message
    tensors.write_bytes(b"garbage")
    assert not check("mask2former").usable


def test_every_single_file_has_a_published_checksum_and_a_network():
    for name, entry in CHECKPOINTS.items():
        assert entry.library_folder or len(entry.sha256) == 64, name
        assert entry.library_folder or not check(name, "/nonexistent").usable
    assert set(_NETWORKS) == {name for name, entry in CHECKPOINTS.items() if not entry.library_folder}


def test_a_pickle_that_numbers_its_objects_absurdly_is_refused_before_it_is_read(folder, toy):
    for number in (2**31, 10**8):  # 32 and 1.6 GiB in the C reader
        path = folder / "toy.pth"
        path.write_bytes(b"\x80\x02K\x01r" + number.to_bytes(4, "little") + b".")
        toy(path)
        with pytest.raises(WeightsError, match=f"object number {number} is too large"):
            convert("toy")
