"""Hard cases of wind, weight, motion and time."""

from dataclasses import replace

import numpy as np

import jaxhair as jh
from hard_cases.catalogue import (
    HANGING,
    LENGTH,
    SOLVERS,
    STEP,
    WEIGHTLESS,
    WET,
    Setting,
    Start,
    among,
    blown,
    hard,
    helix,
    moved,
    straight,
    swept,
    through,
)

ALONG = (0.0, 0.0, 0.1), (0.0, 0.0, -1.0)  # blower and target on the first strand's own line
ACROSS = (0.3, 0.0, -0.1), (-0.3, 0.02, -0.1)


SHORTENED = {
    "smooth": "edges that a step turns far are shortened: a kink",
    "modes": 0.2,
    "why": "violent motion: derivatives over 8 steps are large, and rounding in float32 with them",
}


@hard(
    breaks="wind along the hair, on its axis: sine and distance are norms of 0",
    smooth="distances have a kink on the axis",
)
def wind_along_the_hair(s: Setting) -> jh.Scene:
    return s.scene(straight(), *blown(*ALONG, 100.0), bonds=WET)


@hard(
    breaks="wind of strength 0 on its axis, on wet hair",
    holds="nothing dries",
    smooth="a speed's norm has a kink at 0",
    check=lambda start, end: np.testing.assert_array_equal(end.fractions[:, 0], 0.5),
)
def wind_of_no_strength(s: Setting) -> jh.Scene:
    return s.scene(straight(), *blown(*ALONG, 0.0), bonds=WET)


@hard(
    breaks="the wind's axis goes through a point of the hair",
    smooth="distances have a kink on the axis",
    speed=20,
)
def wind_through_a_point(s: Setting) -> jh.Scene:
    at = (0.3, 0.0, -0.12), (-0.3, 0.0, -0.12)
    return s.scene(straight(), *blown(*at, 100.0), bonds=WET)


@hard(breaks="air of 100 m/s: 50 g across the hair", speed=150, stretch=0.1)
def wind_of_100_metres_a_second(s: Setting) -> jh.Scene:
    return s.scene(straight(), *blown(*ACROSS, 500.0), bonds=WET)


@hard(
    breaks="wind that adds 100 m/s in every step: 3700 g",
    speed=2e3,
    stretch=0.5,
    except_for={"direct": SHORTENED},
)
def wind_of_36000_metres_a_second_squared(s: Setting) -> jh.Scene:
    return s.scene(straight(), *blown(*ACROSS, 36000.0), bonds=WET)


@hard(
    breaks="gravity of 10^4 g",
    holds="direct: two Newton steps",
    speed=1e3,
    end_speed=1e-3,
    stretch=0.02,
    except_for={
        **swept("stretch of a swept strand grows with its weight", stretch=100.0),
        "direct": SHORTENED,
    },
)
def gravity_of_1e5(s: Setting) -> jh.Scene:
    hair, heavy = straight((1.0, 0.0, -0.2)), jh.Gravity((0.0, 0.0, -1e5))
    return s.scene(hair, jh.Hold(), heavy, jh.Drag(0.2), solver=twice(s))


def twice(s: Setting) -> object:
    """The solver; the direct one with two Newton steps. With one, hair that has to turn under a
    thousand times its own weight stays within a tenth of its length and never comes to rest."""
    return jh.Direct(newton_steps=2) if s.solver == "direct" else SOLVERS[s.solver]


@hard(breaks="air that takes all speed in a step", speed=1)
def drag_of_a_picosecond(s: Setting) -> jh.Scene:
    return s.scene(straight((1.0, 0.0, 0.0)), jh.Hold(), jh.Gravity(), jh.Drag(1e-12))


def thrown(scene: jh.Scene, speed: float) -> Start:
    """The same start, with every point at a speed in a direction of its own."""
    v = np.random.default_rng(2).normal(size=moved(scene).state.velocities.shape)
    return moved(scene, velocities=speed * v / np.linalg.norm(v, axis=1, keepdims=True))


@hard(
    breaks="points at 1 km/s, each its own way: 3 m a step in hair of 24 cm",
    speed=2e3,
    except_for={"direct": SHORTENED},
)
def speed_of_1_km_a_second(s: Setting) -> Start:
    return thrown(s.scene(straight(), *HANGING), 1e3)


@hard(breaks="no point held, no force", speed=5)
def free_strand(s: Setting) -> Start:
    return thrown(s.scene(through(helix()), jh.Drag(1e9)), 1.0)


@hard(
    breaks="the root jumps by the hair's length in one step",
    speed=500,
    except_for={"direct": SHORTENED},
)
def root_jumps_by_the_hairs_length(s: Setting) -> Start:
    scene = s.scene(straight(), *HANGING)
    p = np.array(moved(scene).state.positions)
    p[0, 0] += LENGTH
    return moved(scene, positions=p)


@hard(
    breaks="the root runs on by the hair's length in every step",
    speed=500,
    stretch=0.5,
    except_for={"direct": SHORTENED},
)
def root_runs_by_the_hairs_length_a_step(s: Setting) -> jh.Scene:
    runs = (LENGTH / STEP, 0.0, 0.0), (0.0, 0.0, 0.0)
    return s.scene(straight(), *among(root_moves=runs))


@hard(
    breaks="the root turns by more than half a turn a step, the tip at 100 m/s",
    speed=200,
    stretch=0.5,
    except_for={"direct": SHORTENED},
)
def root_spins_at_200_turns_a_second(s: Setting) -> jh.Scene:
    spins = (0.0, 0.0, 0.0), (0.0, 0.0, 2 * np.pi * 200.0)
    return s.scene(through(helix()), *among(root_moves=spins))


@hard(
    breaks="both ends held, 1.5 of the hair's length apart: 20 N",
    smooth="forces that would break hair jump with a micrometre",
    speed=200,
    stretch=1.2,
    except_for={
        "direct": SHORTENED,
        "direct-float32": {
            "slopes": 2,
            "modes": 1e-4,
            "why": "derivatives are 1e8 after 2 steps and 4 after 8, where all digits are rounding",
        },
    },
)
def pulled_to_one_and_a_half_lengths(s: Setting) -> Start:
    scene = s.scene(straight(), *HANGING, jh.Hold("tip"))
    p = np.array(moved(scene).state.positions)
    p[-1] *= 1.5
    return moved(scene, positions=p)


@hard(breaks="everything is held: no mass is free", speed=1e-3, stretch=1e-6)
def all_is_held(s: Setting) -> jh.Scene:
    return s.scene(straight(points=2), *HANGING, jh.Hold("tip"))


@hard(
    breaks="a weight 600 times the hair's own at its tip",
    holds="direct: two Newton steps",
    speed=200,
    stretch=1e-3,
    end_speed=1e-3,
    except_for={
        "direct": SHORTENED,
        "compliant": {"stretch": 20.0, "why": "stretch of a swept strand grows with its load"},
        "paper": {"stretch": 0.02, "end_speed": 0.1, "why": "no unit, no weight: it hangs alone"},
        "sequential": {
            "stretch": 0.02,
            "end_speed": 0.1,
            "why": "no unit, no weight: it hangs alone",
        },
    },
)
def weight_of_1_gramme_at_the_tip(s: Setting) -> jh.Scene:
    pull = (jh.TipForce((0.0, 0.0, -9.8e-3)),) if s.physical else ()
    return s.scene(through(helix()), *HANGING, *pull, solver=twice(s))


@hard(breaks="1 / dt^2 is 10^10", speed=1, steps=2000)
def dt_of_1e_minus_5(s: Setting) -> jh.Scene:
    return s.scene(through(helix()), *HANGING, dt=1e-5)


@hard(
    breaks="a step as long as a film's frame",
    speed=20,
    except_for=swept("stretch of a swept strand grows as dt^2", stretch=2.5),
)
def dt_of_a_24th(s: Setting) -> jh.Scene:
    return s.scene(through(helix()), *HANGING, dt=1 / 24)


@hard(breaks="100 sweeps or 5 Newton steps: convergence must not turn into noise")
def many_iterations(s: Setting) -> jh.Scene:
    more = {"newton_steps": 5} if s.solver == "direct" else {"iterations": 100}
    return s.scene(through(helix()), *HANGING, solver=replace(SOLVERS[s.solver], **more))


@hard(breaks="nothing acts, and the hair rests in a coil", speed=1e-3, stretch=1e-5)
def coil_at_rest_without_weight(s: Setting) -> jh.Scene:
    return s.scene(through(helix()), *WEIGHTLESS)
