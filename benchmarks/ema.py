"""Time of one update of the averaged weights: `python benchmarks/ema.py [rounds]`."""

import sys
from copy import deepcopy
from itertools import count
from types import SimpleNamespace
from typing import Any

import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from sections import Row, Section, section, show, take_turns
from torch import nn
from torch.optim.swa_utils import AveragedModel

from flame_mdm.config import compose, instantiate
from flame_mdm.training.averaging import MovingAverage

SIZES = {"quickstart": "quickstart", "full size": "humanml3d/mdm"}
DECAY = 0.999


def updates(network: nn.Module) -> dict[str, Any]:
    """Returns functions that update an average of the network's weights once."""
    ours = MovingAverage(DECAY)
    ours._average_model = AveragedModel(network)
    ours.on_train_start(None, network)  # type: ignore[arg-type]
    numbers = count(1)
    lightning = AveragedModel(network, use_buffers=True, **EMAWeightAveraging(decay=DECAY)._kwargs)
    pairs = list(zip(deepcopy(network).parameters(), network.parameters(), strict=True))

    @torch.no_grad()
    def loop() -> None:
        for average, weight in pairs:
            average.lerp_(weight, 1 - DECAY)

    def framework() -> None:
        ours.on_train_batch_end(SimpleNamespace(global_step=next(numbers)), network, None, None, 0)  # type: ignore[arg-type]

    return {
        "Lightning's EMAWeightAveraging": lambda: lightning.update_parameters(network),
        "loop over the parameters": loop,
        "framework": framework,
    }


def measure(*words: str) -> Section:
    """Measures with the number of rounds in `words`."""
    rounds = int(words[0]) if words else 100
    rows: list[Row] = []
    ratios = []
    for name, recipe in SIZES.items():
        config = compose(recipe)["denoiser"]
        network = instantiate(config, in_features=263, out_features=263, cond_features=512)
        millions = sum(p.numel() for p in network.parameters()) / 1e6
        times = take_turns(updates(network), rounds)
        for way, taken in times.items():
            ratio = taken / times["framework"]
            rows.append({"weights": f"{name}, {millions:.1f} M", "update": way, "ms": 1000 * taken, "ratio": ratio})
        ratios.append(times["Lightning's EMAWeightAveraging"] / times["framework"])
    return section(
        "Averaged weights",
        f"One update of the exponential moving average of all weights, median of {rounds}. The framework updates all "
        "of them in one call.",
        f"The update of the averaged weights is {ratios[0]:.1f} times as fast as Lightning's in the quickstart, and "
        f"{ratios[1]:.1f} times at full size.",
        updates=rows,
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
