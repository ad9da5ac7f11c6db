"""Obstacles of a recording as meshes of a USD file."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from jaxhair.effects import names
from jaxhair.extras import optional
from jaxhair.obstacles import Obstacle
from jaxhair.recording import Recording
from jaxhair.scene import Phase

COLOR = (0.6, 0.6, 0.6)
CLOSE = 1e-6  # m, between an obstacle at the end of a phase and at the start of the next


@dataclass(frozen=True)
class Solid:
    """An obstacle throughout a recording.

    Arguments:
        name: such as "Sphere".
        frames: in which it is there.
        vertices: in each of those [m], each of shape (vertices, 3).
        triangles: shape (triangles, 3).
    """

    name: str
    frames: tuple[int, ...]
    vertices: tuple[np.ndarray, ...]
    triangles: np.ndarray

    def moved(self, to: Callable[[np.ndarray], np.ndarray]) -> "Solid":
        """With vertices somewhere else."""
        return replace(self, vertices=tuple(to(v) for v in self.vertices))


def solids(recording: Recording) -> list[Solid]:
    """Every obstacle. One that a phase takes over where the phase before left it is the same."""
    scene, times = recording.scene, np.asarray(recording.times, float)
    found: list[Solid] = []
    last: dict[str, tuple[int, Any]] = {}  # by name: place in `found`, and its end
    begin = 0.0
    for number, phase in enumerate(scene.phases):
        duration = phase.steps(scene.dt) * scene.dt
        frames = [
            i
            for i, name in enumerate(recording.phases)
            if name == phase.name or (not name and number == 0)  # the start shows the first phase
        ]
        now: dict[str, tuple[int, Any]] = {}
        for name, obstacle in _obstacles(phase):
            first, triangles = obstacle.mesh(0.0)
            seen = tuple(np.asarray(obstacle.mesh(float(times[i]) - begin)[0]) for i in frames)
            if name in last and _same(last[name][1], first):
                place = last[name][0]
                old = found[place]
                found[place] = replace(
                    old, frames=(*old.frames, *frames), vertices=(*old.vertices, *seen)
                )
            else:
                place = len(found)
                found.append(Solid(name, tuple(frames), seen, np.asarray(triangles)))
            now[name] = (place, obstacle.mesh(duration)[0])
        last, begin = now, begin + duration
    return [solid for solid in found if solid.frames]


def _obstacles(phase: Phase) -> list[tuple[str, Obstacle]]:
    pairs = zip(names(phase.effects), phase.effects, strict=True)
    return [(name, effect) for name, effect in pairs if isinstance(effect, Obstacle)]


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    return a.shape == b.shape and bool(np.max(np.abs(a - b), initial=0.0) < CLOSE)


def write_obstacles(stage: Any, found: Sequence[Solid], codes: np.ndarray) -> None:
    """Adds meshes, their vertices in the stage's unit and axes as float32."""
    if not found:
        return
    geom, vt = optional("pxr.UsdGeom", "usd"), optional("pxr.Vt", "usd")
    geom.Scope.Define(stage, "/hair/obstacles")
    for place, solid in enumerate(found):
        before = sum(other.name == solid.name for other in found[:place])
        name = solid.name + (f"_{before + 1}" if before else "")
        mesh = geom.Mesh.Define(stage, f"/hair/obstacles/{name}")
        corners = np.ascontiguousarray(solid.triangles, np.int32)
        mesh.CreateFaceVertexCountsAttr(vt.IntArray([3] * len(corners)))
        mesh.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(corners.ravel()))
        mesh.CreateSubdivisionSchemeAttr("none")
        mesh.CreateDoubleSidedAttr(True)
        mesh.CreateDisplayColorAttr([COLOR])
        stands = all(np.array_equal(v, solid.vertices[0]) for v in solid.vertices)
        for frame, vertices in zip(solid.frames, solid.vertices, strict=True):
            box = np.stack([vertices.min(0), vertices.max(0)])
            code = [] if stands else [float(codes[frame])]
            mesh.CreatePointsAttr().Set(vt.Vec3fArray.FromNumpy(vertices), *code)
            mesh.CreateExtentAttr().Set(vt.Vec3fArray.FromNumpy(box), *code)
            if stands:
                break
        _show(mesh, solid.frames, codes)


def _show(mesh: Any, frames: Sequence[int], codes: np.ndarray) -> None:
    """Samples of visibility where it changes; in between, players keep the one before."""
    there = np.isin(np.arange(len(codes)), frames)
    if there.all():
        return
    attribute = mesh.CreateVisibilityAttr()
    for i, (code, visible) in enumerate(zip(codes, there, strict=True)):
        if i == 0 or visible != there[i - 1]:
            attribute.Set("inherited" if visible else "invisible", float(code))
