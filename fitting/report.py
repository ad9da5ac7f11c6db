"""A fit for people and programs: table, JSON, picture, strands."""

import json
import platform
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.parameters import labels
from jaxhair.export import check_new
from jaxhair.files import Curves, write_curves
from jaxhair.output import new_file

if TYPE_CHECKING:
    from fitting.fit import Fit

PACKAGES = ("jaxhair", "jax", "jaxlib", "numpy", "scipy", "optax")


def table(fit: "Fit") -> str:
    """The values, the residuals and what is not determined, as text."""
    lines = [f"{'parameter':<34} {'value':>12}"]
    lines += [f"{label:<34} {number:>12.5g}" for label, number in _numbers(fit).items()]
    lines += ["", f"{'state':<34} {'residual':>12}"]
    for state, residual in fit.residuals_mm.items():
        lines.append(f"{state:<34} {residual:>9.3f} mm")
    lines.append(f"{'all':<34} {fit.residual_mm:>9.3f} mm")
    verb = "converged" if fit.converged else "did NOT converge"
    lines += ["", f"{verb} after {fit.steps} simulations in {fit.seconds:.1f} s"]
    if fit.undetermined:
        lines.append("The data do not determine (change along it, by how much in free numbers):")
        for direction in fit.undetermined:
            size = "any" if direction.uncertainty > 1e3 else f"{direction.uncertainty:.2g}"
            lines.append(f"  {direction}   +- {size}")
    else:
        lines.append("The data determine every parameter.")
    return "\n".join(lines)


def _numbers(fit: "Fit") -> dict[str, float]:
    """Every fitted number by its label."""
    return {
        label: float(number)
        for name, value in fit.values.items()
        for label, number in zip(labels(name, value.shape), value.ravel(), strict=True)
    }


def as_json(fit: "Fit", **more: Any) -> dict[str, Any]:
    """The fit as plain data, see `write`."""
    return {
        "parameters": {label: {"value": _plain(v)} for label, v in _numbers(fit).items()},
        "residual_mm": _plain(fit.residual_mm),
        "residual_mm_by_state": {name: _plain(v) for name, v in fit.residuals_mm.items()},
        "converged": fit.converged,
        "undetermined": [
            {"change": d.change, "uncertainty": _plain(d.uncertainty)} for d in fit.undetermined
        ],
        "singular_values": _plain(fit.singular_values),
        "simulations": fit.steps,
        "seconds": fit.seconds,
        "settings": fit.settings,
        "versions": {"python": platform.python_version(), **_versions()},
        **more,
    }


def _plain(value: Any) -> Any:
    """Numbers that JSON has: not finite becomes null."""
    array = np.asarray(value, float)
    if array.ndim == 0:
        return float(array) if np.isfinite(array) else None
    return [_plain(v) for v in array]


def _versions() -> dict[str, str]:
    found = {}
    for package in PACKAGES:
        try:
            found[package] = version(package)
        except PackageNotFoundError:
            found[package] = "unknown"
    return found


def write(fit: "Fit", folder: Path, *, overwrite: bool = False, **more: Any) -> list[Path]:
    """Writes `fit.json`, the fitted strands of each state (`fitted-<state>.hair`) and `fit.png`.

    The folder must exist. The picture needs the extra `pictures`; without it the rest is written.
    Returns the files. Raises what `check_outputs` raises, before anything is written.
    """
    check_outputs(folder, fit.simulated, overwrite=overwrite)
    report, picture, *strands = outputs(folder, fit.simulated)
    with new_file(report, overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(as_json(fit, **more), indent=2) + "\n", encoding="utf-8")
    for path, points in zip(strands, fit.simulated.values(), strict=True):
        counts = np.full(len(points), points.shape[1])
        write_curves(path, Curves(points, counts), overwrite=overwrite)
    paths = [report, *strands]
    try:
        from jaxhair import pictures

        pictures.comparison(
            picture,
            list(fit.wanted.values()),
            list(fit.simulated.values()),
            labels=list(fit.wanted),
            residuals=[f"residual {r:.2f} mm" for r in fit.residuals_mm.values()],
            overwrite=overwrite,
        )
        paths.append(picture)
    except ImportError as error:
        print(f"no picture: {error}")
    return paths


def outputs(folder: Path, states: Iterable[str]) -> list[Path]:
    """The files that `write` writes: `fit.json`, `fit.png`, and the strands of each state."""
    strands = [folder / f"fitted-{file_name(state)}.hair" for state in states]
    return [folder / "fit.json", folder / "fit.png", *strands]


def check_outputs(folder: Path, states: Iterable[str], *, overwrite: bool) -> None:
    """Raises what would keep `write` from writing all files: to be called before a long fit.

    FileExistsError where a file exists and `overwrite` is false; ValueError where two states have
    names that differ in no letter or digit.
    """
    paths = outputs(folder, states)
    for path in paths:
        if paths.count(path) > 1:
            raise ValueError(f"two states would be written to {path}; their names must differ more")
        check_new(path, overwrite=overwrite)


def file_name(state: str) -> str:
    """A state's name as part of a file name."""
    return "-".join("".join(c if c.isalnum() else " " for c in state).split())
