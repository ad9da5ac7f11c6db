"""The paper's three scenes, with the numbers of its table 1: bed hair, blow dryer, perm."""

from typing import Any

import numpy as np

from jaxhair import check
from jaxhair.bonds import Bonds, Cut, Reform
from jaxhair.contact import HairContact
from jaxhair.effects import Effect
from jaxhair.forces import Drag, DryingWind, Gravity
from jaxhair.holding import Hold
from jaxhair.obstacles import Cylinder, Floor, Sphere
from jaxhair.scene import Phase, Scene
from jaxhair.strands import Strands
from jaxhair.treatments import perm as perm_from_wound

WET = Bonds(fraction=(0.0, 1.0, 1.0, 1.0))
"""Bonds of wet hair: hydrogen bonds are cut."""

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def bed_hair(
    *,
    strands: int = 200,
    points: int = 9,
    length: float = 0.24,
    seed: int = 0,
    contact: bool = True,
    dry: bool = True,
    **options: Any,
) -> Scene:
    """Scene 1: wet hair on a head is pressed on a pillow, dries there, and keeps a bend.

    Arguments:
        strands, points: how many, and points on each. length: of a strand [m].
        seed: of the roots' places.
        contact: whether hair collides with hair.
        dry: whether the hydrogen bonds re-form on the pillow; without, no bend is kept.
        options: of `Scene`, such as fibre, solver or dt.

    Phases: "lie down" (1 s), "asleep" (1 s), "get up" (1 s), "morning" (2 s).
    """
    _check(strands, length, seed, contact=contact, dry=dry)
    rng = np.random.default_rng(seed)
    head, gap = 0.09, 0.02  # radius of the head, and space below the tips at the start [m]
    outward = _cap(strands, half_angle=0.6)
    down = outward * (0.3, 0.3, 1.0) + rng.normal(0, 0.03, (strands, 3))
    centre = np.array([0.0, 0.0, length + gap + head])
    drop = length + gap - 0.05
    hair = Strands.straight(centre + head * outward, down, length=length, points=points)
    always = _always(contact)

    def head_at(moved: float, speed: float) -> tuple[Effect, ...]:
        velocity = None if speed == 0 else (0.0, 0.0, speed)
        place = tuple(centre + np.array([0.0, 0.0, moved]))
        return (*always, Hold(velocity=velocity), Sphere(place, head, 0.3, velocity=velocity))

    pillow = Floor(0.0, friction=0.5)
    dries = (Reform(hydrogen=1.0, rate=1.5),) if dry else ()
    phases = (
        Phase("lie down", 1.0, (*head_at(0.0, -drop), pillow)),
        Phase("asleep", 1.0, (*head_at(-drop, 0.0), pillow, *dries)),
        Phase("get up", 1.0, (*head_at(-drop, drop), pillow)),
        Phase("morning", 2.0, (*head_at(0.0, 0.0), pillow)),
    )
    return Scene(hair, bonds=WET, phases=phases, **options)


def blow_dry(
    *,
    strands: int = 200,
    points: int = 9,
    length: float = 0.24,
    seed: int = 0,
    contact: bool = True,
    strength: float = 400.0,
    **options: Any,
) -> Scene:
    """Scene 2: wet hair is pressed on a floor, a dryer blows on its middle, and it is lifted again.

    The wind comes from above, at x = 0; where it is strongest the hair dries most in its bent shape
    (Eq. 19) and keeps the strongest curl.

    Arguments:
        strands, points: how many, and points on each. length: of a strand [m].
        seed: of the roots' places. contact: whether hair collides with hair.
        strength: of the wind [m/s^2].
        options: of `Scene`, such as fibre, solver or dt.

    Phases: "press" (1 s), "blow" (3 s), "lift" (1 s), "hang" (4 s).
    """
    _check(strands, length, seed, contact=contact)
    rng = np.random.default_rng(seed)
    rows = 4
    x = (np.arange(strands) + 0.5) / strands * 0.24 - 0.12
    y = (np.arange(strands) % rows - (rows - 1) / 2) * 0.01
    height, low = length + 0.02, 0.06
    roots = np.stack([x, y, np.full(strands, height)], 1) + rng.normal(0, 1e-3, (strands, 3))
    down = np.array([0.0, 0.0, -1.0]) + rng.normal(0, 0.05, (strands, 3))
    hair = Strands.straight(roots, down, length=length, points=points)
    always, floor = _always(contact), Floor(0.0, friction=0.5)
    wind = DryingWind((0.0, -0.3, 0.3), (0.0, 0.05, 0.0), strength)

    def lowered(speed: float) -> Hold:
        return Hold(velocity=(0.0, 0.0, speed))

    phases = (
        Phase("press", 1.0, (*always, lowered(low - height), floor)),
        Phase("blow", 3.0, (*always, Hold(), floor, wind)),
        Phase("lift", 1.0, (*always, lowered(height - low), floor)),
        Phase("hang", 4.0, (*always, Hold(), floor)),
    )
    return Scene(hair, bonds=WET, phases=phases, **options)


def perm(
    *,
    strands: int = 100,
    points: int = 17,
    length: float = 0.48,
    rod_diameter: float = 0.06,
    winding: bool = True,
    treated: bool = True,
    disulfide_left: float = 0.8,
    seed: int = 0,
    contact: bool = True,
    seconds: float = 5.0,
    **options: Any,
) -> Scene:
    """Scene 3: dry hair is wound on a rod, bonds are cut and re-formed there, and it is released.

    With points 3 cm apart, as in the paper, the rod must be thick: a curl needs 8 points a turn.
    A simulated winding needs 12: with the paper's 17 points edges cut so far into a rod of 60 mm
    that the hair slips off it, with 33 it stays on.
    For a rod as in a salon, 17 mm, take points 6 mm apart and more iterations.

    Arguments:
        strands, points: how many, and points on each. length: of a strand [m].
        rod_diameter: [m].
        winding: True simulates it: the rod takes the tips and rolls up towards the roots. False
            starts from a prepared state in which every strand is wound on a rod of its own, which
            is fast, and the form to use in a fit.
        treated: False winds and releases the hair without cutting a bond: it stays straight.
        disulfide_left: fraction of disulfide bonds that the lotion leaves.
        seed: of the roots' places. contact: whether hair collides with hair.
        seconds: after the release.
        options: of `Scene`, such as fibre, solver or dt.

    Phases with winding: "wind" (3 s), "reduce" and "neutralise" (0.1 s each), "released". Without:
    "released, wound", "released, set", "released".
    """
    _check(strands, length, seed, contact=contact, winding=winding, treated=treated)
    check.positive("rod_diameter", rod_diameter)
    rng = np.random.default_rng(seed)
    y = (np.arange(strands) - (strands - 1) / 2) * 0.002
    roots = np.stack([np.zeros(strands), y, np.full(strands, length + rod_diameter)], 1)
    roots[:, 0] += rng.normal(0, 1e-3, strands)
    hair = Strands.straight(roots, (0.0, 0.0, -1.0), length=length, points=points)
    free = (*_always(contact), Hold())
    if not winding:
        phases = perm_from_wound(
            name="released",
            rod_diameter=rod_diameter,
            climb=0.1,
            disulfide_left=disulfide_left if treated else 1.0,
            seconds=seconds,
            free=free,
            unload=False,
        )
        if not treated:
            phases = phases[-1:]
        return Scene(hair, phases=phases, **options)

    radius, wind_time = rod_diameter / 2, 3.0
    left = 0.2 * length  # hair between the root and the wound rod
    speed = (length - left) / wind_time

    def rod(moved: float, speed: float) -> tuple[Effect, ...]:
        """The rod, and the tips that it holds."""
        centre = (radius, 0.0, rod_diameter + moved)
        motion: dict[str, Any] = {}
        if speed != 0:
            motion = {
                "velocity": (0.0, 0.0, speed),
                "angular_velocity": (0.0, -speed / radius, 0.0),
            }
        width = float(np.ptp(y)) + 0.04
        side = Cylinder(centre, (0.0, 1.0, 0.0), radius, 0.5, width, **motion)
        return (Hold("tip", centre=centre if motion else None, **motion), side)

    cut = (Cut(hydrogen=0.0, ionic=0.0, disulfide=disulfide_left),) if treated else ()
    form = (Reform(hydrogen=1.0, ionic=1.0, disulfide=1.0),) if treated else ()
    phases = (
        Phase("wind", wind_time, (*free, *rod(0.0, speed))),
        Phase("reduce", 0.1, (*free, *rod(length - left, 0.0), *cut)),
        Phase("neutralise", 0.1, (*free, *rod(length - left, 0.0), *form)),
        Phase("released", seconds, free),
    )
    return Scene(hair, phases=phases, **options)


SCENES = {"bed-hair": bed_hair, "blow-dry": blow_dry, "perm": perm}
"""The paper's scenes by the names that the command line uses."""


def by_name(name: str, **options: Any) -> Scene:
    """A scene of `SCENES`. Raises ValueError for another name."""
    check.choice("scene", name, tuple(SCENES))
    return SCENES[name](**options)


def _check(strands: int, length: float, seed: int, **flags: bool) -> None:
    check.whole("strands", strands, least=1)
    check.positive("length", length)
    check.whole("seed", seed, least=0, most=2**63)
    for name, value in flags.items():
        check.flag(name, value)


def _always(contact: bool) -> tuple[Effect, ...]:
    """Gravity, air, and hair against hair if wanted."""
    return (Gravity(), Drag(0.2), *((HairContact(radius=5e-4, strength=20.0),) if contact else ()))


def _cap(count: int, half_angle: float) -> np.ndarray:
    """Unit vectors spread evenly over the lower cap of a sphere, shape (count, 3)."""
    place = (np.arange(count) + 0.5) / count
    z = -(1 - place * (1 - np.cos(half_angle)))
    turn = GOLDEN_ANGLE * np.arange(count)
    across = np.sqrt(1 - z**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), z], 1)
