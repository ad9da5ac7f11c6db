"""What accuracy costs: error against time for every setting, and the cheapest for an error."""

from jaxhair.accuracy.table import Choice, cheapest

__all__ = ["Choice", "cheapest"]
