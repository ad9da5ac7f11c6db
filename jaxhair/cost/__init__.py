"""What each effect of a scene costs: time, operations and memory of a step, with and without it."""

from jaxhair.cost.measuring import Part, PhaseCost, SceneCost, measured

__all__ = ["Part", "PhaseCost", "SceneCost", "measured"]
