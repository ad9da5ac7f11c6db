"""Poses at the ends of their ranges: rods thinner than an edge, half turns, nothing bonded."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

import jaxhair as jh
from jaxhair.simulate import posed, prepare, start


def coil() -> jh.Strands:
    """One strand of 9 points, 3 cm apart, on a helix."""
    angle = np.linspace(0, 6, 9)
    points = 0.03 * np.stack([np.cos(angle), np.sin(angle), -angle / 4], 1)
    return jh.Strands.from_points(points[None])


def test_a_rod_that_is_thinner_than_an_edge() -> None:
    """A fit may try one, as traced numbers are not checked: finite, and so is the slope."""
    scene = jh.Scene(coil()).as_arrays()

    @jax.jit
    @jax.value_and_grad
    def tip(diameter: jax.Array) -> jax.Array:
        return posed(prepare(scene, (jh.Wound(diameter),)), start(scene)).positions[-1].sum()

    for diameter in (1e-3, float(jnp.max(scene.strands.lengths))):
        assert np.isfinite(tip(jnp.asarray(diameter))).all()


def test_a_remembered_half_turn() -> None:
    """Its quaternion has no real part, whose root has an infinite slope there."""
    hair = coil()
    half = jnp.zeros_like(hair.natural_shape).at[..., 0].set(1)
    scene = jh.Scene(replace(hair, natural_shape=half)).as_arrays()

    @jax.jit
    @jax.value_and_grad
    def tip(shape: jax.Array) -> jax.Array:
        bent = replace(scene, strands=replace(scene.strands, natural_shape=shape))
        return posed(prepare(bent, (jh.Unloaded(),)), start(bent)).positions[-1].sum()

    value, slope = tip(scene.strands.natural_shape)
    assert np.isfinite(value)
    assert np.isfinite(slope).all()


def test_all_bonds_cut_keep_the_present_shape() -> None:
    """Hair that remembers a straight line and is coiled stays coiled."""
    hair = coil()
    straight = replace(hair, natural_shape=jnp.zeros_like(hair.natural_shape))
    scene = jh.Scene(straight, bonds=jh.Bonds(fraction=(0.0,) * 4)).as_arrays()
    before = start(scene)
    after = jax.jit(posed)(prepare(scene, (jh.Unloaded(),)), before)
    np.testing.assert_allclose(after.positions, before.positions, atol=1e-12)
