"""Strands from files as targets: the scene in which hair like theirs could be made."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np

from fitting.measured import FREE, Measured
from fitting.targets import Shape, Target, resampled
from jaxhair import Bonds, Curves, Scene, Strands, check, treatments
from jaxhair.scene import Phase

STATES = ("permed", "washed", "water set", "acid set")
"""States that hair can be observed in, in the order in which files without a name are taken."""

EDGES_PER_ROD = 4.0
"""Rod diameters are this many edges: 12 or 13 points a turn."""


def from_strands(
    observed: Mapping[str, Curves],
    *,
    rod_diameter: float | None = None,
    strands: int = 16,
    points: int | None = None,
    weight: bool = False,
) -> Measured:
    """A scene and targets for strands observed in one or several states of the same hair.

    Straight hair of the same lengths is wound, climbing as the first state's curls do, and treated
    as each state's name says. Shapes are compared after the rigid motion that brings each strand
    nearest.

    Arguments:
        observed: from a state of `STATES` to its strands; the same number in each state.
        rod_diameter: [m]; if not given, 0.6 of the typical curl's diameter of the first state, as
            a salon's perm gives (Journal of Cosmetic Science 66 (2015) 37, Table IV).
        strands: at most this many are used, spread evenly over each file.
        points: on a simulated strand; if not given, so many that the rod is 4 edges thick.
        weight: the strands were observed hanging under gravity.

    Raises ValueError for an unknown state, files that differ in their number of strands, strands
    with fewer than 3 points or curls that a rod of the given diameter cannot give.
    """
    check.instance("observed", observed, Mapping)
    if not observed:
        raise ValueError("observed is empty; it must have at least one state")
    check.whole("strands", strands, least=1)
    check.flag("weight", weight)
    sizes = {}
    for state, curves in observed.items():
        check.choice("state", state, STATES)
        check.instance(f"observed[{state!r}]", curves, Curves)
        check.finite(f"observed[{state!r}].points", curves.points)
        sizes[state] = len(curves.counts)
        if sizes[state] == 0:
            raise ValueError(f"state {state!r} has no strand; it must have one or more")
        if curves.counts.min() < 3:
            raise ValueError(
                f"state {state!r} has a strand of {curves.counts.min()} points; each must have 3 "
                "or more"
            )
    if len(set(sizes.values())) > 1:
        raise ValueError(f"states have different numbers of strands: {sizes}; they must agree")
    total = next(iter(sizes.values()))
    used = np.unique(np.linspace(0, total - 1, min(strands, total)).round().astype(int))
    for state, curves in observed.items():
        for i in used:
            if (
                _length(curves.points[i]) < check.SMALLEST
            ):  # what stands behind the last point repeats it
                raise ValueError(f"state {state!r}: strand {i} has length 0; it must be above 0")
    first = next(iter(observed.values()))
    lengths = np.array([_length(first.points[i, : first.counts[i]]) for i in used])
    curl, climb = curl_shape(first, used)
    if rod_diameter is None:
        rod_diameter = min(0.6 * curl, float(lengths.min()) / 3)
    check.positive("rod_diameter", rod_diameter)
    if rod_diameter >= curl:
        raise ValueError(
            f"rod_diameter is {1e3 * rod_diameter:.1f} mm and the target's curls are about "
            f"{1e3 * curl:.1f} mm wide; the rod must be thinner than the curls"
        )
    if points is None:
        points = int(np.clip(EDGES_PER_ROD * lengths.max() / rod_diameter + 1, 9, 129))
    check.whole("points", points, least=3, most=100_000)
    free = treatments.HANGING if weight else FREE
    phases: list[Phase] = []
    for state in sorted(observed, key=("water set", "acid set", "permed", "washed").index):
        options = {"rod_diameter": rod_diameter, "climb": climb, "free": free}
        phases += _treated(state, options, after=[phase.name for phase in phases])
    hair = _straight(first, used, lengths, points)
    equal = Bonds((0.25, 0.25, 0.25, 0.25))
    scene = Scene(hair, bonds=equal, phases=tuple(phases))
    targets: dict[str, Target] = {
        state: Shape(resampled(c.points[used], c.counts[used], points), align=True)
        for state, c in observed.items()
    }
    return Measured(f"{len(used)} of {total} strands", scene, targets)


def _treated(state: str, options: dict[str, Any], after: list[str]) -> list[Phase]:
    """The phases that bring the hair from the states before to this one."""
    free = options["free"]
    phases: list[Phase] = []
    if after and state != "washed":
        phases += treatments.wash(name=f"before {state}", free=free)
    if state == "water set":
        phases += treatments.water_set(**options)
    elif state == "acid set":
        phases += treatments.acid_set(**options)
    elif state == "permed" or "permed" not in after:
        phases += treatments.perm(name="permed", **options)
    if state == "washed":
        phases += treatments.wash(free=free)
    return phases


def _straight(curves: Curves, used: np.ndarray, lengths: np.ndarray, points: int) -> Strands:
    """Straight hair of the target's lengths, from its roots along its first edges."""
    roots = curves.points[used, 0]
    toward = _first_edges(curves, used)
    hair = Strands.straight(roots, toward, length=float(lengths.max()), points=points)
    edges = np.repeat(lengths[:, None] / (points - 1), points - 1, axis=1)
    along = np.linspace(0, 1, points)[:, None] * lengths[:, None, None]
    t = toward / np.linalg.norm(toward, axis=1, keepdims=True)
    return replace(
        hair,
        positions=jnp.asarray(roots[:, None] + along * t[:, None], hair.positions.dtype),
        lengths=jnp.asarray(edges, hair.positions.dtype),
    )


def curl_shape(curves: Curves, used: np.ndarray) -> tuple[float, float]:
    """Typical diameter [m] and climb [rad] of the strands' curls, taken as helices.

    From one edge, of length l, to the next a helix turns about its axis by phi. With the climb a,
    the bend b between edges and the twist c between bends, by half angles,
    sin(phi / 2) cos(a) = sin(b / 2) and sin(phi / 2) sin(a) = cos(b / 2) sin(c / 2), and the
    diameter is l cos(a) / sin(phi / 2). Of l, b / l and c / l the medians along the strands are
    taken. The climb is positive for a right-handed curl, and 0 for hair that hardly bends.
    """
    sizes, curvatures, torsions, longest = [], [], [], 0.0
    for i in used:
        x = curves.points[i, : curves.counts[i]]
        x = x[:: -(-len(x) // 65)]  # points as they are: those put between would bend less
        x = x[np.append(True, np.linalg.norm(np.diff(x, axis=0), axis=1) > check.SMALLEST)]
        size = np.linalg.norm(np.diff(x, axis=0), axis=1)
        t = np.diff(x, axis=0) / size[:, None]
        across = np.cross(t[:-1], t[1:])
        bend = np.arctan2(np.linalg.norm(across, axis=1), (t[:-1] * t[1:]).sum(1))
        b = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        twist = np.arctan2((np.cross(b[:-1], b[1:]) * t[1:-1]).sum(1), (b[:-1] * b[1:]).sum(1))
        sizes.append(size)
        curvatures.append(2 * bend / (size[1:] + size[:-1]))
        torsions.append(twist / size[1:-1])
        longest = max(longest, float(size.sum()))
    edge, curvature = _median(sizes), max(_median(curvatures), 1e-3)
    # Hair that turns less than a radian has no visible torsion, only its points' noise.
    torsion = _median(torsions) if curvature * longest > 1 else 0.0
    half_bend, half_twist = curvature * edge / 2, torsion * edge / 2
    across_axis, along_axis = np.sin(half_bend), np.cos(half_bend) * np.sin(half_twist)
    square = across_axis**2 + along_axis**2  # sin(phi / 2)^2
    return float(edge * across_axis / square), float(np.arctan2(along_axis, across_axis))


def _median(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts)
    return float(np.median(values)) if values.size else 0.0


def _first_edges(curves: Curves, used: np.ndarray) -> np.ndarray:
    """From each strand's root to its first point that is elsewhere [m], shape (strands, 3)."""
    edges = []
    for i in used:
        away = curves.points[i] - curves.points[i, 0]
        edges.append(away[np.argmax(np.any(away != 0, axis=1))])
    return np.array(edges)


def _length(x: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(x, axis=0), axis=1).sum())
