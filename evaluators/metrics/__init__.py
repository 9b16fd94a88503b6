# pyright: standard
"""Metrics for generated motions, as torchmetrics classes.

Each metric's `update` takes some of these inputs as keyword arguments. There are B generated and R
real motions.

| name | shape | content |
|---|---|---|
| generated | (B, E) | features of generated motions |
| text | (B, E) | features of the requested texts |
| text_keys | (B,) int64 | keys of the requested texts; equal texts have equal keys |
| captions | B strings | the requested texts |
| logits | (B, A) | class scores of generated motions |
| labels | (B,) int64 | requested classes |
| groups | (B,) int64 | keys of the prompts, if several motions are generated per prompt |
| requested | B mappings | requested attributes; see `attributes` |
| sides | B pairs of strings | requested content and side (Bandai set only); see `attributes` |
| joints | (B, F, J, 3) | joint positions of generated motions in meters, y up, floor at y = 0 |
| mask | (B, F) bool | True for real frames of a generated motion |
| contacts | (B, F, 4) bool | generated contacts of `skeleton.feet`, if the features contain them |
| kept | (B, F, J) bool | for edits: True if the edit must keep this joint in this frame |
| keys | (B,) int64 | unique keys of generated motions |
| real | (R, E) | features of real motions |
| real_joints | (B, F, J, 3) | joint positions of real motions in meters, y up, floor at y = 0 |
| real_mask | (B, F) bool | True for real frames of a real motion |
| real_keys | (R,) int64 | unique keys of real motions |
| nearest, real_nearest | (B, 1 or 2) | distances to the nearest training motion; see `memorization` |
| references | B of (F', J, 3) | real motions at the frame rate of their recording |

A key is the `flame_mdm.seeds.key` of an id. If there are several samples per id, the key also
depends on the sample index. Metrics that compare motions one by one (MID, position and displacement
errors) require real motions in the same order as the generated motions.

`compute()` returns a number, or a dict that maps names to numbers. If there are no samples, it
returns None. It raises `UserError` if a number would be meaningless, for example because there are
too few samples. Given the same features, values are bit-identical for any batch size, order and
number of processes. Random draws depend only on `seed`.
"""

from __future__ import annotations

import inspect
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from flame_mdm.config import Config, instantiate, parameters
from flame_mdm.errors import UserError

if TYPE_CHECKING:
    from torchmetrics import Metric

    from evaluators.metrics.samples import SampleMetric


def make_metrics(configs: Mapping[str, Config], **options: Any) -> dict[str, SampleMetric]:
    """Creates metrics, keyed by name, from mappings with a `_target_`.

    Each metric receives the `options` that it accepts.
    """
    metrics: dict[str, SampleMetric] = {}
    for name, config in configs.items():
        legal = parameters(config["_target_"]) if "_target_" in config else ()
        metrics[name] = instantiate(
            config, **{option: value for option, value in options.items() if option in legal}
        )
    return metrics


def inputs_of(metric: Metric) -> dict[str, bool]:
    """Returns the names of the inputs of `update`, and whether each input is required."""
    parameters = inspect.signature(metric.update).parameters
    if "rows" in parameters:  # `SampleMetric.update`
        return dict.fromkeys(("keys", *getattr(metric, "states", ())), True)
    return {name: parameter.default is parameter.empty for name, parameter in parameters.items()}


def required_inputs(metric: Metric) -> list[str]:
    """Returns the names of the inputs that `update` requires."""
    return [name for name, is_required in inputs_of(metric).items() if is_required]


def update_metrics(metrics: Mapping[str, Metric], **inputs: Any) -> None:
    """Updates each metric with its inputs. Raises `UserError` if a required input is missing."""
    for name, metric in metrics.items():
        for needed in required_inputs(metric):
            if needed not in inputs:
                raise missing_input(name, metric, needed)
        metric.update(
            **{needed: inputs[needed] for needed in inputs_of(metric) if needed in inputs}
        )


def missing_input(name: str, metric: Metric, needed: str) -> UserError:
    """Returns the error to raise for a metric whose input `needed` is missing."""
    return UserError(
        f"metric {name} ({type(metric).__name__}): missing input: {needed}. Remove the metric from the protocol, or "
        "choose data, an extractor or a protocol with this input"
    )
