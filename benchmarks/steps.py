"""Times training steps at both speeds: `python benchmarks/steps.py`.

The full-size step trains humanml3d/mdm on motions with HumanML3D's lengths. It is compared with the
authors' step, from a clone of their code, and with a plain PyTorch loop that trains an
`nn.TransformerEncoder` of the same size. Both receive the same clips, padded to 196 frames as in the
published code. Other tables show a training step for each of the small networks and, on the CPU, for
the quickstart in the complete framework. All measurements alternate in one run.
"""

import statistics
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from functools import partial
from operator import truediv
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from authors import authors_step
from sections import QUIET, Row, Section, Settings, section, show, take_turns
from torch import Tensor, nn

from flame_mdm.batch import Condition, MotionBatch, padded_length
from flame_mdm.config import compose, instantiate
from flame_mdm.data.datamodule import TrainingBatches
from flame_mdm.runs import read_history
from flame_mdm.task import GeneratorTask
from flame_mdm.training.compilation import COMPILED_FROM
from flame_mdm.training.fit import fit
from flame_mdm.training.speed import accelerate

WIDTH, LONGEST = 263, 196
TOKENS = 30  # tokens per caption
# On each batch of the full-size step, all implementations take turns.
BATCHES = 10
# Rounds in which the speeds of a network take turns, for small networks and for networks at full size
ROUNDS, LARGE_ROUNDS = 10, 5
SMALL_CLIPS = 32
SMALL = {
    "MDM, encoder": ["synthetic/mdm"],
    "MDM, decoder": ["synthetic/mdm_decoder"],
    "MDM, decoder + token": ["synthetic/mdm_decoder", "+denoiser.input_token=condition"],
    "MDM, GRU": ["synthetic/mdm_gru"],
    "MDM, U-Net": ["synthetic/mdm_unet"],
    "FLAME": ["synthetic/flame"],
    "MFM": ["synthetic/mfm"],
}
# Networks at full size, by the number of clips per batch. The encoder of MDM has a table of its own.
# The transformers are trained on few clips, because their steps take longest.
LARGE = {
    16: {"MDM, GRU": ["humanml3d/mdm_gru"], "MDM, U-Net": ["humanml3d/mdm_unet"]},
    2: {
        "MDM, decoder": ["humanml3d/mdm_decoder"],
        "MDM, decoder + token": ["humanml3d/mdm_decoder_token"],
        "FLAME": ["humanml3d/flame"],
        "MFM": ["humanml3d/mfm"],
    },
}
SPEEDS = ("reference", "fast")


def training_step(task: GeneratorTask, batch: MotionBatch) -> Tensor:
    """Returns the loss of one training step. A condition of zeros replaces the encoded text."""
    generator = task.generator
    pooled = batch.x.new_zeros(len(batch), generator.condition.features)
    tokens = pooled[:, None].expand(-1, TOKENS, -1)
    real = batch.mask.new_ones(len(batch), TOKENS)
    null = Condition(pooled[:1], tokens[:1], real[:1])
    cond = Condition(pooled, tokens, real, null)
    return task.loss_terms(batch, cond)["loss"].mean()


class Peer(nn.Module):
    """MDM's encoder in plain PyTorch: inputs (B, F, 263), a token for the condition, `nn.TransformerEncoder`."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        layer = nn.TransformerEncoderLayer(width, 4, 2 * width, 0.1, "gelu")
        self.encoder = nn.TransformerEncoder(layer, layers)
        self.input, self.output = nn.Linear(WIDTH, width), nn.Linear(width, WIDTH)
        self.token, self.dropout = nn.Linear(512, width), nn.Dropout(0.1)

    def forward(self, x: Tensor, mask: Tensor, cond: Tensor) -> Tensor:
        """Returns the output of the network (B, F, 263). Inside, frames come first, as in the authors' code."""
        tokens = self.dropout(torch.cat([self.token(cond)[None], self.input(x.transpose(0, 1))]))
        padding = ~torch.cat([mask.new_ones(len(mask), 1), mask], 1)
        return self.output(self.encoder(tokens, src_key_padding_mask=padding))[1:].transpose(0, 1)


def peer_step(width: int, layers: int, device: str) -> Callable[[MotionBatch], None]:
    """Returns a training step of `Peer` with AdamW."""
    model = Peer(width, layers).to(device).train()
    optimizer = torch.optim.AdamW(model.parameters(), 1e-4)

    def step(batch: MotionBatch) -> None:
        output = model(batch.x, batch.mask, torch.zeros(len(batch), 512, device=device))
        ((output - batch.x).square() * batch.mask[..., None]).sum().div(batch.mask.sum()).backward()
        optimizer.step()
        optimizer.zero_grad()

    return step


def build_task(config: dict[str, Any]) -> GeneratorTask:
    """Returns the training task that a recipe configures."""
    return GeneratorTask.build(config, instantiate(config["representation"]))


def recipe_step(
    config: dict[str, Any], speed: str, device: str, compiles: bool = False
) -> tuple[Callable[[MotionBatch], None], int]:
    """Returns a training step for a recipe, and the number of frames to whose multiples batches are padded.

    On a CPU, `compiles` determines whether the step is compiled, as it is in long runs. On a GPU,
    the length of the recipe's runs determines it.
    """
    config = deepcopy(config)
    config["trainer"]["accelerator"] = device
    if device == "cpu":
        config["trainer"]["max_steps"] = COMPILED_FROM if compiles else 1
    task = build_task(config).to(device).train()
    data: Any = SimpleNamespace(pad_multiple=1)
    half = speed == "fast" and accelerate(task, data, config) == "bf16-mixed"
    optimizer, clip = task.make_optimizer(), config["trainer"]["gradient_clip_val"]

    def step(batch: MotionBatch) -> None:
        with torch.autocast(device, torch.bfloat16, enabled=half):
            loss = training_step(task, batch)
        loss.backward()
        if clip:
            nn.utils.clip_grad_norm_(task.parameters(), clip)
        optimizer.step()
        optimizer.zero_grad()

    return step, data.pad_multiple


def batch_of(lengths: np.ndarray, frames: int, device: str, features: int = WIDTH) -> MotionBatch:
    """Returns a random batch of motions with these lengths, padded to `frames`."""
    mask = torch.arange(frames) < torch.from_numpy(lengths)[:, None]
    x = torch.randn(len(lengths), frames, features) * mask[..., None]
    return MotionBatch(x.to(device), mask.to(device), [str(i) for i in range(len(lengths))])


def drawn_lengths(rows: int, batches: int) -> list[np.ndarray]:
    """Returns the motion lengths (rows,) in each batch, as drawn by the framework's sampler."""
    lengths = 4 * np.random.default_rng(0).integers(10, 50, TrainingBatches.BUCKETS * rows)
    world = TrainingBatches.BUCKETS // batches
    sampler = iter(TrainingBatches(lengths, rows, seed=0, first=0, rank=0, world=world))
    return [lengths[[index for index, _ in next(sampler)]] for _ in range(batches)]


def full_size(settings: Settings) -> tuple[list[Row], str]:
    """Returns the table of the full-size step, and a phrase that describes its batches."""
    words = ["data.batch_size=16"]
    if settings.quick:
        words = [
            "data.batch_size=2",
            "denoiser.latent_dim=16",
            "denoiser.ff_size=32",
            "denoiser.num_layers=1",
        ]
    config, device = compose("humanml3d/mdm", words), settings.device
    rows = config["data"]["batch_size"]
    width = config["denoiser"]["latent_dim"]
    layers = config["denoiser"]["num_layers"]

    steps = {"plain PyTorch, padded to 196": (peer_step(width, layers, device), LONGEST)}
    if settings.mdm_repo:
        authors = authors_step(settings.mdm_repo, width, layers, device)
        steps = {"the authors' code, padded to 196": (authors, LONGEST)} | steps
    steps |= {f"speed={speed}": recipe_step(config, speed, device) for speed in SPEEDS}
    if device == "cpu" and not settings.quick:
        steps["speed=fast, compiled"] = recipe_step(config, "fast", device, compiles=True)

    drawn = drawn_lengths(rows, 1 if settings.quick else BATCHES)
    seconds: dict[str, list[float]] = {name: [] for name in steps}
    warm: set[str] = set()
    for lengths in drawn:
        turns = {}
        for name, (step, multiple) in steps.items():
            frames = padded_length(int(lengths.max()), multiple, LONGEST)
            batch = batch_of(lengths, frames, device)
            if name not in warm:
                step(batch)
                warm.add(name)
            turns[name] = partial(step, batch)
        for name, taken in take_turns(turns, 1, device, warm_up=False).items():
            seconds[name].append(taken)

    peer = next(iter(seconds.values()))
    real = sum(int(lengths.sum()) for lengths in drawn) / len(drawn)
    table: list[Row] = []
    for name, times in seconds.items():
        taken = statistics.mean(times)
        ratio = statistics.median(map(truediv, peer, times))
        row: Row = {"training": name, "ms per step": 1000 * taken, "times as fast": ratio}
        table.append(row | {"frames per second": real / taken})

    padded = statistics.mean(padded_length(int(lengths.max()), 1, LONGEST) for lengths in drawn)
    text = (
        f"{rows} clips that average {real / rows:.0f} frames and are padded to {padded:.0f} by the "
        "framework"
    )
    return table, text


def backbones(
    recipes: Mapping[str, Sequence[str]],
    lengths: np.ndarray,
    rounds: int,
    device: str,
    *,
    compiles: bool = False,
) -> list[Row]:
    """Times a training step of several networks at both speeds. Returns one row per network.

    Args:
        recipes: name of each network -> its recipe, followed by changes of the recipe.
        lengths: (rows,), the length of each clip in the batch.
        rounds: number of rounds in which the steps take turns.
        device: the device.
        compiles: whether to also time the compiled steps of `speed=fast`.
    """
    rows: list[Row] = []
    for name, (recipe, *changes) in recipes.items():
        config = compose(recipe, ["condition=none", *changes])
        task = build_task(config)
        features = task.generator.representation.features
        parameters = sum(p.numel() for p in task.parameters() if p.requires_grad)

        steps = {speed: recipe_step(config, speed, device) for speed in SPEEDS}
        if compiles:
            steps["compiled"] = recipe_step(config, "fast", device, compiles=True)
        longest = int(lengths.max())
        frames = max(padded_length(longest, multiple, LONGEST) for _, multiple in steps.values())
        batch = batch_of(lengths, frames, device, features)
        times = take_turns(
            {speed: partial(step, batch) for speed, (step, _) in steps.items()}, rounds, device
        )

        row: Row = {"network": name, "parameters, M": parameters / 1e6, "clips": len(lengths)}
        row |= {f"ms, {speed}": 1000 * taken for speed, taken in times.items()}
        row |= {
            f"times as fast, {speed}": times["reference"] / taken
            for speed, taken in times.items()
            if speed != "reference"
        }
        row["frames per second"] = int(lengths.sum()) / min(times.values())
        rows.append(row)
    return rows


def quickstart(clips: int, steps: int, rounds: int) -> list[Row]:
    """Times training steps of the quickstart in the complete framework.

    Runs at both speeds alternate. Returns one row per speed.
    """
    times: dict[str, list[float]] = {speed: [] for speed in SPEEDS}
    with tempfile.TemporaryDirectory() as name:
        words = [
            *QUIET,
            f"data_root={name}/data",
            f"data.source.clips={clips}",
            f"trainer.max_steps={steps}",
            "condition.pretrain_steps=0",
        ]
        words.append(f"trainer.log_every_n_steps={max(1, steps // 15)}")
        for speed in SPEEDS * rounds:
            folder = Path(tempfile.mkdtemp(dir=name))
            fit(folder, compose("quickstart", [*words, f"run.dir={folder}", f"speed={speed}"]))
            history = read_history(folder)["train/seconds_per_step"]
            # The first steps warm up and do not count
            times[speed] += [value for step, value in history.items() if step >= steps // 3]

    medians = {speed: statistics.median(taken) for speed, taken in times.items()}
    return [
        {
            "training": f"speed={speed}",
            "ms per step": 1000 * taken,
            "times as fast": medians["reference"] / taken,
        }
        for speed, taken in medians.items()
    ]


def summary(rows: Sequence[Row]) -> str:
    """Returns a sentence that compares both speeds with the implementation in the first row."""
    peer = str(rows[0]["training"]).partition(",")[0]
    ratios = {row["training"]: row["times as fast"] for row in rows}
    text = (
        f"At full size, `speed=reference` is {ratios['speed=reference']:.1f} times as fast as {peer}, "
        f"and `speed=fast` is {ratios['speed=fast']:.1f} times as fast"
    )
    if compiled := ratios.get("speed=fast, compiled"):
        text += f" ({compiled:.1f} times in runs that compile the network)"
    return f"{text}."


def free_large_array() -> None:
    """Allocates 30 MB and frees them, as a training does when it prepares data and networks.

    glibc then keeps freed arrays of this size. Otherwise, it would return them to the operating
    system in each step, and small steps would take longer than in a training.
    """
    torch.empty(30 * 2**20, dtype=torch.uint8)


def measure(settings: Settings) -> Section:
    """Times training steps and returns the page section."""
    warnings.filterwarnings("ignore")
    torch.manual_seed(0)
    torch.set_float32_matmul_precision("high")  # as in training
    free_large_array()
    quick, device = settings.quick, settings.device

    full, batches = full_size(settings)
    tables: dict[str, list[Row]] = {"full size": full}
    if device == "cuda":
        memory = torch.cuda.max_memory_allocated() / 2**30
        batches += f"; at most {memory:.1f} GiB of memory for all models together"
    rng = np.random.default_rng(1)
    small = {name: SMALL[name] for name in ("FLAME", "MFM")} if quick else SMALL
    tables["small networks"] = backbones(
        small,
        rng.integers(36, 61, SMALL_CLIPS),
        1 if quick else ROUNDS,
        device,
        compiles=device == "cpu" and not quick,
    )
    if not quick:
        tables["other networks at full size"] = [
            row
            for clips, recipes in LARGE.items()
            for row in backbones(recipes, rng.integers(40, 197, clips), LARGE_ROUNDS, device)
        ]
    if device == "cpu":
        tables["quickstart"] = quickstart(60, 4, 1) if quick else quickstart(600, 45, 2)

    authors = (
        "The authors' step runs their code with zeros instead of CLIP's features. "
        if settings.mdm_repo
        else "The authors' code was not measured in this run. "
    )
    return section(
        "Training steps",
        f"""The full-size step trains `humanml3d/mdm` (8 layers of width 512, dropout 0.1) on {batches}. Lengths
        are uniform from 40 to 196 frames, in multiples of 4, similar to HumanML3D's lengths, and batches are drawn by
        the framework's sampler. {authors}Plain PyTorch trains `nn.TransformerEncoder` with AdamW on the same clips in
        float32, padded to 196 frames as in the published code. On each of {BATCHES} batches, all implementations
        take turns. Before the first batch, a step is taken that is not timed. Times are means
        over the batches, and ratios are medians over the batches. The other networks are trained without a text
        encoder, and the speeds take turns for {ROUNDS} rounds ({LARGE_ROUNDS} at full size). "Compiled" is
        `speed=fast` in runs of at least {COMPILED_FROM:,} steps, which compile the network; the compilation itself is
        not timed. Frames per second are those of the fastest step. The quickstart is trained by the complete
        framework, with its text encoder.""",
        summary(full),
        tables,
    )


if __name__ == "__main__":
    show(measure(Settings()))
