"""Inverse design: the rod and the treatment that give a wanted curl.

    python -m fitting design --curl-diameter 25mm --output designed

A perm on a rod of diameter D_rod leaves a curl of diameter D_rod / S, where the set S is the
share of the bonds that formed on the rod. So a wanted curl asks for one of many pairs of rod and
treatment. The treatment of the request is kept where some rod goes with it; where none does, more
or fewer disulfide bonds are cut; and where that does not do either, the wish is refused with the
nearest curl that can be had.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting import measures
from fitting.constraints import Constraint, Interval
from fitting.curls import Curl
from fitting.fit import Fit, fit
from jaxhair import (
    Bonds,
    Direct,
    Drag,
    Gravity,
    Hold,
    PhysicalFibre,
    PositionBased,
    Scene,
    Strands,
    check,
    named_leaves,
    replace_leaves,
    run,
    treatments,
)
from jaxhair.scene import matching

RODS = (3e-3, 0.1)
"""Diameters of the thinnest and the thickest perm rod [m]."""

CUT = (0.0, 0.98)
"""Fractions of disulfide bonds that a perm may leave."""

EXACT = 1e-3
"""Relative error at which a wish counts as met."""

EDGES_PER_CURL = 8.0
"""Curl diameters are so many edges, 25 points a turn."""

LEAST_EDGES = 48
"""Of the hair, where curls are so wide that few edges would do for them."""

HAIR_ERRORS = {"bonds.influence": 0.1, "fibre.young_modulus": 0.1, "fibre.shear_modulus": 0.1}
"""Relative standard errors of what is not well known of a hair, and in which answers are told."""

ROD, LEFT, CLIMB = "phases.*.Wound.diameter", "phases.*.Cut.disulfide", "phases.*.Wound.climb"


class Unreachable(ValueError):
    """No rod and treatment give the curl; `nearest` is the nearest diameter that they give [m]."""

    def __init__(self, message: str, nearest: float) -> None:
        super().__init__(message)
        self.nearest = nearest


@dataclass(frozen=True)
class Wish:
    """A curl to design.

    Arguments:
        curl_diameter: [m]. length: of the hair [m]. waves: turns, or None for any.
        after_wash: the curl is that after a first wash, when water has taken what hydrogen bonds
            held; else that after the perm.
        weight: the hair hangs under its weight; else it lies free of it.
        disulfide_left: fraction of disulfide bonds that the perm leaves, where a rod goes with it.
        influence: f_j of the hair, as `fitting.fit` finds them; table 1 of the paper if not given.

    Raises ValueError for numbers not above 0.
    """

    curl_diameter: float
    length: float = 0.2
    waves: float | None = None
    after_wash: bool = False
    weight: bool = False
    disulfide_left: float = 0.8
    influence: tuple[float, ...] = (0.33, 0.30, 0.20, 0.17)

    def __post_init__(self) -> None:
        check.positive("curl_diameter", self.curl_diameter)
        check.positive("length", self.length)
        if self.waves is not None:
            check.positive("waves", self.waves)
        check.flag("after_wash", self.after_wash)
        check.flag("weight", self.weight)
        check.fraction("disulfide_left", self.disulfide_left)
        check.shape("influence", self.influence, (4,))
        least = math.pi * self.curl_diameter / 2
        if self.length < least:
            raise ValueError(
                f"length is {self.length}; for a curl of {self.curl_diameter} m it must be at "
                f"least half a turn, {least:.3g} m"
            )
        if self.waves is not None and self.waves * math.pi * self.curl_diameter > self.length:
            most = self.length / (math.pi * self.curl_diameter)
            raise ValueError(
                f"waves is {self.waves}; in {self.length} m of hair with curls of "
                f"{self.curl_diameter} m it must be at most {most:.3g}"
            )

    @property
    def state(self) -> str:
        """The phase at whose end the curl is looked at."""
        return "washed" if self.after_wash else "perm"

    def scene(self, *, finer: bool = False) -> Scene:
        """The treatment of one strand; `finer`: with twice the points, a third of the time step,
        and uncoiling from the rod in place of taking the shape free of stress at once."""
        edge = min(self.curl_diameter / EDGES_PER_CURL, self.length / LEAST_EDGES)
        edge = edge / 2 if finer else edge
        points = int(np.clip(math.ceil(self.length / edge) + 1, 9, 258 if finer else 129))
        hair = Strands.straight(
            np.zeros((1, 3)), (0.0, 0.0, -1.0), length=self.length, points=points
        )
        fibre = PhysicalFibre()
        # the slowest swing, of a straight hair held at one end, is damped as fast as can be
        swing = float(
            self.length**2
            * np.sqrt(fibre.density * fibre.area / fibre.bending_stiffness[0])
            / 3.516
        )
        free: tuple[Any, ...] = (Hold(), Drag(swing / 2))
        if self.weight:
            free = (Hold(), Gravity(), Drag(swing / 2))
        resting = 8 * swing if self.weight or finer else treatments.AT_ONCE
        options: dict[str, Any] = {"free": free, "seconds": resting, "unload": not finer}
        rod = float(np.clip(self.curl_diameter / 1.5, 1.01 * RODS[0], 0.99 * RODS[1]))
        phases = treatments.perm(
            rod_diameter=rod, climb=0.15, disulfide_left=self.disulfide_left, **options
        )
        if self.after_wash:
            phases += treatments.wash(**options)
        return Scene(
            hair,
            fibre,
            Bonds(self.influence),
            phases,
            Direct(newton_steps=2 if finer else 1) if self.weight or finer else PositionBased(),
            dt=1 / 360 if finer else 1 / 120,
        )


@dataclass(frozen=True)
class Design:
    """What to use for a wanted curl.

    Arguments:
        wish: that was designed for.
        rod_diameter: [m]. disulfide_left: fraction of disulfide bonds to leave.
        climb: of the winding on the rod [rad].
        curl_diameter, waves: of the curl that they give in the simulation of the design.
        finer_curl_diameter: the same simulated afresh and finer, see `Wish.scene`; NaN before.
        met: whether the wish is met. unmet: what is not, in words.
        sensitivities: change of the rod that keeps the curl, for a standard error in what is not
            well known [m], by the number's name.
        fit: that found it.
    """

    wish: Wish
    rod_diameter: float
    disulfide_left: float
    climb: float
    curl_diameter: float
    waves: float
    finer_curl_diameter: float
    met: bool
    unmet: tuple[str, ...]
    sensitivities: dict[str, float]
    fit: Fit = field(repr=False)

    @property
    def rod_error(self) -> float:
        """Standard error of the rod diameter from all that is not well known [m]."""
        return float(np.sqrt(sum(value**2 for value in self.sensitivities.values())))


def design(
    wish: Wish,
    *,
    verify: bool = True,
    progress: Callable[[int, str], None] = lambda done, doing: None,
) -> Design:
    """The rod, and where it must be another, the treatment that give a wanted curl.

    Arguments:
        verify: simulate the design afresh and finer, which takes longer than to find it.
        progress: called with how many of 4 stages are done and what is done next.

    Raises Unreachable, with the nearest curl, where no rod of `RODS` and no treatment give it.
    """
    scene = wish.scene()
    wanted = {"diameter": (wish.curl_diameter, EXACT * wish.curl_diameter)}
    if wish.waves is not None:
        wanted["waves"] = (wish.waves, 10 * EXACT * wish.waves)
    target = {wish.state: Curl(**wanted)}
    free: dict[str, Constraint] = {ROD: Interval(*RODS)}
    if wish.waves is not None:
        free[CLIMB] = Interval(-1.2, 1.2)
    progress(0, "the rod")
    found = fit(scene, target, free, prior_width=30.0)
    if _off(found, wish) > 2 * EXACT:
        # another treatment; the fit starts from the nearest end of what rods can do
        progress(1, "another treatment")
        left = float(np.clip(wish.disulfide_left, CUT[0] + 0.01, CUT[1] - 0.01))
        scene = _with(scene, {LEFT: left, ROD: _value(found, ROD)})
        found = fit(scene, target, {**free, LEFT: Interval(*CUT)}, prior_width=30.0)
        if _off(found, wish) > 10 * EXACT:
            nearest = _curl(found, wish).diameter
            raise Unreachable(_refusal(wish, found, float(nearest[0])), float(nearest[0]))
    curl = _curl(found, wish)
    finer = math.nan
    if verify:
        progress(2, "a finer simulation")
        finer = _simulated_finer(wish, found)
    progress(3, "what uncertain hair changes")
    sensitivities = _sensitivities(found, wish)
    progress(4, "")
    waves = float(curl.waves[0])
    unmet = []
    if wish.waves is not None and abs(waves / wish.waves - 1) > 0.02:
        unmet.append(f"waves: {waves:.2f} in place of {wish.waves:g}")
    if verify and abs(finer / wish.curl_diameter - 1) > 0.03:
        unmet.append(f"simulated finer, the curl is {1e3 * finer:.1f} mm wide")
    return Design(
        wish=wish,
        rod_diameter=_value(found, ROD),
        disulfide_left=_value(found, LEFT),
        climb=_value(found, CLIMB),
        curl_diameter=float(curl.diameter[0]),
        waves=waves,
        finer_curl_diameter=finer,
        met=not unmet,
        unmet=tuple(unmet),
        sensitivities=sensitivities,
        fit=found,
    )


def _curl(found: Fit, wish: Wish) -> measures.Curl:
    return measures.curl(found.simulated[wish.state])


def _off(found: Fit, wish: Wish) -> float:
    """Relative error of the curl's diameter."""
    return abs(float(_curl(found, wish).diameter[0]) / wish.curl_diameter - 1)


def _value(found: Fit, name: str) -> float:
    """A number of the fitted scene."""
    return float(named_leaves(found.scene)[matching(name, named_leaves(found.scene))[0]])


def _with(scene: Scene, values: Mapping[str, float]) -> Scene:
    """The scene with other numbers."""
    put = {
        leaf: jnp.asarray(v)
        for name, v in values.items()
        for leaf in matching(name, named_leaves(scene))
    }
    return replace_leaves(scene, put)


def _simulated_finer(wish: Wish, found: Fit) -> float:
    """Diameter of the designed curl in a finer simulation [m]."""
    used = {name: _value(found, name) for name in (ROD, LEFT, CLIMB)}
    ends = run(_with(wish.scene(finer=True), used))
    return float(measures.curl_diameter(ends[wish.state].points)[0])


def _refusal(wish: Wish, found: Fit, nearest: float) -> str:
    rod = 1e3 * _value(found, ROD)
    return (
        f"curl_diameter is {1e3 * wish.curl_diameter:.4g} mm; with rods from {1e3 * RODS[0]:g} to "
        f"{1e3 * RODS[1]:g} mm the nearest that can be had is {1e3 * nearest:.4g} mm, on a rod of "
        f"{rod:.3g} mm with {100 * _value(found, LEFT):.0f} % of the disulfide bonds left"
    )


def _sensitivities(found: Fit, wish: Wish) -> dict[str, float]:
    """d D_rod / d u times the standard error of u, so that the curl stays: by implicit derivatives,
    -(dD / du) / (dD / dD_rod)."""
    scene = found.scene
    leaves = named_leaves(scene)
    rods = matching(ROD, leaves)
    errors = {name: share for name, share in HAIR_ERRORS.items() if name in leaves}
    names = ["rod"]
    changes: list[dict[str, Any]] = [dict.fromkeys(rods, np.asarray(1.0))]
    for name, share in errors.items():
        value = np.asarray(leaves[name], float)
        for place in np.ndindex(value.shape):
            change = np.zeros_like(value)
            change[place] = share * value[place]
            kind = f"[{('hydrogen', 'ionic', 'disulfide', 'peptide')[place[0]]}]" if place else ""
            names.append(name + kind)
            changes.append({name: change})
    if not wish.weight:  # then only ratios of the bonds count
        keep = [i for i, name in enumerate(names) if not name.startswith("fibre.")]
        names, changes = [names[i] for i in keep], [changes[i] for i in keep]

    @jax.jit
    def slopes(changes: list[dict[str, Any]]) -> Any:
        def curliness(values: dict[str, Any]) -> Any:
            state = run(replace_leaves(scene, values))[wish.state]
            return measures.curl(state.points).curliness[0]

        _, along = jax.linearize(curliness, {k: jnp.asarray(leaves[k]) for k in moved})
        return [along({k: jnp.asarray(c.get(k, 0.0 * leaves[k])) for k in moved}) for c in changes]

    moved = [*rods, *errors]
    like = {k: np.asarray(leaves[k]) for k in moved}
    typed = [{k: np.asarray(v, like[k].dtype) for k, v in c.items()} for c in changes]
    per_rod, *others = (float(x) for x in slopes(typed))
    return {name: -x / per_rod for name, x in zip(names[1:], others, strict=True)}


def as_text(found: Design) -> str:
    """What to use, how well it meets the wish, and how it changes with what is uncertain."""
    wish = found.wish
    lines = [
        f"For curls of {1e3 * wish.curl_diameter:.4g} mm in {100 * wish.length:.4g} cm of hair, "
        f"{'hanging' if wish.weight else 'free of weight'}, after the "
        f"{'first wash' if wish.after_wash else 'perm'}, use",
        f"  a rod of {1e3 * found.rod_diameter:.3g} mm",
        f"  a perm that leaves {100 * found.disulfide_left:.0f} % of the disulfide bonds",
        f"  turns that climb by {math.degrees(found.climb):.1f} degrees",
        f"That gives a curl of {1e3 * found.curl_diameter:.4g} mm with {found.waves:.1f} turns.",
    ]
    if not math.isnan(found.finer_curl_diameter):
        lines.append(
            f"Simulated afresh and finer, uncoiling from the rod: "
            f"{1e3 * found.finer_curl_diameter:.4g} mm."
        )
    if found.disulfide_left != wish.disulfide_left and LEFT in found.fit.values:
        lines.append(
            f"With the {100 * wish.disulfide_left:.0f} % of the request no rod from "
            f"{1e3 * RODS[0]:g} to {1e3 * RODS[1]:g} mm gives this curl."
        )
    lines += [f"Not met: {text}" for text in found.unmet]
    lines.append(
        f"The rod is uncertain by {1e3 * found.rod_error:.2g} mm, as hair differs. To keep the "
        "curl, for a standard error of"
    )
    for name, change in found.sensitivities.items():
        share = next(v for k, v in HAIR_ERRORS.items() if name.startswith(k))
        lines.append(f"  {name} ({100 * share:+.0f} %): rod {1e3 * change:+.2f} mm")
    return "\n".join(lines)
