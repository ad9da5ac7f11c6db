"""Wanted numbers of curls: measured diameters and the like, and curvatures along strands."""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting import measures
from fitting.targets import Target
from jaxhair import State, check, pytree
from jaxhair.strands import strands_first

MEASURES = ("diameter", "pitch", "waves", "index", "extent")


@pytree
class Curl(Target):
    """Measured numbers of curls, each with its standard error: `Curl(diameter=(25e-3, 1e-3))`.

    Arguments:
        diameter, pitch: of the curl [m]. waves: its turns. index: contour length over the distance
            of root and tip. extent: that distance [m]. Each is a value and its standard error,
            shape (2,), of the mean over the strands; or shape (2, strands), of every strand; or
            None where it was not measured. See `fitting.measures`.

    Diameters and indices are compared by their inverses, which are finite for straight hair and
    for ends that meet: to first order the same.
    Raises ValueError where nothing was measured, and for values and errors not above 0.
    """

    diameter: Any = None
    pitch: Any = None
    waves: Any = None
    index: Any = None
    extent: Any = None

    def __post_init__(self) -> None:
        given = [name for name in MEASURES if getattr(self, name) is not None]
        if not given:
            raise ValueError(f"Curl has no measure; it must have one of {', '.join(MEASURES)}")
        for name in given:
            shape = check.size(f"Curl.{name}", getattr(self, name))
            if shape[:1] != (2,) or len(shape) > 2:
                check.shape(f"Curl.{name}", getattr(self, name), (2,))
            check.positive(f"Curl.{name}", getattr(self, name), many=True)

    @property
    def error(self) -> float:
        """Residuals are counted in standard errors."""
        return 1.0

    def residuals(self, state: State, lengths: Array) -> Array:
        """(simulated - wanted) / error of each measure, shape (n,)."""
        points = strands_first(state.positions)
        found = simulated(points)
        residuals = []
        for name in MEASURES:
            given = getattr(self, name)
            if given is None:
                continue
            value, error = jnp.asarray(given, points.dtype)
            if name in ("diameter", "index"):
                value, error = 1 / value, error / value**2
            number = found[name] if value.ndim else jnp.mean(found[name], keepdims=True)
            residuals.append(jnp.ravel((number - value) / error))
        return jnp.concatenate(residuals)

    def compared(self, points: Any) -> dict[str, tuple[float, float, float]]:
        """Of each measure the simulated mean, the wanted one and its error.

        points: simulated [m], shape (strands, points, 3).
        """
        found = simulated(jnp.asarray(points))
        out = {}
        for name in MEASURES:
            if getattr(self, name) is not None:
                value, error = np.asarray(getattr(self, name), float)
                number = float(jnp.mean(found[name]))
                if name in ("diameter", "index"):
                    number = 1 / number if number else np.inf
                out[name] = (number, float(np.mean(value)), float(np.mean(error)))
        return out


def simulated(points: Array) -> dict[str, Array]:
    """Each measure of each strand, diameters and indices by their inverses, shape (strands,).

    points: [m], shape (strands, points, 3).
    """
    curl, extent = measures.curl(points), measures.extent(points)
    return {
        "diameter": curl.curliness,
        "pitch": curl.pitch,
        "waves": curl.waves,
        "index": extent / measures.length(points),
        "extent": extent,
    }


@pytree
class Curvatures(Target):
    """Curvature and torsion along given strands: the shape, wherever its curls stand and begin.

    Two curls that differ a little in their pitch are far apart point by point, and the more so the
    longer they are, and near by these numbers.

    Arguments:
        strands: points [m], shape (strands, points, 3), as many as in the scene; see `resampled`.
        error: standard error of a curvature [1/m].

    Torsions count as the wanted curvature beside them over its mean: a straight place has none.
    """

    strands: Any
    error: Any = 1.0

    def __post_init__(self) -> None:
        check.shape("target.strands", self.strands, ("strands", "points", 3))
        check.finite("target.strands", self.strands)
        check.positive("target.error", self.error)
        if np.shape(self.strands)[1] < 4:
            check.shape("target.strands", self.strands, ("strands", "4 or more", 3))

    def residuals(self, state: State, lengths: Array) -> Array:
        """Differences of curvature and of weighted torsion [1/m], shape (strands, 2 points - 5)."""
        points = strands_first(state.positions)
        check.shape("target.strands", self.strands, points.shape)
        wanted = jnp.asarray(self.strands, points.dtype)
        bent = measures.curvature(wanted)
        mean = jnp.mean(bent, axis=1, keepdims=True)
        straight = mean == 0
        weight = jnp.sqrt(bent[:, :-1] * bent[:, 1:]) / jnp.where(straight, 1, mean)
        curvature = measures.curvature(points) - bent
        torsion = weight * (measures.torsion(points) - measures.torsion(wanted))
        return jnp.concatenate([curvature, torsion], axis=1)
