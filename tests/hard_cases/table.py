"""Writes README.md, the table of all hard cases: `python -m hard_cases.table`, run in tests/."""

from pathlib import Path

from hard_cases import contact, forces, geometry, materials
from hard_cases.catalogue import CASES, Case

PARTS = {
    "Shape": geometry,
    "Fibre and bonds": materials,
    "Wind, weight, motion, time": forces,
    "Contact": contact,
}

INTRODUCTION = """# Hard cases

Each is run by `test_hard_cases.py` for `PositionBased` (both sweeps), `Compliant` and `Direct`, in
float32 and float64, over 360 steps (a second) unless said otherwise. In all of them every value
stays finite; at every step quaternions have norm 1 to 1e-5, bonded fractions lie in [0, 1] to
1e-6, remembered shapes have a norm of at most 1, and no free point is faster than the bound given
here, which keeps the energy bounded; at the end no edge is longer or shorter than its rest length
by more than the share given here. Derivatives of the state after 8 steps in every number of scene
and state are finite in forward and in reverse mode and the same in both; and where the case is
smooth they are those of central differences.

This table is made from the cases: `python -m hard_cases.table`, run in `tests/`.
"""


def text() -> str:
    """The whole page."""
    parts = [INTRODUCTION]
    for title, module in PARTS.items():
        parts.append(
            f"\n## {title}\n\n| case | what could break | speed below | stretch below | and |\n"
        )
        parts.append("| --- | --- | --- | --- | --- |\n")
        parts += [_row(case) for case in CASES.values() if case.build.__module__ == module.__name__]
    return "".join(parts)


def _row(case: Case) -> str:
    notes = [case.holds] if case.holds else []
    if case.end_speed < 1e3:
        notes.append(f"at the end below {case.end_speed:g} m/s")
    if case.steps != 360:
        notes.append(f"{case.steps} steps")
    if case.smooth is not True:
        notes.append(f"not smooth: {case.smooth}")
    if case.fixed:
        notes.append(f"not varied: {', '.join(case.fixed)}")
    reasons: dict[str, list[str]] = {}
    for solver, own in case.except_for.items():
        bounds = ", ".join(f"{k} {v}" for k, v in own.items() if k != "why")
        reasons.setdefault(f"{bounds}: {own['why']}", []).append(solver)
    notes += [f"{', '.join(solvers)}: {why}" for why, solvers in reasons.items()]
    name = case.name.replace("_", " ")
    return (
        f"| {name} | {case.breaks} | {case.speed:g} m/s | {case.stretch:g} | {'; '.join(notes)} |\n"
    )


if __name__ == "__main__":
    Path(__file__).with_name("README.md").write_text(text(), encoding="utf-8")
