"""Takes each guard out of the code in turn and names the test that notices.

    cd tests && python -m mutations            # all, about half an hour
    cd tests && python -m mutations contact    # those whose file or guard has this word in it

A guard is code that only hard cases need: a zero before a division, a sign, a bound, a refusal.
Each is removed in a copy of the repository, and the tests named beside it run there until one
fails. Ends with 1 if all of them pass for some guard, because then nothing holds it.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
HARD = "tests/hard_cases/test_hard_cases.py"


@dataclass(frozen=True)
class Mutation:
    """A guard and how it is removed.

    Arguments:
        file: under the repository's root. guard: what it is, in words.
        old, new: text of the file, which occurs once, and what takes its place.
        tests: arguments of pytest.
    """

    file: str
    guard: str
    old: str
    new: str
    tests: tuple[str, ...]


def hard(*cases: str, solver: str, dtype: str = "float64") -> tuple[str, ...]:
    """Hard cases of a solver and a precision, as arguments of pytest."""
    names = [
        f"{HARD}::test_{kind}[{solver}-{dtype}-{case}]"
        for case in cases
        for kind in ("values", "derivatives")
        if (solver, kind) != ("sequential", "derivatives")
    ]
    return tuple(names)


QUATERNION = "tests/test_quaternion.py"
ZERO = (QUATERNION, "-k", "gradients_at_zero or norms")
RAGGED = ("tests/test_oracle.py", "-k", "one_step and ragged")
ONE_STEP = ("tests/test_oracle.py", "-k", "one_step")
CONTACT = ("tests/test_contact.py",)
ALEMBIC = ("tests/test_alembic_reading.py",)
SIGNS = ("tests/test_invariants.py", "-k", "signs_of_frames")

MUTATIONS = (
    Mutation(
        "jaxhair/quaternion.py",
        "root of zero in a norm",
        "return jnp.where(zero, 0, jnp.sqrt(jnp.where(zero, 1, square)))",
        "return jnp.where(zero, 0, jnp.sqrt(square))",
        ZERO,
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "division by a norm of zero",
        "jnp.where(zero, 0, lax.rsqrt(jnp.where(zero, 1, square)))",
        "jnp.where(zero, 0, lax.rsqrt(square))",
        ZERO,
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "root of zero in a small rotation",
        "half = jnp.sqrt(jnp.where(small, 1, x))",
        "half = jnp.sqrt(x)",
        (QUATERNION, "-k", "zero or exponential"),
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "half turn between opposite vectors",
        "unit(stored(jnp.where(opposite, half_turn, q)))",
        "unit(q)",
        (QUATERNION, "-k", "between"),
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "vector part longer than 1",
        "jnp.sqrt(jnp.maximum(1 - dot(vector, vector), 0))",
        "jnp.sqrt(1 - dot(vector, vector))",
        (QUATERNION, "-k", "vector_part"),
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "no slope through the real part",
        "jnp.concatenate([lax.stop_gradient(real), vector], axis=-2)",
        "jnp.concatenate([real, vector], axis=-2)",
        (QUATERNION, "-k", "vector_part or zero"),
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "hemisphere of orthogonal quaternions is a sign",
        "jnp.where(along >= 0, 1, -1).astype(a.dtype)",
        "jnp.sign(along)",
        (QUATERNION, "-k", "hemisphere"),
    ),
    Mutation(
        "jaxhair/quaternion.py",
        "hemisphere",
        "jnp.where(along >= 0, 1, -1).astype(a.dtype)",
        "jnp.ones_like(along)",
        SIGNS,
    ),
    Mutation(
        "jaxhair/rods.py",
        "hemisphere of bend and twist",
        "return (r - quat.same_hemisphere(r, rest) * rest)[..., 1:, :]",
        "return (r - rest)[..., 1:, :]",
        SIGNS,
    ),
    Mutation(
        "jaxhair/rods.py",
        "hemisphere of the material's damping",
        "old = quat.same_hemisphere(old, shape) * old",
        "old = old",
        SIGNS,
    ),
    Mutation(
        "jaxhair/rods.py",
        "no share where all is held",
        "return jnp.where(none, 0, part / jnp.where(none, 1, whole))",
        "return part / whole",
        ("tests/test_equations.py", "-k", "held"),
    ),
    Mutation(
        "jaxhair/rods.py",
        "no share where all is held, in slopes",
        "return jnp.where(none, 0, part / jnp.where(none, 1, whole))",
        "return jnp.where(none, 0, part / whole)",
        hard("all_is_held", "straight_at_rest", solver="paper"),
    ),
    Mutation(
        "jaxhair/rods.py",
        "missing edges have no stiffness",
        "return jnp.where(exists, 4 * self.stiffness / jnp.where(exists, h, 1), 0)",
        "return 4 * self.stiffness / h",
        hard("strands_of_2_and_9_points", solver="direct"),
    ),
    Mutation(
        "jaxhair/rods.py",
        "a missing edge has the tangent of the one before",
        "return jnp.where(missing, before, tip)",
        "return tip",
        RAGGED,
    ),
    Mutation(
        "jaxhair/fibre.py",
        "cuticle gone",
        "return jnp.maximum(1 - peeling_rate * distance, 0)",
        "return 1 - peeling_rate * distance",
        ("tests/test_equations.py", "-k", "13"),
    ),
    Mutation(
        "jaxhair/simulate.py",
        "stiffness is a share",
        "k = jnp.clip(k, 0, 1)",
        "k = k",
        ("tests/test_equations.py", "-k", "share"),
    ),
    Mutation(
        "jaxhair/simulate.py",
        "held points have no length of their own",
        "own = jnp.where(points_free, rod.point_lengths(), 1)",
        "own = rod.point_lengths()",
        hard("strands_of_2_and_9_points", solver="direct"),
    ),
    Mutation(
        "jaxhair/simulate.py",
        "held points do not fall",
        "jnp.where(rod.point_weights > 0, dt * v, 0)",
        "dt * v",
        ONE_STEP,
    ),
    Mutation(
        "jaxhair/solvers.py",
        "stiffness of exactly 1",
        "return jnp.where(rigid, 1, -jnp.expm1(jnp.log1p(-below) / iterations))",
        "return -jnp.expm1(jnp.log1p(-stiffness) / iterations)",
        hard("k_of_1", solver="paper"),
    ),
    Mutation(
        "jaxhair/solvers.py",
        "missing edges do not move points",
        "stretch = tuple(g * exists for g in stretch)",
        "stretch = stretch",
        RAGGED,
    ),
    Mutation(
        "jaxhair/bonds.py",
        "all bonds cut",
        "jnp.where(cut, 1, whole)",
        "whole",
        hard("all_bonds_cut", solver="direct"),
    ),
    Mutation(
        "jaxhair/bonds.py",
        "bonds cut but for next to nothing",
        "cut = share <= _nothing(share)",
        "cut = share == 0",
        hard("cut_but_for_next_to_nothing", solver="direct"),
    ),
    Mutation(
        "jaxhair/bonds.py",
        "bonds formed by next to nothing",
        "rises = (rise > 0) & (fraction + rise > _nothing(fraction))",
        "rises = rise > 0",
        hard("formed_by_next_to_nothing", solver="direct"),
    ),
    Mutation(
        "jaxhair/bonds.py",
        "b + db = 0",
        "rise / jnp.where(rises, fraction + rise, 1)",
        "rise / (fraction + rise)",
        ("tests/test_equations_15_to_19.py", "-k", "no_rise"),
    ),
    Mutation(
        "jaxhair/bonds.py",
        "no fraction below 0",
        "after = jnp.maximum(after, 0)",
        "after = after",
        ("tests/test_equations_15_to_19.py", "-k", "cuts_at_once"),
    ),
    Mutation(
        "jaxhair/bonds.py",
        "no fraction above 1",
        "rises[j] = jnp.minimum(rise, 1 - after)",
        "rises[j] = rise",
        ("tests/test_equations_15_to_19.py", "-k", "19"),
    ),
    Mutation(
        "jaxhair/bonds.py",
        "cutting forms nothing",
        "after = before + sum(jnp.minimum(change(e), 0) for e in cutting)",
        "after = before + sum(change(e) for e in cutting)",
        ONE_STEP,
    ),
    Mutation(
        "jaxhair/bonds.py",
        "forming cuts nothing",
        "(jnp.maximum(change(e), 0) for e in forming[1:]), jnp.maximum(change(forming[0]), 0)",
        "(change(e) for e in forming[1:]), change(forming[0])",
        ONE_STEP,
    ),
    Mutation(
        "jaxhair/bonds.py",
        "influences that sum to 0 are refused",
        "if f is not None and np.any(few := f.max(axis=-1, initial=0) < TINY):",
        "if f is not None and np.any(few := f.max(axis=-1, initial=0) < -1):",
        ("tests/test_checks.py",),
    ),
    Mutation(
        "jaxhair/contact.py",
        "edge of no length",
        "quat.dot(p, along) / jnp.where(square == 0, 1, square)",
        "quat.dot(p, along) / square",
        ("tests/test_equations_15_to_19.py", "-k", "18"),
    ),
    Mutation(
        "jaxhair/contact.py",
        "no direction between hairs as near as rounding",
        "jnp.where(nowhere, 0, apart)",
        "apart",
        (*CONTACT, "-k", "but_for_rounding"),
    ),
    Mutation(
        "jaxhair/contact.py",
        "nearest point within the edge",
        "jnp.clip(quat.dot(p, along) / jnp.where(square == 0, 1, square), 0, 1)",
        "quat.dot(p, along) / jnp.where(square == 0, 1, square)",
        ("tests/test_equations_15_to_19.py", "-k", "18"),
    ),
    Mutation(
        "jaxhair/contact.py",
        "no pull beyond two radii",
        "jnp.maximum(1 - quat.safe_norm(apart) / (2 * self.radius), 0)",
        "1 - quat.safe_norm(apart) / (2 * self.radius)",
        ("tests/test_equations_15_to_19.py", "-k", "18"),
    ),
    Mutation(
        "jaxhair/contact.py",
        "missing edges push nothing",
        "if rod.ragged:",
        "if False:",
        RAGGED,
    ),
    Mutation(
        "jaxhair/contact.py",
        "lists are made again once hair has moved",
        "return jnp.sqrt(jnp.sum(box**2)) <= self.skin",
        "return jnp.sqrt(jnp.sum(box**2)) <= 4 * self.skin",
        CONTACT,
    ),
    Mutation(
        "jaxhair/contact.py",
        "lists that do not hold push with NaN",
        "jnp.where(holds, stored(jnp.stack(total)), jnp.nan)",
        "stored(jnp.stack(total))",
        CONTACT,
    ),
    Mutation(
        "jaxhair/contact.py",
        "skins shrink until lists have room",
        "(carry[1].count > room) & (carry[1].skin >= 0)",
        "(carry[1].count > room) & (carry[1].builds < builds)",
        CONTACT,
    ),
    Mutation(
        "jaxhair/neighbours.py",
        "an edge without length, in the search",
        "across = along / jnp.where(square == 0, 1, square)",
        "across = along / square",
        ("tests/test_equations_15_to_19.py", "-k", "18"),
    ),
    Mutation(
        "jaxhair/neighbours.py",
        "points and edges that are missing have no box",
        "there = ~jnp.isnan(p + q)",
        "there = p == p",
        CONTACT,
    ),
    Mutation(
        "jaxhair/obstacles.py",
        "slip of zero",
        "1 - stop / jnp.where(sticks, 1, size)",
        "1 - stop / size",
        hard("lying_on_the_floor", "ball_centred_on_a_point", solver="paper"),
    ),
    Mutation(
        "jaxhair/obstacles.py",
        "friction turns no slip around",
        "left = jnp.where(sticks, 0, 1 - stop / jnp.where(sticks, 1, size))",
        "left = 1 - stop / jnp.where(size == 0, 1, size)",
        hard("friction_of_1e6", "lying_on_the_floor", solver="paper"),
    ),
    Mutation(
        "jaxhair/obstacles.py",
        "direction at the centre of a ball",
        "jnp.where(distance == 0, up, quat.unit(offset))",
        "quat.unit(offset)",
        ("tests/test_obstacles.py",),
    ),
    Mutation(
        "jaxhair/obstacles.py",
        "direction on the axis of a rod",
        "jnp.where(distance == 0, quat.perpendicular(axis), quat.unit(away))",
        "quat.unit(away)",
        ("tests/test_obstacles.py",),
    ),
    Mutation(
        "jaxhair/obstacles.py",
        "held points stay in obstacles",
        "touches = (depth > 0) & (rod.point_weights > 0)",
        "touches = depth > 0",
        ("tests/test_obstacles.py",),
    ),
    Mutation(
        "jaxhair/direct.py",
        "direction of a short edge",
        "missing = jnp.maximum(length / 2 - quat.safe_norm(edge), 0)",
        "missing = jnp.zeros_like(length)",
        ("tests/test_direct.py", "-k", "short_edges"),
    ),
    Mutation(
        "jaxhair/direct.py",
        "an edge that shrinks fast does not turn around",
        "edge = stored(p[1:] - p[:-1] + across - quat.scaled(axis, quat.dot(across, axis)))",
        "edge = p[1:] - p[:-1] + across",
        ("tests/test_direct.py", "-k", "shrink"),
    ),
    Mutation(
        "jaxhair/direct.py",
        "edges that turned far are shortened",
        "return unit.length * _shortened(rod, unit, p, n), q, n * unit.force",
        "return unit.length * p, q, n * unit.force",
        hard(
            "weight_of_1_gramme_at_the_tip", "gravity_of_1e5", "hair_inside_a_ball", solver="direct"
        ),
    ),
    Mutation(
        "jaxhair/direct.py",
        "rotations along tangents",
        "real = 1 + jnp.sqrt(1 + quat.dot(phi, phi))",
        "real = 2 + 0 * quat.dot(phi, phi)",
        hard("weight_of_1_gramme_at_the_tip", "gravity_of_1e5", solver="direct"),
    ),
    Mutation(
        "jaxhair/direct.py",
        "held points have no mass to divide by",
        "mass = jnp.where(free, 1 / jnp.where(free, w, 1), 1e6)",
        "mass = 1 / w",
        hard("straight_at_rest", solver="direct"),
    ),
    Mutation(
        "jaxhair/direct.py",
        "missing edges carry no force",
        "gap = jnp.where(rod.edge_exists(), gap, -n)",
        "gap = gap",
        hard("strands_of_2_and_9_points", solver="direct"),
    ),
    Mutation(
        "jaxhair/direct.py",
        "a held frame has an equation of its own",
        "stiffness=stiffness * may_turn + (1 - may_turn) * eye,",
        "stiffness=stiffness * may_turn,",
        hard("straight_at_rest", solver="direct"),
    ),
    Mutation(
        "jaxhair/direct.py",
        "a frame that nothing holds",
        "+ frame_inertia * length[:, None] ** 3 * eye",
        "+ 0 * frame_inertia * length[:, None] ** 3 * eye",
        hard("all_bonds_cut", solver="direct"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "a joint of no stiffness",
        "jnp.where(weakest > 0, quat.dot(moment, moment) / jnp.where(weakest > 0, weakest, 1), 0)",
        "quat.dot(moment, moment) / weakest",
        hard("all_bonds_cut", solver="direct"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "an edge without force",
        "inverse = jnp.where(none, 0, 1 / jnp.where(none, 1, size))",
        "inverse = 1 / size",
        hard("straight_at_rest", solver="direct"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "slopes of an edge without force",
        "(4 * jnp.where(none, 1, size + along))",
        "(4 * (size + along))",
        hard("straight_at_rest", solver="direct"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "cover of what is negative",
        "_cover(r, moment, weakest, strongest))",
        "0 * _cover(r, moment, weakest, strongest))",
        ("tests/test_direct.py", "-k", "bounds_the_true or loaded_coil"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "only the positive part of pulls",
        "pulled=jnp.maximum(n3, 0),",
        "pulled=n3,",
        ("tests/test_direct.py", "-k", "pull_matrix"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "the cover's tip is rounded",
        "rounding = 32 * np.finfo(r.dtype).eps * strongest",
        "rounding = 0 * strongest",
        ("tests/test_direct.py", "-k", "no_slope"),
    ),
    Mutation(
        "jaxhair/hessian.py",
        "hemisphere of joints",
        "r = stored(quat.same_hemisphere(r, shape) * r)",
        "r = r",
        SIGNS,
    ),
    Mutation(
        "jaxhair/holding.py",
        "rod thinner than an edge",
        "sine = jnp.clip(length * jnp.cos(climb) / self.diameter, 0, 0.999)",
        "sine = length * jnp.cos(climb) / self.diameter",
        ("tests/test_holding.py",),
    ),
    Mutation(
        "jaxhair/holding.py",
        "remembered half turn",
        "square = jnp.minimum(quat.dot(free[:, 1:], free[:, 1:]), 0.999)",
        "square = quat.dot(free[:, 1:], free[:, 1:])",
        ("tests/test_holding.py",),
    ),
    Mutation(
        "jaxhair/holding.py",
        "all bonds cut keep the present shape",
        "jnp.where(share == 0, present, turn)",
        "turn",
        ("tests/test_holding.py",),
    ),
    Mutation(
        "jaxhair/forces.py",
        "wind from where it goes to is refused",
        "and np.abs(blower - target).max() < check.SMALLEST",
        "and np.abs(blower - target).max() < 0",
        ("tests/test_checks.py",),
    ),
    Mutation(
        "jaxhair/check.py",
        "numbers are finite and not too large",
        "np.any(wrong := ~(np.abs(array) <= LARGEST))",
        "np.any(wrong := np.abs(array) > np.inf)",
        ("tests/test_checks.py", "tests/test_checks_extreme.py"),
    ),
    Mutation(
        "jaxhair/recording.py",
        "a frame that is not finite ends the run",
        "if not (sound and _finite(frame)):",
        "if False:",
        ("tests/test_recording.py", "-k", "finite"),
    ),
    Mutation(
        "jaxhair/recording.py",
        "what is not observed is looked at too",
        "if not (sound and _finite(frame)):",
        "if not _finite(frame):",
        ("tests/test_failures.py", "-k", "observed"),
    ),
    Mutation(
        "jaxhair/checkpoints.py",
        "parts of other work are refused",
        'if str(part.pop("fingerprint", "")) != self._fingerprint:',
        'if part.pop("fingerprint", None) is None:',
        ("tests/test_checkpoints.py", "-k", "other_work"),
    ),
    Mutation(
        "jaxhair/recording.py",
        "programs tell work apart",
        '"programs": programs,',
        '"programs": [],',
        ("tests/test_checkpoints.py", "-k", "other_work"),
    ),
    Mutation(
        "jaxhair/saved_frames.py",
        "frames that were saved twice",
        "del self.frames[first:]",
        "pass",
        ("tests/test_checkpoints.py", "-k", "ctrl_c"),
    ),
    Mutation(
        "jaxhair/output.py",
        "an existing file is refused",
        "            raise _exists(path)\n    if not os.access",
        "            pass\n    if not os.access",
        ("tests/test_output.py",),
    ),
    Mutation(
        "jaxhair/output.py",
        "a new name appears with its content",
        "        os.link(source, path)\n        return\n",
        "        raise OSError\n",
        ("tests/test_output.py",),
    ),
    Mutation(
        "jaxhair/output.py",
        "half a file is removed",
        "    finally:\n        temporary.unlink(missing_ok=True)",
        "    finally:\n        pass",
        ("tests/test_output.py",),
    ),
    Mutation(
        "jaxhair/alembic/ogawa.py",
        "places outside of an Alembic file",
        "        if not START <= place <= self.size - 8:",
        "        if False:",
        ALEMBIC,
    ),
    Mutation(
        "jaxhair/alembic/ogawa.py",
        "counts larger than an Alembic file",
        "        if count > most:",
        "        if False:",
        ALEMBIC,
    ),
    Mutation(
        "jaxhair/alembic/archive_reading.py",
        "data that an Alembic file has many times",
        "        if self._left < 0:",
        "        if False:",
        ALEMBIC,
    ),
    Mutation(
        "jaxhair/alembic/headers.py",
        "changes outside of an Alembic file's samples",
        "    if not (first <= last < max(count, 1) and (first > 0 or last == 0)):",
        "    if False:",
        ALEMBIC,
    ),
)


def noticed(mutation: Mutation, at: Path) -> str:
    """The first test that fails without the guard, in a copy of the repository at `at`; or ""."""
    for name in ("jaxhair", "fitting", "tests", "notebooks", "pyproject.toml", "README.md"):
        source = ROOT / name
        copy = shutil.copytree if source.is_dir() else shutil.copy
        copy(source, at / name)
    path = at / mutation.file
    text = path.read_text(encoding="utf-8")
    assert text.count(mutation.old) == 1, f"{mutation.guard}: not once in {mutation.file}"
    path.write_text(text.replace(mutation.old, mutation.new), encoding="utf-8")
    options = ["-x", "-p", "no:cacheprovider", "-m", "slow or not slow"]
    command = [sys.executable, "-m", "pytest", *options, *mutation.tests]
    environment = {**os.environ, "PYTHONPATH": str(at)}
    run = subprocess.run(command, cwd=at, env=environment, capture_output=True, text=True)
    failed = re.search(r"^FAILED (\S+)", run.stdout, re.MULTILINE)
    if run.returncode == 1 and failed:
        return failed[1]
    if run.returncode != 0:
        raise RuntimeError(f"{mutation.guard}: pytest ended with {run.returncode}\n{run.stdout}")
    return ""


def _one(mutation: Mutation) -> str:
    with tempfile.TemporaryDirectory() as folder:
        try:
            return noticed(mutation, Path(folder))
        except (AssertionError, RuntimeError) as error:
            return f"? {error}"


def main(words: list[str]) -> int:
    """Prints a line for each guard; 1 if one is held by no test."""
    chosen = [m for m in MUTATIONS if all(word in f"{m.file} {m.guard}" for word in words)]
    unheld = 0
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for mutation, test in zip(chosen, pool.map(_one, chosen), strict=True):
            held = test and not test.startswith("?")
            unheld += not held
            place = Path(mutation.file).name
            print(f"{place:16} {mutation.guard}: {test or 'NO TEST'}", flush=True)
    print(f"{len(chosen)} guards, {unheld} held by no test")
    return 1 if unheld else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
