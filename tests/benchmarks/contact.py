"""What hair against hair costs: python tests/benchmarks/contact.py

Contact alone, for more and more strands that sway by 2 cm at the same density: time of a step with
lists of neighbours and with all pairs, how often lists were made, and the largest difference of
pushes from all pairs: from the same pushes of float32, of which only the sums have another order,
and from pushes computed in float64. Then a step of the paper's scenes with and without contact.
Float32, the least of some repeats, compilation apart.
"""

import argparse
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax

import jaxhair as jh
from jaxhair.effects import of_kind
from jaxhair.simulate import Setup, blank, phase_end, prepare, remembering_step, start

sys.path.insert(0, str(Path(__file__).parents[1]))
import all_pairs
from measure import in_turn

DT = 1 / 360
CONTACT = jh.HairContact(radius=1e-3, strength=20.0)


def patch(strands: int, points: int = 9) -> jh.Scene:
    """Wavy hair of 24 cm on a square with 2 roots on a square centimetre."""
    rng = np.random.default_rng(0)
    side = np.sqrt(strands / 2e4)
    roots = np.concatenate([rng.uniform(0, side, (strands, 2)), np.zeros((strands, 1))], 1)
    edges = rng.normal(0, 0.15, (strands, points - 1, 3)) + [0.0, 0.0, -1.0]
    edges *= 0.24 / (points - 1) / np.linalg.norm(edges, axis=-1, keepdims=True)
    x = np.concatenate([roots[:, None], edges], 1).cumsum(1).astype("float32")
    phase = jh.Phase("only", DT, (jh.Hold(), CONTACT))
    return jh.Scene(jh.Strands.from_points(x), phases=(phase,)).as_arrays()


def swaying(state: jh.State, number: Array) -> jh.State:
    """The hair in a step: strands sway at 1 Hz, each in a phase of its own, tips by 2 cm."""
    points, _, strands = state.positions.shape
    phase = 2 * jnp.pi * (number * DT + 0.618 * jnp.arange(strands) % 1)
    share = jnp.linspace(0, 1, points)[:, None]
    moved = 0.02 * share * jnp.sin(phase)[None]
    return replace(state, positions=state.positions.at[:, 0].add(moved))


@partial(jax.jit, static_argnames=("steps", "every_pair"))
def pushes(setup: Setup, state: jh.State, steps: int, every_pair: bool = False) -> Any:
    """The sum of all pushes over some steps, the last ones, and the memory at the end."""
    contact = of_kind(setup.effects, jh.HairContact)[0]

    def one(carry: Any, number: Array) -> Any:
        total, _, lists = carry
        now = swaying(state, number)
        if every_pair:
            change = all_pairs.velocity_change(contact, setup.rod, now, DT)
        else:
            lists = contact.remembered(setup.rod, now, lists)
            change = contact.recalled_change(setup.rod, now, DT, lists)
        return (total + change, change, lists), None

    zero = jnp.zeros_like(state.positions)
    lists = None if every_pair else contact.blank(setup.rod, state)
    return lax.scan(one, (zero, zero, lists), jnp.arange(steps, dtype="float32"))[0]


def _some(strands: int, number: int) -> np.ndarray:
    """Some of the strands, each once."""
    return np.random.default_rng(1).choice(strands, min(number, strands), replace=False)


def of_sums(setup: Setup, state: jh.State, steps: int, found: Any, samples: int = 10) -> float:
    """As `difference`, but of the same pushes of float32, with all edges in the lists."""
    contact = of_kind(setup.effects, jh.HairContact)[0]
    now = swaying(state, jnp.float32(steps - 1))
    some = _some(now.positions.shape[2], samples)
    pairs = all_pairs.listed(now, some)
    theirs = jax.jit(contact.recalled_change)(setup.rod, now, DT, pairs)
    off = np.abs(theirs - found[1])[..., some].max()
    return float(off / np.abs(found[1]).max())


def difference(state: jh.State, steps: int, found: Any, samples: int = 100) -> float:
    """Largest difference of the last step's pushes from those of all pairs, computed in float64 for
    some strands, over the largest push."""
    x = np.asarray(swaying(state, jnp.float32(steps - 1)).positions, float)
    strands = x.shape[2]
    some = _some(strands, samples)
    ours, worst = np.asarray(found[1], float), 0.0
    along = x[1:] - x[:-1]
    for strand in some:
        others = np.arange(strands) != strand
        for point, p in enumerate(x[:, :, strand]):
            apart = p[:, None] - x[:-1]
            place = np.clip((apart * along).sum(1) / (along**2).sum(1), 0, 1)
            apart = apart - place[:, None] * along
            far = np.linalg.norm(apart, axis=1)
            depth = np.maximum(1 - far / (2 * CONTACT.radius), 0) * others
            push = CONTACT.strength * DT * (depth / np.where(far > 0, far, 1))[:, None] * apart
            worst = max(worst, np.abs(push.sum(axis=(0, 2)) - ours[point, :, strand]).max())
    return float(worst / np.abs(ours).max())


def alone(sizes: list[int], steps: int, repeats: int) -> None:
    """Prints what contact alone costs."""
    print(f"\ncontact alone, {steps} steps of strands of 9 points at one density")
    print("  strands   ms a step   all pairs   ratio   steps a list   off: sums   float64")
    times = []
    for strands in sizes:
        scene = patch(strands)
        setup, state = prepare(scene, scene.phases[0].effects), start(scene)
        found = pushes(setup, state, steps)
        few = repeats if strands < 5000 else 2
        taken = 1e3 * in_turn(partial(pushes, setup, state, steps), times=few).min() / steps
        times.append(taken)
        pairs = ratio = "-"
        if strands <= 600:
            slow = 1e3 * in_turn(partial(pushes, setup, state, 4, True), times=3).min() / 4
            pairs, ratio = f"{slow:.2f}", f"{slow / taken:.1f}"
        made = int(found[2].builds)
        sums, off = of_sums(setup, state, steps, found), difference(state, steps, found)
        print(f"  {strands:7d}   {taken:9.3f}   {pairs:>9}   {ratio:>5}   {steps / made:12.1f}   "
              f"{sums:9.1e} {off:9.1e}", flush=True)  # fmt: skip
    slope = np.polyfit(np.log(sizes), np.log(times), 1)[0]
    ends = np.log(times[-1] / times[0]) / np.log(sizes[-1] / sizes[0])
    print(f"  exponent: {ends:.3f} from the first to the last, {slope:.3f} by least squares")


def in_scenes(repeats: int) -> None:
    """Prints what contact adds to a step of the paper's scenes, phase by phase."""
    print("\na step of the paper's scenes [ms], from each phase's true start, 60 steps")
    print("  scene     phase          without   with contact   steps a list   skin [mm]")
    for name, make in jh.scenes.SCENES.items():
        size = {"points": 9, "length": 0.24} if name == "perm" else {}
        scene = make(strands=200, **size).as_arrays()
        bare, state = replace(scene, phases=()), start(scene)
        for phase in scene.phases:
            taken = []
            free = tuple(e for e in phase.effects if not isinstance(e, jh.HairContact))
            for effects in (free, phase.effects):
                run = partial(phase_end, bare, effects, state, steps=60, kernels=True)
                taken.append(1e3 * in_turn(run, times=repeats).min() / 60)
            made, skin = memory_after(prepare(bare, phase.effects), state, 60)
            print(f"  {name:<9} {phase.name:<12} {taken[0]:9.3f}   {taken[1]:12.3f}   "
                  f"{60 / made:12.1f}   {1e3 * skin:9.1f}", flush=True)  # fmt: skip
            steps = phase.steps(scene.dt)
            state = phase_end(bare, phase.effects, state, steps=steps, kernels=True)


@partial(jax.jit, static_argnames="steps")
def _memory(setup: Setup, state: jh.State, steps: int) -> Any:
    def one(number: Array, carry: Any) -> Any:
        return remembering_step(setup, *carry, number.astype("float32") * DT)

    return lax.fori_loop(0, steps, one, (state, blank(setup, state)))[1][0]


def memory_after(setup: Setup, state: jh.State, steps: int) -> tuple[int, float]:
    """How often lists were made in some steps, and the last skin [m]."""
    lists = _memory(setup, state, steps)
    return int(lists.builds), float(lists.skin)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="+", default=[200, 600, 2000, 6000, 20000])
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument("--only", choices=("alone", "scenes"))
    options = parser.parse_args()
    print(f"jax {jax.__version__}, {jax.devices()[0].device_kind}")
    if options.only != "scenes":
        alone(options.sizes, options.steps, options.repeats)
    if options.only != "alone":
        in_scenes(options.repeats)


if __name__ == "__main__":
    main()
