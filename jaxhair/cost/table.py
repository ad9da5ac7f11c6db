"""Measured costs as a text, as JSON and as a .csv file."""

import csv
import io
import math
import os
from typing import Any

import jax

from jaxhair.cost.measuring import BAR, Part, PhaseCost, SceneCost

COLUMNS = ("time", "of the whole", "operations", "temporaries", "compilation")
CSV_COLUMNS = (
    "phases",
    "part",
    "seconds_per_step",
    "operations_per_step",
    "temporary_bytes",
    "compile_seconds",
)


def title(cost: SceneCost) -> str:
    """The strands, the solver and the time step in a line."""
    scene = cost.scene
    return (
        f"{scene.strands.count} strands of {scene.strands.points} points, {scene.dtype}, "
        f"{type(scene.solver).__name__}, {round(1 / scene.dt)} steps a second"
    )


def machine() -> dict[str, Any]:
    """What the figures were measured on."""
    return {
        "jax": jax.__version__,
        "device": jax.devices()[0].device_kind,
        "cores": os.cpu_count(),
    }


def text(cost: SceneCost) -> str:
    """The table that the command prints."""
    here = machine()
    lines = [
        title(cost),
        f"jax {here['jax']}, {here['device']}, {here['cores']} cores; of one step, in loops of "
        f"{cost.measured_steps}, the fastest of up to {cost.repeat}",
    ]
    for phase in cost.phases:
        lines += ["", *_phase(phase, cost.scene.dt)]
    lines += [
        "",
        "Each program is compiled once: differences of some tenths of a second are noise.",
        f"The whole scene: {cost.scene.duration:g} s take {cost.seconds:.3g} s, "
        f"{cost.times_real_time:.3g} times real time",
    ]
    return "\n".join(lines)


def _phase(phase: PhaseCost, dt: float) -> list[str]:
    whole = phase.whole
    sums = Part("sum", phase.total_seconds, phase.total_operations, None, math.nan)
    shown = (*phase.parts, sums, shared(phase), whole, *phase.derivatives)
    rows: list[tuple[str, ...]] = [("", *COLUMNS), *(_row(part, whole) for part in shown)]
    if phase.first:
        of_rest = {part.name: _percent(part.seconds / phase.rest) for part in phase.parts}
        of_rest |= {"": f"without {phase.first}", phase.first: ""}
        rows = [(*row[:3], of_rest.get(row[0], ""), *row[3:]) for row in rows]
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    lines = [f"{', '.join(phase.phases)} ({phase.steps} steps)"]
    for row in rows:
        cells = zip(row[1:], widths[1:], strict=True)
        line = "  ".join((row[0].ljust(widths[0]), *(cell.rjust(width) for cell, width in cells)))
        lines.append("  " + line.rstrip())
    if phase.first:
        lines.append(
            f"  {phase.first} makes more than half of the operations: all others are measured "
            f"without it, in a step of {_micro(phase.rest)}"
        )
    lines += [
        f"  noise {_micro(phase.noise)}; {adding_up(phase)}",
        f"  {1 / whole.seconds:.4g} steps a second, {dt / whole.seconds:.3g} times real time",
    ]
    return lines


def adding_up(phase: PhaseCost) -> str:
    """How far the parts make up the measured whole, beside the bar."""
    found = f"the parts add up to {phase.share:.0%} of the whole"
    if phase.first:
        found += f" and, without {phase.first}, to {phase.share_of_rest:.0%}"
    allowed = f"{1 - BAR:.0%} to {1 + BAR:.0%}"
    return f"{found} ({'within' if phase.adds_up else 'NOT within'} {allowed})"


def shared(phase: PhaseCost) -> Part:
    """What the whole takes beyond the sum of its parts."""
    whole = phase.whole
    return Part(
        "shared or rounding",
        whole.seconds - phase.total_seconds,
        whole.operations - phase.total_operations,
        None,
        math.nan,
    )


def _row(part: Part, whole: Part) -> tuple[str, ...]:
    return (
        part.name,
        _micro(part.seconds),
        _percent(part.seconds / whole.seconds),
        "" if math.isnan(part.operations) else f"{part.operations:,.0f}",
        "" if part.memory is None else f"{part.memory / 1e3:,.1f} kB",
        "" if math.isnan(part.compile_seconds) else f"{round(part.compile_seconds, 1) + 0.0:.1f} s",
    )


def _micro(seconds: float) -> str:
    return f"{round(1e6 * seconds, 1) + 0.0:,.1f} us"  # + 0.0 because there is no -0.0 us


def _percent(share: float) -> str:
    return f"{round(100 * share, 1) + 0.0:.1f} %"


def as_json(cost: SceneCost) -> dict[str, Any]:
    """All figures, and what they were measured on and with."""
    scene = cost.scene
    return {
        "scene": {
            "strands": scene.strands.count,
            "points": scene.strands.points,
            "dtype": str(scene.dtype),
            "solver": str(scene.solver),
            "dt_s": scene.dt,
            "seconds": scene.duration,
        },
        "machine": machine(),
        "measured_steps": cost.measured_steps,
        "repeat": cost.repeat,
        "phases": [_phase_json(phase, scene.dt) for phase in cost.phases],
        "wall_seconds": cost.seconds,
        "times_real_time": cost.times_real_time,
    }


def _phase_json(phase: PhaseCost, dt: float) -> dict[str, Any]:
    return {
        "phases": list(phase.phases),
        "steps": phase.steps,
        "parts": [_part_json(part) for part in phase.parts],
        "shared_or_rounding": _part_json(shared(phase)),
        "whole": _part_json(phase.whole),
        "derivatives": [_part_json(part) for part in phase.derivatives],
        "measured_first": phase.first or None,
        "seconds_without_first": phase.rest,
        "noise_seconds": phase.noise,
        "sum_over_whole": phase.share,
        "sum_over_whole_without_first": phase.share_of_rest,
        "adds_up": phase.adds_up,
        "times_real_time": dt / phase.whole.seconds,
    }


def _part_json(part: Part) -> dict[str, Any]:
    return {
        "name": part.name,
        "seconds": part.seconds,
        "operations": None if math.isnan(part.operations) else part.operations,
        "temporary_bytes": part.memory,
        "compile_seconds": None if math.isnan(part.compile_seconds) else part.compile_seconds,
    }


def as_csv(cost: SceneCost) -> str:
    """One line for each part of each phase, and for the whole."""
    made = io.StringIO(newline="")
    writer = csv.writer(made, lineterminator="\n")
    writer.writerow(CSV_COLUMNS)
    for phase in cost.phases:
        for part in (*phase.parts, shared(phase), phase.whole, *phase.derivatives):
            cells = ["" if x is None else x for x in _part_json(part).values()]
            writer.writerow((", ".join(phase.phases), *cells))
    return made.getvalue()
