"""Imports files into Blender and writes the positions of their bones.

PYTHON blender_import.py OUT.json FPS FRAME,FRAME,... FILE...
"""

import json
import os
import sys
from pathlib import Path

import bpy  # pyright: ignore[reportMissingImports]

out, fps, frames, *files = sys.argv[1:]
operators = {".fbx": bpy.ops.import_scene.fbx, ".glb": bpy.ops.import_scene.gltf}
scenes = []
for file in files:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.render.fps = int(fps)
    operators.get(Path(file).suffix, bpy.ops.wm.usd_import)(filepath=file)
    armature = next(item for item in bpy.context.scene.objects if item.type == "ARMATURE")
    meshes = [item for item in bpy.context.scene.objects if item.type == "MESH"]
    result = {"frames": [], "vertices": sum(len(item.data.vertices) for item in meshes)}
    result["materials"] = sorted(
        material.name for item in meshes for material in item.data.materials
    )
    result["fps"] = bpy.context.scene.render.fps / bpy.context.scene.render.fps_base
    first = armature.animation_data.action.frame_range[0]
    for frame in map(int, frames.split(",")):
        bpy.context.scene.frame_set(int(first) + frame)
        world = armature.matrix_world
        result["frames"].append(
            {bone.name: list(world @ bone.head) for bone in armature.pose.bones}
        )
    scenes.append(result)
Path(out).write_text(json.dumps(scenes))
os._exit(0)  # Blender 4.2 may crash when it exits
