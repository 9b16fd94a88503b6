"""Distills a model into a student that samples in one to four steps."""

from pathlib import Path

import flame_mdm
from flame_mdm.__main__ import main

FOLDER = Path("examples_output/09_distill")
TEACHER, STUDENT = FOLDER / "teacher", FOLDER / "student"
SMALL = ["data.source.clips=100", "callbacks.samples=null", "trainer.max_steps=10"]


def run(*words: str) -> None:
    if code := main([*words, *SMALL]):
        raise SystemExit(code)


if __name__ == "__main__":  # data sets are prepared by processes that import this file
    # Ten steps only show that the code runs. A teacher is trained for thousands of steps, and a
    # student for a fifth of its teacher's steps.
    run("train", "quickstart", f"run.dir={TEACHER}", "condition.pretrain_steps=0")
    run("distill", str(TEACHER), str(STUDENT))

    student = flame_mdm.load(STUDENT)
    text = "a person jumps twice"
    print(flame_mdm.generate(student, text, seconds=2, num_inference_steps=2, seed=0)[0])
