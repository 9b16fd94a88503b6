"""Imports motion files into Blender and renders frames as small PNG files with Cycles.

Run `PYTHON blender_render.py JOB.json` with a Python interpreter that has the package bpy (Blender
4.2 or later). The job contains the picture size (`width`, `height`), the rays per pixel
(`samples`), and a list of `files` with these keys:

path     path of the motion file
out      prefix of the picture paths, to which _000.png, _001.png, ... are appended
every    render every Nth frame; 0 = render `count` frames, evenly spaced over the motion
bones    true = draw the skeleton instead of the skin
"""

import json
import math
import os
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]
import mathutils  # pyright: ignore[reportMissingImports]

OPERATORS = {".fbx": bpy.ops.import_scene.fbx, ".glb": bpy.ops.import_scene.gltf}
BONE = (0.75, 0.18, 0.03, 1)  # bone color
THICK = 0.16  # width of a bone relative to its length
TILE = 0.5  # size of the floor's squares in meters
# Distance from the person in meters. The person faces -y in Blender.
CAMERA = mathutils.Vector((2.9, -2.9, 1.6))


def material(name, color):
    paint = bpy.data.materials.new(name)
    paint.use_nodes = True
    paint.node_tree.nodes["Principled BSDF"].inputs["Base Color"].default_value = color
    return paint


def stage(job):
    """Adds a light, a checkered floor and a camera to the scene, and configures the renderer."""
    scene = bpy.context.scene
    scene.render.engine, scene.cycles.device = "CYCLES", "CPU"
    scene.cycles.samples, scene.cycles.use_denoising = job["samples"], False
    scene.cycles.seed = 0
    scene.render.resolution_x, scene.render.resolution_y = job["width"], job["height"]
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.render.use_persistent_data = True
    scene.view_settings.view_transform = "Standard"
    world = bpy.data.worlds.new("world")
    scene.world, world.use_nodes = world, True
    sky = world.node_tree.nodes["Background"].inputs
    sky[0].default_value, sky[1].default_value = (0.95, 0.96, 0.98, 1), 0.55
    bpy.ops.object.light_add(type="SUN", rotation=(0.7, 0.2, 0.5))
    bpy.context.object.data.energy, bpy.context.object.data.angle = 1.6, 0.2

    bpy.ops.mesh.primitive_plane_add(size=80 * TILE)
    floor = bpy.context.object
    paint = material("floor", (1, 1, 1, 1))
    nodes, links = paint.node_tree.nodes, paint.node_tree.links
    squares, place = nodes.new("ShaderNodeTexChecker"), nodes.new("ShaderNodeTexCoord")
    squares.inputs["Scale"].default_value = 80
    squares.inputs["Color1"].default_value = (0.62, 0.64, 0.68, 1)
    squares.inputs["Color2"].default_value = (0.42, 0.44, 0.48, 1)
    links.new(place.outputs["Generated"], squares.inputs["Vector"])
    links.new(squares.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    floor.data.materials.append(paint)

    lens = bpy.data.cameras.new("camera")
    lens.lens = 62
    scene.camera = bpy.data.objects.new("camera", lens)
    scene.collection.objects.link(scene.camera)


def heads(armature):
    """Returns the world positions of the bone heads in the current frame, by bone name."""
    return {bone.name: armature.matrix_world @ bone.head for bone in armature.pose.bones}


def draw_bones(mesh, armature):
    """Gives a mesh the shape of the bones.

    Each bone is a double pyramid from the head of its parent to its own head.
    """
    points, faces, at = [], [], heads(armature)
    for bone in armature.pose.bones:
        # The bone from a root on the floor to the hips would hide the legs
        if bone.parent is None or bone.parent.name.lower() == "root":
            continue
        begin, end = at[bone.parent.name], at[bone.name]
        along = end - begin
        if along.length < 1e-3:
            continue
        turn = along.to_track_quat("Z", "Y")
        wide = THICK * along.length
        ring = [
            begin + 0.15 * along + turn @ mathutils.Vector((wide * x, wide * y, 0))
            for x, y in ((1, 0), (0, 1), (-1, 0), (0, -1))
        ]
        first = len(points)
        points += [begin, *ring, end]
        for k in range(4):
            a, b = first + 1 + k, first + 1 + (k + 1) % 4
            faces += [(first, b, a), (first + 5, a, b)]
    mesh.clear_geometry()
    mesh.from_pydata(points, [], faces)
    mesh.update()


def render(job, file):
    path = Path(file["path"])
    bpy.ops.wm.read_factory_settings(use_empty=True)
    OPERATORS.get(path.suffix, bpy.ops.wm.usd_import)(filepath=str(path))
    scene = bpy.context.scene
    armature = next(item for item in scene.objects if item.type == "ARMATURE")
    skins = [item for item in scene.objects if item.type == "MESH"]
    # The glTF importer adds a mesh for the shape of bones, which is not a skin
    for item in [*skins, armature]:
        is_skin = item.type == "MESH" and any(part.type == "ARMATURE" for part in item.modifiers)
        item.hide_render = bool(file.get("bones")) or not is_skin
    stage(job)
    bones = bpy.data.objects.new("bones", bpy.data.meshes.new("bones"))
    if file.get("bones"):
        scene.collection.objects.link(bones)
        bones.data.materials.append(material("bones", BONE))

    begin, end = map(round, armature.animation_data.action.frame_range)
    frames = list(range(begin, end + 1, file["every"])) if file.get("every") else None
    if frames is None:
        count = file["count"]
        frames = [begin + round(k * (end - begin) / (count - 1)) for k in range(count)]
    for number, frame in enumerate(frames):
        scene.frame_set(frame)
        if file.get("bones"):
            draw_bones(bones.data, armature)
            bones.data.materials[0] = bpy.data.materials["bones"]
        points = [point for name, point in heads(armature).items() if name.lower() != "root"]
        middle = sum(points, mathutils.Vector()) / len(points)
        scene.camera.location = (middle.x + CAMERA.x, middle.y + CAMERA.y, CAMERA.z)
        scene.camera.rotation_euler = (math.radians(79.5), 0, math.radians(45))
        scene.render.filepath = f"{file['out']}_{number:03d}.png"
        bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    job = json.loads(Path(sys.argv[1]).read_text())
    for file in job["files"]:
        render(job, file)
    sys.stdout.flush()
    os._exit(0)  # Blender 4.2 may crash when it exits
