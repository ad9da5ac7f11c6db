"""Errors of fitted numbers that count how uncertain the shapes are that they were fitted with.

Strands seen with noise leave open what their shapes are: those wanted, and those remembered, which
a fit takes as given. How this moves the numbers x is seen by one Newton step of the fit for other
shapes, each as likely as those taken; and what a chain of edges loses, by one for a finer chain.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import jax.numpy as jnp
import numpy as np
from scipy.stats import norm, t

from fitting.clamped import Seen, rooted
from fitting.constraints import Constraint
from fitting.many import FitEach, estimates
from fitting.targets import Shape, Target
from fitting.tiles import TILE, Tiles, freed, numbers
from jaxhair import BONDS, Scene, Strands

DRAWS = 16
"""Likely shapes of each strand."""

FINER = 1.5
"""Edges of the finer chain over those of the fit's; errors fall with their square."""

WIDTH = 30.0
"""Of the prior in a step: wide enough to leave the step to the data."""

LEVEL = 0.95


def widened(
    scene: Scene,
    free: Mapping[str, Constraint],
    states: tuple[str, str],
    seen: Seen,
    found: FitEach,
) -> FitEach:
    """A fit with errors^2 = sum d_b^2 / draws + (1.8 d_finer)^2 + its own errors^2, for steps d, +
    what no data hold, and with intervals of 95 %, ends included, shape (strands, 2).

    An interval is made where the number has no bounds, and taken back. That of the peeling rate s
    is made in the mean share of the cuticle that is lost on a strand of length L, s L / 2 up to
    1 / 2 and 1 - 1 / (2 s L) above, in which a strand's shape is about linear: s may be infinite.

    Arguments:
        states: the phases at whose ends the strands are seen, hanging and unloaded; what they are
            unloaded is what their bonds remember.
    """
    points = scene.strands.points
    hanging, unloaded = seen.chains(points, DRAWS)
    finer = seen.chains(round(FINER * (points - 1)) + 1)
    (moved, loose), (away, _) = (
        steps(scene, free, dict(zip(states, shapes, strict=True)), states[1], seen.noise_mm, found)
        for shapes in ((hanging[1:], unloaded[1:]), finer)
    )
    parameters = freed(scene, free)
    own = np.concatenate([found.number_errors[p.name] for p in parameters], axis=1)
    few = t.ppf((1 + LEVEL) / 2, DRAWS) / norm.ppf((1 + LEVEL) / 2)  # few draws say less
    chain = away[0] / (1 - FINER**-2)
    variance = few**2 * (moved**2).mean(axis=0) + loose.mean(axis=0) + chain**2 + own**2
    x = np.concatenate([found.numbers[p.name] for p in parameters], axis=1)
    covariance = variance[:, :, None] * np.eye(x.shape[1])
    with np.errstate(over="ignore"):
        estimated: dict[str, Any] = {**estimates(parameters, x, covariance, scene.dtype)}
    found = replace(found, **estimated)
    lengths = np.linalg.norm(np.diff(rooted(unloaded[0]), axis=1), axis=2).sum(axis=1)
    return replace(found, intervals=_intervals(found, scene, lengths))


def steps(
    scene: Scene,
    free: Mapping[str, Constraint],
    shapes: Mapping[str, np.ndarray],
    remembered: str,
    noise_mm: float,
    found: FitEach,
) -> tuple[np.ndarray, np.ndarray]:
    """Newton steps d = -(J' J + 1 / WIDTH^2)^-1 (J' r + (x - x_0) / WIDTH^2) from the numbers x
    found, with other shapes in the place of the scene's; and the squares by which the data leave
    each number to the prior, WIDTH^2 where they say nothing. Both of shape (draws, strands,
    numbers).

    Arguments:
        shapes: of each phase's end [m], shape (draws, strands, points, 3). remembered: the phase
            whose shape the bonds remember.
    """
    draws, count, *size = np.shape(shapes[remembered])
    flat = {name: np.reshape(x, (draws * count, *size)) for name, x in shapes.items()}
    targets: dict[str, Target] = {name: Shape(x) for name, x in flat.items()}
    scene = replace(scene, strands=Strands.from_points(jnp.asarray(flat[remembered], scene.dtype)))
    parameters = freed(scene, free)
    start = np.concatenate([numbers(p) for p in parameters], axis=1)
    x = np.tile(np.concatenate([found.numbers[p.name] for p in parameters], axis=1), (draws, 1))
    sums = Tiles(scene, targets, parameters, noise_mm, TILE).evaluate(x, np.arange(len(x)))
    known = sums.finite & np.isfinite(x).all(axis=1)
    prior = np.eye(x.shape[1]) / WIDTH**2
    curvature = np.where(known[:, None, None], sums.curvature, 0) + prior
    slope = np.where(known[:, None], sums.slope + (x - start) / WIDTH**2, 0)
    d = -np.linalg.solve(curvature, slope[..., None])[..., 0]
    d[~known] = WIDTH
    loose = (np.linalg.inv(curvature) ** 2).sum(axis=2) / WIDTH**2
    shape = draws, count, x.shape[1]
    return np.clip(d, -WIDTH, WIDTH).reshape(shape), loose.reshape(shape)


def _intervals(found: FitEach, scene: Scene, lengths: np.ndarray) -> dict[str, np.ndarray]:
    """By the names of the columns of a report."""
    ends = norm.ppf((1 + LEVEL) / 2) * np.array([-1.0, 1.0])
    hydrogen, rate = "bonds.influence", "fibre.peeling_rate"
    x, error = (each[hydrogen] for each in (found.numbers, found.number_errors))
    whole = np.asarray(scene.bonds.influence).sum()
    x, error = x + ends * error, found.number_errors[rate]
    y = found.values[rate] * lengths
    worn = np.where(y < 1, y / 2, 1 - 1 / (2 * np.maximum(y, 1)))
    slope = np.where(y < 1, y / 2, 1 / (2 * np.maximum(y, 1)))
    share = np.clip(worn[:, None] + ends * slope[:, None] * error, 0, 1)
    with np.errstate(divide="ignore"):
        length = np.where(share < 0.5, 2 * share, 1 / (2 * (1 - np.maximum(share, 0.5))))
    return {
        f"{hydrogen}[{BONDS[0]}]": whole / (1 + np.exp(-np.clip(x, -700, 700))),
        rate: length / lengths[:, None],
    }
