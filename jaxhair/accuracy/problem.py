"""The problem on which settings are compared, and its reference with a bound on its own error.

A perm in motion: straight hair is wound on a rod, bonds are cut and re-formed there, and it is
released and springs under gravity. The answer is its shape shortly after; the derivative asked for
is that of its mean height. Both transient and stiffness matter.
"""

import time
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair.direct import Direct
from jaxhair.fibre import PhysicalFibre
from jaxhair.forces import Drag, Gravity
from jaxhair.holding import Hold
from jaxhair.scene import Scene, named_leaves, replace_leaves
from jaxhair.simulate import run
from jaxhair.solvers import Solver
from jaxhair.strands import Strands
from jaxhair.treatments import perm

COMMON = 9
"""Points at which shapes are compared: they are material points of every strand with 8 m + 1."""

PARAMETERS = ("young_modulus", "disulfide_influence", "rod_diameter")
"""With respect to the logarithms of which the gradient is taken."""

_DIAMETERS = tuple(f"phases.perm, {when}.Wound.diameter" for when in ("wound", "set"))


def precision(dtype: str) -> AbstractContextManager[Any]:
    """Context in which JAX computes as it does for a user of that dtype."""
    double = dtype == "float64"
    if hasattr(jax, "enable_x64"):
        return jax.enable_x64(double)
    from jax import experimental

    older: Any = experimental
    return older.enable_x64(double)


@dataclass(frozen=True)
class Problem:
    """Equal strands, released from a rod.

    Arguments:
        strands: how many. length: of a strand [m].
        rod_diameter: [m]. climb: of the winding [rad]. seconds: from the release to the end.
    """

    strands: int = 64
    length: float = 0.24
    rod_diameter: float = 60e-3
    climb: float = 0.1
    seconds: float = 0.5

    def scene(
        self,
        solver: Solver,
        *,
        points: int,
        steps_per_second: int,
        dtype: str,
        strands: int | None = None,
    ) -> Scene:
        """The scene as arrays; to be called, and used, within `precision(dtype)`.

        Raises ValueError unless points is 8 m + 1 and the seconds are a whole number of steps.
        """
        if (points - 1) % (COMMON - 1) or points < COMMON:
            raise ValueError(f"points is {points}; it must be one of 9, 17, 25, ...")
        steps = self.seconds * steps_per_second
        if abs(steps - round(steps)) > 1e-9 or steps < 1:
            raise ValueError(
                f"steps_per_second is {steps_per_second}; {self.seconds:g} s must be whole steps"
            )
        count = self.strands if strands is None else strands
        roots = np.zeros((count, 3))
        roots[:, 1] = 1e-3 * np.arange(count)
        hair = Strands.straight(
            roots, (0.0, 0.0, -1.0), length=self.length, points=points, dtype=dtype
        )
        phases = perm(
            rod_diameter=self.rod_diameter,
            climb=self.climb,
            unload=False,
            seconds=self.seconds,
            free=(Hold(), Gravity(), Drag(0.1)),
        )
        scene = Scene(hair, PhysicalFibre(), phases=phases, solver=solver, dt=1 / steps_per_second)
        return scene.as_arrays()

    def height(self, logarithms: Array, scene: Scene) -> Array:
        """Mean height of the common points over the length, shape ().

        Arguments:
            logarithms: of the factors on `PARAMETERS`, shape (3,).
        """
        return jnp.mean(common_points(_scaled(scene, logarithms))[:, 2]) / self.length


def common_points(scene: Scene) -> Array:
    """The common points at the end, from the root [m], shape (9, 3, strands)."""
    return common(run(scene)["perm"].positions)


def common(positions: Array) -> Array:
    """Those of the points that all settings have, from the root [m], shape (9, 3, strands)."""
    x = positions[:: (positions.shape[0] - 1) // (COMMON - 1)]
    return x - x[:1]


def _scaled(scene: Scene, logarithms: Array) -> Scene:
    """The scene with the numbers named in `PARAMETERS` times exp of the logarithms."""
    leaves = named_leaves(scene)
    young, disulfide, rod = jnp.exp(logarithms)
    factors = jnp.stack([jnp.ones_like(young)] * 2 + [disulfide, jnp.ones_like(young)])
    values = {
        "fibre.young_modulus": leaves["fibre.young_modulus"] * young,
        "bonds.influence": leaves["bonds.influence"] * factors,
    }
    values |= {name: leaves[name] * rod for name in _DIAMETERS}
    return replace_leaves(scene, values)


@dataclass(frozen=True)
class Reference:
    """What settings are compared with.

    Arguments:
        shape: common points from the root [m], shape (9, 3).
        gradient: of `Problem.height`, shape (3,).
        bound: on the error of the shape, over the length.
        gradient_bound: on the error of the gradient, over its norm.
        points, steps_per_second: of the finest computation. levels: 2 or 3, see `reference`.
        seconds: that it took, compilation included.
    """

    shape: np.ndarray
    gradient: np.ndarray
    bound: float
    gradient_bound: float
    points: int
    steps_per_second: int
    levels: int
    seconds: float = 0.0

    def __str__(self) -> str:
        return (
            f"reference: Direct(newton_steps=2), float64, extrapolated from {self.points} points "
            f"and {self.steps_per_second} steps per second; its own error is below "
            f"{self.bound:.2%} of the length, that of its gradient below {self.gradient_bound:.1%}"
        )


def reference(problem: Problem, *, points: int, steps_per_second: int, levels: int) -> Reference:
    """The problem's solution by Richardson extrapolation in the points and in the time step.

    Both errors are of first order: implicit Euler is, and so is a root clamped over half an edge.
    So the difference between the finest computation and one half as fine is about the error that is
    left, and is added. What is then left is bounded, in each of the two,

    - with 2 levels by that difference itself, which holds where each next difference is at most
      two thirds of the one before (first order halves them);
    - with 3 levels, d1 the last difference and d2 the one before, by 2 |d1 - d2 / 2|, which holds
      for every further term of an order p >= 1: one of size c leaves (2^p - 2) c, and the
      bound is 2 (2^p - 1) (2^(p-1) - 1) c; and by twice what a mixed term, points times time
      step, leaves, which is the change of the last difference in the points over two time steps.

    Differences in the points are taken at twice the finest time step. The gradient is taken by
    central differences in float64, with all seven scenes in one program.
    """
    begin = time.perf_counter()
    half, quarter = (points + 1) // 2, (points + 3) // 4
    rate = steps_per_second

    def level(points: int, rate: int) -> tuple[np.ndarray, np.ndarray]:
        return _shape_and_gradient(problem, points, rate)

    fine, slow, few = level(points, rate), level(points, rate // 2), level(half, rate // 2)
    more = None
    if levels == 3:
        more = level(points, rate // 4), level(quarter, rate // 2), level(half, rate // 4)
    values, errors = [], []
    for i in range(2):
        in_time, in_points = fine[i] - slow[i], slow[i] - few[i]
        values.append(fine[i] + in_time + in_points)
        if more is None:
            errors.append(_size(in_time) + _size(in_points))
        else:
            slower, fewer, both = (m[i] for m in more)
            left = (
                in_time - (slow[i] - slower) / 2,
                in_points - (few[i] - fewer) / 2,
                in_points - (slower - both),
            )
            errors.append(2 * sum(_size(x) for x in left))
    return Reference(
        shape=values[0],
        gradient=values[1],
        bound=errors[0] / problem.length,
        gradient_bound=errors[1] / _size(values[1]),
        points=points,
        steps_per_second=rate,
        levels=levels,
        seconds=time.perf_counter() - begin,
    )


def _size(x: np.ndarray) -> float:
    """RMS length of the rows of a shape (9, 3), or norm of a gradient (3,)."""
    return float(np.sqrt(np.sum(x**2) / (len(x) if x.ndim == 2 else 1)))


def shape_error(problem: Problem, reference: Reference, shape: np.ndarray) -> float:
    """RMS distance of common points, shape (9, 3, strands), from the reference, over the length."""
    square = np.sum((np.asarray(shape, float) - reference.shape[:, :, None]) ** 2, axis=1)
    return float(np.sqrt(np.mean(square))) / problem.length


def gradient_error(reference: Reference, gradient: np.ndarray) -> float:
    """Norm of the difference from the reference's gradient, over its norm."""
    return _size(np.asarray(gradient, float) - reference.gradient) / _size(reference.gradient)


def _shape_and_gradient(problem: Problem, points: int, rate: int) -> tuple[np.ndarray, np.ndarray]:
    """Common points (9, 3) and gradient (3,) of one strand.

    The frames' inertia, which in the default acts against twist as l^2 / dt, is all but left out.
    """
    small = 1e-3
    steps = small * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    solver = Direct(newton_steps=2, frame_inertia=1e-6)
    with precision("float64"):
        scene = problem.scene(
            solver, points=points, steps_per_second=rate, dtype="float64", strands=1
        )
        ends = jax.vmap(lambda s, scene: common_points(_scaled(scene, s)), in_axes=(0, None))
        x = np.asarray(jax.jit(ends)(jnp.asarray(steps), scene))[..., 0]
    heights = x[:, :, 2].mean(axis=1) / problem.length
    return x[0], (heights[1:4] - heights[4:]) / (2 * small)
