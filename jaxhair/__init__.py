"""Differentiable simulation of hair that keeps its shape through side-chain bonds."""
