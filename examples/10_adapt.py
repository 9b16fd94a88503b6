"""Teaches a model a style from a few clips. The result is a small file that changes the model."""

from pathlib import Path

import numpy as np

import flame_mdm

FOLDER = Path("examples_output/10_adapt")
CLIPS = FOLDER / "clips"


def main() -> None:
    # Your clips: .bvh, .fbx, .npz, ... Here, walks with raised arms take their place.
    CLIPS.mkdir(parents=True, exist_ok=True)
    model = flame_mdm.load("quickstart")
    for number, motion in enumerate(
        flame_mdm.generate(model, "a person raises both arms", samples=4, seed=0)
    ):
        np.savez(CLIPS / f"clip_{number}", joints=motion.joints, fps=motion.fps)
        (CLIPS / f"clip_{number}.txt").write_text("a person walks")

    # Ten steps only show that the code runs. The default number of steps is enough for a style.
    adapter = flame_mdm.adapt(
        "quickstart", CLIPS, "proud", FOLDER / "run", overrides=["trainer.max_steps=10"]
    )
    proud = flame_mdm.load("quickstart", adapter=adapter, strength=0.8)
    print(flame_mdm.generate(proud, "a person walks in proud style", seconds=2, seed=0)[0])


if __name__ == "__main__":  # data sets are prepared by processes that import this file
    main()
