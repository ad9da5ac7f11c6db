"""Inverse design of hair: which numbers of a scene give a wanted curl."""

from fitting.constraints import (
    Constraint,
    Interval,
    PerExperiment,
    PerStrand,
    Positive,
    Simplex,
    Unbounded,
)
from fitting.curls import Curl, Curvatures
from fitting.design import Design, Unreachable, Wish, design
from fitting.determined import Direction
from fitting.fit import Fit, fit
from fitting.many import FitEach, fit_each
from fitting.measured import Measured, packaged, read
from fitting.natural import Natural, natural
from fitting.parameters import Parameters
from fitting.posterior import Posterior, posterior
from fitting.profile import Profile, profile
from fitting.starts import Basin
from fitting.strands import from_strands
from fitting.targets import Helix, PointTarget, Shape, Target, helix, resampled
from fitting.uncertainty import Uncertainty

__all__ = [
    "Basin",
    "Constraint",
    "Curl",
    "Curvatures",
    "Design",
    "Direction",
    "Fit",
    "FitEach",
    "Helix",
    "Interval",
    "Measured",
    "Natural",
    "Parameters",
    "PerExperiment",
    "PerStrand",
    "PointTarget",
    "Positive",
    "Posterior",
    "Profile",
    "Shape",
    "Simplex",
    "Target",
    "Unbounded",
    "Uncertainty",
    "Unreachable",
    "Wish",
    "design",
    "fit",
    "fit_each",
    "from_strands",
    "helix",
    "natural",
    "packaged",
    "posterior",
    "profile",
    "read",
    "resampled",
]
