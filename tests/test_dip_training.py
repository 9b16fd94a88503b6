"""Training of DiP equals a loop in plain PyTorch, continues where it stopped, and is the same in two processes."""

import math
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lightning import Trainer
from support.refusals import one_error
from support.runs import built, reference
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from flame_mdm import task as task_module
from flame_mdm.__main__ import main
from flame_mdm.batch import Condition, MotionBatch, collate, length_mask
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.conditions import ConditionEncoder
from flame_mdm.config import compose, instantiate
from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import MotionDataModule, TrainingBatches
from flame_mdm.seeds import integers, key
from flame_mdm.task import GeneratorTask
from flame_mdm.training.averaging import MovingAverage

CONTEXT, WIDTH, HEADS, LAYERS, HIDDEN, TEXT = 10, 16, 2, 1, 24, 12
DECAY, DROP, STEPS = 0.9999, 0.1, 10

WORDS = [
    *(
        "data.source.clips=120",
        "data.batch_size=8",
        f"denoiser.latent_dim={WIDTH}",
        f"denoiser.ff_size={HIDDEN}",
    ),
    *(f"denoiser.num_layers={LAYERS}", f"denoiser.num_heads={HEADS}", "condition.features=16"),
    *("trainer.accelerator=cpu", "trainer.enable_progress_bar=false", "speed=reference"),
]
"""Overrides that make `synthetic/dip` tiny."""


class FrozenTokens(ConditionEncoder):
    """Stands in for DistilBERT: tokens that are a function of the caption, and zeros as the null."""

    features = TEXT

    def forward(self, batch: MotionBatch) -> Condition:
        tokens, token_mask = text_tokens(batch.text or [])
        null = Condition(torch.zeros_like(tokens[:1, 0]), torch.zeros_like(tokens[:1, :1]), None)
        return Condition(tokens[:, 0], tokens, token_mask, null)


def text_tokens(captions: Sequence[str]) -> tuple[Tensor, Tensor]:
    """Tokens (B, S, TEXT) of captions, one per word, and their mask (B, S)."""
    rows = []
    for caption in captions:
        words = caption.split()
        draws = [np.random.default_rng(key(word)).normal(size=TEXT) for word in words]
        rows.append(torch.from_numpy(np.stack(draws)))
    tokens = nn.utils.rnn.pad_sequence(rows, batch_first=True)
    lengths = torch.tensor([len(row) for row in rows])
    return tokens, torch.arange(tokens.shape[1]) < lengths[:, None]


class ReferenceNetwork(nn.Module):
    """DiP's network in PyTorch's own layers, with the names of the authors."""

    def __init__(self, features: int):
        super().__init__()
        self.pose_embedding = nn.Linear(features, WIDTH)
        self.text_embedding = nn.Linear(TEXT, WIDTH)
        self.time_embedding = nn.Sequential(
            nn.Linear(WIDTH, WIDTH), nn.SiLU(), nn.Linear(WIDTH, WIDTH)
        )
        layer = nn.TransformerDecoderLayer(
            WIDTH, HEADS, HIDDEN, dropout=0.0, activation="gelu", batch_first=True
        )
        self.decoder = nn.TransformerDecoder(layer, LAYERS)
        self.pose_final = nn.Linear(WIDTH, features)

    def forward(
        self, prefix: Tensor, x_t: Tensor, t: Tensor, tokens: Tensor, padding: Tensor
    ) -> Tensor:
        time = self.time_embedding(positions(10)[t])
        memory = self.text_embedding(tokens) + time[:, None]
        frames = self.pose_embedding(torch.cat([prefix, x_t], 1))
        frames = frames + positions(frames.shape[1])
        decoded = self.decoder(frames, memory, memory_key_padding_mask=padding)
        return self.pose_final(decoded[:, prefix.shape[1] :])

    def take_weights(self, task: GeneratorTask) -> None:
        """Copies the weights of a model."""
        ours = dict(task.generator.denoiser.named_parameters())
        with torch.no_grad():
            for name, parameter in self.named_parameters():
                parameter.copy_(ours[our_name(name)])


def our_name(name: str) -> str:
    """Our name of a weight of the reference."""
    for theirs, ours in (
        *(
            ("pose_embedding", "input"),
            ("text_embedding", "condition.projection"),
            ("pose_final", "output"),
        ),
        *(("time_embedding", "condition.time_embedding"), ("decoder.layers", "transformer.layers")),
        *(
            ("self_attn.in_proj_", "self_attention.qkv."),
            ("self_attn.out_proj", "self_attention.out"),
        ),
        *(
            ("multihead_attn.in_proj_", "cross_attention.qkv."),
            ("multihead_attn.out_proj", "cross_attention.out"),
        ),
        *(("linear1", "feed_forward.0"), ("linear2", "feed_forward.3"), ("norm1", "self_norm")),
        *(("norm2", "cross_norm"), ("norm3", "feed_forward_norm")),
    ):
        name = name.replace(theirs, ours)
    return name


def positions(count: int) -> Tensor:
    """The sinusoids of positions (count, WIDTH), rounded to float32 as in the authors' table."""
    position = torch.arange(count, dtype=torch.float32)[:, None]
    rate = torch.exp(torch.arange(0, WIDTH, 2, dtype=torch.float32) * (-math.log(10000.0) / WIDTH))
    table = torch.zeros(count, WIDTH, dtype=torch.float32)
    table[:, 0::2], table[:, 1::2] = torch.sin(position * rate), torch.cos(position * rate)
    return table.double()


def signal_levels() -> Tensor:
    """The products of 1 - beta of the cosine schedule, with each beta at most 0.999."""
    level = [
        math.cos((step / STEPS + 0.008) / 1.008 * math.pi / 2) ** 2 for step in range(STEPS + 1)
    ]
    betas = [min(1 - after / before, 0.999) for before, after in pairwise(level)]
    return torch.cumprod(1 - torch.tensor(betas, dtype=torch.float64), 0)


class ReferenceLoop:
    """DiP's training loop: windows, noise, loss on the predicted frames, AdamW, and averaged weights."""

    def __init__(self, task: GeneratorTask, data: MotionDataModule):
        self.clips, self.seed = data.train, task.seed
        self.network = ReferenceNetwork(task.generator.representation.features).double()
        self.network.take_weights(task)
        self.average = [parameter.detach().clone() for parameter in self.network.parameters()]
        self.optimizer = torch.optim.AdamW(self.network.parameters(), lr=1e-3, weight_decay=0.0)
        batches = TrainingBatches(
            data.train.lengths, data.batch_size, seed=data.seed, first=0, rank=0, world=1
        )
        self.batches = enumerate(batches)

    def step(self) -> float:
        """Trains one step, and returns its loss."""
        number, draws = next(self.batches)
        torch.manual_seed(key("step", self.seed, number, 0))
        windows, captions = self.windows(draws)
        prefix, x = windows[:, :CONTEXT], windows[:, CONTEXT:]
        tokens, token_mask = text_tokens(captions)

        dropped = torch.rand(len(x), dtype=torch.float64) < DROP
        t = (torch.rand(len(x), dtype=torch.float64) * STEPS).long()
        noise = torch.randn(x.shape, dtype=torch.float64)
        level = signal_levels()[t][:, None, None]
        x_t = level.sqrt() * x + (1 - level).sqrt() * noise
        predicted = self.network(prefix, x_t, t, tokens * ~dropped[:, None, None], ~token_mask)
        loss = (predicted - x).square().mean((1, 2)).mean()

        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimizer.step()
        for average, parameter in zip(self.average, self.network.parameters(), strict=True):
            average.mul_(DECAY).add_(parameter.detach(), alpha=1 - DECAY)
        return float(loss.detach())

    def windows(self, draws: list[tuple[int, int]]) -> tuple[Tensor, list[str]]:
        """The windows (B, F, D) of a batch, cut from the whole clips and normalized, and their captions."""
        indices = [index for index, _ in draws]
        firsts, lengths, captions = self.clips.draw(indices, draws[0][1])
        rows, texts = [], []
        for index, first, length, caption in zip(indices, firsts, lengths, captions, strict=True):
            clip = self.clips.clips[index]
            frames = self.clips.store.motion(clip)[first : first + length]
            rows.append(torch.from_numpy((frames - self.clips.mean) / self.clips.std))
            texts.append(clip.captions[caption])
        return torch.stack(rows).double(), texts


def prepared(data_root: Path, *words: str) -> tuple[GeneratorTask, MotionDataModule]:
    """A tiny task of `synthetic/dip` in float64, without geometric losses, and its data."""
    config = compose(
        "synthetic/dip", [*WORDS, f"data_root={data_root}", "losses.velocity=0", *words]
    )
    torch.manual_seed(0)
    representation = instantiate(config["representation"])
    data: MotionDataModule = instantiate(
        config["data"], representation=representation, seed=config["seed"]
    )
    data.prepare_data()
    data.setup("fit")
    features = config["condition"]["features"]
    config["condition"]["features"] = TEXT
    config["condition"]["heads"] = 1
    task = GeneratorTask.build(config, representation).double()
    config["condition"]["features"] = features
    task.generator.condition = FrozenTokens()
    return task, data


@pytest.mark.parametrize("steps", [60, pytest.param(1000, marks=pytest.mark.robustness)])
def test_training_equals_the_loop_in_plain_pytorch(data_root, tmp_path, steps, subtests):
    task, data = prepared(data_root, "data.resident=false")
    loop = ReferenceLoop(task, data)
    average = MovingAverage(DECAY, from_initial_weights=True)
    trainer = Trainer(
        max_steps=steps,
        accelerator="cpu",
        precision="64-true",
        gradient_clip_val=1.0,
        callbacks=[average],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        use_distributed_sampler=False,
        num_sanity_val_steps=0,
        limit_val_batches=0,
        default_root_dir=tmp_path,
    )
    trainer.fit(task, data)
    losses = [loop.step() for _ in range(steps)]
    assert np.mean(losses[-10:]) < np.mean(losses[:10])

    # `fit` leaves the averaged weights in the task.
    ours = dict(task.generator.denoiser.named_parameters())
    for (name, parameter), averaged in zip(
        loop.network.named_parameters(), loop.average, strict=True
    ):
        with subtests.test(parameter=name):
            torch.testing.assert_close(ours[our_name(name)].detach(), averaged, rtol=0, atol=1e-7)
            assert (parameter - averaged).abs().max() > 1e-6


def test_windows_are_uniform_over_all_places_of_a_clip(subtests):
    crop = Units(min_frames=60, max_frames=60, unit=60)
    for frames in (60, 61, 199):
        with subtests.test(frames=frames):
            below = integers(np.arange(20_000))
            first, length = crop.draw(np.full(20_000, frames), below)
            assert (length == 60).all()
            counts = np.bincount(first, minlength=frames - 59)
            assert len(counts) == frames - 59
            assert counts.min() > 0.5 * counts.mean()


def test_clips_without_a_frame_to_predict_are_refused_before_training(tmp_path, data_root, capsys):
    words = [
        *WORDS,
        f"data_root={data_root}",
        f"run.dir={tmp_path / 'run'}",
        "denoiser.context_frames=40",
    ]
    assert main(["train", "synthetic/dip", *words]) == 1
    assert (
        "data.crop: a sample of 40 frames has no frames left after a prefix of 40 frames"
        in one_error(capsys)
    )


def test_the_loss_of_targets_is_measured_at_the_end_of_each_motion():
    aims = ["denoiser=dip_target", "task=generation_targets", "task.targets.choices=[[pelvis]]"]
    config = compose("synthetic/dip", [*aims, *WORDS, "denoiser.context_frames=10"])
    representation = instantiate(config["representation"])
    task = GeneratorTask.build(config, representation).double().eval()
    mask = length_mask(torch.tensor([40, 30]))
    x = torch.randn(2, 40, representation.features, generator=torch.Generator().manual_seed(0))
    x = x.double() * mask[..., None]
    texts = ["a person walks", "a person sits"]
    padded = task.losses_of(MotionBatch(x, mask, ["long", "short"], texts))
    alone = task.losses_of(MotionBatch(x[1:, :30], mask[1:, :30], ["short"], texts[1:]))
    assert padded["target"].min() > 0.01
    for name in ("target", "loss"):
        torch.testing.assert_close(padded[name][1:], alone[name])


def test_a_motion_has_no_target_with_the_given_probability(monkeypatch):
    monkeypatch.setattr(
        task_module,
        "_conditioned",
        lambda _, __, batch, u: (batch, Condition(u[:, None], batch.x[:, :0], None)),
    )
    conditions: list[Condition] = []

    def loss_terms(batch: MotionBatch, cond: Condition) -> dict[str, Tensor]:
        conditions.append(cond)
        return {"loss": batch.x.sum((1, 2))}

    stub: Any = SimpleNamespace(
        seed=0,
        global_rank=0,
        device=torch.device("cpu"),
        generator=None,
        targets=SimpleNamespace(drop_prob=0.2),
        loss_terms=loss_terms,
        is_reported=False,
    )
    x = torch.zeros(4000, 1, 1)
    batch = MotionBatch(x, x[..., 0] == 0, [""] * 4000)
    GeneratorTask.training_step(stub, batch, 0)
    (cond,) = conditions
    assert cond.target_mask is not None
    assert cond.target_mask.float().mean() == pytest.approx(0.8, abs=0.02)
    # Which targets are drawn does not depend on which motions have one.
    u = cond.pooled[:, 0]
    assert u[cond.target_mask].mean() == pytest.approx(0.5, abs=0.03)
    assert u[~cond.target_mask].mean() == pytest.approx(0.5, abs=0.03)


RUN = [
    "callbacks.samples=null",
    "logger=tensorboard",
    "trainer.val_check_interval=2",
    "callbacks.checkpoints.every_n_steps=2",
]


@pytest.mark.slow
@pytest.mark.parametrize("recipe", ["synthetic/dip", "targets"])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, data_root, recipe, subtests):
    extra = ["denoiser=dip_target", "task=generation_targets", *WORDS, "denoiser.context_frames=10"]
    words = [*(extra if recipe == "targets" else WORDS), *RUN, f"data_root={data_root}"]
    weights = []
    for name, stops in (("whole", [4]), ("resumed", [2, 4])):
        for steps in stops:
            run = [f"run.dir={tmp_path / name}", f"trainer.max_steps={steps}"]
            assert main(["train", "synthetic/dip", *words, *run]) == 0
        weights.append(read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt"))
    whole, resumed = weights
    for part in ("state_dict", "current_model_state"):
        with subtests.test(part=part):
            assert whole[part].keys() == resumed[part].keys()
            assert all(torch.equal(whole[part][key], resumed[part][key]) for key in whole[part])


class Step(nn.Module):
    """A training step as the forward of a module, which DDP wraps."""

    def __init__(self, task: GeneratorTask):
        super().__init__()
        self.task = task

    def forward(self, batch: MotionBatch, number: int) -> Tensor:
        return self.task.training_step(batch, number)


def trained_in_process(rank: int, words: list[str], steps: int) -> dict[str, Tensor]:
    """Trains in one of two processes, and returns the weights."""
    config, data, task = built(words, "synthetic/dip")
    task.__class__ = type("OfRank", (type(task),), {"global_rank": rank})  # type: ignore[arg-type]
    parallel = DistributedDataParallel(Step(task))
    optimizer = task.make_optimizer()
    stream = TrainingBatches(
        data.train.lengths, data.batch_size, seed=config["seed"], first=0, rank=rank, world=2
    )
    for number, draws in zip(range(steps), stream, strict=False):
        optimizer.zero_grad()
        parallel(collate([data.train[draw] for draw in draws]), number).backward()
        nn.utils.clip_grad_norm_(task.parameters(), config["trainer"]["gradient_clip_val"])
        optimizer.step()
    return {name: value.detach() for name, value in task.state_dict().items()}


def test_two_processes_train_as_one_with_both_batches(data_root, pool, subtests):
    prepared(data_root)
    sgd = [
        "ema=null",
        "optimizer._target_=torch.optim.SGD",
        "optimizer.lr=0.05",
        "data.batch_size=2",
    ]
    words = [*WORDS, *sgd, f"data_root={data_root}"]
    expected = reference(words, 3, "synthetic/dip")
    for rank, weights in enumerate(pool.run(trained_in_process, (0, words, 3), (1, words, 3))):
        with subtests.test(rank=rank):
            torch.testing.assert_close(weights, expected, rtol=1e-4, atol=1e-6)
