"""Inverse design of hair: which numbers of a scene give a wanted curl."""

from fitting.curls import Curl, Curvatures
from fitting.determined import Direction
from fitting.fit import Basin, Fit, fit
from fitting.measured import Measured, packaged, read
from fitting.parameters import (
    Constraint,
    Interval,
    Parameters,
    PerExperiment,
    PerStrand,
    Positive,
    Simplex,
    Unbounded,
)
from fitting.strands import from_strands
from fitting.targets import Helix, PointTarget, Shape, Target, helix, resampled
from fitting.uncertainty import Uncertainty

__all__ = [
    "Basin",
    "Constraint",
    "Curl",
    "Curvatures",
    "Direction",
    "Fit",
    "Helix",
    "Interval",
    "Measured",
    "Parameters",
    "PerExperiment",
    "PerStrand",
    "PointTarget",
    "Positive",
    "Shape",
    "Simplex",
    "Target",
    "Unbounded",
    "Uncertainty",
    "fit",
    "from_strands",
    "helix",
    "packaged",
    "read",
    "resampled",
]
