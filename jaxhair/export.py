"""A recording as a file: arrays, USD, Alembic, strands, pictures, by the file's ending."""

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxhair import check
from jaxhair.arrays import write_arrays
from jaxhair.extras import optional
from jaxhair.files import Curves, write_curves
from jaxhair.obstacles import Mesh, Obstacle
from jaxhair.output import new_file
from jaxhair.progress import each
from jaxhair.recording import Recording
from jaxhair.scene import Scene, named_leaves
from jaxhair.strands import BONDS

COLORS = (*BONDS, "strain", "curvature")
"""What the colour of the hair can show: the bonded fraction of a kind of bond, an edge's length
over its rest length less 1, or curvature [1/m]."""

USD = (".usdc", ".usda", ".usd")
STRAND_FILES = (*USD, ".abc", ".hair", ".data")
PICTURES = (".png", ".gif", ".mp4")
ENDINGS = (".npz", *STRAND_FILES, *PICTURES, ".html")


def save(
    path: str | os.PathLike[str],
    recording: Recording,
    *,
    frame: int = -1,
    color_by: str | None = None,
    overwrite: bool = False,
    progress: bool = False,
    **options: Any,
) -> None:
    """Writes a recording; the file's ending chooses how.

    | ending         | holds                                                                    |
    | -------------- | ------------------------------------------------------------------------ |
    | `.npz`         | `positions` [m], (frames, strands, points, 3); `fractions`, (frames,     |
    |                | strands, points - 2, 4); `times` [s]; `phases`, of each frame; `counts`, |
    |                | points of each strand; `bonds`, the kinds; `scene`, as text; and every   |
    |                | number of the scene as `parameter:<name>`                                |
    | `.usdc .usda   | animated BasisCurves with widths, colours and bonded fractions, and the  |
    | .usd`          | obstacles, see `jaxhair.usd`; needs the extra `usd`                      |
    | `.abc`         | animated Alembic Curves with widths and bonded fractions, see            |
    |                | `jaxhair.alembic`                                                        |
    | `.hair .data`  | the strands of one frame                                                 |
    | `.png`         | a picture of one frame                                                   |
    | `.gif .mp4`    | a movie; needs the extra `pictures`, as `.png` does                      |
    | `.html`        | a web page to turn, zoom and play the hair, in one file; `view` says how |

    Arguments:
        frame: for what holds one frame, and the one that a web page shows first; the last.
        color_by: kind of bond whose fraction is shown from blue (0) to red (1), in pictures and
            USD, and written to Alembic; a web page can show "strain" and "curvature" too.
        overwrite: replace a file that exists. progress: show a bar for movies.
        options: of `jaxhair.usd.write` for USD: basis, width, color, unit, up; of
            `jaxhair.alembic.write` for Alembic: basis, width, unit, up; of `write_curves` for
            strands: unit, up; of `view` for a web page; of `jaxhair.pictures.Options` for pictures
            and movies.

    Raises ValueError for another ending, kind or frame, and FileExistsError.
    """
    ending = check_ending(path)
    check.instance("recording", recording, Recording)
    frames = len(recording.phases)
    check.whole("frame", frame, least=-frames, most=frames - 1)
    check.flag("overwrite", overwrite)
    check.flag("progress", progress)
    check_color(path, color_by)
    counts = recording.scene.strands.counts
    if ending == ".npz":
        write_arrays(path, as_arrays(recording), overwrite=overwrite, **options)
    elif ending in (".hair", ".data"):
        curves = Curves(recording.positions[frame], counts)
        write_curves(path, curves, overwrite=overwrite, **options)
    elif ending == ".html":
        from jaxhair.viewer import view

        page = view(recording, color_by=color_by, frame=frame, **options).page
        with new_file(path, overwrite=overwrite) as temporary:
            temporary.write_text(page, encoding="utf-8")
    elif ending in USD:
        from jaxhair import usd

        usd.write(path, recording, color_by=color_by, overwrite=overwrite, **options)
    elif ending == ".abc":
        from jaxhair import alembic

        alembic.write(path, recording, color_by=color_by, overwrite=overwrite, **options)
    else:
        _draw(path, recording, frame, color_by, overwrite, progress, options)


def check_ending(path: str | os.PathLike[str]) -> str:
    """The path's ending, in lower case. Raises ValueError if no format goes by it."""
    ending = check.path("output", path).suffix.lower()
    if ending not in ENDINGS:
        shown = check.short(Path(path).name)
        raise ValueError(f"output is {shown}; its name must end in {', '.join(ENDINGS)}")
    return ending


def check_color(path: str | os.PathLike[str], color_by: str | None) -> None:
    """Raises ValueError unless a file of the path's ending can show `color_by`, or it is None."""
    if color_by is not None:
        check.choice("color_by", color_by, COLORS if check_ending(path) == ".html" else BONDS)


def check_new(path: str | os.PathLike[str], *, overwrite: bool) -> None:
    """Raises what writing to the path would raise, before any work is done."""

    class Enough(Exception):
        pass

    try:
        with new_file(path, overwrite=overwrite):
            raise Enough
    except Enough:
        pass


def check_new_folder(folder: Path, names: Iterable[str], *, overwrite: bool) -> None:
    """Makes the folder `--output` and raises what writing files into it would raise, before any
    work is done; where one exists, without making the folder."""
    paths = [folder / name for name in names]
    for path in paths:
        if not overwrite and os.path.lexists(path):
            raise FileExistsError(
                f"{path} exists: --output must be another folder, or add --overwrite"
            )
    folder.mkdir(parents=True, exist_ok=True)
    for path in paths:
        check_new(path, overwrite=overwrite)


def check_drawing(path: str | os.PathLike[str], size: int) -> None:
    """Raises what drawing a square picture or movie would raise, before any work is done.

    ValueError for a size [pixels] that is too small, or odd for an .mp4; ImportError without the
    extra `pictures`, or for a USD file `usd`.
    """
    ending = check_ending(path)
    if ending in USD:
        optional("pxr.Usd", "usd")
    if ending not in PICTURES:
        return
    check.whole("size", size, least=16)
    if ending == ".mp4" and size % 2:
        raise ValueError(f"size is {size}; it must be even for an .mp4")
    for module in ("matplotlib", "PIL", *(("imageio_ffmpeg",) if ending == ".mp4" else ())):
        optional(module)


def as_arrays(recording: Recording) -> dict[str, np.ndarray]:
    """A recording as named arrays, see `save`."""
    leaves = named_leaves(recording.scene)
    return {
        "positions": np.asarray(recording.positions),
        "fractions": np.asarray(recording.fractions),
        "times": np.asarray(recording.times),
        "phases": np.asarray(recording.phases),
        "counts": recording.scene.strands.counts,
        "bonds": np.asarray(BONDS),
        "scene": np.asarray(str(recording.scene)),
        **{f"parameter:{name}": np.asarray(leaf) for name, leaf in leaves.items()},
    }


def _draw(
    path: str | os.PathLike[str],
    recording: Recording,
    frame: int,
    color_by: str | None,
    overwrite: bool,
    progress: bool,
    drawing: dict[str, Any],
) -> None:
    from jaxhair import pictures

    scene, counts = recording.scene, recording.scene.strands.counts
    bonded = None
    if color_by is not None:
        bonded = recording.fractions_at_points()[..., BONDS.index(color_by)]
    if Path(path).suffix.lower() == ".png":
        pictures.picture(
            path,
            recording.positions[frame],
            counts=counts,
            bonded=None if bonded is None else bonded[frame],
            meshes=meshes(scene, recording.phases[frame], float(recording.times[frame])),
            overwrite=overwrite,
            **drawing,
        )
        return

    def bar(frames: range) -> Any:
        return each(frames, "drawing", unit="frame", shown=progress)

    times = np.asarray(recording.times)
    pictures.movie(
        path,
        recording.positions,
        fps=min(50.0, 1 / max(float(np.median(np.diff(times))), 1e-3)) if len(times) > 1 else 30.0,
        counts=counts,
        bonded=bonded,
        meshes=[
            meshes(scene, phase, float(t)) for phase, t in zip(recording.phases, times, strict=True)
        ],
        overwrite=overwrite,
        progress=bar,
        **drawing,
    )


def meshes(scene: Scene, phase: str, time: float) -> list[Mesh]:
    """The obstacles of a scene, to draw.

    Arguments:
        phase: name; "" is the start, which shows the first phase's obstacles.
        time: since the start of the scene [s].
    """
    begin = 0.0
    for place in scene.phases:
        if place.name == phase or not phase:
            inside = time - begin
            return [e.mesh(inside) for e in place.effects if isinstance(e, Obstacle)]
        begin += place.steps(scene.dt) * scene.dt
    return []
