"""Run by a Python with the package bpy: opens a motion file in Blender, prints its joints in three frames as JSON."""

import json
import os
import sys

import bpy  # pyright: ignore[reportMissingImports]

path, fps = sys.argv[1], int(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = fps
if path.endswith(".glb"):
    bpy.ops.import_scene.gltf(filepath=path)
else:
    bpy.ops.import_anim.bvh(
        filepath=path, global_scale=0.01, update_scene_fps=True, update_scene_duration=True
    )
armature = next(object_ for object_ in bpy.data.objects if object_.type == "ARMATURE")
first, last = (round(frame) for frame in armature.animation_data.action.frame_range)
shown = []
for frame in (first, (first + last) // 2, last):
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()
    heads = {bone.name: armature.matrix_world @ bone.head for bone in armature.pose.bones}
    # from Blender's z up to y up
    shown.append((frame - first, {name: [head.x, head.z, -head.y] for name, head in heads.items()}))
print("FOUND" + json.dumps(shown), flush=True)
os._exit(0)  # Blender 4.2 crashes when it exits after an import of glTF
