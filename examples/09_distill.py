"""A student that samples in one to four steps."""

from pathlib import Path

import flame_mdm
from flame_mdm.__main__ import main

OUT = Path("examples_output/09_distill")

if __name__ == "__main__":  # data sets are prepared by processes that import this file
    # 10 steps only show that it runs; by default, a fifth of the steps of the model are trained.
    words = ["trainer.max_steps=10", "data.source.clips=100", "callbacks.samples=null"]
    if code := main(["distill", "quickstart", str(OUT), *words]):
        raise SystemExit(code)

    student = flame_mdm.load(OUT)
    text = "a person jumps twice"
    print(flame_mdm.generate(student, text, seconds=2, num_inference_steps=2, seed=0)[0])
