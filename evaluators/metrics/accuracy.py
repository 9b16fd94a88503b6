# pyright: standard
"""Action recognition accuracy of generated motions."""

from torch import Tensor

from evaluators.metrics.samples import SampleMetric


class ActionAccuracy(SampleMetric):
    """Accuracy: the fraction of motions whose largest logit belongs to their label, in [0, 1].

    Source: Guo et al. 2020 ("Action2Motion"). MDM reports this metric. Higher is better. `update`
    takes `logits` (B, A), `labels` (B,) and `keys` (B,).

    Example:
        >>> import torch
        >>> metric = ActionAccuracy()
        >>> logits, labels = torch.tensor([[2.0, 1.0], [0.0, 1.0]]), torch.tensor([0, 0])
        >>> metric.update(logits=logits, labels=labels, keys=torch.arange(2))
        >>> metric.compute()
        0.5
    """

    higher_is_better = True
    states = ("logits", "labels")

    def value(self, logits: Tensor, labels: Tensor) -> float:
        """Computes the accuracy from logits (N, A) and int64 labels (N,)."""
        return (logits.argmax(1) == labels).double().mean().item()
