"""Obstacles that hair cannot enter, with friction: floor, sphere, cylinder."""

from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxhair import check
from jaxhair import quaternion as quat
from jaxhair.effects import PositionEffect
from jaxhair.pytree import pytree
from jaxhair.rods import Rod
from jaxhair.strands import column

Mesh = tuple[np.ndarray, np.ndarray]
"""Vertices [m], shape (vertices, 3), and triangles, shape (triangles, 3), to draw."""


class Obstacle(PositionEffect):
    """A moving solid. Points inside are put on its surface; Coulomb friction slows their slip."""

    centre: Any
    friction: Any
    velocity: Any
    angular_velocity: Any

    @abstractmethod
    def surface(self, offset: Array) -> tuple[Array, Array]:
        """Signed distance (points, 1, strands) and outward normal (points, 3, strands).

        offset: points [m] relative to the obstacle's centre, shape (points, 3, strands).
        """

    @abstractmethod
    def mesh(self, time: float) -> Mesh:
        """The obstacle at a time within the phase [s], to draw."""

    def centre_at(self, time: Any, like: Array) -> Array:
        """Centre at a time within the phase, shape (1, 3, 1)."""
        centre = column(self.centre, like)
        return centre if self.velocity is None else centre + time * column(self.velocity, like)

    def projected(
        self, rod: Rod, positions: Array, previous: Array, time: Array, dt: float
    ) -> Array:
        """Positions outside the obstacle, their slip along its surface reduced by friction.

        x1 = x + depth n; then slip_t (1 - min(1, mu depth / |slip_t|)) of the tangential slip is
        left (Mueller et al., Position Based Dynamics, 2006; DOI 10.1016/j.jvcir.2007.01.005).
        """
        centre = self.centre_at(time + dt, positions)
        distance, normal = self.surface(positions - centre)
        depth = jnp.maximum(-distance, 0)
        outside = positions + depth * normal
        slip = outside - previous
        for carried in self._carried(outside - centre, dt):
            slip = slip - carried
        slip = slip - quat.dot(slip, normal) * normal
        size = quat.safe_norm(slip)
        stop = self.friction * depth
        sticks = size <= stop
        left = jnp.where(sticks, 0, 1 - stop / jnp.where(sticks, 1, size))
        slowed = outside - (1 - left) * slip
        touches = (depth > 0) & (rod.point_weights > 0)
        return jnp.where(touches, slowed, positions)

    def _carried(self, offset: Array, dt: float) -> Iterator[Array]:
        """Displacements of the obstacle's own surface over a step, by its motion and its spin."""
        if self.velocity is not None:
            yield dt * column(self.velocity, offset)
        if self.angular_velocity is not None:
            spin = jnp.broadcast_to(column(self.angular_velocity, offset), offset.shape)
            yield dt * quat.cross(spin, offset)

    def _check_motion(self) -> None:
        name = type(self).__name__
        check.not_negative(f"{name}.friction", self.friction)
        if self.velocity is not None:
            check.vector(f"{name}.velocity", self.velocity)
        if self.angular_velocity is not None:
            check.vector(f"{name}.angular_velocity", self.angular_velocity)


@pytree
class Floor(Obstacle):
    """The half space below a height.

    Arguments:
        height: z of the floor [m]. friction: mu.
        velocity: of the floor [m/s], shape (3,); None stands still.
    """

    each_strand_alone = True
    height: Any = 0.0
    friction: Any = 0.0
    velocity: Any = None

    def __post_init__(self) -> None:
        check.number("Floor.height", self.height)
        self._check_motion()

    @property
    def centre(self) -> Array:
        height = jnp.asarray(self.height)
        return jnp.stack([jnp.zeros_like(height), jnp.zeros_like(height), height])

    @property
    def angular_velocity(self) -> None:
        return None

    def surface(self, offset: Array) -> tuple[Array, Array]:
        """Height above the floor; straight up."""
        up = jnp.broadcast_to(column((0, 0, 1), offset), offset.shape)
        return offset[:, 2:], up

    def mesh(self, time: float, size: float = 0.5) -> Mesh:
        """A square of side 2 size."""
        z = float(self.height) + (0.0 if self.velocity is None else time * float(self.velocity[2]))
        corners = [(-size, -size, z), (size, -size, z), (size, size, z), (-size, size, z)]
        return np.array(corners), np.array([(0, 1, 2), (0, 2, 3)])


@pytree
class Sphere(Obstacle):
    """A ball, such as a head.

    Arguments:
        centre: [m], shape (3,). radius: [m]. friction: mu.
        velocity: [m/s], angular_velocity: [rad/s], shape (3,); None stands still.
    """

    each_strand_alone = True
    centre: Any
    radius: Any
    friction: Any = 0.0
    velocity: Any = None
    angular_velocity: Any = None

    def __post_init__(self) -> None:
        check.vector("Sphere.centre", self.centre)
        check.positive("Sphere.radius", self.radius)
        self._check_motion()

    def surface(self, offset: Array) -> tuple[Array, Array]:
        """|x| - R and x / |x|; straight up at the very centre."""
        distance = quat.safe_norm(offset)
        up = column((0, 0, 1), offset)
        return distance - self.radius, jnp.where(distance == 0, up, quat.unit(offset))

    def mesh(self, time: float, segments: int = 24) -> Mesh:
        """Triangles of a globe."""
        polar = np.linspace(0, np.pi, segments // 2 + 1)[:, None]
        azimuth = np.linspace(0, 2 * np.pi, segments, endpoint=False)[None]
        x = np.stack(
            [
                np.sin(polar) * np.cos(azimuth),
                np.sin(polar) * np.sin(azimuth),
                np.broadcast_to(np.cos(polar), (len(polar), segments)),
            ],
            axis=-1,
        )
        vertices = _place(self, time) + float(self.radius) * x.reshape(-1, 3)
        return vertices, _grid_triangles(len(polar), segments)


@pytree
class Cylinder(Obstacle):
    """The side of a round rod, such as a perm rod; hair passes its open ends.

    Arguments:
        centre: middle of the axis [m], shape (3,). axis: its direction, shape (3,), not zero.
        radius: [m]. friction: mu.
        length: [m] along the axis; None has no ends.
        velocity: [m/s], angular_velocity: [rad/s], shape (3,); None stands still. The axis keeps
            its direction: the rod may only spin about it.
    """

    each_strand_alone = True
    centre: Any
    axis: Any
    radius: Any
    friction: Any = 0.0
    length: Any = None
    velocity: Any = None
    angular_velocity: Any = None

    def __post_init__(self) -> None:
        check.vector("Cylinder.centre", self.centre)
        check.direction("Cylinder.axis", self.axis)
        check.positive("Cylinder.radius", self.radius)
        if self.length is not None:
            check.positive("Cylinder.length", self.length)
        self._check_motion()

    def surface(self, offset: Array) -> tuple[Array, Array]:
        """Distance to the axis less R, and the direction away from the axis."""
        axis = quat.unit(column(self.axis, offset))
        along = quat.dot(offset, axis)
        away = offset - along * axis
        distance = quat.safe_norm(away)
        normal = jnp.where(distance == 0, quat.perpendicular(axis), quat.unit(away))
        depth = distance - self.radius
        if self.length is not None:
            depth = jnp.where(jnp.abs(along) <= self.length / 2, depth, 1)
        return depth, normal

    def mesh(self, time: float, segments: int = 24) -> Mesh:
        """Triangles of the side; 2 m long if the cylinder has no ends."""
        axis = np.asarray(self.axis, float) / np.linalg.norm(np.asarray(self.axis, float))
        length = 2.0 if self.length is None else float(self.length)
        first = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        first /= np.linalg.norm(first)
        second = np.cross(axis, first)
        turn = np.linspace(0, 2 * np.pi, segments, endpoint=False)[:, None]
        ring = float(self.radius) * (np.cos(turn) * first + np.sin(turn) * second)
        ends = [_place(self, time) + ring + side * length / 2 * axis for side in (-1, 1)]
        return np.concatenate(ends), _grid_triangles(2, segments)


def _place(obstacle: Obstacle, time: float) -> np.ndarray:
    centre = np.asarray(obstacle.centre, float)
    return centre if obstacle.velocity is None else centre + time * np.asarray(obstacle.velocity)


def _grid_triangles(rows: int, columns: int) -> np.ndarray:
    """Triangles of a grid of vertices whose columns close to a ring."""
    row, col = np.meshgrid(np.arange(rows - 1), np.arange(columns), indexing="ij")
    a = (row * columns + col).ravel()
    b = (row * columns + (col + 1) % columns).ravel()
    return np.concatenate(
        [np.stack([a, b, b + columns], 1), np.stack([a, b + columns, a + columns], 1)]
    )
