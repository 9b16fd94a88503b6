"""Trains a denoiser of your own, and samples from it as from any other model."""

from dataclasses import replace

import torch
from lightning import Trainer
from torch import nn

import flame_mdm
from flame_mdm.config import compose, instantiate
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.layers import TimeAndCondition
from flame_mdm.generator import Parts
from flame_mdm.task import GeneratorTask


class Convolutions(Denoiser):
    """Convolutions over the frames, with time and condition added to each frame."""

    def __init__(self, in_features: int, out_features: int, cond_features: int, width: int = 64):
        super().__init__()
        self.condition = TimeAndCondition(width, cond_features, project_condition=True)
        self.read = nn.Linear(in_features, width)
        self.layer = nn.Conv1d(width, width, 7, padding=3)
        self.write = nn.Linear(width, out_features)

    # (B, F, D), (B,), (B, F), Condition -> (B, F, out_features)
    def forward(self, x_t, t, mask, cond):
        x = self.read(x_t) + self.condition(t, cond.pooled)[:, None]
        x = x * mask[..., None]  # padding must not change real frames
        x = x + self.layer(x.mT).mT.relu()
        return self.write(x)


def main() -> None:
    # A recipe provides the other parts.
    config = compose("quickstart", ["data.source.clips=100", "condition.pretrain_steps=0"])
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=0)

    parts = Parts.build(config, representation, 0)
    features = representation.features
    network = Convolutions(features, parts.process.out_features(features), parts.condition.features)
    options = {key: value for key, value in config["task"].items() if key != "_target_"}
    task = GeneratorTask(
        replace(parts, denoiser=network),
        losses=config["losses"],
        optimizer=config["optimizer"],
        **options,
    )
    task.config = task.generator.config = config
    trainer = Trainer(max_steps=10, accelerator="cpu", logger=False, enable_checkpointing=False)
    trainer.fit(task, data)

    motion = flame_mdm.generate(task.generator, "a person walks forward", seconds=2)[0]
    print(motion, "finite:", bool(torch.as_tensor(motion.joints).isfinite().all()))


if __name__ == "__main__":  # data sets are prepared by processes that import this file
    main()
