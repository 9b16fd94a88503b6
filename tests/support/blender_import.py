"""Imports a file into Blender and writes the positions of its bones. PYTHON blender_import.py FILE OUT.json FRAME..."""

import json
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]

file, out, *frames = sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = 20
operators = {".fbx": bpy.ops.import_scene.fbx, ".glb": bpy.ops.import_scene.gltf}
if Path(file).suffix in operators:
    operators[Path(file).suffix](filepath=file)
else:
    bpy.ops.wm.usd_import(filepath=file)
armature = next(item for item in bpy.context.scene.objects if item.type == "ARMATURE")
meshes = [item for item in bpy.context.scene.objects if item.type == "MESH"]
result = {"frames": [], "materials": [], "vertices": sum(len(item.data.vertices) for item in meshes)}
result["materials"] = sorted(material.name for item in meshes for material in item.data.materials)
first = armature.animation_data.action.frame_range[0]
for frame in map(int, frames):
    bpy.context.scene.frame_set(int(first) + frame)
    world = armature.matrix_world
    result["frames"].append({bone.name: list(world @ bone.head) for bone in armature.pose.bones})
Path(out).write_text(json.dumps(result))
