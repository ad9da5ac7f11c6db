"""Smooth curves through the noisy points of strands, and others that are as likely.

A polyline through points with noise is too long, by 2 noise^2 / edge for each edge, and it cuts
corners. Here a strand's points are y = x(u) + e at their chord lengths u, with e ~ N(0, noise^2),
and the third derivative of x is white noise of its own: the likeliest curve is then a smoothing
spline of degree 5, and how wrong it may be is known (Wahba, Journal of the Royal Statistical
Society B 45 (1983) 133). How rough the curves are, and how large the noise of a file is, are those
with which the points are likeliest (Wahba, Annals of Statistics 13 (1985) 1378).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import eigh

DEGREE, DERIVATIVE = 5, 3
"""Of the spline, and the derivative that is noise."""

MOST_COEFFICIENTS = 80
"""Of a strand."""

PENALTIES = np.geomspace(1e-16, 1e4, 101)
"""Tried, over the geometric mean of the modes' own."""

NOISES = np.geomspace(1e-9, 1e-1, 161)
"""Tried, in lengths of the strand of median length."""

ALONG = 3 / 2
"""Noise along a strand only moves u: of three coordinates' noise two are seen."""


@dataclass(frozen=True)
class Curve:
    """All curves of a strand, by their likelihood: Gaussian, in modes that the points show with
    equal noise each.

    Arguments:
        knots, degree: of the B-splines. modes: their coefficients, shape (coefficients, modes).
        middle: of each mode in the likeliest curve [m], shape (modes, 3).
        errors: standard deviations of the modes [m], shape (modes,).
    """

    knots: np.ndarray
    degree: int
    modes: np.ndarray
    middle: np.ndarray
    errors: np.ndarray

    def likely(self, draws: int, rng: np.random.Generator) -> np.ndarray:
        """Spline coefficients of the likeliest curve and of random ones by their likelihood, shape
        (coefficients, 1 + draws, 3)."""
        off = self.errors[:, None, None] * rng.normal(size=(len(self.middle), draws, 3))
        middle = self.middle[:, None]
        return np.tensordot(self.modes, np.concatenate([middle, middle + off], axis=1), 1)

    def at(self, shares: np.ndarray, coefficients: np.ndarray) -> np.ndarray:
        """Points at shares of the arc length [m], shape (curves, shares, 3).

        Arguments:
            shares: in [0, 1], shape (shares,). coefficients: shape (coefficients, curves, 3).
        """
        u = np.linspace(0, 1, 20 * len(self.knots) + 1)
        speed = np.linalg.norm(self._spline(coefficients)(u, 1), axis=-1)
        along = np.concatenate([0 * speed[:1], (speed[1:] + speed[:-1]).cumsum(axis=0)])
        out = np.empty((coefficients.shape[1], len(shares), 3))
        for i in range(len(out)):
            places = np.interp(shares * along[-1, i], along[:, i], u)
            out[i] = self._spline(coefficients[:, i])(places)
        return out

    def _spline(self, coefficients: np.ndarray) -> BSpline:
        return BSpline(self.knots, coefficients, self.degree)


def smoothed(strands: Sequence[np.ndarray]) -> tuple[list[Curve], float]:
    """The curves of a file's strands, each as rough as its points say, and the noise of the file: a
    coordinate's standard error [m].

    Arguments:
        strands: points [m], each of shape (points, 3), of which no two neighbours are one.
    """
    each = [_Points.of(x) for x in strands]
    tried = NOISES * np.median([x.length for x in each])
    unlikely = np.sum([x.unlikely(tried).min(axis=1) for x in each], axis=0)
    noise = float(tried[np.argmin(unlikely)])
    return [x.curve(noise) for x in each], float(np.sqrt(ALONG)) * noise


@dataclass(frozen=True)
class _Points:
    """What the points of one strand say.

    Arguments:
        given: of each mode [m], shape (modes, 3). rough: how much the prior holds it down where
            the penalty is 1, shape (modes,); 0 for polynomials that have no such derivative.
        left: sum of the squares that no mode takes [m^2]. count: of points.
    """

    knots: np.ndarray
    degree: int
    modes: np.ndarray
    given: np.ndarray
    rough: np.ndarray
    left: float
    count: int
    length: float

    @staticmethod
    def of(x: np.ndarray) -> "_Points":
        n = len(x)
        u = np.append(0, np.linalg.norm(np.diff(x, axis=0), axis=1).cumsum())
        length, u = float(u[-1]), u / u[-1]
        degree, size = min(DEGREE, n - 1), min(n, MOST_COEFFICIENTS)
        sites = np.interp(np.linspace(0, n - 1, size), np.arange(n), u)
        inner = [sites[j : j + degree].mean() for j in range(1, size - degree)]
        knots = np.concatenate([np.zeros(degree + 1), inner, np.ones(degree + 1)])
        design = BSpline.design_matrix(u, knots, degree).toarray()
        order = min(DERIVATIVE, degree)
        nodes, weights = np.polynomial.legendre.leggauss(degree)
        ends = np.unique(knots)
        half = np.diff(ends)[:, None] / 2
        slopes = BSpline(knots, np.eye(size), degree)(
            (ends[:-1, None] + half * (1 + nodes)).ravel(), order
        )
        penalty = slopes.T @ ((half * weights).ravel()[:, None] * slopes)
        rough, modes = eigh(penalty, design.T @ design)
        rough[:order] = 0
        rough /= np.exp(np.log(np.maximum(rough[order:], 1e-300)).mean()) if size > order else 1
        given = modes.T @ (design.T @ x)
        left = float(((x - design @ (modes @ given)) ** 2).sum())
        return _Points(knots, degree, modes, given, rough, left, n, length)

    def unlikely(self, noises: np.ndarray) -> np.ndarray:
        """-2 log of the likelihood, shape (noises, penalties)."""
        there = self.rough > 0
        weak = PENALTIES[:, None] * self.rough[there]
        square = self.left + weak / (1 + weak) @ (self.given[there] ** 2).sum(axis=1)
        number = 3 * (self.count - len(self.rough) + there.sum())
        size = 3 * np.log1p(1 / weak).sum(axis=1)
        return square / noises[:, None] ** 2 + number * np.log(noises[:, None] ** 2) + size

    def curve(self, noise: float) -> Curve:
        """The curves where that is the noise across the strand [m]."""
        best = int(np.argmin(self.unlikely(np.array([noise]))))
        held = 1 + PENALTIES[best] * self.rough
        errors = np.sqrt(ALONG / held) * noise
        return Curve(self.knots, self.degree, self.modes, self.given / held[:, None], errors)
