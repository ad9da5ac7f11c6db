"""Published perms, predicted: `python -m fitting published --output DIR`.

For nine perm lotions the literature gives two moduli, in % of the intact hair's in water: E_re
after reduction and E_ro after re-oxidation, and the set that the same hair took. The moduli
say how many bonds a lotion cuts and how many re-form; with these the simulator predicts the set.

1. Fit. Bonds are springs in parallel (`jaxhair.bonds.springs`), so a hair with the fractions b_j
   bonded has the share sum_j f_j b_j / sum_j f_j of its stiffness. For each lotion the covalent
   fractions b_re and b_ro with which the share, over that of intact wet hair, is nearest to
   E_re and E_ro.
2. Simulation. Straight hair is wound on a rod, cut to b_re and re-formed to b_ro there, released
   without weight, and moves until it rests.
3. Set = rod diameter / diameter of the curl that the points then make.

Two parallel networks give the set 1 - E_re / E_ro, which the tests hold this against and which
nothing here uses. No set is fitted: the measured ones are only compared. Two moduli give two
fractions exactly, so what is tested is that bonds which re-form are free of stress and that both
networks add up; how much a lotion cuts is taken from the experiment, not foretold.

What is assumed:

- Set and moduli are measured in water, so hydrogen and ionic bonds are cut from the start and
  hold nothing. In truth some ionic bonds last in neutral water.
- One covalent network, here the disulfide bonds, carries all that wet hair has. The share that
  table 1 of the paper gives peptide bonds, 17 against 20, would leave 46 % of the modulus with
  all disulfide bonds cut; eight of the nine lotions leave less. The influences cancel: any others
  with none on peptide bonds give the same sets.
- The set was measured in extension and is predicted in bending. The model is linear and takes a
  hair's section as even, so the two are the same; reduction from the outside in would part them.
"""

import csv
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from scipy.optimize import least_squares

import jaxhair as jh
from fitting.measures import curl
from jaxhair.bonds import per_inner_point, springs
from jaxhair.output import new_file
from jaxhair.treatments import AT_ONCE

INFLUENCE = (0.33, 0.30, 0.37, 0.0)
"""f_j: table 1 of the paper, with the peptide bonds' share added to the disulfide bonds'."""

IN_WATER = (0.0, 0.0, 1.0, 1.0)
"""b_j of intact hair in water."""

ROD_DIAMETER, LENGTH, POINTS = 20e-3, 0.12, 25
"""Our choices [m, m, -], on which the set does not depend: it is a ratio of curvatures."""

REST = 3.0
"""Time in which released hair comes to rest [s]."""

UNREADABLE = "not predicted: E_ro could not be read"
SOURCE = "Journal of Cosmetic Science 66 (2015) 40, Table II: set in extension, 1.5 % strain"
FILES = ("published.json", "published.csv", "published.png")


@dataclass(frozen=True)
class Lotion:
    """A row of the data and what is made of it; None where it is not known.

    Arguments:
        e_re_percent, e_ro_percent: modulus after reduction and re-oxidation, of the intact hair's.
        set_measured_percent: of the same hair.
        cut_to, re_formed_to: covalent fractions b_re and b_ro in [0, 1], fitted.
        set_predicted_percent: read off the simulated curl.
    """

    lotion: str
    e_re_percent: float
    e_ro_percent: float | None = None
    set_measured_percent: float | None = None
    cut_to: float | None = None
    re_formed_to: float | None = None
    set_predicted_percent: float | None = None

    @property
    def difference(self) -> float | None:
        """Predicted less measured set [percentage points]."""
        if self.set_predicted_percent is None or self.set_measured_percent is None:
            return None
        return self.set_predicted_percent - self.set_measured_percent

    def row(self) -> dict[str, Any]:
        """All of it as plain data, to the digits that single precision has."""
        note = UNREADABLE if self.e_ro_percent is None else ""
        row = {**asdict(self), "difference_points": self.difference, "note": note}
        return {k: round(v, 5) if isinstance(v, float) else v for k, v in row.items()}


def lotions() -> list[Lotion]:
    """The packaged data, see data/perm_set.csv for their source."""
    lines = files("fitting").joinpath("data/perm_set.csv").read_text(encoding="utf-8").splitlines()
    keys = ("E_re_percent", "E_ro_percent", "set_measured_percent")
    return [
        Lotion(row["lotion"], **{k.lower(): float(row[k]) for k in keys if row[k]})
        for row in csv.DictReader(line for line in lines if not line.startswith("#"))
    ]


@jax.jit
def modulus(covalent: Array, influence: Any = INFLUENCE) -> Array:
    """E / E_intact in water [%] of hairs with the disulfide fractions given, shape (hairs,)."""
    f, straight = per_inner_point(influence), jnp.zeros((1, 4, 3, covalent.size))
    intact = jnp.broadcast_to(per_inner_point(IN_WATER), (1, 4, covalent.size))
    left = intact.at[:, jh.BONDS.index("disulfide")].set(covalent)
    share, whole = (springs(straight, b, f)[1][0, 0] for b in (left, intact))
    return 100 * share / whole


_slope = jax.jit(jax.jacobian(modulus))


def fitted(moduli: Sequence[float], influence: Any = INFLUENCE) -> list[float]:
    """Disulfide fractions in [0, 1] whose `modulus` [%] is nearest to those given."""

    def off(b: np.ndarray) -> np.ndarray:
        return np.asarray(modulus(jnp.asarray(b), influence), float) - moduli

    def slope(b: np.ndarray) -> np.ndarray:
        return np.asarray(_slope(jnp.asarray(b), influence), float)

    start = np.full(len(moduli), 0.5)
    return np.asarray(least_squares(off, start, jac=slope, bounds=(0, 1)).x).tolist()


def experiment(cut_to: float, re_formed_to: float, influence: Any = INFLUENCE) -> jh.Scene:
    """The perm as a scene: one hair in water, wound, reduced, re-oxidised and released."""
    rod = jh.Wound(ROD_DIAMETER)  # each turn lies on the one before: curls stay in a plane
    return jh.Scene(
        jh.Strands.straight([[0, 0, 0]], (0, 0, -1), length=LENGTH, points=POINTS),
        bonds=jh.Bonds(influence, IN_WATER),
        phases=(
            jh.Phase("reduced", AT_ONCE, (rod, jh.Cut(disulfide=cut_to))),
            jh.Phase("re-oxidised", AT_ONCE, (rod, jh.Reform(disulfide=re_formed_to))),
            jh.Phase("released", REST, (jh.Hold(), jh.Drag(0.1))),
        ),
        solver=jh.Direct(),
    )


@jax.jit
@jax.vmap
def _released(scene: jh.Scene) -> Array:
    """The hair at rest [m], shape (scenes, points, 3): one program for all scenes."""
    return jh.run(scene)["released"].points[0]


def simulated_sets(scenes: Sequence[jh.Scene]) -> np.ndarray:
    """The sets [%] that the hairs of `experiment` show, from their points, shape (scenes,).

    A curl in a plane is a circle, whose diameter is 2 / curvature. (The diameter of a helix would
    say the same, but of hair without set it would be rounding over rounding.)
    """
    arrays = [scene.as_arrays() for scene in scenes]
    points = _released(jax.tree.map(lambda *leaves: np.stack(leaves), *arrays))
    return 100 * ROD_DIAMETER * np.asarray(curl(points).curvature, float) / 2


def predictions(rows: Sequence[Lotion], influence: Any = INFLUENCE) -> list[Lotion]:
    """The lotions with their fractions and, where both moduli are known, the simulated set."""
    moduli = [[e for e in (b.e_re_percent, b.e_ro_percent) if e is not None] for b in rows]
    fractions = [fitted(known, influence) for known in moduli]
    scenes = [experiment(b[0], b[1], influence) for b in fractions if len(b) == 2]
    sets = iter(simulated_sets(scenes).tolist())
    return [
        replace(row, cut_to=b[0], re_formed_to=b[1], set_predicted_percent=next(sets))
        if len(b) == 2
        else replace(row, cut_to=b[0])
        for row, b in zip(rows, fractions, strict=True)
    ]


def summary(made: Sequence[Lotion]) -> dict[str, float]:
    """How far off the predicted sets are [percentage points], and their correlation."""
    predicted, measured = _sets(made)
    off = predicted - measured
    return {
        "root_mean_square_difference_points": float(np.sqrt(np.mean(off**2))),
        "mean_difference_points": float(np.mean(off)),
        "largest_difference_points": float(np.max(np.abs(off))),
        "correlation": float(np.corrcoef(predicted, measured)[0, 1]),
    }


def _sets(made: Sequence[Lotion]) -> np.ndarray:
    """Predicted and measured sets [%] of the lotions that have both, shape (2, lotions)."""
    known = [b for b in made if b.difference is not None]
    return np.array([(b.set_predicted_percent, b.set_measured_percent) for b in known], float).T


def table(made: Sequence[Lotion]) -> str:
    """Lotions, fractions and sets as text."""
    heads = ("E_re %", "E_ro %", "cut to", "re-formed", "predicted %", "measured %", "difference")
    forms = (".1f", ".1f", ".3f", ".3f", ".1f", ".1f", "+.1f")
    lines = ["lotion" + "".join(f"{head:>12}" for head in heads)]
    for b in made:
        values: tuple[float | None, ...]
        values = (b.e_re_percent, b.e_ro_percent, b.cut_to, b.re_formed_to)
        if b.set_predicted_percent is not None:
            values += (b.set_predicted_percent, b.set_measured_percent, b.difference)
        pairs = zip(values, forms, strict=False)
        cells = ("-" if value is None else format(value, form) for value, form in pairs)
        row = "".join(f"{cell:>12}" for cell in cells)
        lines.append(f"{b.lotion:<6}{row}   {b.row()['note']}".rstrip())
    rms, mean, largest, correlation = summary(made).values()
    off = f"root mean square {rms:.2f} points, mean {mean:+.2f}, largest {largest:.2f}"
    return "\n".join([*lines, "", f"difference: {off}; correlation {correlation:.4f}"])


def write(made: Sequence[Lotion], folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Writes `FILES` into a folder that exists, and returns those written.

    The picture needs the extra `pictures`; without it the rest is written.
    """
    report, sheet, image = paths = [folder / name for name in FILES]
    rows = [b.row() for b in made]
    whole = {
        "source": SOURCE,
        "influence": dict(zip(jh.BONDS, INFLUENCE, strict=True)),
        "fractions_in_water": dict(zip(jh.BONDS, IN_WATER, strict=True)),
        "lotions": rows,
        **summary(made),
    }
    with new_file(report, overwrite=overwrite) as temporary:
        temporary.write_text(json.dumps(whole, indent=2) + "\n", encoding="utf-8")
    with (
        new_file(sheet, overwrite=overwrite) as temporary,
        temporary.open("w", encoding="utf-8", newline="") as stream,
    ):
        writer = csv.DictWriter(stream, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    try:
        picture(image, made, overwrite=overwrite)
    except ImportError as error:
        print(f"no picture: {error}", file=sys.stderr)
        paths.remove(image)
    return paths


def picture(path: Path, made: Sequence[Lotion], *, overwrite: bool = False) -> None:
    """Draws measured against predicted sets, and below by how much they differ (.png)."""
    from jaxhair.figures import FITTED_COLOR, figure

    x, y = _sets(made)
    names = [b.lotion for b in made if b.difference is not None]
    rms, _, _, correlation = summary(made).values()
    drawing, _ = figure(6.4, 8.2, dpi=150, layout="constrained")
    drawing.suptitle("Set of perm lotions: simulated against measured", fontweight="bold")
    top, below = drawing.subplots(2, 1, sharex=True, height_ratios=(3.2, 1))
    ends = [min(50.0, x.min() - 2, y.min() - 2), 100.0]
    top.plot(ends, ends, color="0.6", linewidth=1, label="prediction = measurement")
    top.plot(x, y, "o", color=FITTED_COLOR, label="lotion (maker - strong, neutral or weak)")
    for number, i in enumerate(np.argsort(x)):  # on either side, so that names do not meet
        side = -1 if number % 2 == 0 else 1
        place, align = (9 * side, -7 * side), "right" if side < 0 else "left"
        top.annotate(names[i], (x[i], y[i]), place, textcoords="offset points", ha=align,
                     va="center")  # fmt: skip
    said = f"root mean square difference {rms:.1f} points\ncorrelation {correlation:.3f}"
    missing = [b.lotion for b in made if b.set_predicted_percent is None]
    said += f"\n{', '.join(missing)} {UNREADABLE}" if missing else ""
    top.text(0.97, 0.04, said, transform=top.transAxes, ha="right", linespacing=1.5)
    top.set(ylabel="measured set [%]", xlim=ends, ylim=ends)
    top.legend(loc="upper left", frameon=False)
    below.axhline(0, color="0.6", linewidth=1)
    below.vlines(x, 0, x - y, color=FITTED_COLOR, alpha=0.5)
    below.plot(x, x - y, "o", color=FITTED_COLOR)
    below.set_xlabel("predicted set: rod diameter / curl diameter [%]")
    below.set_ylabel("predicted - measured\n[percentage points]")
    for axes in (top, below):
        axes.grid(color="0.92")
        axes.set_axisbelow(True)
    with new_file(path, overwrite=overwrite) as temporary:
        drawing.savefig(temporary)
