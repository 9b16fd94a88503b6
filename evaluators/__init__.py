"""Metrics of generated motions, as torchmetrics classes that share one vocabulary.

Every `update` takes some of these tensors by name. A batch holds B generated and R real motions, B and R of any size.

| name | shape | what |
|---|---|---|
| generated | (B, E) | features of generated motions |
| text | (B, E) | features of the texts they were generated for |
| text_keys | (B,) int64 | keys of those captions; equal captions have equal keys |
| logits | (B, A) | class scores of generated motions |
| labels | (B,) int64 | classes they were generated for |
| groups | (B,) int64 | keys of the prompts, where several motions are generated for one |
| joints | (B, F, J, 3) | generated motions in metres, y up, floor at y = 0 |
| mask | (B, F) bool | True = real frame of a generated motion |
| kept | (B, F, J) bool | True = this joint of this frame was to be kept, where motions are edits |
| keys | (B,) int64 | keys of generated motions, no two the same |
| real, real_joints, real_mask, real_keys | as above | the same of real motions |

A key is `flame_mdm.noise.key` of an id (and the number of the sample, where there are several). Metrics that compare
motion by motion (MID, position and displacement errors) take real motions in the order of the generated ones.

`compute()` gives a number, or a dict of numbers by name, or None where the metric was given nothing; it raises
ValueError where a number would mean nothing, as with too few samples. For the same features the values are the same to
the last bit in whatever batches, order and processes the samples came; draws depend on `seed` alone.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchmetrics import Metric


def feed(metrics: Mapping[str, Metric], **features: Any) -> None:
    """Updates each metric with those of the features that it takes; one that needs others too is left alone."""
    for metric in metrics.values():
        parameters = inspect.signature(metric.update).parameters.values()
        if all(p.name in features for p in parameters if p.default is p.empty):
            given = {p.name: features[p.name] for p in parameters if p.name in features}
            if given:
                metric.update(**given)
