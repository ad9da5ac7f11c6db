"""Differentiable simulation of hair that keeps its shape through side-chain bonds."""

from jaxhair import scenes, treatments
from jaxhair.accuracy import cheapest
from jaxhair.bonds import Bonds, Cut, Reform
from jaxhair.contact import HairContact
from jaxhair.direct import Direct
from jaxhair.export import save
from jaxhair.fibre import Fibre, PhysicalFibre, Soften
from jaxhair.files import Curves, read_curves, read_strands, write_curves
from jaxhair.forces import Drag, DryingWind, Gravity, TipForce, Wind
from jaxhair.holding import Hold, Unloaded, Wound
from jaxhair.obstacles import Cylinder, Floor, Sphere
from jaxhair.pytree import pytree
from jaxhair.recording import NotFinite, Recording, simulate
from jaxhair.scene import Phase, Scene, named_leaves, replace_leaves
from jaxhair.simulate import run
from jaxhair.solvers import Compliant, PositionBased
from jaxhair.strands import BONDS, State, Strands
from jaxhair.viewer import view

__all__ = [
    "BONDS",
    "Bonds",
    "Compliant",
    "Curves",
    "Cut",
    "Cylinder",
    "Direct",
    "Drag",
    "DryingWind",
    "Fibre",
    "Floor",
    "Gravity",
    "HairContact",
    "Hold",
    "NotFinite",
    "Phase",
    "PhysicalFibre",
    "PositionBased",
    "Recording",
    "Reform",
    "Scene",
    "Soften",
    "Sphere",
    "State",
    "Strands",
    "TipForce",
    "Unloaded",
    "Wind",
    "Wound",
    "cheapest",
    "named_leaves",
    "pytree",
    "read_curves",
    "read_strands",
    "replace_leaves",
    "run",
    "save",
    "scenes",
    "simulate",
    "treatments",
    "view",
    "write_curves",
]
