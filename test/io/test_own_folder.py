"""What may be deleted, and by whom."""

import os

import pytest

from hat_ros.bench.synth.suite import CLIPS, synthesize
from hat_ros.errors import RunError, UsageError
from hat_ros.io.own_folder import MARKER, NewFolder, mark, remove


def test_remove_takes_ours_and_empty_ones_only(tmp_path):
    ours, empty, other, link = (tmp_path / name for name in ("ours", "empty", "other", "link"))
    for folder in (ours, empty, other):
        folder.mkdir()
    mark(ours)
    (other / "thesis.tex").touch()
    link.symlink_to(other)
    for folder in (ours, empty, tmp_path / "absent"):
        remove(folder)
        assert not folder.exists()
    for folder in (other, link):
        with pytest.raises(UsageError, match="not a folder that hat has made"):
            remove(folder)
    assert (other / "thesis.tex").exists()


def test_new_folder_is_locked_while_it_is_open_and_replaced_afterwards(tmp_path):
    with NewFolder(tmp_path / "new"):
        (tmp_path / "new" / "done").touch()
        with pytest.raises(UsageError, match="another command"):
            NewFolder(tmp_path / "new")
        assert (tmp_path / "new" / "done").exists()
    with NewFolder(tmp_path / "new") as folder:
        assert [path.name for path in folder.path.iterdir()] == [MARKER]


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_read_only_parent_is_one_sentence(tmp_path):
    tmp_path.chmod(0o500)
    try:
        with pytest.raises(RunError, match="cannot create"):
            NewFolder(tmp_path / "new")
    finally:
        tmp_path.chmod(0o700)


@pytest.mark.parametrize("suffix", ["", ".work"])
def test_synth_deletes_nothing_of_others(tmp_path, suffix):
    photos = tmp_path / f"clip{suffix}"
    photos.mkdir()
    (photos / "cat.jpg").touch()
    with pytest.raises(UsageError):
        synthesize(next(iter(CLIPS.values())), tmp_path / "clip")
    assert (photos / "cat.jpg").exists()
