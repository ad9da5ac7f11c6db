"""Hard cases of hair against hair and of hair against things."""

from collections.abc import Callable
from typing import Any

import numpy as np

import jaxhair as jh
from hard_cases.catalogue import HANGING, Setting, Start, among, hard, moved, straight

BEGINS = "contact begins and ends in kinks"

PUSHED_OUT = {
    "direct-float32": {
        "slopes": 2,
        "why": "pushed out at up to 200 m/s, slopes grow a thousandfold in two steps, and rounding "
        "with them: over 8 steps forward and reverse mode part by 0.01 % to 12 %, in float64 by "
        "1e-11",
    }
}


def pair(first: Any, second: Any) -> jh.Strands:
    """Two straight strands, each from a root in a direction."""
    roots, directions = zip(first, second, strict=True)
    return jh.Strands.straight(
        np.array(roots, float), np.array(directions, float), length=0.24, points=9, dtype="float64"
    )


def touching(s: Setting, hair: jh.Strands, strength: float = 20.0) -> jh.Scene:
    """Hair of 2 mm radius that hangs and collides."""
    return s.scene(hair, *HANGING, jh.HairContact(radius=2e-3, strength=strength))


@hard(breaks="two hairs cross in a point of both: no way to part is the shorter", smooth=BEGINS)
def hairs_that_cross_exactly(s: Setting) -> jh.Scene:
    return touching(s, pair(((-0.12, 0, 0), (1, 0, 0)), ((0, -0.12, 0), (0, 1, 0))))


@hard(breaks="two hairs exactly two radii apart", smooth=BEGINS)
def hairs_that_just_touch(s: Setting) -> jh.Scene:
    return touching(s, pair(((0, 0, 0), (0, 0, -1)), ((0, 4e-3, 0), (0, 0, -1))))


@hard(
    breaks="two hairs in the same place",
    smooth="no direction leads apart",
)
def hairs_that_coincide(s: Setting) -> jh.Scene:
    return touching(s, pair(((0, 0, 0), (0, 0, -1)), ((0, 0, 0), (0, 0, -1))))


@hard(breaks="a hair begins where another ends, on its line", smooth=BEGINS)
def hairs_end_to_end(s: Setting) -> jh.Scene:
    return touching(s, pair(((0, 0, 0), (0, 0, -1)), ((0, 0, -0.24), (0, 0, -1))))


@hard(
    breaks="hairs 10 um apart push each other with 10^5 m/s^2",
    smooth=BEGINS,
    speed=1e3,
    except_for={
        "direct": {"stretch": 0.2, "why": "one Newton step keeps lengths to a tenth in such motion"}
    },
)
def stiff_contact(s: Setting) -> jh.Scene:
    return touching(s, pair(((0, 0, 0), (0, 0, -1)), ((0, 1e-5, 0), (0, 0, -1))), 1e5)


BALL = (0.0, 0.0, -0.12)


def outside(distance: Callable[[np.ndarray], Any], depth: float) -> Any:
    """A check that all points but the held ones are outside, to a depth [m]."""

    def check(start: Start, end: jh.State) -> None:
        found = np.min(distance(np.asarray(end.positions, float)[1:]))
        assert found > -depth, found

    return check


def from_ball(x: np.ndarray) -> Any:
    return np.linalg.norm(x - np.array(BALL)[:, None], axis=1) - 0.05


@hard(
    breaks="a ball's centre is a point of the hair: no way out is the shortest",
    holds="hair that goes through a ball's middle stays stuck there, and still",
    smooth="at the centre no direction leads out",
    speed=100,
    end_speed=0.5,
    stretch=0.5,
    except_for=PUSHED_OUT,
)
def ball_centred_on_a_point(s: Setting) -> jh.Scene:
    return s.scene(straight(), *among(ball=(BALL, 0.05)))


@hard(
    breaks="the hair lies on a rod's axis",
    smooth="on the axis no direction leads out",
    speed=100,
    stretch=0.5,
)
def rod_along_the_hair(s: Setting) -> jh.Scene:
    return s.scene(straight(), *among(rod=((0, 0, -0.65), (0, 0, 1.0), 0.02)))


@hard(
    breaks="all of the hair starts inside a ball",
    smooth=BEGINS,
    speed=200,
    stretch=3.0,
    except_for=PUSHED_OUT,
)
def hair_inside_a_ball(s: Setting) -> jh.Scene:
    return s.scene(straight(), *among(ball=((0.03, 0.0, -0.12), 0.3)))


@hard(
    breaks="points exactly on the floor, at rest",
    holds="it stays there",
    smooth=BEGINS,
    speed=0.05,
    check=outside(lambda x: x[:, 2], 1e-4),
)
def lying_on_the_floor(s: Setting) -> jh.Scene:
    return s.scene(straight((1.0, 0.0, 0.0)), *among(floor=(0.0, 0.5)))


@hard(
    breaks="the hair is pressed on the floor and drawn over it",
    smooth=BEGINS,
    check=outside(lambda x: x[:, 2], 1e-3),
)
def sliding_on_the_floor(s: Setting) -> Start:
    pulled = (0.5, 0.0, 0.0), (0.0, 0.0, 0.0)
    scene = s.scene(straight((-1.0, 0.0, 0.0)), *among(floor=(0.0, 0.5), root_moves=pulled))
    p = np.array(moved(scene).state.positions)
    p[:, 2] -= 1e-4
    return moved(scene, positions=p)


@hard(breaks="friction that holds whatever it touches", smooth=BEGINS, speed=20)
def friction_of_1e6(s: Setting) -> jh.Scene:
    return s.scene(straight((1.0, 0.0, -0.3)), *among(floor=(-0.05, 1e6)))


@hard(
    breaks="hair draped over a ball slides off it",
    smooth=BEGINS,
    check=outside(from_ball, 3e-3),
)
def draped_over_a_ball(s: Setting) -> jh.Scene:
    hair = pair(((-0.1, 0, -0.06), (1, 0, 0)), ((-0.1, 0.01, -0.06), (1, 0, 0)))
    return s.scene(hair, *among(ball=(BALL, 0.05)))


@hard(
    breaks="a spinning rod comes by at 30 m/s: four of its radii a step",
    smooth=BEGINS,
    speed=1e3,
    stretch=0.5,
)
def rod_at_30_metres_a_second(s: Setting) -> jh.Scene:
    rod = (-1.0, 0.0, -0.12), (0.0, 1.0, 0.0), 0.02
    moves = (30.0, 0.0, 0.0), (0.0, 1e3, 0.0)
    return s.scene(straight(), *among(rod=rod, rod_moves=moves))
