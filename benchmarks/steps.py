"""Training steps in both speeds, compared to plain PyTorch: `python benchmarks/steps.py [--device cuda] [--quick]`.

The full-size step is that of humanml3d/mdm with lengths as in HumanML3D. A plain PyTorch loop trains
`nn.TransformerEncoder` of the same size on the same clips, padded to 196 frames, as the published codes do. Then follow
a step of every network in its size for CPU runs, and on the CPU the quickstart by the complete framework. All take
turns in one run. On CUDA, the section also has the memory.
"""

import argparse
import itertools
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from lightning import Callback
from run import Row, Section, body
from torch import Tensor, nn

from flame_mdm.batch import Condition, MotionBatch, padded_length
from flame_mdm.config import compose, instantiate
from flame_mdm.data.datamodule import TrainingBatches
from flame_mdm.task import MotionGeneration
from flame_mdm.training import fit as training
from flame_mdm.training.speed import accelerate

WIDTH, LONGEST = 263, 196
TOKENS = 30  # tokens of a caption
BACKBONES = {
    "MDM, encoder": ["synthetic/mdm"],
    "MDM, decoder": ["synthetic/mdm_decoder"],
    "MDM, decoder + token": ["synthetic/mdm_decoder", "+denoiser.input_token=condition"],
    "MDM, GRU": ["synthetic/mdm_gru"],
    "MDM, U-Net": ["synthetic/mdm_unet"],
    "FLAME": ["synthetic/flame"],
    "MFM": ["synthetic/mfm"],
}
SPEEDS = ("reference", "fast")
QUIET = [
    *("trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "trainer.val_check_interval=1000000"),
    *("callbacks.samples=null", "callbacks.best=null", "callbacks.checkpoints.every_n_steps=1000000", "logger=csv"),
]


def training_step(task: MotionGeneration, batch: MotionBatch) -> Tensor:
    """Returns the loss of a step, with a condition of the right shape instead of an encoded text."""
    features = task.condition.features
    rows = len(batch)
    real = torch.ones(rows, TOKENS, dtype=torch.bool)
    null = Condition(torch.zeros(1, features), torch.zeros(1, TOKENS, features), real[:1])
    cond = Condition(torch.zeros(rows, features), torch.zeros(rows, TOKENS, features), real, null)
    return task.process.loss(task.denoiser, batch.x, batch.mask, cond, auxiliary=task.losses)["loss"].mean()


class Peer(nn.Module):
    """MDM's encoder in plain PyTorch: inputs (B, F, 263), a token for the condition, `nn.TransformerEncoder`."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        layer = nn.TransformerEncoderLayer(width, 4, 2 * width, 0.1, "gelu")
        self.encoder = nn.TransformerEncoder(layer, layers)
        self.input, self.output = nn.Linear(WIDTH, width), nn.Linear(width, WIDTH)
        self.token, self.dropout = nn.Linear(512, width), nn.Dropout(0.1)

    def forward(self, x: Tensor, mask: Tensor, cond: Tensor) -> Tensor:
        tokens = self.dropout(torch.cat([self.token(cond)[None], self.input(x.transpose(0, 1))]))
        padding = ~torch.cat([mask.new_ones(len(mask), 1), mask], 1)
        return self.output(self.encoder(tokens, src_key_padding_mask=padding))[1:].transpose(0, 1)


def peer_step(width: int, layers: int, device: str) -> Callable[[MotionBatch], None]:
    model = Peer(width, layers).to(device).train()
    optimizer = torch.optim.AdamW(model.parameters(), 1e-4)

    def step(batch: MotionBatch) -> None:
        output = model(batch.x, batch.mask, torch.zeros(len(batch), 512, device=device))
        ((output - batch.x).square() * batch.mask[..., None]).sum().div(batch.mask.sum()).backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def build_task(config: dict[str, Any]) -> MotionGeneration:
    return MotionGeneration.build(config, instantiate(config["representation"]))


def recipe_step(config: dict[str, Any], speed: str, device: str) -> tuple[Callable[[MotionBatch], None], int]:
    """Returns a training step of a recipe, with zeros in place of the text, and the multiple of frames it pads to."""
    config = deepcopy(config)
    config["trainer"]["accelerator"] = device
    task = build_task(config).to(device).train()
    data: Any = SimpleNamespace(pad_multiple=1)
    half = speed == "fast" and accelerate(task, data, config) == "bf16-mixed"
    optimizer, clip = task.make_optimizer(), config["trainer"]["gradient_clip_val"]

    def step(batch: MotionBatch) -> None:
        with torch.device(device), torch.autocast(device, torch.bfloat16, enabled=half):
            loss = training_step(task, batch)
        loss.backward()
        if clip:
            nn.utils.clip_grad_norm_(task.parameters(), clip)
        optimizer.step()
        optimizer.zero_grad()

    return step, data.pad_multiple


def batch_of(lengths: np.ndarray, frames: int, device: str) -> MotionBatch:
    mask = torch.arange(frames) < torch.from_numpy(lengths)[:, None]
    x = torch.randn(len(lengths), frames, WIDTH) * mask[..., None]
    return MotionBatch(x.to(device), mask.to(device), [str(i) for i in range(len(lengths))])


def take_turns(runs: Mapping[str, Callable[[], object]], rounds: int, device: str = "cpu") -> dict[str, float]:
    """Returns the median seconds of each function. They take turns, so that a busy machine slows all of them.

    The first round warms up.
    """
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(rounds + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if device == "cuda":
                torch.cuda.synchronize()
            times[name].append(time.perf_counter() - start)
    return {name: statistics.median(taken[1:]) for name, taken in times.items()}


def full_size(size: list[str], batches: int, device: str) -> tuple[list[Row], str]:
    """Returns rows of the full-size step, and a text about the batches."""
    config = compose("humanml3d/mdm", ["data.batch_size=16", *size])
    rows = config["data"]["batch_size"]
    lengths = 4 * np.random.default_rng(0).integers(10, 50, TrainingBatches.BUCKETS * rows)
    world = TrainingBatches.BUCKETS // batches
    sampler = iter(TrainingBatches(lengths, rows, seed=0, first=0, rank=0, world=world))
    drawn = [lengths[[index for index, _ in next(sampler)]] for _ in range(batches)]

    def batches_of(multiple: int) -> list[MotionBatch]:
        return [batch_of(chosen, padded_length(int(chosen.max()), multiple, LONGEST), device) for chosen in drawn]

    bucketed = batches_of(1)
    real = sum(int(chosen.sum()) for chosen in drawn)
    width, layers = config["denoiser"]["latent_dim"], config["denoiser"]["num_layers"]
    ways: dict[str, tuple[Callable[[MotionBatch], None], list[MotionBatch]]] = {
        "plain PyTorch, padded to 196": (peer_step(width, layers, device), batches_of(LONGEST)),
    }
    for speed in SPEEDS:
        step, multiple = recipe_step(config, speed, device)
        ways[f"speed={speed}"] = step, batches_of(multiple)

    def run(step: Callable[[MotionBatch], None], all_batches: list[MotionBatch]) -> None:
        for batch in all_batches:
            step(batch)

    times = take_turns({name: partial(run, *way) for name, way in ways.items()}, 3, device)
    slowest = next(iter(times.values()))
    table: list[Row] = []
    for name, taken in times.items():
        row: Row = {"training": name, "ms per step": 1000 * taken / batches, "times as fast": slowest / taken}
        table.append(row | {"frames per second": real / taken})
    mean = sum(batch.x.shape[1] for batch in bucketed) / batches
    text = f"{rows} clips of {real / rows / batches:.0f} frames on average, padded to {mean:.0f} by the framework"
    return table, text


def backbones(names: Sequence[str], rounds: int, device: str) -> list[Row]:
    """Returns a row per network of `BACKBONES`, in its size for CPU runs."""
    rows: list[Row] = []
    lengths = np.random.default_rng(1).integers(36, 61, 32)
    for name in names:
        config = compose(BACKBONES[name][0], ["condition=none", *BACKBONES[name][1:]])
        batch = batch_of(lengths, int(lengths.max()), device)
        parameters = sum(p.numel() for p in build_task(config).parameters() if p.requires_grad)
        runs = {speed: partial(recipe_step(config, speed, device)[0], batch) for speed in SPEEDS}
        times = take_turns(runs, rounds, device)
        row: Row = {"network": name, "parameters, M": parameters / 1e6}
        row |= {f"ms, {speed}": 1000 * taken for speed, taken in times.items()}
        row["times as fast"] = times["reference"] / times["fast"]
        row |= {f"frames per second, {speed}": int(lengths.sum()) / taken for speed, taken in times.items()}
        rows.append(row)
    return rows


class Clock(Callback):
    """Records the time after every step."""

    def __init__(self) -> None:
        self.times: list[float] = []

    def on_train_batch_end(self, *_: Any) -> None:
        self.times.append(time.perf_counter())


def framework(steps: int, folder: Path, *words: str) -> float:
    """Returns the median milliseconds per step of the quickstart, trained by the framework with other settings."""
    run, clock = Path(tempfile.mkdtemp(dir=folder)), Clock()
    words = (*QUIET, f"data_root={folder / 'data'}", f"run.dir={run}", f"trainer.max_steps={steps}", *words)
    config = compose("quickstart", words)
    config["callbacks"]["clock"] = {"_target_": f"{__name__}.clock"}
    globals()["clock"] = lambda: clock
    training.fit(run, config)
    times = clock.times[min(50, steps // 2) :]  # the first ones warm up
    return 1000 * statistics.median(b - a for a, b in itertools.pairwise(times))


def quickstart(clips: int, steps: int, rounds: int) -> list[Row]:
    """Returns a row per speed of the quickstart's step, trained by the complete framework; the speeds take turns."""
    times: dict[str, list[float]] = {speed: [] for speed in SPEEDS}
    with tempfile.TemporaryDirectory() as name:
        for speed in SPEEDS * rounds:
            times[speed].append(framework(steps, Path(name), f"data.source.clips={clips}", f"speed={speed}"))
    medians = {speed: statistics.median(taken) for speed, taken in times.items()}
    slow = medians["reference"]
    return [{"training": f"speed={s}", "ms per step": t, "times as fast": slow / t} for s, t in medians.items()]


def measure(*words: str) -> Section:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu")
    parser.add_argument("--quick", action="store_true", help="tiny sizes, which show only that everything runs")
    args = parser.parse_args(words)
    quick, device = args.quick, args.device
    warnings.filterwarnings("ignore")
    torch.manual_seed(0)
    torch.set_float32_matmul_precision("high")  # as in training
    size = ["data.batch_size=2", "denoiser.latent_dim=16", "denoiser.ff_size=32", "denoiser.num_layers=1"]
    full, batches = full_size(size if quick else [], 1 if quick else 8, device)
    tables = {"full size": full}
    if device == "cuda":
        memory = torch.cuda.max_memory_allocated() / 2**30
        batches += f"; at most {memory:.1f} GiB of memory for all three models together"
    names = ["FLAME", "MFM"] if quick else list(BACKBONES)
    tables["networks in their size for CPU runs"] = backbones(names, 1 if quick else 15, device)
    if device == "cpu":
        tables["quickstart"] = quickstart(60, 4, 1) if quick else quickstart(600, 150, 2)
    reference, fast = full[1]["times as fast"], full[2]["times as fast"]
    return {
        "title": "Training steps",
        "text": "The full-size step is that of `humanml3d/mdm` (8 layers of 512, dropout 0.1), "
        f"{batches}. Lengths are uniform from 40 to 196 frames, in units of 4, as a stand-in for HumanML3D's, and "
        "batches are those of the framework's sampler. Plain PyTorch trains `nn.TransformerEncoder` with AdamW on the "
        "same clips, padded to 196 frames as in the published codes, in float32. Everything takes turns; medians of 3 "
        "rounds over all batches. The small networks have 32 clips per batch and no text encoder; the quickstart is "
        "trained by the complete framework, with its text encoder.",
        "summary": f"At full size, `speed=reference` is {reference:.1f} times as fast as plain PyTorch, "
        f"and `speed=fast` {fast:.1f} times.",
        "tables": tables,
    }


if __name__ == "__main__":
    print(body(measure(*sys.argv[1:])))
