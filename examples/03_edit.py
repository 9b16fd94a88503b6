"""Keeps some parts of a motion and generates the others."""

from pathlib import Path

import flame_mdm

FOLDER = Path("examples_output/03_edit")
FOLDER.mkdir(parents=True, exist_ok=True)

model = flame_mdm.load("quickstart")
walk = flame_mdm.generate(model, "a person walks forward", seconds=3, seed=0)[0]

# The beginning and the end are kept; the middle follows the text.
jump = flame_mdm.edit(model, walk, "a person jumps once", region="in_between", seed=0)[0]
print(
    f"kept: {jump.keep.mean(dtype=float):.0%} of the features, with an error of {jump.feature_error:.1e}"
)

# The legs are kept; arms and head follow the text.
wave = flame_mdm.edit(model, walk, "a person waves with both hands", joints="upper_body", seed=0)[0]

jump.save(FOLDER / "jump.gif")
wave.save(FOLDER / "wave.gif")
