"""Long work in whole parts, so that it can be killed at any moment and go on from the last part."""

import hashlib
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import jax
import numpy as np
from numpy.typing import NDArray

from jaxhair import check
from jaxhair.arrays import read_arrays
from jaxhair.output import new_file

Arrays = dict[str, NDArray[Any]]


class Checkpoints:
    """A folder of numbered parts, part-000000000.npz and so on, of one piece of work.

    Each part appears when it is complete. What a killed process left half written, under a
    temporary name, is removed when the folder is opened: one process at a time may use it.

    Arguments:
        folder: made if it is not there; for this work alone.
        work: everything that the result depends on, as a pytree of arrays, texts and numbers. With
            the versions of jaxhair and jax it makes the fingerprint that each part carries.

    Raises ValueError where the folder is a file, or holds parts of other work or a damaged part.
    """

    def __init__(self, folder: str | os.PathLike[str], work: Any) -> None:
        try:
            self.folder = Path(folder)
            self.folder.mkdir(parents=True, exist_ok=True)
        except (TypeError, FileExistsError, NotADirectoryError):
            raise ValueError(
                f"checkpoint is {check.short(folder)}; it must be the path of a folder"
            ) from None
        self._fingerprint = fingerprint(work)
        self.parts: list[Arrays] = []
        """Those that were there when the folder was opened, in order."""
        self._paths = sorted(self.folder.glob("part-*.npz"))
        for path in self._paths:
            try:
                part = read_arrays(path)
            except ValueError as error:
                raise ValueError(
                    f"{error}; delete this file and the parts after it to go on from there"
                ) from error
            if str(part.pop("fingerprint", "")) != self._fingerprint:
                raise ValueError(
                    f"checkpoint {self.folder} is of other work (another scene, program, version "
                    "or other options); it must be another folder, or be deleted"
                )
            self.parts.append(part)
        # only now: in a folder of other work they may be another process's
        for left in self.folder.glob(".new-*"):
            left.unlink(missing_ok=True)
        self._next = int(self._paths[-1].stem.removeprefix("part-")) + 1 if self._paths else 0

    def add(self, arrays: Mapping[str, Any], *, alone: bool = False) -> None:
        """Writes the next part. `alone`: it is all that is needed, and the others are deleted."""
        path = self.folder / f"part-{self._next:09d}.npz"
        # before writing: where Ctrl-C comes between the two, a number is left out, not used twice
        self._next += 1
        with new_file(path) as temporary:
            # not compressed: it would be slow, and what shrinks too much is not read back
            np.savez(temporary, fingerprint=np.array(self._fingerprint), **arrays)
        if alone:
            for old in self._paths:
                old.unlink(missing_ok=True)
            self._paths = []
        self._paths.append(path)


def fingerprint(work: Any) -> str:
    """A text of 64 characters that differs where work differs in structure, type or any bit."""
    leaves, structure = jax.tree.flatten(work)
    digest = hashlib.sha256()
    packages = [version(name) for name in ("jaxhair", "jax", "jaxlib")]
    for text in (*packages, jax.default_backend(), str(structure)):
        digest.update(text.encode() + b"\0")
    for leaf in leaves:
        array = np.asarray(leaf)
        digest.update(f"{array.dtype} {array.shape}\0".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def named(prefix: str, tree: Any) -> Arrays:
    """The leaves of a pytree as arrays named "prefix 0", "prefix 1" and so on."""
    return {f"{prefix} {i}": np.asarray(leaf) for i, leaf in enumerate(jax.tree.leaves(tree))}


def unnamed(prefix: str, arrays: Arrays, like: Any) -> Any:
    """The pytree of the structure of `like` whose leaves `named` named."""
    leaves, structure = jax.tree.flatten(like)
    return jax.tree.unflatten(structure, [arrays[f"{prefix} {i}"] for i in range(len(leaves))])
