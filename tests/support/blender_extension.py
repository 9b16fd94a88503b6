"""Run by a Python with the package bpy: installs the extension and generates the motions that a JSON file requests.

Arguments: the extension, the requests, and the folder for results: names and joints of each motion, or the error; and
a picture of the last motion on a character. A request is [settings, frames per second, character to import or null].
"""

import json
import os
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]

package, requests, out = sys.argv[1], json.loads(Path(sys.argv[2]).read_text()), Path(sys.argv[3])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.extensions.package_install_files(
    filepath=package, repo="user_default", enable_on_install=True
)
scene, results = bpy.context.scene, []


def picture(frame: int) -> None:
    """Renders a frame with Cycles, which needs no graphics card."""
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.location, camera.rotation_euler = (1.6, -4.2, 1.3), (1.5, 0, 0.36)
    sun = bpy.data.objects.new("sun", bpy.data.lights.new("sun", "SUN"))
    sun.rotation_euler, sun.data.energy = (0.9, 0, 0.6), 3
    for item in (camera, sun):
        scene.collection.objects.link(item)
    bpy.ops.mesh.primitive_plane_add(size=30)
    scene.world = bpy.data.worlds.new("world")
    scene.world.color = (0.2, 0.2, 0.2)
    scene.camera, scene.render.engine, scene.cycles.samples = camera, "CYCLES", 16
    scene.render.resolution_x, scene.render.resolution_y, scene.render.filepath = (
        480,
        480,
        str(out / "picture.png"),
    )
    scene.frame_set(frame)
    bpy.ops.render.render(write_still=True)


for settings, fps, character in requests:
    scene.render.fps = fps
    if character:
        bpy.ops.import_scene.gltf(filepath=character)
        bpy.data.objects.remove(bpy.data.objects["Icosphere"])  # Blender's import adds it
        armature = next(
            item for item in bpy.context.scene.objects if item.type == "ARMATURE" and item.children
        )
        bpy.context.view_layer.objects.active = armature
        armature.select_set(True)
    before = len(bpy.data.objects), len(bpy.data.armatures), len(bpy.data.actions)
    for name, value in settings.items():
        setattr(scene.flame_mdm, name, value)
    try:
        bpy.ops.flame_mdm.generate()
    except RuntimeError as error:
        assert before == (len(bpy.data.objects), len(bpy.data.armatures), len(bpy.data.actions))
        results.append(str(error).strip())
        continue
    armature = bpy.context.view_layer.objects.active
    first, last = (round(frame) for frame in armature.animation_data.action.frame_range)
    names, joints = [bone.name for bone in armature.pose.bones], []
    for frame in range(first, last + 1):
        scene.frame_set(frame)
        heads = [armature.matrix_world @ bone.head for bone in armature.pose.bones]
        joints.append([[head.x, head.z, -head.y] for head in heads])  # from z up to y up
    results.append([names, joints])
    if character:
        picture((first + last) // 2)
(out / "results.json").write_text(json.dumps(results))
sys.stdout.flush()
os._exit(0)  # Blender 4.2 crashes when it exits after an import of glTF
