"""A scene from a command's options, with any of its numbers replaced by name (`--set`)."""

import argparse
import dataclasses
from typing import Any

import numpy as np

from jaxhair import check, scenes
from jaxhair.command_line import Mistake
from jaxhair.direct import Direct
from jaxhair.options import Assignments, Switch, length, nearest, one_of, positive, whole
from jaxhair.scene import Scene, matching, named_leaves, replace_leaves
from jaxhair.solvers import SWEEPS, Compliant, PositionBased, Solver
from jaxhair.treatments import wash

SOLVERS: dict[str, type[Any]] = {
    "paper": PositionBased,
    "compliant": Compliant,
    "direct": Direct,
}

MANY = 12
"""Numbers of a leaf that `listed` shows; of more it tells the range."""

NOTE = (
    "--set takes any number of the scene by the name that --list shows; a name with * stands for "
    "all that match, and several values are separated by commas. In a settings file these stand "
    "in a table: [set], then fibre.peeling_rate = 0.5"
)


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the scene and its options, which `scene_of` makes a scene of."""
    parser.add_argument("scene", help="which of the paper's scenes", **one_of(*scenes.SCENES))
    group = parser.add_argument_group("the scene")
    add = group.add_argument
    add("--strands", type=whole(1), help="number of strands (default: as in the paper)")
    add("--points", type=whole(1), help="points on a strand (default: as in the paper)")
    add("--length", type=length, help="of a strand, such as 24cm (default: as in the paper)")
    add("--rod-diameter", type=length, help="of the perm's rod, such as 60mm (default: 60 mm)")
    add("--prepared", action=Switch, help="start the perm wound, skip the winding")
    add("--contact", action=Switch, default=True, help="let hairs pass through each other")
    add("--wash", action=Switch, help="wash the hair at the end")
    add("--seconds", type=positive, help="stop after this simulated time (default: all phases)")
    add("--seed", type=whole(0), default=0, help="of the roots' places (default: %(default)d)")
    add(
        "--set",
        action=Assignments,
        metavar="NAME=VALUE",
        help="replace a number of the scene, such as fibre.peeling_rate=0.5; may be repeated",
    )
    add("--list", action=Switch, help="print the scene's numbers, NAME=VALUE, and do nothing else")
    add = parser.add_argument_group("the solver").add_argument
    add(
        "--solver",
        default="paper",
        help="the paper's, with its k; or, with stiffnesses in pascal, compliant constraints "
        "(XPBD) or the direct solver (default: %(default)s)",
        **one_of(*SOLVERS),
    )
    add("--iterations", type=whole(1), help="a solve, of paper or compliant (default: 5)")
    add("--sweep", help="order, of paper or compliant (default: red-black)", **one_of(*SWEEPS))
    add("--newton-steps", type=whole(1), help="a solve, of direct (default: 1)")
    add("--substeps", type=whole(1), default=1, help="solves a time step (default: %(default)d)")
    add(
        "--steps-per-second",
        type=positive,
        default=360.0,
        help="time steps a simulated second (default: %(default)g)",
    )


def scene_of(options: argparse.Namespace) -> Scene:
    """The scene that is asked for. Raises ValueError for options that do not fit together."""
    chosen: dict[str, Any] = {
        "strands": options.strands,
        "points": options.points,
        "length": options.length,
        "rod_diameter": options.rod_diameter,
    }
    chosen = {name: value for name, value in chosen.items() if value is not None}
    if options.prepared:
        chosen["winding"] = False
    if options.scene != "perm":
        for name, flag in (("rod_diameter", "--rod-diameter"), ("winding", "--prepared")):
            if name in chosen:
                raise Mistake(f"{flag} is for the perm; the scene is {options.scene!r}")
    scene = scenes.by_name(
        options.scene,
        seed=options.seed,
        contact=options.contact,
        solver=_solver(options),
        dt=1 / options.steps_per_second,
        **chosen,
    )
    if options.wash:
        scene = scene.then(*wash(free=scene.phases[-1].effects, seconds=2.0, unload=False))
    if options.seconds is not None:
        scene = scene.first(options.seconds)
    return replaced(scene, options.set or [])


def _solver(options: argparse.Namespace) -> Solver:
    """The solver that is asked for; options that it does not have are mistakes."""
    chosen: dict[str, Any] = {"substeps": options.substeps}
    direct = options.solver == "direct"
    for name, of in (
        ("iterations", "paper or compliant"),
        ("sweep", "paper or compliant"),
        ("newton_steps", "direct"),
    ):
        value = getattr(options, name)
        if value is None:
            continue
        if direct != (of == "direct"):
            flag = "--" + name.replace("_", "-")
            raise Mistake(f"{flag} is {value!r}; it must be left out unless --solver is {of}")
        chosen[name] = value
    solver: Solver = SOLVERS[options.solver](**chosen)
    return solver


def replaced(scene: Scene, assignments: list[str]) -> Scene:
    """The scene with other numbers, each "NAME=VALUE"; of two for one name the later one counts.

    Raises ValueError for a name that it does not have, as many values as the leaf does not have,
    and values that the scene's classes refuse.
    """
    leaves, values = named_leaves(scene), {}
    for text in assignments:
        name, equals, numbers = text.partition("=")
        if not equals:
            raise Mistake(f"--set is {check.short(text)}; it must be NAME=VALUE")
        found = matching(name, leaves)
        if not found:
            close = nearest(name, leaves)
            raise Mistake(f"--set names {check.short(name)}, which the scene does not have{close}")
        for leaf in found:
            values[leaf] = _numbers(leaf, numbers, np.shape(leaves[leaf]))
    if not values:
        return scene
    # built anew, because only constructors check numbers
    checked: Scene = _rebuilt(replace_leaves(scene, values))
    return checked


def _numbers(name: str, text: str, shape: tuple[int, ...]) -> Any:
    size = int(np.prod(shape))
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != size:
        wanted = "a number" if shape == () else f"{size} numbers, separated by commas"
        raise Mistake(f"--set {name} is {check.short(text)}; it must be {wanted}")
    return values[0] if shape == () else np.reshape(values, shape)


def _rebuilt(part: Any) -> Any:
    """A part of a scene, made by its constructors."""
    if isinstance(part, tuple):
        return tuple(_rebuilt(entry) for entry in part)
    if not dataclasses.is_dataclass(part) or isinstance(part, type):
        return part
    fields = [field.name for field in dataclasses.fields(part) if field.init]
    return dataclasses.replace(part, **{name: _rebuilt(getattr(part, name)) for name in fields})


def listed(scene: Scene) -> str:
    """The scene's numbers, a line each, as `--set` takes them."""
    lines = []
    for name, leaf in named_leaves(scene).items():
        values = np.asarray(leaf, scene.dtype)
        shown = ",".join(map(str, values.ravel()))
        if values.size > MANY:
            shown = f"({values.size} numbers from {values.min()!s} to {values.max()!s})"
        lines.append(f"{name}={shown}")
    return "\n".join(lines)
