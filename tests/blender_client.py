"""What Blender makes of a USD or Alembic file: run by an interpreter that has the `bpy` wheel.

    python blender_client.py FILE FOUND.npz [PICTURE.png | EXPORT.abc] [CODE ...]

Writes positions, colours and heights of meshes at each time code; draws the last, or exports all
as Alembic. Frames are tenths of a second.
"""

import sys

import bpy
import numpy as np
from mathutils import Vector


def at(code: float) -> None:
    """Goes to a time code, which Blender takes for a frame whatever its frames a second are."""
    bpy.context.scene.frame_set(int(code // 1), subframe=code % 1)


def attribute(data, name: str, field: str, width: int) -> np.ndarray:
    values = data.attributes[name].data
    found = np.empty(len(values) * width, np.float32)
    values.foreach_get(field, found)
    return found.reshape(-1, width)


def draw(path: str) -> None:
    """The scene by Cycles, hair in the colours that the file gives its points."""
    scene = bpy.context.scene
    (hair,) = (o for o in bpy.data.objects if o.type == "CURVES")
    # the importer makes no material of displayColor for curves, only an attribute
    material = bpy.data.materials.new("hair")
    material.use_nodes = True
    nodes = material.node_tree.nodes
    color = nodes.new("ShaderNodeAttribute")
    color.attribute_name = "displayColor"
    inputs = nodes["Principled BSDF"].inputs
    inputs["Roughness"].default_value = 0.4
    material.node_tree.links.new(color.outputs["Color"], inputs["Base Color"])
    hair.data.materials.append(material)
    scene.render.hair_type = "STRIP"
    points = positions(hair)
    low, high = points.min(0), points.max(0)
    centre, size = Vector((low + high) / 2), float(np.linalg.norm(high - low))
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    away = Vector((0.5, -1.0, 0.25)).normalized()
    camera.location = centre + 1.25 * size * away
    camera.rotation_euler = away.to_track_quat("Z", "Y").to_euler()
    camera.data.lens, camera.data.clip_start = 36, 0.01 * size  # hair is smaller than 0.1 m away
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.data.energy = 2.0
    sun.rotation_euler = (0.6, 0.3, 0.2)
    for thing in (camera, sun):
        scene.collection.objects.link(thing)
    scene.camera = camera
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    scene.world.node_tree.nodes["Background"].inputs["Color"].default_value = (0.3, 0.3, 0.3, 1)
    scene.render.engine, scene.cycles.device, scene.cycles.samples = "CYCLES", "CPU", 16
    scene.cycles.use_denoising = False
    scene.view_settings.view_transform = "Standard"
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.resolution_x = scene.render.resolution_y = 400
    scene.render.filepath = path
    bpy.ops.render.render(write_still=True)


def positions(hair) -> np.ndarray:
    """In the world, as shown."""
    shown = hair.evaluated_get(bpy.context.evaluated_depsgraph_get())
    found = attribute(shown.data, "position", "vector", 3)
    matrix = np.array(shown.matrix_world)
    if np.array_equal(matrix, np.eye(4)):
        return found
    return found @ matrix[:3, :3].T + matrix[:3, 3]


def export(path: str, first: float, last: float) -> None:
    """All as Alembic; in this process, since one in the background ends with it."""
    bpy.ops.wm.alembic_export(
        filepath=path,
        start=int(first),
        end=int(last),
        export_hair=True,
        as_background_job=False,
    )


def main() -> None:
    """See above."""
    file, output, picture, *codes = sys.argv[1:]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = 10
    if file.endswith(".abc"):
        bpy.ops.wm.alembic_import(filepath=file, as_background_job=False)
    else:
        bpy.ops.wm.usd_import(filepath=file)
    (hair,) = (o for o in bpy.data.objects if o.type == "CURVES")
    meshes = sorted((o for o in bpy.data.objects if o.type == "MESH"), key=lambda o: o.name)
    found: dict[str, list] = {"positions": [], "colors": [], "heights": []}
    for code in map(float, codes):
        at(code)
        shown = hair.evaluated_get(bpy.context.evaluated_depsgraph_get())
        found["positions"].append(positions(hair))
        if "displayColor" in shown.data.attributes:
            found["colors"].append(attribute(shown.data, "displayColor", "color", 4)[:, :3])
        graph = bpy.context.evaluated_depsgraph_get()
        heights = []
        for mesh in meshes:
            data = mesh.evaluated_get(graph).data
            heights.append(np.mean([(mesh.matrix_world @ v.co)[2] for v in data.vertices]))
        found["heights"].append(heights)
    curves = hair.data
    bonded = "bonded_hydrogen" in curves.attributes  # Alembic's own parameters are not imported
    np.savez(
        output,
        **{name: np.array(values) for name, values in found.items()},
        counts=[c.points_length for c in curves.curves],
        radius=attribute(curves, "radius", "value", 1)[:, 0],
        bonded=attribute(curves, "bonded_hydrogen", "value", 1)[:, 0] if bonded else [],
        meshes=[m.name for m in meshes],
        range=[bpy.context.scene.frame_start, bpy.context.scene.frame_end],
        version=bpy.app.version_string,
    )
    if picture.endswith(".abc"):
        export(picture, float(codes[0]), float(codes[-1]))
    elif picture:
        draw(picture)


main()
