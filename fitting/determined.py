"""What the data determine, and what they do not."""

from dataclasses import dataclass

import jax
import numpy as np
from jax import Array

from fitting.parameters import Parameters


@dataclass(frozen=True)
class Direction:
    """A combination of numbers that the data do not determine.

    Arguments:
        change: of each number along the direction, by its label, largest first; the largest is 1.
        uncertainty: standard deviation along it, in free numbers (1 is a factor of e for a
            positive number); infinite if the data do not see it at all.
    """

    change: dict[str, float]
    uncertainty: float

    def __str__(self) -> str:
        parts = [f"{value:+.2f} {label}" for label, value in self.change.items()]
        return " ".join(parts)


def undetermined(
    parameters: Parameters,
    free: Array,
    jacobian: np.ndarray,
    *,
    noise: float = 1.0,
    limit: float = 0.3,
) -> tuple[tuple[Direction, ...], np.ndarray]:
    """Directions in which the fitted numbers may move with little change of the shapes.

    With J = U S V^T, noise of standard deviation e on each residual leaves the free numbers
    uncertain by e / S_i along V_i. A direction counts as undetermined where that exceeds `limit`.

    Arguments:
        free: fitted free numbers, shape (n,). jacobian: of the residuals, shape (m, n).
        noise: standard error of each residual. limit: in free numbers; 0.3 is a factor of 1.35.
    Returns the directions, least determined first, and the singular values.
    """
    if not np.all(np.isfinite(jacobian)):
        singular = np.full(len(free), np.nan)
        everything = dict.fromkeys(parameters.labels(), 1.0)
        return (Direction(everything, np.inf),), singular
    _, singular, vt = np.linalg.svd(jacobian.astype(float), full_matrices=True)
    singular = np.concatenate([singular, np.zeros(len(vt) - len(singular))])
    slopes = np.asarray(jax.jacfwd(parameters.flat_values)(free), float)
    labels = parameters.labels()
    found = []
    for value, direction in zip(singular[::-1], vt[::-1], strict=True):
        uncertainty = noise / value if value > 0 else np.inf
        if uncertainty <= limit:
            break
        change = slopes @ direction
        change = change / change[np.argmax(np.abs(change))]
        order = np.argsort(-np.abs(change), kind="stable")
        shown = {labels[i]: float(change[i]) for i in order if abs(change[i]) > 0.02}
        found.append(Direction(shown, float(uncertainty)))
    return tuple(found), singular
