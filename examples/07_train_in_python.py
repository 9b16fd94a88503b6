"""Trains a model in ten lines of Python.

`make train EXP=quickstart` also resumes runs, logs curves and writes reports.
"""

from lightning import Trainer

import flame_mdm
from flame_mdm.config import compose, instantiate
from flame_mdm.task import GeneratorTask


def main() -> None:
    config = compose("quickstart", ["data.source.clips=100", "condition.pretrain_steps=20"])
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=0)
    task = GeneratorTask.build(config, representation)
    trainer = Trainer(max_steps=10, accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.fit(task, data)

    # 10 steps are not enough for a walk; 3,000 steps take about ten minutes.
    print(flame_mdm.generate(task.generator, "a person walks forward", seconds=2, seed=0)[0])


if __name__ == "__main__":  # data sets are prepared by processes that import this file
    main()
