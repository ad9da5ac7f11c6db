"""A fit for people and programs: table, JSON, picture, strands."""

import json
import platform
import sys
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from fitting.curls import Curl
from jaxhair.export import check_new
from jaxhair.files import Curves, write_curves
from jaxhair.output import new_file

if TYPE_CHECKING:
    from fitting.fit import Fit

PACKAGES = ("jaxhair", "jax", "jaxlib", "numpy", "scipy", "optax")


def table(fit: "Fit") -> str:
    """The values with their intervals, the misfits and what is not determined, as text."""
    spread = fit.uncertainty
    percent = f"{100 * spread.level:g} % interval"
    width = max(34, *(len(label) for label in spread.labels), *(len(s) for s in fit.misfits))
    lines = [f"{'parameter':<{width}} {'value':>12}   {percent}"]
    for label, value, low, high in zip(
        spread.labels, spread.values, spread.low, spread.high, strict=True
    ):
        end = "  at its bound" if label in fit.at_bounds else ""
        lines.append(f"{label:<{width}} {value:>12.5g}   {low:.4g} to {high:.4g}{end}")
    lines += ["", f"{'state':<{width}} {'residual':>12}   in standard errors"]
    for state, misfit in fit.misfits.items():
        distance = fit.residuals_mm.get(state)
        shown = "" if distance is None else f"{distance:.3f} mm"
        lines.append(f"{state:<{width}} {shown:>12}   {misfit:.3g}")
        target = fit.problem.states[state]
        if isinstance(target, Curl):
            for name, (found, wanted, error) in target.compared(fit.simulated[state]).items():
                lines.append(f"  {name}: {found:.4g}, wanted {wanted:.4g} +- {error:.2g}")
    shown = f"{fit.residual_mm:.3f} mm" if np.isfinite(fit.residual_mm) else ""
    lines.append(f"{'all':<{width}} {shown:>12}   {fit.misfit:.3g}")
    verb = "converged" if fit.converged else "did NOT converge"
    lines += ["", f"{verb} after {fit.steps} simulations in {fit.seconds:.1f} s: {fit.reason}"]
    if fit.misfit > 2:
        lines.append(
            f"The model misses the data by {fit.misfit:.3g} standard errors: it is too simple for "
            "them, or they are less exact than said. The intervals are widened by as much."
        )
    if len(fit.basins) > 1:
        lines.append("Different starts led to different ends:")
        lines += [
            f"  misfit {b.misfit:.4g} from {b.starts} start{'s' * (b.starts > 1)}"
            for b in fit.basins
        ]
    strong = [pair for pair in spread.strongest_correlations() if abs(pair[2]) > 0.9]
    if strong:
        lines.append("Numbers that the data hardly tell apart (correlation):")
        lines += [f"  {a} and {b}: {value:+.3f}" for a, b, value in strong]
    if fit.undetermined:
        lines.append("The data do not determine (change along it, by how much in free numbers):")
        for direction in fit.undetermined:
            size = "any" if direction.uncertainty > 1e3 else f"{direction.uncertainty:.2g}"
            lines.append(f"  {direction}   +- {size}")
    else:
        lines.append("The data determine every parameter.")
    return "\n".join(lines)


def as_json(fit: "Fit", **more: Any) -> dict[str, Any]:
    """The fit as plain data, see `write`."""
    spread = fit.uncertainty
    numbers = zip(spread.labels, spread.values, spread.low, spread.high, strict=True)
    return {
        "parameters": {
            label: {"value": plain(value), "interval": plain([low, high])}
            for label, value, low, high in numbers
        },
        "level": spread.level,
        "correlations": plain(spread.correlations),
        "residual_mm": plain(fit.residual_mm),
        "residual_mm_by_state": {name: plain(v) for name, v in fit.residuals_mm.items()},
        "misfit": plain(fit.misfit),
        "misfit_by_state": {name: plain(v) for name, v in fit.misfits.items()},
        "converged": fit.converged,
        "reason": fit.reason,
        "at_bounds": list(fit.at_bounds),
        "basins": [{"misfit": plain(b.misfit), "starts": b.starts} for b in fit.basins],
        "undetermined": [
            {"change": d.change, "uncertainty": plain(d.uncertainty)} for d in fit.undetermined
        ],
        "singular_values": plain(fit.singular_values),
        "simulations": fit.steps,
        "seconds": fit.seconds,
        "settings": fit.settings,
        "versions": versions(),
        **more,
    }


def plain(value: Any) -> Any:
    """Numbers that JSON has: not finite becomes null."""
    array = np.asarray(value, float)
    if array.ndim == 0:
        return float(array) if np.isfinite(array) else None
    return [plain(v) for v in array]


def versions() -> dict[str, str]:
    """Of Python and the packages that results depend on."""
    found = {"python": platform.python_version()}
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
            [fit.wanted.get(state, points) for state, points in fit.simulated.items()],
            list(fit.simulated.values()),
            labels=list(fit.simulated),
            residuals=[_residual(fit, state) for state in fit.simulated],
            overwrite=overwrite,
        )
        paths.append(picture)
    except ImportError as error:
        print(f"no picture: {error}", file=sys.stderr)
    return paths


def _residual(fit: "Fit", state: str) -> str:
    if state in fit.residuals_mm:
        return f"residual {fit.residuals_mm[state]:.2f} mm"
    return f"misfit {fit.misfits[state]:.2g} standard errors"


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
