"""A slow oracle of one step of the hair simulator: plain NumPy, float64, one function per equation.

Position-based Cosserat rods whose rest shape is held by side-chain bonds that break and re-form
(Demura, Fujisawa, Mikawa). Equation numbers are the paper's, units are SI. Nothing here is fast:
loops run over strands and points, and each function treats one edge, one inner point or one bond.

Arrays have the strands (N) first, then the points (P); quaternions are in the order w x y z.
Edge i joins points i and i + 1; inner point j is point j + 1, between edges j and j + 1.
Every strand has an edge; one with fewer than P points has rest length 0 at its last edges, which
are then missing: nothing moves there and no bond changes there.

An effect is a dict such as {"kind": "Gravity", "acceleration": (0, 0, -9.8)}; see FIELDS.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

Array = np.ndarray

BONDS = ("hydrogen", "ionic", "disulfide", "peptide")
E1, E3 = np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])
FIELDS = {  # of each kind of effect; None or absent: the default
    "Gravity": "acceleration",
    "Drag": "time",
    "Wind": "blower target strength width",
    "DryingWind": "blower target strength width rate",
    "HairContact": "radius strength",
    "Cut": "hydrogen ionic disulfide peptide rate",
    "Reform": "hydrogen ionic disulfide peptide rate",
    "Exchange": "amount",  # of every bond, cut and re-formed in each step: for tests only
    "Soften": "factor",
    "Hold": "part clamped velocity angular_velocity centre",
    "Floor": "height friction velocity",
    "Sphere": "centre radius friction velocity angular_velocity",
    "Cylinder": "centre axis radius length friction velocity angular_velocity",
    "Wound": "diameter climb",
}


@dataclass
class Hair:
    """The state of all strands."""

    positions: Array  # (N, P, 3) [m]
    velocities: Array  # (N, P, 3) [m/s]
    orientations: Array  # (N, P-1, 4), unit quaternions w x y z
    shapes: Array  # (N, P-2, 4 kinds, 3), what the bonds remember
    fractions: Array  # (N, P-2, 4 kinds), bonded fractions in [0, 1]


@dataclass
class Settings:
    """What does not change from step to step."""

    lengths: Array  # (N, P-1) rest lengths [m], 0 at missing edges
    influence: Array = (0.25, 0.25, 0.25, 0.25)  # (4,) or (N, P-2, 4)
    stiffness: float = 0.05  # k_o
    cuticle_share: float = 0.5764  # k_cut / k_o
    peeling_rate: float = 0.33  # s [1/m]
    dt: float = 1 / 360  # [s]
    iterations: int = 5  # n
    sweep: str = "sequential"  # or "red-black"
    orientation_weight: float = 1.0  # beta: w_q = beta / l^2


def run(hair: Hair, settings: Settings, effects: Sequence[dict], steps: int, time=0.0) -> Hair:
    """`steps` steps under the same effects, from the phase time `time` on."""
    for count in range(steps):
        hair = step(hair, settings, effects, time + count * settings.dt)
    return hair


def step(hair: Hair, settings: Settings, effects: Sequence[dict], time: float) -> Hair:
    """One step of the paper's figure 1, starting at the phase time `time`."""
    for effect in effects:
        check(effect)
    hair = Hair(*(np.array(value, float) for value in vars(hair).values()))
    dt = settings.dt
    fallen, risen = new_fractions(hair, settings, effects)

    wound = [effect for effect in effects if effect["kind"] == "Wound"]
    if wound:
        positions, orientations = wound_pose(hair, settings, wound[-1])
        velocities = np.zeros_like(hair.velocities)
    else:
        weights, turn_weights = inverse_masses(settings, effects)
        velocities = hair.velocities + velocity_changes(hair, settings, effects)
        positions = hair.positions + dt * velocities * (weights > 0)[..., None]
        orientations = hair.orientations.copy()
        move_held(hair, settings, effects, time, positions, orientations)
        meet_obstacles(hair, settings, effects, time, positions, weights)
        rest = rest_shapes(hair, settings, fallen, orientations)
        k = stiffnesses(settings, effects)
        solve(positions, orientations, weights, turn_weights, rest, k, settings)
        velocities = (positions - hair.positions) / dt

    shapes = hair.shapes.copy()
    for n, j in inner_points(settings):
        r = relative(orientations[n, j], orientations[n, j + 1])
        for kind in range(len(BONDS)):
            before, after = fallen[n, j, kind], risen[n, j, kind]
            shapes[n, j, kind] = remembered_shape(hair.shapes[n, j, kind], r, before, after)
    return Hair(positions, velocities, orientations, shapes, risen)


def check(effect: dict) -> None:
    """Raises for a kind or a field that is not known."""
    if effect["kind"] not in FIELDS:
        raise ValueError(f"unknown kind {effect['kind']!r}, allowed: {', '.join(FIELDS)}")
    if unknown := set(effect) - {"kind", *FIELDS[effect["kind"]].split()}:
        raise ValueError(f"{effect['kind']} has no field {', '.join(sorted(unknown))}")


def field(effect: dict, name: str, default: object) -> object:
    """A field that may be absent or None."""
    value = effect.get(name)
    return default if value is None else value


def vector(effect: dict, name: str, default: Sequence[float] = (0.0, 0.0, 0.0)) -> Array:
    """A 3-vector field that may be absent or None."""
    return np.asarray(field(effect, name, default), float)


# --- vectors and quaternions (w x y z) ---


def unit(v: Array) -> Array:
    """v / |v|, and 0 for the null vector."""
    length = np.sqrt(v @ v)
    return v / length if length > 0 else np.zeros_like(v)


def product(a: Array, b: Array) -> Array:
    """Hamilton product a b."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return np.array(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ]
    )


def conjugate(q: Array) -> Array:
    return np.array([q[0], -q[1], -q[2], -q[3]])


def pure(v: Array) -> Array:
    """The quaternion (0, v)."""
    return np.array([0.0, v[0], v[1], v[2]])


def rotate(q: Array, v: Array) -> Array:
    """R(q) v, the vector part of q v conj(q)."""
    return product(product(q, pure(v)), conjugate(q))[1:]


def whole(shape: Array) -> Array:
    """The unit quaternion with the vector part `shape` and a real part >= 0."""
    return np.array([np.sqrt(max(1.0 - shape @ shape, 0.0)), *shape])


def rotation(vector: Array) -> Array:
    """The quaternion that turns by the angle |vector| about `vector`."""
    angle = np.linalg.norm(vector)
    return np.array([np.cos(angle / 2), *(np.sin(angle / 2) * unit(vector))])


# --- which points and edges there are, and which may move ---


def edge_count(settings: Settings, n: int) -> int:
    """Number of edges of strand n, which is also the index of its last point."""
    return int(np.count_nonzero(settings.lengths[n]))


def inner_points(settings: Settings) -> Iterator[tuple[int, int]]:
    """All (strand, inner point) that exist."""
    for n in range(len(settings.lengths)):
        for j in range(edge_count(settings, n) - 1):
            yield n, j


def held_parts(settings: Settings, hold: dict) -> Iterator[tuple[int, int, int]]:
    """(strand, point, edge) of the held end of each strand."""
    part = field(hold, "part", "root")
    if part not in ("root", "tip"):
        raise ValueError(f"part is {part!r}, allowed: 'root', 'tip'")
    for n in range(len(settings.lengths)):
        last = edge_count(settings, n)
        yield (n, 0, 0) if part == "root" else (n, last, last - 1)


def inverse_masses(settings: Settings, effects: Sequence[dict]) -> tuple[Array, Array]:
    """w of each point (1) and w_q of each edge (beta / l^2); 0 where held or missing."""
    lengths = np.asarray(settings.lengths, float)
    w = np.zeros((lengths.shape[0], lengths.shape[1] + 1))
    w_q = np.zeros_like(lengths)
    for n in range(len(lengths)):
        count = edge_count(settings, n)
        w[n, : count + 1] = 1.0
        w_q[n, :count] = settings.orientation_weight / lengths[n, :count] ** 2
    for hold in effects:
        if hold["kind"] == "Hold":
            for n, point, edge in held_parts(settings, hold):
                w[n, point] = 0.0
                if field(hold, "clamped", True):
                    w_q[n, edge] = 0.0
    return w, w_q


# --- step 1: what changes velocities and bonded fractions ---


def velocity_changes(hair: Hair, settings: Settings, effects: Sequence[dict]) -> Array:
    """Sum of the velocity changes of all effects, each from the state at the start of the step."""
    dv = np.zeros_like(hair.velocities)
    for effect in effects:
        if effect["kind"] == "Gravity":
            dv += vector(effect, "acceleration", (0.0, 0.0, -9.8)) * settings.dt
        elif effect["kind"] == "Drag":
            dv -= (1.0 - np.exp(-settings.dt / effect["time"])) * hair.velocities
        elif effect["kind"] in ("Wind", "DryingWind"):
            dv += wind(hair, settings, effect)
        elif effect["kind"] == "HairContact":
            dv += hair_contact(hair, settings, effect)
    return dv


def wind(hair: Hair, settings: Settings, effect: dict) -> Array:
    """Velocity change by the wind at every point; the tip takes the direction of the last edge."""
    dv = np.zeros_like(hair.positions)
    for n, p in enumerate(hair.positions):
        count = edge_count(settings, n)
        for i in range(count + 1):
            edge = min(i, count - 1)
            dv[n, i] = wind_at(p[i], unit(p[edge + 1] - p[edge]), effect, settings.dt)
    return dv


def wind_at(point: Array, edge_direction: Array, effect: dict, dt: float) -> Array:
    """dv = alpha sin(theta) / (d / width + 1) w dt, d the distance from the axis. (Eq. 17)"""
    blower = np.asarray(effect["blower"], float)
    w = unit(np.asarray(effect["target"], float) - blower)
    sin_theta = np.linalg.norm(edge_direction - (edge_direction @ w) * w)
    from_blower = point - blower
    d = np.linalg.norm(from_blower - (from_blower @ w) * w)
    return effect["strength"] * sin_theta / (d / field(effect, "width", 0.01) + 1.0) * w * dt


def hair_contact(hair: Hair, settings: Settings, effect: dict) -> Array:
    """Velocity change of every point by the edges of all other strands."""
    there = np.asarray(settings.lengths) > 0
    starts, ends = hair.positions[:, :-1], hair.positions[:, 1:]
    dv = np.zeros_like(hair.positions)
    for n, p in enumerate(hair.positions):
        others = there.copy()
        others[n] = False
        for i in range(edge_count(settings, n) + 1):
            dv[n, i] = push(p[i], starts[others], ends[others], effect, settings.dt)
    return dv


def push(point: Array, starts: Array, ends: Array, effect: dict, dt: float) -> Array:
    """Sum over the edges nearer than 2r of alpha (2r - D) / 2r n dt. (Eq. 18)

    D and n are the distance and direction from the nearest point of the edge to `point`.
    """
    along, reach, total = ends - starts, 2 * effect["radius"], np.zeros(3)
    squares = np.sum(along * along, axis=1)
    place = np.sum((point - starts) * along, axis=1) / np.where(squares > 0, squares, 1.0)
    feet = starts + np.clip(place, 0.0, 1.0)[:, None] * along
    for offset in point - feet[np.linalg.norm(point - feet, axis=1) < reach]:
        total += effect["strength"] * (reach - np.linalg.norm(offset)) / reach * unit(offset) * dt
    return total


def new_fractions(hair: Hair, settings: Settings, effects: Sequence[dict]) -> tuple[Array, Array]:
    """The bonded fractions after all falls, and those after all rises as well."""
    there = np.zeros(hair.fractions.shape[:2])
    for n, j in inner_points(settings):
        there[n, j] = 1.0
    fall, rise = np.zeros_like(hair.fractions), np.zeros_like(hair.fractions)
    for effect in effects:
        for change in fraction_changes(hair, settings, effect):
            fall += np.minimum(change, 0.0) * there[..., None]
            rise += np.maximum(change, 0.0) * there[..., None]
    fallen = np.clip(hair.fractions + fall, 0.0, 1.0)
    return fallen, np.clip(fallen + rise, 0.0, 1.0)


def fraction_changes(hair: Hair, settings: Settings, effect: dict) -> Iterator[Array]:
    """Changes of the bonded fractions by one effect, from the state at the start of the step."""
    if effect["kind"] == "DryingWind":
        yield drying(wind(hair, settings, effect)[:, 1:-1], field(effect, "rate", 0.003))
    elif effect["kind"] == "Exchange":  # a fall and an equal rise in the same step
        amount = np.broadcast_to(np.asarray(effect["amount"], float), hair.fractions.shape)
        yield from (-amount, amount)
    elif effect["kind"] in ("Cut", "Reform"):
        change = np.zeros_like(hair.fractions)
        most = field(effect, "rate", np.inf) * settings.dt
        for kind, name in enumerate(BONDS):
            if effect.get(name) is not None:
                wish = effect[name] - hair.fractions[..., kind]
                lowest, highest = (-most, 0.0) if effect["kind"] == "Cut" else (0.0, most)
                change[..., kind] = np.clip(wish, lowest, highest)
        yield change


def drying(dv: Array, rate: float) -> Array:
    """Rise of the hydrogen bonds, rate |dv|; the clip at 1 is the caller's. (Eq. 19)"""
    change = np.zeros((*dv.shape[:2], len(BONDS)))
    change[..., BONDS.index("hydrogen")] = rate * np.linalg.norm(dv, axis=-1)
    return change


# --- step 2: held ends and obstacles (both write into `positions`) ---


def move_held(hair, settings, effects, time, positions, orientations) -> None:
    """Moves held points, and held edges if clamped, by the rigid motion of their Hold."""
    dt = settings.dt
    for hold in effects:
        if hold["kind"] != "Hold":
            continue
        velocity = vector(hold, "velocity")
        centre = vector(hold, "centre") + velocity * time
        turn = rotation(vector(hold, "angular_velocity") * dt)
        for n, point, edge in held_parts(settings, hold):
            arm = hair.positions[n, point] - centre
            positions[n, point] = centre + velocity * dt + rotate(turn, arm)
            if field(hold, "clamped", True):
                orientations[n, edge] = product(turn, hair.orientations[n, edge])


def meet_obstacles(hair, settings, effects, time, positions, weights) -> None:
    """Projects the predicted free points out of each obstacle, in the order of the effects."""
    for effect in effects:
        if effect["kind"] in ("Floor", "Sphere", "Cylinder"):
            for n, i in np.argwhere(weights > 0):
                before = hair.positions[n, i]
                positions[n, i] = projected(positions[n, i], before, effect, settings.dt, time)


def projected(x: Array, x_old: Array, obstacle: dict, dt: float, time: float) -> Array:
    """x, put on the surface if below it; friction then takes back slip along the surface."""
    velocity, spin = vector(obstacle, "velocity"), vector(obstacle, "angular_velocity")
    centre = vector(obstacle, "centre") + field(obstacle, "height", 0.0) * E3  # of a Floor
    centre = centre + velocity * (time + dt)  # at the end of the step
    distance, normal = surface(x - centre, obstacle)
    depth = max(-distance, 0.0)
    x = x + depth * normal
    carried = (velocity + np.cross(spin, x - centre)) * dt
    slip = x - x_old - carried
    slip = slip - (slip @ normal) * normal
    length = np.linalg.norm(slip)
    return (
        x - slip * min(1.0, field(obstacle, "friction", 0.0) * depth / length) if length > 0 else x
    )


def surface(x: Array, obstacle: dict) -> tuple[float, Array]:
    """Signed distance of x from an obstacle around the origin, and the outward normal there."""
    if obstacle["kind"] == "Floor":
        return x[2], E3
    if obstacle["kind"] == "Sphere":
        distance = np.linalg.norm(x)
        return distance - obstacle["radius"], unit(x) if distance > 0 else E3
    axis = unit(np.asarray(obstacle["axis"], float))
    height = x @ axis
    if abs(height) > field(obstacle, "length", np.inf) / 2:
        return np.inf, E3
    radial = x - height * axis
    distance = np.linalg.norm(radial)
    if distance == 0:
        radial = np.cross(axis, E1 if abs(axis[2]) > 0.5 else E3)  # any will do
    return distance - obstacle["radius"], unit(radial)


# --- steps 3 and 5: bonds ---


def relative(q1: Array, q2: Array) -> Array:
    """conj(q1) q2, whose vector part is the present shape Omega. (Eq. 8)"""
    return product(conjugate(q1), q2)


def sign(r: Array, shape: Array) -> float:
    """s: on which side r lies of `shape`, both as whole quaternions. (Eq. 7 and 11)"""
    return 1.0 if r @ whole(shape) >= 0 else -1.0


def rest_shape(shapes: Array, influence: Array, fractions: Array, r: Array) -> Array:
    """Omega_o = sum_j f_j {Omega_j + (1 - b_j) (s_j Omega - Omega_j)} / sum_j f_j. (Eq. 15)"""
    total = np.zeros(3)
    for shape, f, b in zip(shapes, influence, fractions, strict=True):
        total += f * (shape + (1.0 - b) * (sign(r, shape) * r[1:] - shape))
    return total / np.sum(influence)


def rest_shapes(hair: Hair, settings: Settings, fractions: Array, orientations: Array) -> Array:
    """Omega_o at every inner point, (N, P-2, 3)."""
    influence = np.broadcast_to(np.asarray(settings.influence, float), fractions.shape)
    rest = np.zeros((*fractions.shape[:2], 3))
    for n, j in inner_points(settings):
        r = relative(orientations[n, j], orientations[n, j + 1])
        rest[n, j] = rest_shape(hair.shapes[n, j], influence[n, j], fractions[n, j], r)
    return rest


def remembered_shape(shape: Array, r: Array, before: float, after: float) -> Array:
    """Omega_j <- (b Omega_j + db s_j Omega) / (b + db) if db > 0, otherwise Omega_j. (Eq. 16)"""
    if after <= before:
        return shape
    return (before * shape + (after - before) * sign(r, shape) * r[1:]) / after


# --- step 4: the elastic solve (writes into `positions` and `orientations`) ---


def cuticle(d: float, peeling_rate: float) -> float:
    """c = max(1 - s d, 0), what is left of the cuticle. (Eq. 14)"""
    return max(1.0 - peeling_rate * d, 0.0)


def stiffness_at(d: float, settings: Settings) -> float:
    """k = k_o - k_cut (1 - c). (Eq. 13)"""
    k_cut = settings.cuticle_share * settings.stiffness
    return settings.stiffness - k_cut * (1.0 - cuticle(d, settings.peeling_rate))


def per_iteration(k: float, iterations: int) -> float:
    """k' = 1 - (1 - k)^(1/n). (Eq. 12)"""
    return 1.0 - (1.0 - k) ** (1.0 / iterations)


def stiffnesses(settings: Settings, effects: Sequence[dict]) -> Array:
    """k' at every inner point, at the arc length d from the root, (N, P-2)."""
    lengths = np.asarray(settings.lengths, float)
    factor = np.prod([effect["factor"] for effect in effects if effect["kind"] == "Soften"])
    k = np.zeros((lengths.shape[0], lengths.shape[1] - 1))
    for n, j in inner_points(settings):
        softened = np.clip(factor * stiffness_at(np.sum(lengths[n, : j + 1]), settings), 0.0, 1.0)
        k[n, j] = per_iteration(softened, settings.iterations)
    return k


def order(count: int, sweep: str) -> list[int]:
    """The order in which `count` constraints of one strand are solved."""
    if sweep == "sequential":
        return list(range(count))
    if sweep == "red-black":
        return [*range(0, count, 2), *range(1, count, 2)]
    raise ValueError(f"sweep is {sweep!r}, allowed: 'sequential', 'red-black'")


def solve(positions, orientations, weights, turn_weights, rest, k, settings) -> None:
    """n iterations: all edges of a strand, then all its inner points."""
    for n in range(len(positions)):
        p, q, w, w_q = positions[n], orientations[n], weights[n], turn_weights[n]
        count = edge_count(settings, n)
        for _ in range(settings.iterations):
            for i in order(count, settings.sweep):
                ends, masses = (p[i], p[i + 1], q[i]), (w[i], w[i + 1], w_q[i])
                p[i], p[i + 1], q[i] = stretch_shear(*ends, *masses, settings.lengths[n][i])
            for j in order(count - 1, settings.sweep):
                turns = bend_twist(q[j], q[j + 1], w_q[j], w_q[j + 1], rest[n, j], k[n, j])
                q[j], q[j + 1] = turns


def stretch_shear(p1, p2, q, w1, w2, w_q, length) -> tuple[Array, Array, Array]:
    """New p1, p2 and q of one edge from C_s = (p2 - p1) / l - R(q) e3. (Eq. 1 to 5)"""
    gamma = (p2 - p1) / length - rotate(q, E3)  # (Eq. 1, 5)
    denominator = w1 + w2 + 4.0 * w_q * length**2
    if denominator == 0:
        return p1, p2, q
    dp1 = w1 * length / denominator * gamma  # (Eq. 2)
    dp2 = -w2 * length / denominator * gamma  # (Eq. 3)
    turned = product(product(pure(gamma), q), conjugate(pure(E3)))
    dq = 2.0 * w_q * length**2 / denominator * turned  # (Eq. 4), with the factor 2
    return p1 + dp1, p2 + dp2, unit(q + dq) if w_q > 0 else q


def bend_twist(q1, q2, w1, w2, rest, k) -> tuple[Array, Array]:
    """New q1 and q2 around one inner point from C_b = Omega - s Omega_o. (Eq. 6 to 11)"""
    if w1 + w2 == 0:
        return q1, q2
    r = relative(q1, q2)
    error = pure(r[1:] - sign(r, rest) * rest)  # (Eq. 6, 7, 8)
    dq1 = k * w1 / (w1 + w2) * product(q2, error)  # (Eq. 9)
    dq2 = -k * w2 / (w1 + w2) * product(q1, error)  # (Eq. 10)
    return unit(q1 + dq1) if w1 > 0 else q1, unit(q2 + dq2) if w2 > 0 else q2


# --- a prescribed pose ---


def wound_pose(hair: Hair, settings: Settings, effect: dict) -> tuple[Array, Array]:
    """Every strand wound on a rod, from its root point and first edge on."""
    p, q = hair.positions.copy(), hair.orientations.copy()
    climb = field(effect, "climb", 0.0)
    cos, sin = np.cos(climb), np.sin(climb)
    for n, lengths in enumerate(settings.lengths):
        for i in range(edge_count(settings, n)):
            if i > 0:
                mean = (lengths[i - 1] + lengths[i]) / 2
                bend = mean * cos / effect["diameter"] * np.array([cos, 0.0, sin])
                q[n, i] = product(q[n, i - 1], whole(bend))
            p[n, i + 1] = p[n, i] + lengths[i] * rotate(q[n, i], E3)
    return p, q
