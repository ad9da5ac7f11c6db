"""Hard cases of a strand's shape."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

import jaxhair as jh
from hard_cases.catalogue import (
    HANGING,
    WEIGHTLESS,
    Setting,
    Start,
    hard,
    helix,
    moved,
    straight,
    swept,
    through,
)
from jaxhair.quaternion import multiply

KINK = "the force along a horizontal edge is 0, where the bound on its stiffness has a kink"


@hard(
    breaks="gradients of norms that are zero: of speed, bend, stretch, twist",
    holds="nothing moves",
    speed=1e-3,
    stretch=1e-5,
)
def straight_at_rest(s: Setting) -> jh.Scene:
    return s.scene(straight(), *WEIGHTLESS)


@hard(breaks="the root's frame is the identity", speed=1e-3, stretch=1e-5)
def straight_along_e3(s: Setting) -> jh.Scene:
    return s.scene(straight((0.0, 0.0, 1.0)), *WEIGHTLESS)


@hard(breaks="nothing bends a strand that stands upright but rounding", speed=2.5)
def standing_upright(s: Setting) -> jh.Scene:
    return s.scene(straight((0.0, 0.0, 1.0)), *HANGING)


@hard(breaks="the rest shape is the mirror image of the present one: the farthest coil", speed=5)
def rest_shape_mirrored(s: Setting) -> jh.Scene:
    hair = through(helix())
    mirror = np.array([1.0, -1.0, -1.0])  # of a rotation's vector, in the plane of d1 and d3
    return s.scene(replace(hair, natural_shape=np.asarray(hair.natural_shape) * mirror), *HANGING)


def bent_to(degrees: float) -> np.ndarray:
    """Points of a strand with one bend of an angle in its middle, 3 cm apart."""
    angle = np.where(np.arange(8) < 4, 0.0, np.radians(degrees))
    edges = 0.03 * np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], 1)
    return np.concatenate([np.zeros((1, 3)), edges]).cumsum(0)


def signs_mixed(scene: jh.Scene) -> Start:
    """The same start, with the quaternions of some edges negated."""
    q = np.array(moved(scene).state.orientations)
    q[::3] *= -1
    return moved(scene, orientations=q)


@hard(breaks="a rest shape near the half turn, where q and -q are hard to tell; signs mixed")
def natural_bend_of_179_degrees(s: Setting) -> Start:
    return signs_mixed(s.scene(through(bent_to(179.0)), *HANGING))


@hard(
    breaks="a rest shape at the half turn, where q and -q are equally near; signs mixed",
    smooth="at the half turn the nearer of q and -q changes",
)
def natural_bend_of_180_degrees(s: Setting) -> Start:
    return signs_mixed(s.scene(through(bent_to(180.0)), *HANGING))


def unbent(s: Setting, degrees: float) -> jh.Scene:
    """Hair that is bent, and straight by nature."""
    hair = through(bent_to(degrees))
    return s.scene(replace(hair, natural_shape=0 * np.asarray(hair.natural_shape)), *HANGING)


@hard(breaks="a bend that is to open by 179 degrees; signs mixed", speed=20)
def present_bend_of_179_degrees(s: Setting) -> Start:
    return signs_mixed(unbent(s, 179.0))


@hard(
    breaks="a bend that is to open by 180 degrees, to either side; signs mixed",
    speed=20,
    smooth="at the half turn the nearer of q and -q changes",
)
def present_bend_of_180_degrees(s: Setting) -> Start:
    return signs_mixed(unbent(s, 180.0))


def zigzag() -> np.ndarray:
    """Points of a strand that goes down and up again through the same two places."""
    points = np.zeros((9, 3))
    points[1::2, 2] = -0.03
    return points


@hard(
    breaks="every bend is a half turn, every second point in the same place",
    speed=50,
    smooth="at the half turn the nearer of q and -q changes",
)
def folded_back_on_itself(s: Setting) -> jh.Scene:
    hair = through(zigzag())
    return s.scene(replace(hair, natural_shape=0 * np.asarray(hair.natural_shape)), *HANGING)


@hard(
    breaks="all points of a strand in one place: no edge has a direction",
    speed=1e3,
    smooth="an edge of no length has no direction",
)
def all_points_coincide(s: Setting) -> Start:
    scene = s.scene(straight(), *HANGING)
    p = np.array(moved(scene).state.positions)
    return moved(scene, positions=np.broadcast_to(p[:1], p.shape))


@hard(
    breaks="two neighbouring points in one place",
    speed=1e3,
    smooth="an edge of no length has no direction",
)
def two_points_coincide(s: Setting) -> Start:
    scene = s.scene(straight(), *HANGING)
    p = np.array(moved(scene).state.positions)
    p[5] = p[4]
    return moved(scene, positions=p)


@hard(
    breaks="inverse masses and inertias far apart along a strand",
    speed=10,
    except_for=swept("of the tenth of a mm: it bears what hangs from it in 5 sweeps", stretch=1.0),
)
def edges_of_tenth_of_a_mm_beside_3_cm(s: Setting) -> jh.Scene:
    edge = np.where(np.arange(8) % 2, 1e-4, 0.03)
    heading = np.radians(np.linspace(0, 60, 8))
    steps = edge[:, None] * np.stack([np.sin(heading), 0 * heading, -np.cos(heading)], 1)
    return s.scene(through(np.concatenate([np.zeros((1, 3)), steps]).cumsum(0)), *HANGING)


@hard(breaks="a strand of one edge has no bend: empty arrays")
def two_points(s: Setting) -> jh.Scene:
    return s.scene(straight((0.3, 0.0, -1.0), points=2), *HANGING)


@hard(
    breaks="one inner point, no second one",
    speed=5,
    except_for={"direct": {"smooth": KINK, "why": "see there"}},
)
def three_points(s: Setting) -> jh.Scene:
    return s.scene(straight((1.0, 0.0, 0.0), points=3), *HANGING)


@hard(
    breaks="errors that pile up along a strand; short edges, stiff against bending",
    except_for=swept(
        "five sweeps reach five points: at 500 the strand is a rubber band", stretch=40.0
    ),
    speed=10,
)
def five_hundred_points(s: Setting) -> jh.Scene:
    return s.scene(straight((1.0, 0.0, 0.0), points=500), *HANGING)


@hard(
    breaks="50 turns of twist are let loose at once",
    except_for=swept("as in five_hundred_points", stretch=40.0),
    speed=50,
)
def twist_of_50_turns(s: Setting) -> Start:
    scene = s.scene(straight(points=500), *HANGING)
    half = np.pi * 50 * np.arange(499) / 498
    spin = np.stack([np.cos(half), 0 * half, 0 * half, np.sin(half)], 1)[:, :, None]
    q = moved(scene).state.orientations
    return moved(scene, orientations=multiply(q, jnp.asarray(spin, q.dtype)))


@hard(breaks="float32 has steps of 1 um at 10 m", speed=5)
def ten_metres_from_the_origin(s: Setting) -> jh.Scene:
    return s.scene(through(helix() + np.array([10.0, -10.0, 10.0])), *HANGING)


@hard(
    breaks="missing edges of length 0 beside whole strands",
    speed=10,
    fixed=("lengths",),  # a missing edge must stay one
)
def strands_of_2_and_9_points(s: Setting) -> jh.Scene:
    points = np.stack([helix(), helix() + np.array([0, 0.01, 0])])
    return s.scene(jh.Strands.from_points(points, counts=(9, 2)), *HANGING)
