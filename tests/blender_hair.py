"""Hair of Blender's own as Alembic: run by an interpreter that has the `bpy` wheel.

    python blender_hair.py KIND FILE.abc POSITIONS.npy

Two curves of a kind in an object that moves, below another; and their positions in three frames.
"""

import sys

import bpy
import numpy as np


def main() -> None:
    """See above."""
    kind, file, output = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    points = np.random.default_rng(0).normal(size=(12, 3)).astype(np.float32)
    curves = bpy.data.hair_curves.new("strands")
    curves.add_curves([5, 7])
    curves.set_types(type=kind)
    names = ["position", *(["handle_left", "handle_right"] if kind == "BEZIER" else [])]
    for name in names:
        attributes = curves.attributes
        made = attributes.get(name) or attributes.new(name, "FLOAT_VECTOR", "POINT")
        made.data.foreach_set("vector", points.reshape(-1))
    above, hair = bpy.data.objects.new("above", None), bpy.data.objects.new("hair", curves)
    for thing in (above, hair):
        scene.collection.objects.link(thing)
    above.scale, above.rotation_euler = (2, 2, 2), (0.3, 0, 0)
    hair.parent = above
    hair.rotation_euler, hair.scale = (0.1, 0.2, 0.3), (1, 2, 3)
    for frame, x in ((0, 0.5), (2, 1.5)):
        hair.location = (x, 1, 2)
        hair.keyframe_insert("location", frame=frame)
    options = {"export_hair": True, "as_background_job": False}
    bpy.ops.wm.alembic_export(filepath=file, start=0, end=2, **options)
    found = []
    for frame in range(3):
        scene.frame_set(frame)
        matrix = np.array(hair.matrix_world)
        found.append(points @ matrix[:3, :3].T + matrix[:3, 3])
    np.save(output, found)


main()
