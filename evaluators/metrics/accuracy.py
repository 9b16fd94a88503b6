# pyright: standard
"""Action recognition accuracy of generated motions."""

from torch import Tensor

from evaluators.metrics.samples import SampleMetric


class ActionAccuracy(SampleMetric):
    """Fraction of motions whose largest logit is that of their label (Guo et al. 2020), in [0, 1]."""

    higher_is_better = True
    states = ("logits", "labels")

    def value(self, logits: Tensor, labels: Tensor) -> float:
        return (logits.argmax(1) == labels).double().mean().item()
