"""Action recognition accuracy of generated motions."""

from torch import Tensor

from evaluators.metrics.samples import Share


class ActionAccuracy(Share):
    """Fraction of motions whose largest logit is that of their label (Guo et al. 2020), in [0, 1]."""

    higher_is_better = True

    def update(self, logits: Tensor, labels: Tensor) -> None:
        if not logits.isfinite().all():
            raise self.error("class scores are not finite. Look for motions that are not finite")
        self.hits += (logits.argmax(1) == labels).sum()
        self.total += len(labels)
