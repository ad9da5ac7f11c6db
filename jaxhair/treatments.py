"""What is done to hair, as phases to add to a scene: water set, acid set, perm, wash.

Each ends with a phase of the treatment's own name, in which the hair hangs free: the state that
is looked at afterwards. The chemistry takes minutes in a salon; here the hair stays where it is
meanwhile, so that one time step for each stage gives the same result.

    scene = scene.then(*treatments.perm(rod_diameter=17e-3), *treatments.wash())
"""

from collections.abc import Sequence
from typing import Any

from jaxhair import check
from jaxhair.bonds import Cut, Reform
from jaxhair.effects import Effect
from jaxhair.forces import Drag, Gravity
from jaxhair.holding import Hold, Unloaded, Wound
from jaxhair.scene import Phase
from jaxhair.strands import BONDS

AT_ONCE = 1e-6
"""A duration [s] that rounds to one time step."""

HANGING: tuple[Effect, ...] = (Hold(), Gravity(), Drag(0.1))
"""Hair held at its roots, under gravity, in air."""


def wound_treatment(
    name: str,
    cut: Cut,
    *,
    rod_diameter: Any,
    climb: Any = 0.0,
    seconds: float = 1.0,
    free: Sequence[Effect] = HANGING,
    unload: bool = True,
) -> tuple[Phase, ...]:
    """Hair is wound on a rod, bonds are cut and re-formed there, and it is released.

    In zero gravity the curl it takes has the diameter rod_diameter / S, with the set
    S = sum_j f_j (1 - c_j) / sum_j f_j for fractions c_j that stay bonded (straight hair before).

    Arguments:
        name: of the last phase. cut: the bonds that break.
        rod_diameter: [m]. climb: of the winding [rad], see `Wound`.
        seconds: that the hair hangs free at the end. free: the effects then.
        unload: the released hair first takes the shape free of stress, see `Unloaded`; otherwise
            it uncoils from the rod in the given time.
    """
    check.text("name", name)
    check.instance("cut", cut, Cut)
    check.flag("unload", unload)
    rod = Wound(rod_diameter, climb)
    free = check.several("free", free, Effect)
    kinds = [kind for kind in BONDS if getattr(cut, kind) is not None]
    return (
        Phase(f"{name}, wound", AT_ONCE, (rod, cut)),
        Phase(f"{name}, set", AT_ONCE, (rod, Reform(**dict.fromkeys(kinds, 1.0)))),
        *((Phase(f"{name}, unloaded", AT_ONCE, (Unloaded(),)),) if unload else ()),
        Phase(name, seconds, free),
    )


def water_set(**options: Any) -> tuple[Phase, ...]:
    """Wet hair dried on a rod: hydrogen bonds are cut and re-formed.

    Options of `wound_treatment`.
    """
    return wound_treatment(options.pop("name", "water set"), Cut(hydrogen=0.0), **options)


def acid_set(**options: Any) -> tuple[Phase, ...]:
    """A set with acid or shampoo: hydrogen and ionic bonds are cut and re-formed."""
    cut = Cut(hydrogen=0.0, ionic=0.0)
    return wound_treatment(options.pop("name", "acid set"), cut, **options)


def perm(*, disulfide_left: Any = 0.8, **options: Any) -> tuple[Phase, ...]:
    """A perm: hydrogen and ionic bonds are cut, and disulfide bonds to a fraction; all re-form.

    Arguments:
        disulfide_left: fraction of disulfide bonds that stays; the paper's 0.8.
        Others: options of `wound_treatment`.
    """
    cut = Cut(hydrogen=0.0, ionic=0.0, disulfide=disulfide_left)
    return wound_treatment(options.pop("name", "perm"), cut, **options)


def wash(
    *,
    name: str = "washed",
    seconds: float = 1.0,
    free: Sequence[Effect] = HANGING,
    unload: bool = True,
) -> tuple[Phase, ...]:
    """A wash: the hair is wetted and dried hanging free, and forgets what hydrogen bonds held.

    Hydrogen bonds are cut; the wet hair hangs for the given time; they re-form in the shape that
    it then has, and it hangs as long again.

    Arguments:
        seconds: that the hair hangs wet, and then dry. free: the effects then.
        unload: the wet hair first takes the shape free of stress, see `Unloaded`.
    """
    check.text("name", name)
    check.flag("unload", unload)
    free = check.several("free", free, Effect)
    wet = Cut(hydrogen=0.0)
    return (
        *((Phase(f"{name}, unloaded", AT_ONCE, (Unloaded(), wet)),) if unload else ()),
        Phase(f"{name}, wet", seconds, (*free, wet)),
        Phase(f"{name}, dried", AT_ONCE, (*free, Reform(hydrogen=1.0))),
        Phase(name, seconds, free),
    )
