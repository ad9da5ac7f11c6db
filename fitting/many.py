"""Fits of many strands at once, each with numbers of its own.

Strands that do not touch do not know of each other: the derivatives of all strands in their own
n numbers take n tangents, whatever the number of strands. A tile of strands is simulated with its
derivatives by one compiled program; Levenberg and Marquardt's steps are taken outside, in float64,
with a damping for each strand.
"""

import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.parameters import Constraint
from fitting.targets import Shape, Target
from jaxhair import HairContact, Scene, check, named_leaves, run
from jaxhair.effects import of_kind
from jaxhair.strands import strands_last

Progress = Callable[[int, float], None]

TILE = 64
"""Strands simulated together: the fastest of `tests/benchmarks/many_strands.py`."""

MM = 1e3
FIRST_DAMPING, LARGEST_DAMPING = 1e-3, 1e12
"""Relative to the diagonal of the normal equations."""

OWN_AXES = {"bonds.influence": 1, "bonds.fraction": 1}
"""Axes of a leaf besides that of the strands, where that is not the only one."""


@dataclass(frozen=True)
class FitEach:
    """What a fit of each strand found. A strand that could not be fitted has a reason.

    Arguments:
        values: of each parameter, by the name it was freed with; shape (strands, ...).
        errors: standard errors of the values, of the same shapes; see `fit_each`.
        numbers, number_errors: free numbers x of each parameter, and their standard errors, of
            shape (strands, its free numbers).
        residual_mm: root mean square distance between simulated and wanted points [mm], shape
            (strands,), as all below.
        converged: whether a strand met the tolerance.
        reasons: why a strand could not be fitted; None where it was.
        steps: simulations that a strand took. seconds: of all, compilation included.
    """

    values: dict[str, np.ndarray]
    errors: dict[str, np.ndarray]
    numbers: dict[str, np.ndarray]
    number_errors: dict[str, np.ndarray]
    residual_mm: np.ndarray
    converged: np.ndarray
    reasons: tuple[str | None, ...]
    steps: np.ndarray
    seconds: float

    @property
    def fitted(self) -> np.ndarray:
        """True where a strand has no reason why it could not be fitted, shape (strands,)."""
        return np.array([reason is None for reason in self.reasons])

    def summary(self) -> list[str]:
        """Time, quantiles of the residual, and of the numbers of those that were fitted."""
        fitted = self.fitted
        lines = [f"{self.seconds:.0f} s, at most {self.steps.max()} simulations a strand"]
        known = self.residual_mm[np.isfinite(self.residual_mm)]
        if known.size:
            shares = (0.0, 0.25, 0.5, 0.75, 0.95, 1.0)
            found = ", ".join(
                f"{q:.0%} {x:.3g}" for q, x in zip(shares, np.quantile(known, shares), strict=True)
            )
            lines.append(f"residual [mm], share of strands at or below: {found}")
        if not fitted.any():
            return lines
        rows: list[tuple[str, np.ndarray, np.ndarray]] = []
        for name, value in self.values.items():
            shown, errors = f"{name}", self.errors[name]
            if value[0].size > 4:  # a whole shape says nothing in a line
                shown, value, errors = f"{name}, x", self.numbers[name], self.number_errors[name]
            for label in np.ndindex(value.shape[1:]):
                end = f"[{','.join(map(str, label))}]" if label else ""
                rows.append((shown + end, *(x[fitted][:, *label] for x in (value, errors))))
        size = max((len(name) for name, _, _ in rows), default=0)
        lines.append(f"{'':{size}}  {'10 %':>9} {'median':>9} {'90 %':>9}  standard error (median)")
        for name, value, error in rows:
            low, middle, high = np.quantile(value, (0.1, 0.5, 0.9))
            lines.append(
                f"{name:{size}}  {low:9.3g} {middle:9.3g} {high:9.3g}  {np.median(error):.2g}"
            )
        return lines

    def __str__(self) -> str:
        lines = [f"{self.fitted.sum()} of {len(self.reasons)} strands fitted", *self.summary()]
        left = [(i, reason) for i, reason in enumerate(self.reasons) if reason is not None]
        lines += [f"strand {i}: {reason}" for i, reason in left[:10]]
        if len(left) > 10:
            lines.append(f"and {len(left) - 10} more could not be fitted")
        return "\n".join(lines)


def fit_each(
    scene: Scene,
    targets: Mapping[str, Target],
    free: Mapping[str, Constraint],
    *,
    steps: int = 30,
    tolerance: float = 1e-4,
    noise_mm: float = 0.1,
    prior_width: float = 3.0,
    bar_mm: float | None = None,
    tile: int | None = None,
    progress: Progress | None = None,
) -> FitEach:
    """The numbers of each strand with which it takes its wanted shape.

    For each strand the least F(x) = |r(x)|^2 / noise^2 + |x - x_0|^2 / prior_width^2, with the
    distances r of its points from the wanted ones and its free numbers x, which start at x_0.

    Standard errors are those of the linearised problem (Laplace): the covariance of x is the
    inverse of J' J / noise^2 + 1 / prior_width^2, where noise is at least what the residuals say,
    and a value's is D C D' with its derivative D in x.

    Arguments:
        scene: strands that do not touch, with the values to start from.
        targets: from the name of a phase to the shape wanted at its end.
        free: from a leaf's name to the constraint on every strand's own value. Leaves of the
            fibre, the bonds and the strands, and single numbers of effects; a name with `*` is
            one parameter in all leaves that match, such as "phases.*.Wound.diameter".
        steps: largest number of simulations, each with its derivatives.
        tolerance: a strand is fitted when a whole Newton step would lower F by less than this
            share of 1 + F / residuals: its numbers are then within sqrt(tolerance) standard errors.
        noise_mm: standard error of a target's points [mm], where it has none of its own.
        prior_width: see `fitting.fit`.
        bar_mm: a strand with a residual above it counts as not fitted [mm]; if not given, a
            twentieth of the strand's length.
        tile: strands that are simulated together.
        progress: called with the number of simulations so far and the residual of all [mm].

    Tiles go to `jax.devices()` in turn. A strand that has converged is simulated no more.

    Raises ValueError for an unknown phase or leaf, a leaf that cannot differ between strands,
    targets of other numbers than points, and hair that touches hair.
    """
    check.instance("scene", scene, Scene)
    check.whole("steps", steps, least=1)
    tolerance = check.constant("tolerance", tolerance)
    noise_mm = check.constant("noise_mm", noise_mm)
    prior_width = check.constant("prior_width", prior_width)
    bars = _bars(scene, bar_mm)
    check.whole("tile", TILE if tile is None else tile, least=1)
    begin = time.perf_counter()
    parameters = _freed(scene, free)
    problem = _Problem(scene, _checked(scene, targets), parameters, noise_mm, tile or TILE)
    start = np.concatenate([_numbers(p) for p in parameters], axis=1)
    found = _levenberg_marquardt(
        problem, start, steps, tolerance, prior_width, progress or (lambda step, residual: None)
    )
    reasons = list(found.reasons)
    for i, (residual, bar) in enumerate(zip(found.sums.residual_mm, bars, strict=True)):
        if reasons[i] is None and residual > bar:
            reasons[i] = f"residual of {residual:.3g} mm, above {bar:.3g} mm"
    spread = np.maximum(1, found.sums.square / max(problem.residuals - start.shape[1], 1))
    normal = found.sums.curvature / spread[:, None, None] + np.eye(start.shape[1]) / prior_width**2
    values, errors, numbers, number_errors = {}, {}, {}, {}
    begins = np.cumsum([0, *(p.size for p in parameters)])
    with np.errstate(all="ignore"):
        covariance = _inverse(normal)
        for p, first, last in zip(parameters, begins[:-1], begins[1:], strict=True):
            numbers[p.name] = found.x[:, first:last]
            own = covariance[:, first:last, first:last]
            number_errors[p.name] = np.sqrt(np.einsum("sii->si", own))
            values[p.name], errors[p.name] = _values(p, numbers[p.name], own, scene.dtype)
    return FitEach(
        values=values,
        errors=errors,
        numbers=numbers,
        number_errors=number_errors,
        residual_mm=found.sums.residual_mm,
        converged=found.converged,
        reasons=tuple(reasons),
        steps=found.steps,
        seconds=time.perf_counter() - begin,
    )


@dataclass(frozen=True)
class _Freed:
    """Numbers that every strand has its own of.

    leaves: their places among the scene's leaves. start: shape (strands, ...). column: the leaf is
    one number of an effect, which is put as (1, 1, strands).
    """

    name: str
    constraint: Constraint
    leaves: tuple[int, ...]
    start: np.ndarray
    column: bool
    size: int


def _freed(scene: Scene, free: Mapping[str, Constraint]) -> tuple[_Freed, ...]:
    check.instance("free", free, Mapping)
    if not free:
        raise ValueError("free is empty; it must name at least one leaf of the scene")
    leaves = named_leaves(scene)
    names = list(leaves)
    found: list[_Freed] = []
    for name, constraint in free.items():
        shown = check.short(name)
        if not isinstance(constraint, Constraint):
            wanted = "it must be a constraint"
            raise ValueError(f"free[{shown}] is {check.short(constraint)}; {wanted}")
        matches = [n for n in names if n == name or fnmatchcase(n, str(name))]
        if not matches:
            raise ValueError(f"free names {shown}; it must be one of {check.listed(names)}")
        starts = [_start(scene, n, leaves[n]) for n in matches]
        if any(s.shape != starts[0].shape or np.any(s != starts[0]) for s in starts):
            raise ValueError(f"free names {shown}, whose leaves start with different values")
        places = tuple(names.index(n) for n in matches)
        if any(set(places) & set(p.leaves) for p in found):
            raise ValueError(f"free names {shown}, of which a leaf is named twice")
        try:
            size = np.asarray(constraint.free(starts[0][0])).size
        except ValueError as error:
            raise ValueError(f"free names {shown}, whose {error}") from error
        column = matches[0].startswith(("phases.", "solver."))
        found.append(_Freed(name, constraint, places, starts[0], column, size))
    return tuple(found)


def _start(scene: Scene, name: str, leaf: Any) -> np.ndarray:
    """The value of a leaf for each strand."""
    value, count = np.asarray(leaf, float), scene.strands.count
    of_strands = name.startswith("strands.")
    if value.ndim == OWN_AXES.get(name, 0) and not of_strands:
        return np.broadcast_to(value, (count, *value.shape)).copy()
    if not name.startswith(("strands.", "bonds.", "fibre.")) or len(value) not in (1, count):
        wanted = "it must be of the fibre, the bonds or the strands, or a single number"
        raise ValueError(f"free names {name!r}, which cannot differ between strands; {wanted}")
    return np.broadcast_to(value, (count, *value.shape[1:])).copy()


def _numbers(p: _Freed) -> np.ndarray:
    """Free numbers to start from, shape (strands, free numbers)."""
    try:
        return np.stack([np.ravel(p.constraint.free(value)) for value in p.start])
    except ValueError as error:
        raise ValueError(f"free names {check.short(p.name)}, whose {error}") from error


def _checked(scene: Scene, targets: Mapping[str, Target]) -> dict[str, Target]:
    check.instance("targets", targets, Mapping)
    if not targets:
        raise ValueError("targets is empty; it must name at least one phase")
    for name, target in targets.items():
        scene.phase(name)
        check.instance(f"targets[{name!r}]", target, Target)
        if isinstance(target, Shape):
            wanted = (scene.strands.count, scene.strands.points, 3)
            check.shape(f"targets[{name!r}].strands", target.strands, wanted)
    for phase in scene.phases:
        if of_kind(phase.effects, HairContact):
            raise ValueError(
                f"phase {phase.name!r} has a HairContact; strands that are fitted each by itself "
                "must not touch"
            )
    return dict(targets)


def _bars(scene: Scene, bar_mm: float | None) -> np.ndarray:
    """The largest residual of each strand that counts as fitted [mm]."""
    if bar_mm is not None:
        return np.full(scene.strands.count, check.constant("bar_mm", bar_mm))
    lengths = MM * np.asarray(scene.strands.lengths, float).sum(axis=1)
    return np.broadcast_to(lengths / 20, (scene.strands.count,))


class _Squares(NamedTuple):
    """Of each strand |r|^2, J' r and J' J, in standard errors, and its residual [mm]."""

    square: np.ndarray
    slope: np.ndarray
    curvature: np.ndarray
    residual_mm: np.ndarray

    @property
    def finite(self) -> np.ndarray:
        return np.isfinite(self.square) & np.isfinite(self.curvature).all(axis=(1, 2))


class _Problem:
    """Squares of the residuals and their derivatives, as functions of the strands' free numbers.

    residuals: number of them a strand.
    """

    def __init__(
        self,
        scene: Scene,
        targets: dict[str, Target],
        parameters: tuple[_Freed, ...],
        noise_mm: float,
        tile: int,
    ) -> None:
        self.scene, self.parameters = scene.as_arrays(), parameters
        self.targets = targets
        self.tile = min(tile, scene.strands.count)
        leaves, self.structure = jax.tree.flatten(self.scene)
        names = list(named_leaves(self.scene))
        freed = {place for p in parameters for place in p.leaves}
        of_strands = {
            i: np.asarray(leaf)
            for i, (name, leaf) in enumerate(zip(names, leaves, strict=True))
            if i not in freed and _has_strands(name, leaf, scene.strands.count)
        }
        self.shared = {i: x for i, x in enumerate(leaves) if i not in of_strands}
        shapes = {n: t.strands for n, t in targets.items() if isinstance(t, Shape)}
        # everything of which each strand has its own, with the strands first
        self.own: Any = jax.tree.map(
            lambda x: np.asarray(x, self.scene.dtype),
            {"leaves": of_strands, "shapes": shapes, "starts": [p.start for p in parameters]},
        )
        self.devices = jax.devices()
        self._evaluate = jax.jit(self._residuals_and_jacobian)
        self.weights = MM / noise_mm * np.concatenate(self._sizes(noise_mm))
        self.residuals = self.weights.size

    def _sizes(self, noise_mm: float) -> list[np.ndarray]:
        """Of each target noise_mm over its own error, as often as it has residuals a strand.

        Finds out, without computing, whether all leaves take a value for each strand.
        """
        first = np.arange(self.tile)
        numbers = sum(p.size for p in self.parameters)
        x = np.zeros((numbers, self.tile), self.scene.dtype)
        try:
            with jax.numpy_rank_promotion("raise"):  # where a leaf is no column, shapes get wrong
                shapes = jax.eval_shape(self._simulated, x, self._tile(first))
        except (TypeError, ValueError) as error:
            columns = [p.name for p in self.parameters if p.column]
            if not columns:
                raise
            shown = check.listed(columns)
            raise ValueError(f"free names {shown}, which cannot differ between strands") from error
        sizes = []
        wanted = (self.scene.strands.points, 3, self.tile)
        for name, target in self.targets.items():
            if shapes[name].shape != wanted:
                raise ValueError(
                    f"targets[{name!r}] has residuals of shape {shapes[name].shape}; a target of "
                    "each strand must want points, as Shape and Helix do"
                )
            noise = getattr(target, "error", None)
            share = 1.0 if noise is None else noise_mm / (MM * float(noise))
            sizes.append(np.full(wanted[0] * 3, share))
        return sizes

    def _tile(self, strands: np.ndarray) -> Any:
        return jax.tree.map(lambda x: x[strands], self.own)

    def _simulated(self, x: Array, own: Any) -> dict[str, Array]:
        """Residuals [m] of each target, shape (points, 3, strands), for x (numbers, strands)."""
        leaves, begin = {**self.shared, **own["leaves"]}, 0
        for p, start in zip(self.parameters, own["starts"], strict=True):
            value = jax.vmap(p.constraint.value)(x[begin : begin + p.size].T, start)
            value = value.astype(x.dtype).reshape(start.shape)
            begin += p.size
            for place in p.leaves:
                leaves[place] = value.reshape(1, 1, -1) if p.column else value
        scene = jax.tree.unflatten(self.structure, [leaves[i] for i in range(len(leaves))])
        ends = run(scene)
        lengths = strands_last(scene.strands.lengths)[:, None]
        found = {}
        for name, target in self.targets.items():
            if isinstance(target, Shape):
                target = replace(target, strands=own["shapes"][name])
            found[name] = target.residuals(ends[name], lengths)
        return found

    def _residuals_and_jacobian(self, x: Array, own: Any) -> tuple[Array, Array]:
        """Residuals [m], shape (m, strands), and their derivatives, shape (n, m, strands)."""

        def residuals(x: Array) -> Array:
            parts = self._simulated(x, own).values()
            return jnp.concatenate([r.reshape(-1, r.shape[-1]) for r in parts])

        def along(direction: Array) -> tuple[Array, Array]:
            change = jnp.broadcast_to(direction[:, None], x.shape)
            return jax.jvp(residuals, (x,), (change,))

        return jax.vmap(along, out_axes=(None, 0))(jnp.eye(x.shape[0], dtype=x.dtype))

    def _tiles(self, x: np.ndarray, strands: np.ndarray) -> Iterator[tuple[slice, Any]]:
        """Places of each tile's strands, and what was simulated; a few tiles are under way."""
        waiting: deque[tuple[slice, Any]] = deque()
        for number, first in enumerate(range(0, len(strands), self.tile)):
            places = slice(first, min(first + self.tile, len(strands)))
            few = np.arange(first, first + self.tile)
            few = np.minimum(few, len(strands) - 1)  # the last strand fills up the last tile
            inputs = np.ascontiguousarray(x[few].T, self.scene.dtype), self._tile(strands[few])
            device = self.devices[number % len(self.devices)]
            waiting.append((places, self._evaluate(*jax.device_put(inputs, device))))
            if len(waiting) > 2 * len(self.devices):
                yield waiting.popleft()
        yield from waiting

    def evaluate(self, x: np.ndarray, strands: np.ndarray) -> "_Squares":
        """Sums over the residuals of the named strands, in float64.

        The products are made here: in float32 they would lose what the data hardly determine.

        Arguments:
            x: free numbers, shape (strands, n). strands: their places in the scene.
        """
        n, count = x.shape[1], len(strands)
        square, slope, curvature = np.empty(count), np.empty((count, n)), np.empty((count, n, n))
        residual = np.empty(count)
        with np.errstate(all="ignore"):
            for places, arrays in self._tiles(x, strands):
                size = places.stop - places.start
                raw, jacobian = (np.asarray(a, float)[..., :size] for a in arrays)
                residual[places] = MM * np.sqrt(3 * np.mean(raw**2, axis=0))
                r = (raw * self.weights[:, None]).T[..., None]
                j = np.moveaxis(jacobian * self.weights[:, None], -1, 0)
                square[places] = (r**2).sum(axis=(1, 2))
                slope[places] = (j @ r)[..., 0]
                curvature[places] = j @ np.swapaxes(j, 1, 2)
        return _Squares(square, slope, curvature, residual)


def _has_strands(name: str, leaf: Any, strands: int) -> bool:
    """Whether a leaf's first axis is that of the strands."""
    if name.startswith("strands."):
        return len(leaf) == strands
    own = OWN_AXES.get(name, 0)
    return name.startswith(("bonds.", "fibre.")) and leaf.ndim > own and len(leaf) == strands


@dataclass
class _Found:
    """Free numbers of the strands, the sums there, and how each ended."""

    x: np.ndarray
    sums: _Squares
    converged: np.ndarray
    reasons: list[str | None]
    steps: np.ndarray


def _levenberg_marquardt(
    problem: _Problem,
    start: np.ndarray,
    steps: int,
    tolerance: float,
    prior_width: float,
    progress: Progress,
) -> _Found:
    """Steps d of (A + mu diag A) d = -g, with the damping mu of each strand by its gain ratio
    (Nielsen, Damping parameter in Marquardt's method, 1999).
    """
    count, n = start.shape
    everyone = np.arange(count)
    now = _Found(
        start.copy(),
        problem.evaluate(start, everyone),
        np.zeros(count, bool),
        [None] * count,
        np.ones(count, int),
    )
    progress(1, _rms(now.sums.residual_mm))
    alive = now.sums.finite
    for i in everyone[~alive]:
        now.reasons[i] = "not finite at its start"
    damping, growth = np.full(count, FIRST_DAMPING), np.full(count, 2.0)
    for step in range(2, steps + 1):
        at = everyone[alive & ~now.converged]
        total, g, a = _whole(now, start, at, prior_width)
        enough = tolerance * (1 + total / problem.residuals)
        newton = _solved(a, -g)
        near = -(g * newton).sum(axis=1) <= enough
        now.converged[at[near]] = True
        at, total, g, a, enough = (x[~near] for x in (at, total, g, a, enough))
        if not at.size:
            break
        diagonal = np.einsum("sii->si", a)
        d = _solved(a + damping[at, None, None] * diagonal[:, :, None] * np.eye(n), -g)
        # no further at once than is plausible at all
        d /= np.maximum(np.abs(d).max(axis=1, keepdims=True) / prior_width, 1)
        expected = -2 * (g * d).sum(axis=1) - np.einsum("si,sij,sj->s", d, a, d)
        new = problem.evaluate(now.x[at] + d, at)
        prior = ((now.x[at] + d - start[at]) ** 2).sum(axis=1) / prior_width**2
        with np.errstate(all="ignore"):
            gain = np.where(new.finite, (total - new.square - prior) / expected, -np.inf)
        better = gain > 1e-3
        good, bad = at[better], at[~better]
        now.x[good] += d[better]
        for old, value in zip(now.sums, new, strict=True):
            old[good] = value[better]
        now.steps[at] = step
        damping[good] *= np.maximum(1 / 3, 1 - (2 * np.minimum(gain[better], 1) - 1) ** 3)
        growth[good] = 2
        damping[bad] *= growth[bad]
        growth[bad] *= 2
        # what is left to gain is less than the simulation's rounding
        now.converged[bad] = ((expected < 100 * enough) & new.finite)[~better]
        for i in bad[damping[bad] > LARGEST_DAMPING]:
            alive[i], now.reasons[i] = False, "no step lowers its residual"
        progress(step, _rms(now.sums.residual_mm))
    for i in everyone[alive & ~now.converged]:
        now.reasons[i] = f"not converged in {steps} steps"
    return now


def _whole(now: _Found, start: np.ndarray, at: np.ndarray, prior_width: float) -> tuple[Any, ...]:
    """F, half its gradient g and half its second derivatives A of some strands, prior included."""
    away, weight = now.x[at] - start[at], 1 / prior_width**2
    return (
        now.sums.square[at] + weight * (away**2).sum(axis=1),
        now.sums.slope[at] + weight * away,
        now.sums.curvature[at] + weight * np.eye(start.shape[1]),
    )


def _solved(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """x of a x = b for each strand."""
    return np.linalg.solve(a, b[..., None])[..., 0]


def _inverse(a: np.ndarray) -> np.ndarray:
    """Of each strand's matrix; NaN where that is not finite."""
    finite = np.isfinite(a).all(axis=(1, 2))
    safe = np.where(finite[:, None, None], a, np.eye(a.shape[-1]))
    return np.where(finite[:, None, None], np.linalg.inv(safe), np.nan)


def _rms(residual_mm: np.ndarray) -> float:
    """Of all strands whose residual is known; NaN if none is."""
    known = residual_mm[np.isfinite(residual_mm)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


def _values(
    p: _Freed, numbers: np.ndarray, covariance: np.ndarray, dtype: Any
) -> tuple[np.ndarray, np.ndarray]:
    """Values and their standard errors, of shape (strands, ...)."""
    x, start = jnp.asarray(numbers, dtype), jnp.asarray(p.start, dtype)

    def value(x: Array, start: Any) -> Array:
        return p.constraint.value(x, start).reshape(start.shape)

    derivative = np.asarray(jax.vmap(jax.jacfwd(value))(x, start), float)
    d = derivative.reshape(len(numbers), -1, p.size)
    variance = np.einsum("svi,sij,svj->sv", d, covariance, d)
    return np.asarray(jax.vmap(value)(x, start), float), np.sqrt(variance).reshape(p.start.shape)
