"""Times one update of the averaged weights: `python benchmarks/averaging.py`."""

from collections.abc import Callable
from copy import deepcopy
from itertools import count
from types import SimpleNamespace
from typing import Any

import torch
from lightning.pytorch.callbacks import EMAWeightAveraging
from sections import Row, Section, Settings, section, show, take_turns
from torch import nn
from torch.optim.swa_utils import AveragedModel

from flame_mdm.config import compose, instantiate
from flame_mdm.training.averaging import MovingAverage

SIZES = {"quickstart": "quickstart", "full size": "humanml3d/mdm"}
TINY = ["denoiser.num_layers=1", "denoiser.latent_dim=16", "denoiser.ff_size=32"]
LIGHTNING = "Lightning's EMAWeightAveraging"
DECAY = 0.999


def updates(network: nn.Module) -> dict[str, Callable[[], object]]:
    """Returns, by name, functions that update the averaged weights of a network once."""
    average: Any = MovingAverage(DECAY)
    average._average_model = AveragedModel(network)
    average.on_train_start(None, network)
    numbers = count(1)

    def framework() -> None:
        average.on_train_batch_end(
            SimpleNamespace(global_step=next(numbers)), network, None, None, 0
        )

    options = EMAWeightAveraging(decay=DECAY)._kwargs
    lightning = AveragedModel(network, use_buffers=True, **options)
    pairs = list(zip(deepcopy(network).parameters(), network.parameters(), strict=True))

    @torch.no_grad()
    def loop() -> None:
        for averaged, weight in pairs:
            averaged.lerp_(weight, 1 - DECAY)

    return {
        LIGHTNING: lambda: lightning.update_parameters(network),
        "loop over the parameters": loop,
        "framework": framework,
    }


def measure(settings: Settings) -> Section:
    """Times updates of the averaged weights and returns the page section."""
    rounds = 1 if settings.quick else 100
    rows: list[Row] = []
    faster: dict[str, float] = {}
    for name, recipe in SIZES.items():
        config = compose(recipe, TINY if settings.quick else [])["denoiser"]
        network = instantiate(config, in_features=263, out_features=263, cond_features=512)
        millions = sum(p.numel() for p in network.parameters()) / 1e6

        times = take_turns(updates(network), rounds)
        faster[name] = times[LIGHTNING] / times["framework"]
        for update, taken in times.items():
            row: Row = {
                "weights": f"{name}, {millions:.1f} M",
                "update": update,
                "ms": 1000 * taken,
            }
            rows.append(row | {"ratio": taken / times["framework"]})
    return section(
        "Averaged weights",
        f"""The table shows how long one update of the exponential moving average of all weights takes. Values are
        medians over {rounds} updates. The framework updates all weights in one call.""",
        f"Updating the averaged weights is {faster['quickstart']:.1f} times as fast as with Lightning's callback for "
        f"the quickstart, and {faster['full size']:.1f} times as fast at full size.",
        {"updates": rows},
    )


if __name__ == "__main__":
    show(measure(Settings()))
