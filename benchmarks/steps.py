"""Training steps in both speeds, compared to plain PyTorch: `make bench` writes docs/benchmarks/speed.md.

The full-size step is that of humanml3d/mdm with lengths as in HumanML3D. A plain PyTorch loop trains
`nn.TransformerEncoder` of the same size on the same clips, padded to 196 frames, as the published codes do. Then follow
a step of every network in its size for CPU runs, and on the CPU the quickstart by the complete framework. All take
turns in one run. The section of a GPU is next to that of the CPU, and sections that were measured once, by a script of
an earlier commit, keep their figures.
"""

import datetime
import json
import os
import platform
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
from torch import Tensor, nn

from flame_mdm.batch import Condition, MotionBatch, padded_length
from flame_mdm.config import compose, instantiate
from flame_mdm.data.datamodule import TrainingBatches
from flame_mdm.runs import read_history
from flame_mdm.task import MotionGeneration
from flame_mdm.training.fit import fit
from flame_mdm.training.provenance import environment
from flame_mdm.training.speed import accelerate

Row = dict[str, str | float | None]
Section = dict[str, Any]  # a title, a text, a summary in one sentence, and tables by caption

PAGE = Path(__file__).parent.parent / "docs" / "benchmarks" / "speed.md"
HEAD = """# Speed

`make bench` measures the speed of training steps and writes this page and [speed.json](speed.json). Every comparison is
a ratio of two measurements in one run, on an idle machine unless the section says otherwise; the absolute figures next
to it hold for that machine alone. `make bench DEVICE=cuda` adds the section of a GPU. Sections that name a commit were
measured once, by a script of that commit. [Which options to choose](../speed.md) is a page of its own.
"""

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
    rows, features = len(batch), task.condition.features
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
    """Returns a training step of a recipe, and the multiple of frames to which it pads."""
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
    """Returns the median seconds of functions, which take turns, since machines may be busy; one round warms up."""
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
    real = sum(int(chosen.sum()) for chosen in drawn)
    padded = [padded_length(int(chosen.max()), 1, LONGEST) for chosen in drawn]

    def on_batches(step: Callable[[MotionBatch], None], multiple: int) -> Callable[[], None]:
        """Returns a function that trains on all batches, padded to a multiple of frames."""
        ready = [batch_of(c, padded_length(int(c.max()), multiple, LONGEST), device) for c in drawn]

        def run() -> None:
            for batch in ready:
                step(batch)

        return run

    width, layers = config["denoiser"]["latent_dim"], config["denoiser"]["num_layers"]
    runs = {"plain PyTorch, padded to 196": on_batches(peer_step(width, layers, device), LONGEST)}
    runs |= {f"speed={speed}": on_batches(*recipe_step(config, speed, device)) for speed in SPEEDS}
    times = take_turns(runs, 3, device)
    slowest = next(iter(times.values()))
    table: list[Row] = []
    for name, taken in times.items():
        row: Row = {"training": name, "ms per step": 1000 * taken / batches, "times as fast": slowest / taken}
        table.append(row | {"frames per second": real / taken})
    mean = sum(padded) / batches
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
        steps = {speed: recipe_step(config, speed, device)[0] for speed in SPEEDS}
        times = take_turns({speed: partial(step, batch) for speed, step in steps.items()}, rounds, device)
        row: Row = {"network": name, "parameters, M": parameters / 1e6}
        row |= {f"ms, {speed}": 1000 * taken for speed, taken in times.items()}
        row["times as fast"] = times["reference"] / times["fast"]
        row |= {f"frames per second, {speed}": int(lengths.sum()) / taken for speed, taken in times.items()}
        rows.append(row)
    return rows


def quickstart(clips: int, steps: int, rounds: int) -> list[Row]:
    """Returns a row per speed of the quickstart's step, trained by the complete framework; the speeds take turns."""
    times: dict[str, list[float]] = {speed: [] for speed in SPEEDS}
    with tempfile.TemporaryDirectory() as name:
        words = [*QUIET, f"data_root={name}/data", f"data.source.clips={clips}", f"trainer.max_steps={steps}"]
        words.append(f"trainer.log_every_n_steps={max(1, steps // 15)}")
        for speed in SPEEDS * rounds:
            folder = Path(tempfile.mkdtemp(dir=name))
            fit(folder, compose("quickstart", [*words, f"run.dir={folder}", f"speed={speed}"]))
            taken = read_history(folder)["train/seconds_per_step"]
            times[speed] += [1000 * value for step, value in taken.items() if step >= steps // 3]  # the first warm up
    medians = {speed: statistics.median(taken) for speed, taken in times.items()}
    slow = medians["reference"]
    return [{"training": f"speed={s}", "ms per step": t, "times as fast": slow / t} for s, t in medians.items()]


def measure(device: str = "cpu", quick: bool = False) -> Section:
    """Returns the section of a device, cpu or cuda; `quick` takes tiny sizes, which show only that everything runs."""
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


def machine() -> dict[str, str | int]:
    has, software = torch.cpu.get_capabilities(), environment()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return {
        "processor": has.get("cpu_name") or platform.processor(),
        "cores": cores,
        "bfloat16 instructions": " ".join(name for name in ("avx512_bf16", "amx_bf16") if has.get(name)) or "none",
        "threads": torch.get_num_threads(),
        "torch": software["packages"]["torch"],
        "lightning": software["packages"]["lightning"],
        "python": software["python"],
        **({"GPU": torch.cuda.get_device_name()} if torch.cuda.is_available() else {}),
    }


def cell(value: str | float | None) -> str:
    """Returns text with three significant digits."""
    if value is None or isinstance(value, str):
        return value or ""
    return f"{value:,.0f}" if abs(value) >= 100 or value == round(value) else f"{value:#.3g}".rstrip(".")


def table(rows: list[Row]) -> str:
    lines = [list(rows[0]), ["---", *["---:"] * (len(rows[0]) - 1)], *([cell(v) for v in row.values()] for row in rows)]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def render(sections: dict[str, Any]) -> str:
    order = sorted(sections, key=lambda name: ("script" in sections[name], name.endswith("_cuda")))
    machines = list(dict.fromkeys(json.dumps(sections[name]["machine"]) for name in order))
    lines = [HEAD, "## In short\n", *(f"- {sections[name]['summary']}" for name in order), "\n## Machine\n"]
    for number, facts in enumerate(machines, 1):
        lines.append(f"{number}. " + ", ".join(f"{key}: {value}" for key, value in json.loads(facts).items()))
    for name in order:
        section = sections[name]
        where = machines.index(json.dumps(section["machine"])) + 1
        script = section.get("script", "benchmarks/steps.py")
        title = section["title"] + (" on a GPU" if name.endswith("_cuda") else "")
        lines += [f"\n## {title}\n", section["text"]]
        lines += [f"\n{name[:1].upper()}{name[1:]}:\n\n{table(rows)}" for name, rows in section["tables"].items()]
        lines.append(f"\n`{script}`, {section['date']}, machine {where}.")
    return "\n".join(lines) + "\n"


def main(device: str = "cpu") -> None:
    if device not in ("cpu", "cuda") or (device == "cuda" and not torch.cuda.is_available()):
        raise SystemExit(f"DEVICE={device}: give cpu, or cuda on a machine with a CUDA GPU")
    data = PAGE.with_suffix(".json")
    sections: dict[str, Any] = json.loads(data.read_text()) if data.exists() else {}
    section = measure(device) | {"date": datetime.date.today().isoformat(), "machine": machine()}
    sections["steps_cuda" if device == "cuda" else "steps"] = section
    data.write_text(json.dumps(sections, indent=1) + "\n")
    PAGE.write_text(render(sections))
    print(f"{section['summary']}\npage: {PAGE}")


if __name__ == "__main__":
    main(*sys.argv[1:])
