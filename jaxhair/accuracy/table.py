"""Measured settings as a table in a .csv file, the cheapest of them, and what the table says."""

import csv
import io
import json
import math
import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxhair import check
from jaxhair.accuracy.grid import COUNTS, SOLVERS, WEIGHTS, Setting, expression
from jaxhair.accuracy.measuring import Cost, Row
from jaxhair.arrays import contents, reason
from jaxhair.output import new_file
from jaxhair.solvers import Solver

PACKAGED = Path(__file__).parent.parent / "data" / "accuracy.csv"
"""Measured on 2 cores of the machine that the file beside it, accuracy.json, describes."""

SETTING_COLUMNS = (
    "solver",
    "iterations",
    "newton_steps",
    "substeps",
    "orientation_weight",
    "frame_inertia",
    "points",
    "steps_per_second",
    "dtype",
    "turned",
)
COST_COLUMNS = (
    "status",
    "error_relative",
    "seconds_per_simulated_second",
    "compile_seconds",
    "memory_bytes",
)
COLUMNS = (*SETTING_COLUMNS, *COST_COLUMNS, *(f"gradient_{name}" for name in COST_COLUMNS))
"""Of the table. Errors are over a strand's length, those of gradients over the gradient's norm."""

WANTED = (0.1, 0.03, 0.01, 0.003, 0.001)
"""Errors for which the command prints the cheapest settings."""

WANTED_OF_GRADIENTS = (0.3, 0.1, 0.05, 0.02)
"""The same for errors of gradients, which are larger."""


@dataclass(frozen=True)
class Choice:
    """The cheapest measured settings for an error.

    Arguments:
        solver, points, dt [s], dtype: to build a scene with.
        error: that was measured, over the strand's length, or over the norm of the gradient.
        seconds_per_second: wall time per simulated second, of the strands that were measured.
        memory: of the program [bytes], or None where it is not known.
        gradient: error, time and memory are those of the gradient.
    """

    solver: Solver
    points: int
    dt: float
    dtype: str
    error: float
    seconds_per_second: float
    memory: int | None
    gradient: bool = False

    def __str__(self) -> str:
        of = "of the gradient" if self.gradient else "of the length"
        return (
            f"{expression(self.solver)}, {self.points} points, dt = 1/{round(1 / self.dt)} s, "
            f"{self.dtype}: error {self.error:.2%} {of}, "
            f"{self.seconds_per_second:.3g} s a simulated second"
        )


def cheapest(
    error: float,
    *,
    table: str | os.PathLike[str] | None = None,
    points: int | None = None,
    dtype: str | None = None,
    gradient: bool = False,
) -> Choice:
    """The cheapest measured settings whose error is at most the wanted one.

    Errors are those of a perm half a second after its release, against a fine reference; see
    `python -m jaxhair accuracy --help`. Another scene has other errors, in a like order.

    Arguments:
        error: wanted, over the strand's length; 0.01 is one per cent.
        table: an accuracy.csv that the command wrote; the one that comes with the package if None.
        points, dtype: only settings with these are looked at.
        gradient: the error, over its norm, and the time are those of a reverse-mode gradient.

    Raises ValueError where no setting reaches the error; it says what the best one is.
    """
    check.positive("error", error)
    if points is not None:
        check.whole("points", points, least=2)
    if dtype is not None:
        check.choice("dtype", dtype, ("float32", "float64"))
    check.flag("gradient", gradient)
    rows = read(PACKAGED if table is None else table)
    fitting = [
        row
        for row in rows
        if points in (None, row.setting.points) and dtype in (None, row.setting.dtype)
    ]
    found = best(fitting, error, gradient=gradient)
    if found is None:
        reached = [c.error for r in fitting if (c := r.cost(gradient)) is not None and c.ok]
        with_these = "" if points is None and dtype is None else " with these points and dtype"
        known = f"at least {min(reached):.3g}, the best measured" if reached else "another: none is"
        known += "" if reached else " measured"
        raise ValueError(f"error is {error:g}; it must be {known}{with_these}")
    cost = found.cost(gradient)
    assert cost is not None
    setting = found.setting
    return Choice(
        setting.solver,
        setting.points,
        1 / setting.steps_per_second,
        setting.dtype,
        cost.error,
        cost.seconds_per_second,
        cost.memory,
        gradient,
    )


def best(rows: Iterable[Row], error: float, *, gradient: bool) -> Row | None:
    """The row of least time whose error is at most the given one, or None."""
    fitting = [r for r in rows if (c := r.cost(gradient)) is not None and c.ok and c.error <= error]
    return min(fitting, key=lambda row: _time(row, gradient), default=None)


def pareto(rows: Iterable[Row], *, gradient: bool) -> list[Row]:
    """The rows than which no other is both cheaper and better, from the cheapest on."""
    front: list[Row] = []
    fine = [r for r in rows if (c := r.cost(gradient)) is not None and c.ok]
    least = math.inf
    for row in sorted(fine, key=lambda r: (_time(r, gradient), _error(r, gradient))):
        if _error(row, gradient) < least:
            front.append(row)
            least = _error(row, gradient)
    return front


def _time(row: Row, gradient: bool) -> float:
    cost = row.cost(gradient)
    return math.inf if cost is None else cost.seconds_per_second


def _error(row: Row, gradient: bool) -> float:
    cost = row.cost(gradient)
    return math.inf if cost is None else cost.error


def recommended(rows: Sequence[Row], *, gradient: bool) -> str:
    """The cheapest settings for each error of `WANTED`, as an aligned table."""
    head = ("wanted", "reached", "solver", "points", "steps/s", "dtype", "s per s", "memory")
    lines: list[tuple[str, ...]] = [head]
    for error in WANTED_OF_GRADIENTS if gradient else WANTED:
        row = best(rows, error, gradient=gradient)
        cost = None if row is None else row.cost(gradient)
        if row is None or cost is None:
            lines.append((f"{error:.1%}", "-", "none reaches it", *[""] * 5))
            continue
        s = row.setting
        lines.append(
            (
                f"{error:.1%}",
                f"{cost.error:.2%}",
                expression(s.solver),
                str(s.points),
                str(s.steps_per_second),
                s.dtype,
                f"{cost.seconds_per_second:.3g}",
                "" if cost.memory is None else f"{cost.memory / 1e6:.2f} MB",
            )
        )
    widths = [max(len(line[i]) for line in lines) for i in range(len(head))]
    left = (2, 5)  # columns of texts
    return "\n".join(
        "  ".join(
            cell.ljust(width) if i in left else cell.rjust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )


def write(path: Path, rows: Sequence[Row], *, overwrite: bool) -> None:
    """Rows as a .csv file with `COLUMNS`; what does not apply or is not known is empty."""
    with (
        new_file(path, overwrite=overwrite) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as file,
    ):
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows(_cells(row) for row in rows)


def write_json(path: Path, content: Any, *, overwrite: bool) -> None:
    """Content as a .json file."""
    with new_file(path, overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(content, indent=2) + "\n", encoding="utf-8")


def as_json(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Rows as plain data by `COLUMNS`; what does not apply or is not known is None."""
    return [
        {name: _plain(cell) for name, cell in zip(COLUMNS, _cells(row), strict=True)}
        for row in rows
    ]


def _plain(cell: Any) -> Any:
    """A cell as JSON has it: numbers are not texts."""
    if not isinstance(cell, str):
        return cell
    try:
        number = float(cell)
    except ValueError:
        return cell or None
    return number if math.isfinite(number) else None


def _cells(row: Row) -> list[Any]:
    solver: Any = row.setting.solver
    costs: list[Any] = []
    for cost in (row.forward, row.gradient):
        if cost is None:
            costs += [""] * len(COST_COLUMNS)
        else:
            numbers = (cost.error, cost.seconds_per_second, cost.compile_seconds)
            costs += [cost.status, *(f"{x:.6g}" for x in numbers)]
            costs.append("" if cost.memory is None else cost.memory)
    return [
        type(solver).__name__,
        *(getattr(solver, name, "") for name in (*COUNTS, *WEIGHTS)),
        row.setting.points,
        row.setting.steps_per_second,
        row.setting.dtype,
        row.setting.turned,
        *costs,
    ]


def read(path: str | os.PathLike[str]) -> list[Row]:
    """Rows of a .csv file that `write` wrote.

    Raises ValueError naming the file, and the line, where it is none; OSError.
    """
    data = contents(check.path("table", path))
    as_written = "as python -m jaxhair accuracy writes it"
    try:
        reader = csv.DictReader(io.StringIO(data.decode("utf-8"), newline=""), strict=True)
        missing = [name for name in COLUMNS if name not in (reader.fieldnames or ())]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{path}: {error}; it must be an accuracy.csv, {as_written}") from error
    if missing:
        raise ValueError(
            f"{path} has no column {missing[0]!r}; it must be an accuracy.csv, {as_written}"
        )
    try:
        return [_row(line) for line in reader]
    except (KeyError, TypeError, ValueError, OverflowError, csv.Error) as error:
        raise ValueError(
            f"{path}, line {reader.line_num}: {reason(error)}; it must be a row {as_written}"
        ) from error


def _row(cells: dict[str, str]) -> Row:
    check.choice("solver", cells["solver"], tuple(SOLVERS))
    chosen: dict[str, Any] = {name: int(cells[name]) for name in COUNTS if cells[name]}
    chosen |= {name: float(cells[name]) for name in WEIGHTS if cells[name]}
    setting = Setting(
        SOLVERS[cells["solver"]](**chosen),
        int(cells["points"]),
        int(cells["steps_per_second"]),
        cells["dtype"],
        cells["turned"],
        gradient=bool(cells["gradient_status"]),
    )
    forward = _read_cost(cells, "")
    assert forward is not None
    return Row(setting, forward, _read_cost(cells, "gradient_"))


def _read_cost(cells: dict[str, str], prefix: str) -> Cost | None:
    status, *numbers, memory = (cells[prefix + name] for name in COST_COLUMNS)
    if not status and prefix:
        return None
    check.choice(f"{prefix}status", status, ("ok", "failed"))
    error, seconds, compiled = (float(x) for x in numbers)
    return Cost(status, error, seconds, compiled, int(memory) if memory else None)
