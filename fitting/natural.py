"""Natural strands, as files have them: what shape they remember, and what of it may be fitted.

    hair = natural(jh.read_curves("head.hair", unit=0.01))
    print(hair.table(hair.fit()))

A strand that hangs is drawn out by its weight: the shape that its bonds remember is curled more
than what is seen. The moments that weight puts on a strand of known stiffness follow from its
shape alone, so that the remembered shape can be computed, tip to root, without a fit
(`without_weight`; after Derouet-Jourdan, Bertails-Descoubes and Thollot, Stable inverse dynamic
curves, 2010, DOI 10.1145/1882261.1866159). Hydrogen bonds, which every wash makes anew while the
hair hangs, remember less of it.

**Hanging hair alone does not determine f_j and s:** for any of them, and any stiffness, there is a
remembered shape with which it hangs just so. They are taken as they are given, and the shape's
scale is fitted. Seen without weight too (`unloaded`), each strand shows its remembered shape, and
how its weight draws it out shows f_hydrogen and s, for the stiffness given.

A strand of a head stands out farther than a single hair could, held by its neighbours. Where a
hair's stiffness does not keep it as it was seen, the least of some multiples is taken that does.
"""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from fitting.clamped import Seen, off_mm, rooted
from fitting.constraints import Constraint, Positive, Scale, Share
from fitting.ends import in_tiles
from fitting.hanging import STIFFER, Counted, held_up, take, times
from fitting.many import FitEach, distribution, fit_each, not_fitted
from fitting.optimisers import Progress
from fitting.polylines import cleaned, evenly, listed, turns
from fitting.targets import MM, Shape, Target
from fitting.widened import widened
from jaxhair import (
    Bonds,
    Curves,
    Direct,
    PhysicalFibre,
    Scene,
    Strands,
    check,
    named_leaves,
    treatments,
)
from jaxhair.holding import Hold, Unloaded
from jaxhair.scene import Phase
from jaxhair.strands import BONDS

STATE, UNLOADED, REMEMBERED = "natural", "unloaded", "remembered"
"""Phases at whose ends the strands are as they were observed, hanging or not, and unloaded; and the
state that their bonds remember."""

LEAST_POINTS, MOST_POINTS = 17, 65
TURN = 0.5
"""Largest mean turn between the edges of a simulated strand [rad], 12 edges a curl; where the most
points do not reach it, strands may turn twice as far."""


@dataclass(frozen=True)
class Natural:
    """Strands to be fitted, each by itself.

    Arguments:
        scene, targets, free: for `fit_each`.
        used: places of the scene's strands among those given, shape (strands,).
        stiffer: by how much each is stiffer than a single hair, one of `STIFFER`.
        left: from the place of a strand that is not in the scene to the reason.
        resampling_mm: root mean square distance of each strand's given points from the chain of
            edges that is simulated in their place [mm], shape (strands,).
        seen: strands seen both hanging and without weight: all curves that they may be.
    """

    scene: Scene
    targets: dict[str, Target]
    free: dict[str, Constraint]
    used: np.ndarray
    stiffer: np.ndarray
    left: dict[int, str]
    resampling_mm: np.ndarray
    seen: Seen | None = None

    def fit(
        self,
        *,
        progress: Progress | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
    ) -> FitEach:
        """`fit_each` of the strands; where they were seen with and without weight, with the noise
        that their points have, and errors that count how uncertain it makes the shapes."""
        options: dict[str, Any] = {"progress": progress, "checkpoint": checkpoint}
        if self.seen is None:
            return fit_each(self.scene, self.targets, self.free, **options)
        noise = self.seen.noise_mm
        found = fit_each(self.scene, self.targets, self.free, noise_mm=noise, **options)
        return widened(self.scene, self.free, (STATE, UNLOADED), self.seen, found)

    @property
    def lengths(self) -> np.ndarray:
        """Of the strands [m], shape (strands,)."""
        edges = np.asarray(self.scene.strands.lengths, float)
        return edges.sum(axis=1) - (0 if self.seen is None else edges[:, 0] / 2)

    def of_length(self, found: FitEach) -> np.ndarray:
        """Residuals of a fit in lengths of the strand, shape (strands,)."""
        return found.residual_mm / (MM * self.lengths)

    def simulated(self, found: FitEach) -> dict[str, np.ndarray]:
        """Points [m] of the strands as fitted, shape (strands, points, 3): of each observed state,
        and as their bonds remember them."""
        names = named_leaves(self.scene)
        leaves, structure = jax.tree.flatten(self.scene)
        values = [found.values.get(n, x) for n, x in zip(names, leaves, strict=True)]
        fitted = jax.tree.unflatten(structure, values)
        unloaded = (Phase(REMEMBERED, treatments.AT_ONCE, (Unloaded(),)),)
        ends = (
            *in_tiles(fitted, tuple(self.targets)),
            *in_tiles(replace(fitted, phases=unloaded), (REMEMBERED,)),
        )
        points = {
            state: np.concatenate([tile[state] for _, tile in ends if state in tile])
            for state in (*self.targets, REMEMBERED)
        }
        return points if self.seen is None else {n: rooted(x) for n, x in points.items()}

    def reasons(self, found: FitEach) -> dict[int, str]:
        """Why strands could not be fitted, by their places among those given."""
        failed = zip(self.used, found.reasons, strict=True)
        whole = {**self.left, **{int(i): reason for i, reason in failed if reason is not None}}
        return dict(sorted(whole.items()))

    def table(self, found: FitEach, *, most: int = 10) -> str:
        """What a fit of them found, and the strands that could not be fitted, by file order."""
        reasons = self.reasons(found)
        total = len(self.used) + len(self.left)
        lines = [f"{total - len(reasons)} of {total} strands fitted", *found.summary()]
        lines.append(f"residual [lengths of the strand]: {distribution(self.of_length(found))}")
        lines.append(
            f"points of the file off the {self.scene.strands.points - 1} edges simulated "
            f"[mm]: {distribution(self.resampling_mm)}"
        )
        counts = [f"{(self.stiffer == x).sum()} of {x:g}" for x in np.unique(self.stiffer)]
        lines.append(f"strands by their stiffness over a single hair's: {', '.join(counts)}")
        return "\n".join([*lines, *not_fitted(reasons, most)])


def natural(
    curves: Curves | Sequence[Any],
    *,
    unloaded: Curves | Sequence[Any] | None = None,
    points: int | None = None,
    weight: bool = True,
    fibre: PhysicalFibre | None = None,
    influence: Sequence[float] = (0.33, 0.30, 0.20, 0.17),
    strands: int | None = None,
    seconds: float = 0.5,
    dt: float = 1 / 180,
    dtype: str = "float32",
    progress: Counted | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> Natural:
    """Scene and targets for natural strands, which are held at their roots.

    Arguments:
        curves: from `jaxhair.read_curves`, or a list of points [m], each of shape (points, 3).
        unloaded: the same strands seen without weight, such as floating in water.
        points: on a simulated strand; if not given, 17 to 65, so that all but a twentieth of the
            strands turn by at most half a radian an edge.
        weight: `curves` were observed hanging, washed and dried under gravity. Otherwise they are
            without weight, as hair is often modelled.
        fibre: hair's, if not given. influence: of the bonds, to start from.
        strands: at most this many, spread evenly.
        seconds: that the hair hangs wet, and again dry. It starts in the observed shape, without
            weight if that is given, from which it needs a second or more to come to rest.
        dt: time step [s]. dtype: of the computation.
        progress: while it is found out how stiff strands must be; see `hanging.Counted`.
        checkpoint: a folder in which that is kept, for this work alone.

    A strand that cannot be simulated is left out with the reason: fewer than 3 different points, a
    coordinate that is not finite, points too far apart for its curls, too soft for its weight.
    Raises ValueError where no strand can be simulated.
    """
    check.flag("weight", weight)
    fibre = PhysicalFibre() if fibre is None else fibre
    check.instance("fibre", fibre, PhysicalFibre)
    for name, value in vars(fibre).items():
        if value is not None:
            check.number(f"fibre.{name}", value)
    bonds = Bonds(influence)
    check.shape("influence", bonds.influence, (len(BONDS),))
    if unloaded is not None and not weight:
        raise ValueError("weight is False; with unloaded strands it must be True")
    seen = [listed(x) for x in ((curves,) if unloaded is None else (curves, unloaded))]
    if len({len(x) for x in seen}) > 1:
        sizes = f"{len(seen[0])} strands and {len(seen[1])} unloaded ones"
        raise ValueError(f"curves has {sizes}; they must be as many")
    total = len(seen[0])
    if strands is not None:
        check.whole("strands", strands, least=1)
    chosen = np.unique(np.linspace(0, total - 1, min(strands or total, total)).round().astype(int))
    kept, left = _sorted_out(seen, chosen.tolist())
    seen_twice: Seen | None = None
    smooth: Iterable[Sequence[np.ndarray]] = kept.values()
    if unloaded is not None and kept:
        seen_twice = Seen.of(*zip(*kept.values(), strict=True))
        smooth = zip(*(x[0] for x in seen_twice.chains(MOST_POINTS)), strict=True)
    whole = np.array([max(turns(x).sum() for x in several) for several in smooth])
    points = _needed(whole) if points is None else points
    check.whole("points", points, least=4, most=100_000)
    turn = whole / (points - 2)
    for i, each_turn in zip(list(kept), turn, strict=True):
        if each_turn > 2 * TURN:
            left[i] = f"turns by {each_turn:.1f} rad between the edges of {points} points"
            del kept[i]
    _refuse_none(kept, left)
    strands_of = list(zip(*kept.values(), strict=True))
    if seen_twice is not None:
        seen_twice = seen_twice.take(np.flatnonzero(turn <= 2 * TURN).tolist())
        shapes = tuple(x[0] for x in seen_twice.chains(points))
        off = [off_mm(x, chain) for x, chain in zip(strands_of, shapes, strict=True)]
    else:
        shapes, off = zip(*(evenly(x, points) for x in strands_of), strict=True)
    resampling = np.max(off, axis=0)
    hair = Strands.from_points(jnp.asarray(shapes[-1], dtype))
    phases: tuple[Phase, ...] = (Phase(STATE, seconds, (Hold(),)),)
    stiffer = np.ones(len(kept))
    free: dict[str, Constraint] = {"strands.natural_shape": Scale()}
    targets: dict[str, Target] = {}
    if weight:
        phases = treatments.wash(name=STATE, seconds=seconds, unload=False)
    if unloaded is not None:
        phases = (Phase(UNLOADED, treatments.AT_ONCE, (Unloaded(),)), *phases)
        targets[UNLOADED] = Shape(shapes[1])
        free["bonds.influence"] = Share(BONDS.index("hydrogen"))
        free["fibre.peeling_rate"] = Positive()
    elif weight:
        scene = Scene(hair, fibre, bonds, phases, Direct(), dt)
        shape, stiffer = held_up(scene, STATE, progress=progress, checkpoint=checkpoint)
        fits = stiffer > 0
        for i in np.array(list(kept))[~fits].tolist():
            left[i] = f"does not stay as it was seen, at {STIFFER[-1]:g} times the stiffness"
            del kept[i]
        _refuse_none(kept, left)
        shapes, stiffer, resampling = (shapes[0][fits],), stiffer[fits], resampling[fits]
        hair = take(replace(hair, natural_shape=shape), np.flatnonzero(fits))
        fibre = times(fibre, jnp.asarray(stiffer, dtype))
    targets[STATE] = Shape(shapes[0])
    return Natural(
        Scene(hair, fibre, bonds, phases, Direct(), dt),
        targets,
        free,
        np.array(list(kept)),
        stiffer,
        dict(sorted(left.items())),
        resampling,
        seen_twice,
    )


def _sorted_out(
    seen: Sequence[Sequence[Any]], chosen: Sequence[int]
) -> tuple[dict[int, list[np.ndarray]], dict[int, str]]:
    """Of the chosen strands, by place: those to be simulated, as often as they were seen, and the
    reasons why others are left out."""
    kept: dict[int, list[np.ndarray]] = {}
    left: dict[int, str] = {}
    for i in chosen:
        each = [cleaned(strands[i]) for strands in seen]
        if bad := [x for x in each if isinstance(x, str)]:
            left[i] = bad[0]
        else:
            kept[i] = [x for x in each if not isinstance(x, str)]
    return kept, left


def _needed(whole: np.ndarray) -> int:
    """Points with which all but a twentieth of strands that turn by `whole` [rad] turn by at most
    `TURN` an edge."""
    wanted = np.quantile(whole, 0.95) / TURN + 2 if len(whole) else LEAST_POINTS
    return int(np.clip(np.ceil(wanted), LEAST_POINTS, MOST_POINTS))


def _refuse_none(kept: Mapping[int, Any], left: dict[int, str]) -> None:
    if not kept:
        first = next(iter(left.items()), None)
        why = "there is none" if first is None else f"strand {first[0]}: {first[1]}"
        raise ValueError(f"curves has no strand that can be simulated; {why}")
