"""Run by a Python with the package ufbx: prints the positions of the nodes of FBX files, in the unit of the file.

PYTHON ufbx_read.py TIME,TIME,... FILE...
"""

import json
import os
import sys

import ufbx  # pyright: ignore[reportMissingImports]

times, *files = sys.argv[1:]
kept = []  # the package frees its objects too early
scenes = []
for file in files:
    scene = ufbx.load_file(file)
    stacks = scene.anim_stacks
    stack = stacks[0]
    animation = stack.anim
    kept += [scene, stacks, stack, animation]
    frames = []
    for time in map(float, times.split(",")):
        evaluated = ufbx.evaluate_scene(scene, animation, time)
        nodes = evaluated.nodes
        kept += [evaluated, nodes]
        positions = {}
        for number in range(len(nodes)):
            node = nodes[number]
            matrix = node.node_to_world
            column = matrix.c3
            kept += [node, matrix, column]
            positions[node.name] = [column.x, column.y, column.z]
        frames.append(positions)
    scenes.append(frames)
print(json.dumps(scenes), flush=True)
os._exit(0)  # without freeing the objects
