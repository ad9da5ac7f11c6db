"""Named arrays in .npz files, read without trusting them."""

import io
import math
import os
import zipfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from jaxhair import check
from jaxhair.output import new_file

_DEFLATE_RATIO = 1032  # no deflate stream grows by more
_LARGEST, _RATIO = 2**24, 100  # bytes of all arrays, and those over the file's: one may be passed


def read_arrays(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    """Arrays of a .npz file by name.

    Raises ValueError naming the file and the array where the file is no .npz file, is truncated
    or damaged, or holds pickled objects, which are never loaded; OSError where it cannot be opened.
    """
    path = check.path("path", path)
    data = contents(path)
    try:
        return unzip(data)
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error


def write_arrays(
    path: str | os.PathLike[str], arrays: Mapping[str, ArrayLike], *, overwrite: bool = False
) -> None:
    """Write named arrays to a compressed .npz file, which `read_arrays` and `numpy.load` read.

    Entries may be numbers, booleans or strings. The file appears when it is complete; see
    `jaxhair.output.new_file` for what is raised where it exists or its folder does not. Raises
    ValueError where the ending is not .npz, a name is not a string or an entry is of another type.
    """
    path = check.path("path", path)
    check.flag("overwrite", overwrite)
    if path.suffix.lower() != ".npz":
        raise ValueError(f"{path} ends in {path.suffix!r}; arrays must go to a file ending in .npz")
    for name in arrays:
        if not isinstance(name, str) or not name or "\0" in name:
            raise ValueError(
                f"an array is named {check.short(name)}; a name must be a string, without NUL"
            )
    checked = {name: numbers(f"array {name!r}", array, "biufcSU") for name, array in arrays.items()}
    with new_file(path, overwrite=overwrite) as temporary:
        zip_arrays(temporary, checked)


def numbers(name: str, value: Any, kinds: str) -> NDArray[Any]:
    """`value` as an array whose type is of one of NumPy's `kinds`."""
    try:
        array = np.asarray(value)
    except Exception as error:  # lists of different lengths, and what a foreign object raises
        raise ValueError(f"{name} must be an array: {reason(error)}") from None
    if array.dtype.kind not in kinds:
        allowed = {"iu": "whole numbers", "fiu": "real numbers"}.get(
            kinds, "numbers, booleans or strings"
        )
        raise ValueError(
            f"{name} has type {str(array.dtype)[:60]}; it must be an array of {allowed}"
        )
    return array


def unzip(data: bytes, names: Iterable[str] | None = None) -> dict[str, NDArray[Any]]:
    """Arrays of a .npz file: all, or those of `names` that it has."""
    arrays = {}
    # zipfile and NumPy's header parser raise a dozen types of exceptions on damaged bytes, and
    # NumPy a warning, which may be an error here; no input or output happens that could fail.
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except Exception as error:
        raise ValueError(
            f"the file is not readable ({reason(error)}); it must be a complete .npz file"
        ) from error
    with archive:
        entries = {entry.filename: entry for entry in archive.infolist()}
        if sum(entry.compress_size for entry in archive.infolist()) > len(data):
            raise ValueError("its entries overlap; it must be a .npz file of separate arrays")
        left = max(_LARGEST, _RATIO * len(data))
        for filename in entries if names is None else [f"{name}.npy" for name in names]:
            if filename not in entries:
                continue
            name = filename.removesuffix(".npy")
            try:
                arrays[name] = _unzip_array(archive, entries[filename], left)
                left -= entries[filename].file_size
            except Exception as error:
                raise ValueError(
                    f"array {check.short(name)} is not readable ({reason(error)}); it must be a "
                    "complete array of numbers, booleans or strings"
                ) from error
    return arrays


def reason(error: Exception) -> str:
    """An exception's text, in one line that is not long."""
    # some have no text; NumPy's goes on with advice on parameters that are not offered here
    text = str(error).partition("\n")[0] or type(error).__name__
    return text if len(text) <= 150 else text[:147] + "..."


def _unzip_array(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, most: int) -> NDArray[Any]:
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"compression {entry.compress_type}; it must be none or deflate")
    if entry.file_size > _DEFLATE_RATIO * entry.compress_size:
        raise ValueError(f"{entry.compress_size} bytes cannot hold {entry.file_size}")
    if entry.file_size > most:
        raise ValueError(f"{entry.file_size} bytes, where a file so small may hold {most} more")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        elif version == (2, 0):
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
        else:
            raise ValueError(f"version {version} of the .npy format; it must be (1, 0) or (2, 0)")
        if dtype.hasobject:
            raise ValueError(f"type {dtype}, which would run code")
        size = file.tell() + dtype.itemsize * math.prod(shape)
    # before NumPy allocates what the header asks for
    if size != entry.file_size or min(shape, default=0) < 0:
        raise ValueError(f"shape {shape} and type {dtype} do not fit its {entry.file_size} bytes")
    with archive.open(entry) as file:
        array: NDArray[Any] = np.lib.format.read_array(file, allow_pickle=False)
    return array


def zip_arrays(path: Path, arrays: Mapping[str, NDArray[Any]]) -> None:
    # numpy.savez_compressed does the same, but for arrays named like its own parameters
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as file:
                np.lib.format.write_array(file, array, allow_pickle=False)


def check_regular(path: Path) -> None:
    # anything but a regular file could be endless
    if path.exists() and not path.is_file():
        raise ValueError(f"{path} cannot be read: it must be a regular file")


def contents(path: Path) -> bytes:
    check_regular(path)
    return path.read_bytes()
