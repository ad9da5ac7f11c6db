"""Strands that hang: what they must remember, and how stiff they must be, to stay as they are."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from fitting.constraints import LARGEST_SHAPE
from fitting.ends import in_tiles, program
from fitting.tiles import TILE
from jaxhair import PhysicalFibre, Scene, Strands
from jaxhair import quaternion as quat
from jaxhair.checkpoints import Checkpoints
from jaxhair.fibre import stiffness
from jaxhair.forces import Gravity
from jaxhair.strands import strands_last

STIFFER = (1.0, 4.0, 16.0, 64.0)
"""Multiples of a single hair's stiffness that a strand may have."""

STAYS = 0.01
"""Root mean square distance from the observed points, in lengths, up to which a strand stays."""

Counted = Callable[[int, int], None]
"""Called with how many strands were simulated so far, and how many still may be at most."""


def held_up(
    scene: Scene,
    state: str,
    *,
    progress: Counted | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
) -> tuple[Array, np.ndarray]:
    """What strands must remember to stay as they are until a phase ends, and how stiff they must be
    for that.

    Returns the shape, as `without_weight`, and the factor of `STIFFER`, 0 where none is enough.

    Arguments:
        scene: strands as they were observed. state: the phase.
        checkpoint: a folder in which the work is kept after each factor.
    """
    hair, fibre = scene.strands, scene.fibre
    influence = np.asarray(scene.bonds.influence)
    hydrogen = float(influence[0] / influence.sum())
    seen, lengths = np.asarray(hair.positions, float), np.asarray(hair.lengths, float).sum(axis=1)
    shape, found, done = np.array(hair.natural_shape), np.zeros(hair.count), 0
    tile = min(TILE, hair.count)
    journal, first = None, 0
    if checkpoint is not None:
        text = program(replace(scene, fibre=times(fibre, np.ones(hair.count))), (state,), tile)
        journal = Checkpoints(checkpoint, {"scene": scene, "program": text, "stays": STAYS})
        if journal.parts:
            newest = journal.parts[-1]
            shape, found, first = newest["shape"], newest["found"], int(newest["factors"])
    for number, factor in list(enumerate(STIFFER, start=1))[first:]:
        left = np.flatnonzero(found == 0)
        if not left.size:
            break
        some = take(hair, left)
        wanted = without_weight(some, times(fibre, factor), hydrogen=hydrogen)
        bears = np.linalg.norm(wanted, axis=-1).max(axis=1) < LARGEST_SHAPE
        left, wanted = left[bears], wanted[bears].astype(shape.dtype)
        part = replace(
            scene,
            strands=replace(take(hair, left), natural_shape=jnp.asarray(wanted)),
            fibre=times(fibre, np.full(left.size, factor)),
        )
        shape[left] = wanted
        for places, ends in in_tiles(part, (state,), tile):
            at = left[places]
            square = np.mean(np.sum((ends[state] - seen[at]) ** 2, axis=-1), axis=-1)
            found[at[np.sqrt(square) / lengths[at] < STAYS]] = factor
            done += at.size
            if progress is not None:
                more = (len(STIFFER) - number) * np.count_nonzero(found == 0)
                progress(done, left.size - places.stop + int(more))
        if journal is not None:
            arrays = {"shape": shape, "found": found, "factors": np.array(number)}
            journal.add(arrays, alone=True)
    return jnp.asarray(shape), found


def take(strands: Strands, which: np.ndarray) -> Strands:
    """Some of the strands."""
    return jax.tree.map(lambda leaf: leaf[which], strands)


def times(fibre: PhysicalFibre, factor: Any) -> PhysicalFibre:
    """A fibre that is stiffer by a factor, or by one for each strand, shape (strands,)."""
    young, shear = (factor * float(x) for x in (fibre.young_modulus, fibre.shear_modulus))
    return replace(fibre, young_modulus=young, shear_modulus=shear)


def without_weight(
    strands: Strands, fibre: PhysicalFibre, *, hydrogen: float = 0.0, gravity: Any = None
) -> np.ndarray:
    """The shape that strands must remember to hang at rest as they are; (strands, points - 2, 3).

    At rest the edge i is in balance: the moments of its joints and that of the force n_i = g times
    the mass below it, l d3 x n, add up to 0. From the tip on each joint's moment m follows, and
    from it Omega - m / (4 B / h), by (Eq. 6) of a physical fibre.

    Arguments:
        hydrogen: share f_H / sum f of bonds that were made while the wet hair hung. Held by the
            others alone it hung lower, by m / (4 B / h) / (1 - f_H) to first order, and what
            all remember together is as much nearer to that: by 1 / (1 - f_H) in all.
        gravity: g [m/s^2], shape (3,); the effect's own if not given.
    """
    g = np.asarray(Gravity().acceleration if gravity is None else gravity, float)
    length = np.asarray(strands_last(strands.lengths), float)[:, None]
    d1, d2, _ = (np.asarray(d, float) for d in quat.axes(strands_last(strands.orientations)))
    v = np.asarray(strands_last(strands.natural_shape), float)
    w = np.sqrt(np.maximum(1 - (v**2).sum(axis=1, keepdims=True), 0))
    none = np.zeros_like(length[:1])
    own = (np.concatenate([none, length]) + np.concatenate([length, none])) / 2
    mass = own * float(fibre.density * fibre.area)
    below = mass[::-1].cumsum(axis=0)[::-1][1:]
    n = below * g[None, :, None]
    load = length * np.stack([(n * d2).sum(axis=1), -(n * d1).sum(axis=1), 0 * n[:, 0]], axis=1)
    distance = jnp.asarray(length.cumsum(axis=0)[:-1])
    spring = 4 * np.asarray(stiffness(fibre, distance), float) / own[1:-1]
    shape, first = np.empty_like(v), np.zeros_like(load[0])
    eye = np.eye(3)
    for k in reversed(range(len(v))):
        # what the moment m does to the edge behind the joint, (w m - v x m) / 2, as a matrix
        cross = np.cross(v[k].T[:, None], eye).swapaxes(1, 2)
        behind = (w[k].T[..., None] * eye - cross) / 2
        m = np.linalg.solve(behind, -(load[k + 1] + first).T[..., None])[..., 0].T
        first = -(w[k] * m + np.cross(v[k].T, m.T).T) / 2
        shape[k] = v[k] - m / spring[k] / (1 - hydrogen)
    return np.moveaxis(shape, -1, 0)
