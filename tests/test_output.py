"""Output files: complete or absent, and never in place of another without leave."""

import os
from pathlib import Path

import pytest

from jaxhair import output
from jaxhair.output import new_file


def names(folder: Path) -> list[str]:
    return sorted(p.name for p in folder.iterdir())


def test_the_file_appears_when_the_block_ends(tmp_path):
    path = tmp_path / "perm.tar.hair"
    with new_file(path) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".hair"
        assert not temporary.exists()
        temporary.write_text("strands")
        assert not path.exists()
    assert path.read_text() == "strands"
    assert names(tmp_path) == ["perm.tar.hair"]


def test_takes_a_string_and_a_path_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with new_file("a.txt") as temporary:
        temporary.write_text("a")
    assert names(tmp_path) == ["a.txt"]


def test_the_file_gets_the_usual_permissions(tmp_path):
    for path in (tmp_path / "plain", tmp_path / "new"):
        if path.name == "plain":
            path.write_text("")
        else:
            with new_file(path) as temporary:
                temporary.write_text("")
    assert (tmp_path / "new").stat().st_mode == (tmp_path / "plain").stat().st_mode


def write(path, text, *, then=lambda: None, overwrite=False):
    with new_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(text)
        then()


def enter(path, *, overwrite=False):
    with new_file(path, overwrite=overwrite):
        pytest.fail("the block was entered")


@pytest.mark.parametrize("overwrite", [False, True])
@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt, SystemExit])
def test_an_exception_leaves_nothing(tmp_path, error, overwrite):
    def then():
        raise error

    with pytest.raises(error):
        write(tmp_path / "a.txt", "half", then=then, overwrite=overwrite)
    assert names(tmp_path) == []


def test_an_exception_leaves_the_file_that_was_to_be_replaced(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")

    def then():
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write(path, "half", then=then, overwrite=True)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_an_exception_before_anything_is_written(tmp_path):
    with pytest.raises(KeyError), new_file(tmp_path / "a.txt"):
        raise KeyError
    assert names(tmp_path) == []


def test_an_existing_file_is_refused_before_the_block(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(FileExistsError) as raised:
        enter(path)
    for word in (str(path), "exists", "another name", "overwrite=True", "--overwrite"):
        assert word in str(raised.value)
    assert path.read_text() == "old"
    assert names(tmp_path) == ["a.txt"]


def test_overwrite_replaces(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with new_file(path, overwrite=True) as temporary:
        temporary.write_text("new")
        assert path.read_text() == "old"
    assert path.read_text() == "new"
    assert names(tmp_path) == ["a.txt"]


def test_a_file_that_appears_meanwhile_is_kept(tmp_path):
    path = tmp_path / "a.txt"
    with pytest.raises(FileExistsError, match=r"a\.txt exists.*another name"):
        write(path, "mine", then=lambda: path.write_text("theirs"))
    assert path.read_text() == "theirs"
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("error", [OSError("disk"), KeyboardInterrupt()])
@pytest.mark.parametrize("overwrite", [False, True])
def test_an_interrupted_rename_leaves_nothing(tmp_path, monkeypatch, error, overwrite):
    def replace(*_):
        raise error

    monkeypatch.setattr(output.os, "replace", replace)
    monkeypatch.setattr(output.os, "link", replace)
    with pytest.raises(type(error)):
        write(tmp_path / "a.txt", "new", overwrite=overwrite)
    assert names(tmp_path) == []


def test_a_new_name_never_shows_an_empty_file(tmp_path, monkeypatch):
    """The name appears with its content, in one step; without links it works in two."""
    path, open_ = tmp_path / "a.txt", output.Path.open

    def opened(self, *arguments):
        assert self != path, "a process killed here would leave an empty file"
        return open_(self, *arguments)

    monkeypatch.setattr(output.Path, "open", opened)
    with new_file(path) as temporary, open(temporary, "w") as file:
        file.write("new")
    monkeypatch.undo()

    def no_links(*_):
        raise OSError("not here")

    monkeypatch.setattr(output.os, "link", no_links)
    write(tmp_path / "b.txt", "new", overwrite=False)
    assert path.read_text() == (tmp_path / "b.txt").read_text() == "new"


def test_two_writers_have_their_own_temporary_files(tmp_path):
    path = tmp_path / "a.txt"
    with new_file(path, overwrite=True) as first, new_file(path, overwrite=True) as second:
        assert first != second
        first.write_text("first")
        second.write_text("second")
    assert path.read_text() == "first"  # the last to finish
    assert names(tmp_path) == ["a.txt"]


@pytest.mark.parametrize("overwrite", [False, True])
def test_the_folder_must_exist(tmp_path, overwrite):
    (tmp_path / "file").write_text("")
    for folder in (tmp_path / "missing", tmp_path / "file"):
        with pytest.raises(ValueError, match="existing folder") as raised:
            enter(folder / "a.txt", overwrite=overwrite)
        assert str(folder / "a.txt") in str(raised.value)


def test_the_folder_must_be_writable(tmp_path, monkeypatch):
    monkeypatch.setattr(output.os, "access", lambda *_: False)
    with pytest.raises(PermissionError, match=r"a\.txt.*writable folder"):
        enter(tmp_path / "a.txt")


@pytest.mark.parametrize("overwrite", [False, True])
def test_only_regular_files_are_replaced(tmp_path, overwrite):
    (tmp_path / "folder").mkdir()
    os.symlink(tmp_path / "nowhere", tmp_path / "link")
    for name in ("folder", "link"):
        with pytest.raises(ValueError, match=f"{name} cannot be written.*regular file"):
            enter(tmp_path / name, overwrite=overwrite)
    assert names(tmp_path) == ["folder", "link"]


def test_a_block_that_writes_nothing_is_reported(tmp_path):
    with pytest.raises(RuntimeError, match=r"a\.txt was not written"), new_file(tmp_path / "a.txt"):
        pass
    assert names(tmp_path) == []
