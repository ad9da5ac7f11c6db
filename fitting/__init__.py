"""Inverse design of hair: which numbers of a scene give a wanted curl."""

from fitting.determined import Direction
from fitting.fit import Fit, fit
from fitting.measured import Measured, packaged, read
from fitting.parameters import Constraint, Interval, Parameters, Positive, Simplex, Unbounded
from fitting.strands import from_strands
from fitting.targets import Helix, Shape, Target, helix, resampled

__all__ = [
    "Constraint",
    "Direction",
    "Fit",
    "Helix",
    "Interval",
    "Measured",
    "Parameters",
    "Positive",
    "Shape",
    "Simplex",
    "Target",
    "Unbounded",
    "fit",
    "from_strands",
    "helix",
    "packaged",
    "read",
    "resampled",
]
