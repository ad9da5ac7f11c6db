"""Differentiable simulation of hair that keeps its shape through side-chain bonds."""

from jaxhair.pytree import pytree

__all__ = ["pytree"]
