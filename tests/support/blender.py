"""Run by a Python with the package bpy: opens a motion file in Blender, prints its joints in three frames as JSON."""

import json
import sys

import bpy  # pyright: ignore[reportMissingImports]

path, fps = sys.argv[1], int(sys.argv[2])
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.context.scene.render.fps = fps
if path.endswith(".glb"):
    bpy.ops.import_scene.gltf(filepath=path)
else:
    bpy.ops.import_anim.bvh(filepath=path, global_scale=0.01, update_scene_fps=True, update_scene_duration=True)
armature = next(each for each in bpy.data.objects if each.type == "ARMATURE")
first, last = (round(frame) for frame in armature.animation_data.action.frame_range)
found = []
for frame in (first, (first + last) // 2, last):
    bpy.context.scene.frame_set(frame)
    bpy.context.view_layer.update()
    places = {bone.name: armature.matrix_world @ bone.head for bone in armature.pose.bones}
    # from Blender's z up to y up
    found.append((frame - first, {name: [place.x, place.z, -place.y] for name, place in places.items()}))
print("FOUND" + json.dumps(found))
