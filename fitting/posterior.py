"""The full posterior of a fit, by a sampler: what Laplace's interval takes for a Gaussian.

No-U-turn sampler (Hoffman, Gelman, Journal of Machine Learning Research 15 (2014) 1593) of the
package blackjax, which the extra `posterior` installs.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.fit import Fit
from fitting.optimisers import METHODS, strong
from jaxhair import check
from jaxhair.extras import optional

ACCEPTED = 0.8
"""Share of proposals that the step size is adapted to."""

TOLD = ("acceptance_rate", "is_divergent", "num_integration_steps")
"""What is kept of the sampler's report on a draw."""

SPLIT = 4
"""Fewest draws for which convergence can be said: chains are split in half."""


@dataclass(frozen=True)
class Posterior:
    """Draws from the posterior of a fit's numbers.

    Arguments:
        draws: values by the parameter's name, shape (chains, draws, *the value's shape).
        labels: of the single numbers, as in `Uncertainty`.
        medians, low, high: of each number, shape (n,): quantiles 1/2, (1 - level) / 2 and
            (1 + level) / 2. level: of the intervals.
        rhat: of each number: 1 where the chains agree, above 1.01 where they have not converged
            (rank-normalised, split; Vehtari et al., Bayesian Analysis 16 (2021) 667).
        effective: draws that would be worth as much if they were independent, of each number,
            shape (n,) (bulk; the same source).
        acceptance: mean probability by which proposals were accepted.
        divergences: draws whose trajectory left the energy: where there are some, a part of the
            posterior may have been missed.
        simulations: with their derivatives that it took. seconds: compilation included.
    """

    draws: dict[str, np.ndarray]
    labels: tuple[str, ...]
    medians: np.ndarray
    low: np.ndarray
    high: np.ndarray
    level: float
    rhat: np.ndarray
    effective: np.ndarray
    acceptance: float
    divergences: int
    simulations: int
    seconds: float

    def interval(self, label: str) -> tuple[float, float]:
        """The interval of one number. Raises ValueError for an unknown label."""
        check.choice("label", label, self.labels)
        i = self.labels.index(label)
        return float(self.low[i]), float(self.high[i])

    def __str__(self) -> str:
        width = max(34, *(len(label) for label in self.labels))
        percent = f"{100 * self.level:g} % interval"
        lines = [f"{'parameter':<{width}} {'median':>12}   {percent:<24} {'R-hat':>6} {'draws':>6}"]
        for i, label in enumerate(self.labels):
            ends = f"{self.low[i]:.4g} to {self.high[i]:.4g}"
            lines.append(
                f"{label:<{width}} {self.medians[i]:>12.5g}   {ends:<24} {self.rhat[i]:6.3f} "
                f"{self.effective[i]:6.0f}"
            )
        lines.append(
            f"{self.simulations} simulations in {self.seconds:.0f} s; {self.acceptance:.0%} "
            f"accepted, {self.divergences} divergences"
        )
        return "\n".join(lines)


def posterior(
    found: Fit,
    *,
    draws: int = 500,
    chains: int = 4,
    warm_up: int = 100,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Posterior:
    """Draws from exp(-chi^2 / 2), with chi^2 = |r_data|^2 / max(1, scatter)^2 + |r_prior|^2.

    These are the terms of the fit and of `Uncertainty.covariance`; the density is that of the free
    numbers, in which the fit's prior is Gaussian. Chains start at draws from Laplace's
    approximation, and move in its standard deviations, so that only the step size is left to adapt.

    A draw of a chain takes about 3 simulations with their derivatives where Laplace's approximation
    holds, and a hundred or more where the data leave combinations of numbers open.

    Arguments:
        found: a fit with loss "linear".
        draws: of each chain. chains: at least 2. warm_up: draws before, which are left out.
        seed: of the random numbers.
        progress: called after each draw with their number so far and in the end.

    Raises ValueError for a robust loss or a fit without a finite covariance; ImportError without
    the extra `posterior`.
    """
    check.instance("found", found, Fit)
    check.whole("draws", draws, least=SPLIT)
    check.whole("chains", chains, least=2)
    check.whole("warm_up", warm_up, least=1)
    check.whole("seed", seed, least=0)
    if found.settings["loss"] != "linear":
        raise ValueError(f"loss is {found.settings['loss']!r}; it must be 'linear'")
    spread = found.uncertainty
    if not np.isfinite(spread.covariance).all():
        raise ValueError("the fit's covariance is not finite; its values must be")
    nuts, diagnostics, adaptation = (
        optional(f"blackjax.{name}", "posterior")
        for name in ("mcmc.nuts", "diagnostics", "adaptation.step_size")
    )
    begin = time.perf_counter()
    parameters = found.problem.parameters
    dtype = found.problem.start.dtype
    root = _root(spread.covariance)
    middle, axes = jnp.asarray(found.free, dtype), jnp.asarray(root, dtype)

    def free(place: Array) -> Array:
        """Free numbers at a place in standard deviations about the fit."""
        return middle + axes @ place

    density = _log_density(found, free)
    kernel = nuts.build_kernel()
    adapted_from, adapted, final = adaptation.dual_averaging_adaptation(ACCEPTED)
    unit = jnp.ones(len(root), dtype)

    @jax.jit
    def step(key: Array, states: Any, adapting: Any, warming: Any) -> Any:
        """The next draw of all chains, each with its own step size, adapted while they warm up."""

        def one(key: Array, state: Any, adapting: Any) -> Any:
            size = jnp.where(warming, jnp.exp(adapting.log_step_size), final(adapting))
            state, info = kernel(key, state, density, size, unit)
            new = adapted(adapting, info.acceptance_rate)
            adapting = jax.tree.map(lambda a, b: jnp.where(warming, a, b), new, adapting)
            return state, strong(adapting), tuple(getattr(info, name) for name in TOLD)

        return jax.vmap(one)(jax.random.split(key, chains), states, adapting)

    def summary(places: Array) -> Any:
        """Values by name, and in one vector; how far the chains agree on them."""
        each = jax.vmap(jax.vmap(lambda place: parameters.values(free(place))))(places)
        flat = jax.vmap(jax.vmap(lambda place: parameters.flat_values(free(place))))(places)
        return each, flat, diagnostics.rhat(flat), diagnostics.ess_bulk(flat)

    key, first = jax.random.split(jax.random.key(seed))
    start = jax.random.normal(first, (chains, len(root)), dtype)
    states = jax.jit(jax.vmap(lambda place: nuts.init(place, density)))(start)
    adapting = strong(jax.vmap(adapted_from)(jnp.ones(chains, dtype)))
    places, told = [], []
    for number in range(warm_up + draws):
        key, now = jax.random.split(key)
        states, adapting, info = step(now, states, adapting, number < warm_up)
        places.append(states.position)
        told.append(jax.tree.map(np.asarray, info))  # waits for it
        if progress is not None:
            progress(number + 1, warm_up + draws)
    acceptance, divergent, integrations = (np.stack(x) for x in zip(*told, strict=True))
    kept = jnp.stack(places[warm_up:], axis=1)
    values, flat, rhat, effective = jax.tree.map(np.asarray, jax.jit(summary)(kept))
    tail = (1 - spread.level) / 2
    low, medians, high = np.quantile(flat.astype(float), (tail, 0.5, 1 - tail), axis=(0, 1))
    return Posterior(
        draws=values,
        labels=spread.labels,
        medians=medians,
        low=low,
        high=high,
        level=spread.level,
        rhat=np.ravel(rhat).astype(float),
        effective=np.ravel(effective).astype(float),
        acceptance=float(acceptance[warm_up:].mean()),
        divergences=int(divergent[warm_up:].sum()),
        simulations=int(integrations.sum()) + chains,
        seconds=time.perf_counter() - begin,
    )


def _log_density(found: Fit, free: Callable[[Array], Array]) -> Callable[[Array], Array]:
    """-chi^2 / 2 of a place, shape (n,), with its gradient by the mode that the fit took."""
    problem = found.problem
    weight = 1 / max(1.0, found.uncertainty.scatter)

    def residuals(place: Array) -> Array:
        each = problem.residuals(free(place), problem.states)[0]
        return jnp.concatenate([weight * each[: problem.size], each[problem.size :]])

    def value(place: Array) -> Array:
        return -jnp.sum(residuals(place) ** 2) / 2

    if found.settings["method"] != METHODS[0]:
        return value
    density = jax.custom_jvp(value)

    @density.defjvp
    def _(places: Any, directions: Any) -> Any:
        # few numbers: the Jacobian by forward mode costs less than a gradient by reverse mode
        each, derivative = jax.linearize(residuals, places[0])
        jacobian = jax.vmap(derivative)(jnp.eye(places[0].size, dtype=each.dtype))
        return -jnp.sum(each**2) / 2, -(jacobian @ each) @ directions[0]

    return density


def _root(covariance: np.ndarray) -> np.ndarray:
    """L with L L^T = covariance, where rounding may have made it singular, too."""
    values, vectors = np.linalg.eigh(covariance)
    root: np.ndarray = vectors * np.sqrt(np.maximum(values, np.finfo(float).tiny))
    return root
