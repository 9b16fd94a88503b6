"""Generates motions from text, and saves them as files for other programs."""

from pathlib import Path

import flame_mdm

FOLDER = Path("examples_output/01_generate")
FOLDER.mkdir(parents=True, exist_ok=True)

model = flame_mdm.load("quickstart")  # or a run directory, a model file, or a model on the hub
texts = [
    "a person waves with the left hand",
    "a person walks in a circle clockwise, then sits down",
]
motions = flame_mdm.generate(model, texts, seconds=3, samples=2, seed=0, cleanup=True)

# Two samples for the first text are followed by two samples for the second text.
for number, motion in enumerate(motions):
    print(number, motion.text, motion.joints.shape, "meters, y up")

motions[0].save(FOLDER / "wave.glb")  # Blender, Unity, Godot, three.js
motions[0].save(FOLDER / "wave.bvh")
motions[2].save(FOLDER / "walk.gif")
