"""Every hard case, for every solver in both precisions: values over a second, and derivatives.

One compiled program serves all cases of one kind, so tests of a solver and precision belong in one
process: run with `--dist loadgroup`.
"""

from pathlib import Path

import jax
import numpy as np
import pytest
from mechanics import stretch

from hard_cases import contact, forces, geometry, materials, running, table
from hard_cases.catalogue import CASES, SOLVERS, Setting

CENTRAL = {"direct": (1e-9, 1e-4)}  # step, and largest difference relative to its terms
CENTRAL_ELSE = 1e-6, 1e-6
FINER = {"float32": 1.0, "float64": 1e-5}
ROUNDING = 1e-4  # between modes, direct, float64: at rest a bound's slope is rounding over rounding
UNIT = 1e-5  # of quaternions
RANGE = 1e-6  # of fractions
SHAPE = 1 + 1e-4  # of remembered shapes' norms

assert {contact, forces, geometry, materials}  # imported for the cases that they list


def kinds() -> dict[str, int]:
    """A number for each case: the same for cases that share a compiled program."""
    setting, seen, found = Setting("direct", "float64"), [], {}
    for name, case in CASES.items():
        leaves, structure = jax.tree.flatten(running.arrays(case.start(setting)))
        kind = structure, [np.shape(x) for x in leaves], case.within(setting).slopes
        if kind not in seen:
            seen.append(kind)
        found[name] = seen.index(kind)
    return found


KINDS = kinds()


def settings(*turns: tuple[str, ...], later: tuple[str, ...] = ()) -> list[object]:
    """All cases for each "solver-precision", each of these in a process.

    Arguments:
        turns: each kind of case has one of these sets of settings, and the next kind the next one;
            the others in the slow run. later: only in the slow run, for all.
    """

    def marks(setting: str, name: str) -> list[pytest.MarkDecorator]:
        slow = setting not in turns[KINDS[name] % len(turns)]
        return [pytest.mark.xdist_group(setting), *([pytest.mark.slow] if slow else [])]

    each = dict.fromkeys(setting for turn in (*turns, later) for setting in turn)
    return [
        pytest.param(
            name,
            Setting(*setting.split("-")),
            id=f"{setting}-{name}",
            marks=marks(setting, name),
        )
        for setting in each
        for name in CASES
    ]


@pytest.mark.parametrize(
    ("name", "setting"),
    settings(
        ("direct-float32", "sequential-float32"),
        ("paper-float32", "compliant-float32"),
        later=tuple(f"{solver}-float64" for solver in SOLVERS),
    ),
)
def test_values(name: str, setting: Setting) -> None:
    """All finite, and within the case's bounds; quaternions unit at every step."""
    case = CASES[name].within(setting)
    start = case.start(setting)
    end, most = running.run(start, case.steps)
    for leaf in jax.tree.leaves(end):
        assert np.all(np.isfinite(leaf))
    assert most.quaternion <= UNIT
    assert most.fraction <= RANGE
    assert most.shape <= SHAPE
    assert most.speed <= case.speed
    assert np.max(np.abs(end.velocities)) <= case.end_speed
    assert stretch(end, start.scene.strands) <= case.stretch
    if case.check is not None:
        case.check(start, end)


@pytest.mark.parametrize(
    ("name", "setting"),
    settings(
        ("paper-float64",),
        ("direct-float64",),
        later=("compliant-float64", "direct-float32", "paper-float32", "compliant-float32"),
    ),
)
def test_derivatives(name: str, setting: Setting) -> None:
    """Finite in every number of scene and state; both modes agree; so do central differences
    where the case is smooth."""
    case = CASES[name].within(setting)
    at = running.arrays(case.start(setting))
    along = running.direction(at, case.fixed)
    _, forward = running.along(at, along, case.slopes)
    gradient = running.gradient(at, case.slopes)
    for path, leaf in jax.tree_util.tree_leaves_with_path(gradient):
        assert np.all(np.isfinite(leaf)), jax.tree_util.keystr(path)
    reverse, terms = running.product(gradient, along)
    between_modes = case.modes * FINER[setting.dtype]
    if setting.solver == "direct":
        between_modes = max(between_modes, ROUNDING)
    assert abs(float(forward) - reverse) <= between_modes * terms
    if setting.dtype == "float64" and case.smooth is True:
        h, tolerance = CENTRAL.get(setting.solver, CENTRAL_ELSE)
        above, below = (
            float(running.along(running.shifted(at, along, d), along, case.slopes)[0])
            for d in (h, -h)
        )
        assert abs((above - below) / (2 * h) - float(forward)) <= tolerance * terms


def test_the_table_is_current() -> None:
    """`python -m hard_cases.table`, run in tests/, writes it."""
    written = Path(table.__file__).with_name("README.md").read_text(encoding="utf-8")
    assert written == table.text()
