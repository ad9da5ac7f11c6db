"""Output files appear complete or not at all, and never in place of another without leave."""

import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def new_file(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Context in which a file is written under another name; `path` gets it when all is done.

    Yields a path in the same folder with the same suffix, at which nothing exists yet. When the
    block ends without an exception, that file is renamed to `path`; after any exception,
    KeyboardInterrupt too, it is removed and `path` is as it was.

    Raises, before the block is entered: FileExistsError where `path` exists and `overwrite` is
    false; ValueError where its folder does not exist, or where `path` is there but is no regular
    file, which is never replaced; PermissionError where nothing can be created in the folder.
    Raises after it: FileExistsError where `path` has appeared meanwhile and `overwrite` is
    false; RuntimeError where the block has written nothing.
    """
    path = Path(path)
    folder = path.parent
    if not folder.is_dir():
        raise ValueError(f"{path} cannot be written: {folder} must be an existing folder")
    # lexists, because a link that leads nowhere takes the name too
    if os.path.lexists(path):
        if not path.is_file():
            raise ValueError(f"{path} cannot be written: it exists and must be a regular file")
        if not overwrite:
            raise _exists(path)
    if not os.access(folder, os.W_OK):
        raise PermissionError(f"{path} cannot be written: {folder} must be a writable folder")
    temporary = folder / f".new-{secrets.token_hex(8)}{path.suffix}"
    try:
        yield temporary
        if not temporary.is_file():
            raise RuntimeError(f"{path} was not written: nothing is at the path given for it")
        if overwrite:
            os.replace(temporary, path)
        else:
            _rename_to_free_name(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _exists(path: Path) -> FileExistsError:
    return FileExistsError(
        f"{path} exists: it must be another name, or be replaced with overwrite=True (--overwrite)"
    )


def _rename_to_free_name(source: Path, path: Path) -> None:
    """Rename `source` to `path`, or raise FileExistsError where the name is taken."""
    # A link appears whole or not at all, and never in place of another file.
    try:
        os.link(source, path)
        return
    except FileExistsError:
        raise _exists(path) from None
    except OSError:  # not every file system has links
        pass
    # Creating the file exclusively takes the name on all of them; a process that is killed at
    # this place leaves an empty file.
    try:
        path.open("xb").close()
    except FileExistsError:
        raise _exists(path) from None
    try:
        os.replace(source, path)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
