"""Defines a metric of your own, which works like the metrics in the package."""

import torch
from torch import Tensor

import flame_mdm
from evaluators.metrics.samples import SampleMetric


class Height(SampleMetric):
    """Mean height of the pelvis in meters."""

    states = ("joints",)  # the input that is stored for every motion
    unit = "m"

    def value(self, joints: Tensor) -> float:
        return joints[:, :, 0, 1].mean().item()


model = flame_mdm.load("quickstart")
texts = ["a person stands", "a person sits down on a chair"]
for text in texts:
    motions = flame_mdm.generate(model, text, seconds=3, samples=4, seed=0)
    joints = torch.stack([torch.as_tensor(motion.joints) for motion in motions])
    metric = Height()
    metric.update(keys=torch.arange(len(motions)), joints=joints)
    print(f"{text}: {metric.compute():.2f} m")
