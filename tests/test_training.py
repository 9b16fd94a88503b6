"""Training: what a run leaves, resuming and signals; sampling from its checkpoint."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from contextlib import suppress
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from lightning.pytorch.loggers import TensorBoardLogger, WandbLogger
from PIL import Image
from support.fixtures import recipe
from support.runs import TINY, ended, forked
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchmetrics import MeanMetric, Metric

from flame_mdm import task as task_module
from flame_mdm.__main__ import main
from flame_mdm.batch import MotionBatch
from flame_mdm.checkpoints.loading import load, load_task
from flame_mdm.checkpoints.locating import SHIPPED
from flame_mdm.checkpoints.model_files import read_checkpoint, read_model_file
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.config import compose, flatten, instantiate
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import _length_unit
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.progress import ProgressBar
from flame_mdm.reporting.page import number
from flame_mdm.runs import HISTORY, read_history
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.generation import generate
from flame_mdm.task import GeneratorTask, Task
from flame_mdm.training import callbacks, provenance, start
from flame_mdm.training import fit as fit_module
from flame_mdm.training.callbacks import Checkpoints, Interrupted, Measurements, SampleMotions
from flame_mdm.training.guards import BadLoss
from flame_mdm.training.loggers import (
    History,
    TensorBoardRun,
    WandbRun,
    log_config,
    log_table,
    log_video,
)

STEPS = [
    "trainer.val_check_interval=4",
    "callbacks.checkpoints.every_n_steps=4",
    "callbacks.samples=null",
]


def run(overrides: list[str], steps: int, folder: Path) -> Path:
    assert (
        main(["train", "quickstart", *overrides, f"run.dir={folder}", f"trainer.max_steps={steps}"])
        == 0
    )
    return folder / "checkpoints" / "last.ckpt"


def same_weights(first: Path, second: Path) -> bool:
    """Whether two checkpoints hold the same weights, averaged and not, bit for bit."""
    a, b = read_checkpoint(first), read_checkpoint(second)
    pairs = [(a.get(key, {}), b.get(key, {})) for key in ("state_dict", "current_model_state")]
    return all(
        x.keys() == y.keys() and all(torch.equal(x[name], y[name]) for name in x) for x, y in pairs
    )


@pytest.mark.slow
def test_training_learns_and_leaves_what_a_user_looks_for(tiny, tmp_path, subtests):
    words = [
        *tiny,
        "trainer.val_check_interval=30",
        "optimizer.lr=0.01",
        "trainer.log_every_n_steps=1",
    ]
    folder = tmp_path / "run"
    checkpoint = read_checkpoint(run(words, 60, folder))
    losses = list(read_history(folder)["train/loss"].values())
    assert len(losses) == checkpoint["global_step"] == 60
    assert np.mean(losses[-10:]) < 0.7 * np.mean(losses[:5])
    files = (
        "config.yaml",
        "provenance.json",
        "metrics.jsonl",
        "report.html",
        "checkpoints/best.ckpt",
    )
    for name in (*files, "samples/step_0000060/player.html"):
        with subtests.test(name=name):
            assert (folder / name).is_file(), name
    events = EventAccumulator(str(folder / "tensorboard"))
    events.Reload()
    assert {"val/loss", "epoch"} & set(events.Tags()["scalars"]) == {"val/loss"}, (
        "the epoch is always 0"
    )
    assert checkpoint["config"]["experiment"] == "quickstart"
    training = checkpoint["facts"].pop("training")
    assert training.keys() == {"hours", "memory_gib", "processes", "speed", "precision", "device"}
    assert re.fullmatch(r"1 x (?!cpu).+, \d+ threads?", training["device"]), "names the processor"
    facts = json.loads((folder / "provenance.json").read_text())["data"]
    assert facts.items() <= checkpoint["facts"].items()
    assert checkpoint["facts"].keys() - facts.keys() == {"vocabulary", "verbs", "captions"}
    assert not list(folder.rglob(".*"))


@pytest.mark.slow
def test_a_resumed_run_is_the_uninterrupted_one_and_adds_up_what_it_cost(tiny, tmp_path):
    overrides = [*tiny, *STEPS, "denoiser.dropout=0.1", "trainer.log_every_n_steps=2"]
    parts = run(overrides, 5, tmp_path / "parts")
    first = read_checkpoint(parts)
    training = first["facts"]["training"]
    assert 0 < training["hours"] < 1
    assert 0.01 < training["memory_gib"] < 1000
    training |= {"hours": 100.0, "memory_gib": 2000.0}
    torch.save(first, parts)
    # A killed run leaves half a line behind.
    with (tmp_path / "parts" / "metrics.jsonl").open("a") as file:
        file.write('{"step": 6, "train/loss": 77.0}\n{"step": 7, "train/lo')
    run(overrides, 11, tmp_path / "parts")
    assert same_weights(parts, run(overrides, 11, tmp_path / "whole"))
    a, b = (read_history(tmp_path / name) for name in ("parts", "whole"))
    assert a.keys() == b.keys()
    assert all(
        a[name] == b[name] for name in ("train/loss", "train/grad_norm", "val/loss", "train/epochs")
    )
    resumed = read_checkpoint(parts)["facts"]["training"]
    assert 100 < resumed["hours"] < 101
    assert resumed["memory_gib"] == 2000


@pytest.mark.slow
def test_a_decaying_learning_rate_resumes_where_it_was(tiny, tmp_path):
    """Also with accumulated gradients, a loading process, and without averaged weights."""
    overrides = [
        *tiny,
        *STEPS,
        "lr_warmup=2",
        "lr_decay=0.5",
        "optimizer.lr=0.008",
        "callbacks.best=null",
        "data.resident=false",
    ]
    overrides += ["callbacks.checkpoints.keep_every_n_steps=6", "trainer.log_every_n_steps=1"]
    overrides += ["trainer.accumulate_grad_batches=2", "data.num_workers=1", "ema=null"]
    whole = run(overrides, 8, tmp_path / "whole")
    rates = read_history(tmp_path / "whole")["train/lr"]
    assert list(rates.values()) == pytest.approx([0.004] + [0.008] * 4 + [0.006, 0.004, 0.002])
    parts = tmp_path / "parts" / "checkpoints" / "last.ckpt"
    parts.parent.mkdir(parents=True)
    parts.write_bytes((whole.parent / "step=0000006.ckpt").read_bytes())
    run(overrides, 8, tmp_path / "parts")
    assert same_weights(parts, whole)


def test_training_starts_from_the_weights_of_another_model(tiny, trained, tmp_path, capsys):
    """One step with a rate of 0 leaves them as they are. A deeper network gets what fits."""
    overrides = [
        *tiny,
        *STEPS,
        "optimizer.lr=0.0",
        "condition.pretrain_steps=0",
        "ema=null",
        "denoiser.num_layers=2",
        f"initial_weights={trained}",
    ]
    state = read_checkpoint(run(overrides, 1, tmp_path / "run"))["state_dict"]
    source = read_checkpoint(trained)["state_dict"]
    weights = source.keys() - {"representation.mean", "representation.std"}
    assert all(torch.equal(state[name], source[name]) for name in weights)
    assert len(state) > len(source)
    count = len(state) - 2
    assert (
        f"initial weights: {len(weights)} of {count} tensors from {trained}"
        in capsys.readouterr().out
    )


@pytest.mark.parametrize(
    ("source", "says"),
    [
        ("absent/run.ckpt", "initial_weights=absent/run.ckpt: no such checkpoint"),
        (
            "motion_clip_synthetic",
            "initial_weights=motion_clip_synthetic: none of its weights match this recipe",
        ),
    ],
)
def test_initial_weights_that_cannot_be_used_are_refused(tiny, capsys, source, says):
    assert main(["train", "quickstart", *tiny, *STEPS, f"initial_weights={source}"]) == 1
    assert says in capsys.readouterr().err


@pytest.mark.slow
def test_progress_counts_all_steps_and_shows_losses(tiny, tmp_path, capfd, monkeypatch):
    """Also after a resume; in a log file as plain lines, here one per step."""
    monkeypatch.setattr(ProgressBar, "SECONDS", 0.0)
    overrides = [*tiny, *STEPS, "trainer.enable_progress_bar=true", "trainer.log_every_n_steps=2"]
    for count in (6, 8):
        run(overrides, count, tmp_path / "run")
    lines = [line for line in capfd.readouterr().err.splitlines() if line.startswith("training:")]
    steps = [*(f"{step}/6" for step in range(7)), "6/8", "7/8", "8/8"]
    assert list(dict.fromkeys(re.findall(r" (\d+/\d+) \[", "\n".join(lines)))) == steps
    assert ("train/loss=" in lines[3], "val/loss=" in lines[6], "\r" in "".join(lines)) == (
        True,
        True,
        False,
    )


def test_waiting_threads_soon_sleep(subtests):
    """Importing the package says so to OpenMP before torch is loaded, unless the user has said otherwise."""
    code = "import os, sys, flame_mdm; assert 'torch' not in sys.modules; print(os.environ.get('GOMP_SPINCOUNT'))"
    environment = {
        name: os.environ[name] for name in os.environ.keys() - {"OMP_WAIT_POLICY", "GOMP_SPINCOUNT"}
    }
    for own, expected in (
        ({}, "2000"),
        ({"GOMP_SPINCOUNT": "7"}, "7"),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "None"),
    ):
        with subtests.test(own=own, expected=expected):
            printed = subprocess.check_output(
                [sys.executable, "-c", code], text=True, env=environment | own
            )
            assert printed.strip() == expected


@pytest.mark.slow
def test_a_finished_run_says_so_another_configuration_is_refused_and_a_saved_one_repeats_it(
    tiny, tmp_path, capsys
):
    for _ in range(2):
        first = run([*tiny, *STEPS], 2, tmp_path / "run")
    assert "already trained for 2 steps" in capsys.readouterr().out
    assert (
        main(["train", "quickstart", *tiny, *STEPS, "optimizer.lr=0.5", "trainer.max_steps=4"]) == 1
    )
    assert "optimizer.lr (0.002 there, 0.5 here)" in capsys.readouterr().err
    assert (
        main(["train", str(tmp_path / "run" / "config.yaml"), f"run.dir={tmp_path / 'again'}"]) == 0
    )
    assert same_weights(tmp_path / "again" / "checkpoints" / "last.ckpt", first)


@pytest.mark.slow
@pytest.mark.parametrize(
    "signum", [pytest.param(signal.SIGINT, marks=pytest.mark.robustness), signal.SIGTERM]
)
def test_a_signal_stops_at_the_end_of_a_step_and_the_run_goes_on(tiny, signum, tmp_path):
    # Runs of 5,000 steps or more are compiled, so their weights differ by rounding.
    words = ["train", "quickstart", *tiny, *STEPS, "trainer.max_steps=4999"]
    process = forked(tmp_path, ["flame_mdm", *words])
    checkpoint = tmp_path / "run" / "checkpoints" / "last.ckpt"
    while not checkpoint.exists() and process.is_alive():
        time.sleep(0.05)
    os.kill(cast(int, process.pid), signum)
    code, out, err = ended(process, tmp_path)
    assert code == 128 + signum, err
    assert "Traceback" not in err
    step = read_checkpoint(checkpoint)["global_step"]
    assert f"stopped at step {step}. Run the same command to resume" in out
    run([*tiny, *STEPS], step + 2, tmp_path / "run")
    assert same_weights(checkpoint, run([*tiny, *STEPS], step + 2, tmp_path / "whole"))


def test_averaged_weights_are_what_is_loaded(trained):
    checkpoint = read_checkpoint(trained)
    name = next(
        n for n in checkpoint["state_dict"] if n.startswith("denoiser.") and n.endswith("weight")
    )
    assert not torch.equal(checkpoint["state_dict"][name], checkpoint["current_model_state"][name])
    assert torch.equal(load(trained).state_dict()[name], checkpoint["state_dict"][name])


def test_validation_does_not_depend_on_the_batch_size(trained, data_root):
    values = []
    for size in (3, 8):
        overrides = [TINY[0], f"data_root={data_root}", f"data.batch_size={size}"]
        task = load_task(trained, GeneratorTask)
        data = instantiate(
            compose("quickstart", overrides)["data"], representation=task.generator.representation
        )
        data.setup("fit")
        with torch.no_grad():
            for index, batch in enumerate(data.val_dataloader()):
                task.validation_step(batch, index)
        values.append(float(cast(MeanMetric, task.val_losses["loss"]).compute()))
    assert values[0] == pytest.approx(values[1], rel=1e-5)


def test_unconditioned_samples_ignore_guidance(trained):
    a, b = (
        generate(load(trained), frames=24, guidance_scale=scale)[0].features for scale in (1.0, 7.0)
    )
    np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.slow
def test_sampling_writes_motions_and_a_player_and_takes_every_option(
    trained, tmp_path, capsys, subtests
):
    out, text = tmp_path / "samples", "a person's walk (slow), 100%"
    how: dict[str, Any] = {
        "frames": 24,
        "sampler": "ddim",
        "eta": 0.5,
        "num_inference_steps": [0, 2, 5, 9],
        "seed": 9,
    }
    words = [f"{key}={value}".replace(" ", "") for key, value in how.items()]
    words += ["samples=2", "shared_noise=true", "trajectory=true"]
    assert main(["sample", f"ckpt={trained}", f"text={text}", f"out={out}", *words]) == 0
    assert "player.html" in capsys.readouterr().out
    assert {p.name for p in out.iterdir()} >= {"player.html", "motions.gif"}
    model = load(trained)

    def features(**change: Any) -> np.ndarray:
        options: dict[str, Any] = {"shared_noise": True} | how | change
        return generate(model, text, **options)[0].features

    for name in ("motion_000.npz", "motion_001.npz"):  # of the same noise
        with subtests.test(name=name), np.load(out / name) as motion:
            np.testing.assert_allclose(motion["features"], features(), atol=1e-5)
            facts = [motion[key].item() for key in ("text", "seed", "fps")]
            assert (*facts, motion["joints"].shape, len(str(motion["checkpoint"]))) == (
                text,
                9,
                20.0,
                (24, 22, 3),
                64,
            )
    five = features(num_inference_steps=5)
    np.testing.assert_array_equal(features(num_inference_steps=[0, 2, 4, 7, 9]), five)
    for change in ({"spacing": "stride"}, {"eta": 0.0}, {"shared_noise": False}):
        with subtests.test(change=change):
            assert not np.allclose(features(num_inference_steps=5, **change), five)
    with Image.open(out / "trajectory.png") as sheet, Image.open(out / "motions.png") as motions:
        # The sheet shows four estimates and the result.
        assert sheet.height / 5 == pytest.approx(motions.height / 2, rel=0.2)


def test_cleanup_is_noted_in_the_results(trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert (
        main(
            [
                "sample",
                f"ckpt={trained}",
                "text=a person walks",
                "samples=1",
                "seconds=1.5",
                "cleanup=true",
            ]
        )
        == 0
    )
    (path,) = Path("samples").rglob("motion_000.npz")
    model, raw = load(trained), generate(load(trained), "a person walks", seconds=1.5)[0]
    with np.load(path) as motion:
        assert motion["cleanup"]
        assert "features" not in motion
        assert not np.allclose(motion["joints"], raw.joints, atol=1e-3)
    clean = edit(model, raw, "a person jumps", region="in_between", cleanup=True)[0]
    assert (clean.cleanup, clean.feature_error, clean.joint_error > 0) == (True, 0, True)


def test_shared_noise_is_that_of_no_text(trained):
    model, seen = load(trained), []
    model.denoiser.register_forward_hook(lambda module, inputs, output: seen.append(inputs[0]))
    generate(
        model,
        ["a person walks", "a person jumps"],
        frames=20,
        shared_noise=True,
        guidance_scale=1.0,
    )
    assert torch.equal(seen[0][0], seen[0][1])


def test_stages_are_the_clean_estimates_up_to_the_motion(trained):
    model, stages = load(trained), []
    motion = generate(model, "a person walks", frames=20, num_inference_steps=4, stages=stages)[0]
    texts = [f"estimate after {share}% of the sampling" for share in (0, 25, 50, 75)]
    assert [stage.text for stage in stages] == [*texts, "result: a person walks"]
    # The last step is the mean of the posterior, which is the estimate itself.
    np.testing.assert_allclose(stages[3].joints, motion.joints, atol=1e-5)
    assert np.abs(stages[0].joints - motion.joints).max() > 1e-3


class Stub(GeneratorTask):
    """A task without a network."""

    def __init__(self, **attributes: Any) -> None:
        Task.__init__(self, optimizer={}, seed=0)
        self.__dict__ |= attributes


def running(step: int, **attributes: Any) -> Any:
    """A trainer at a step, of 3 processes that accumulate 2 batches of 4 of 60 clips."""
    return SimpleNamespace(
        global_step=step,
        log_every_n_steps=5,
        datamodule=SimpleNamespace(batch_size=4, train=range(60), val=[]),
        world_size=3,
        accumulate_grad_batches=2,
        callback_metrics={},
        logged_metrics={},
        loggers=[],
        current_epoch=0,
        precision="32-true",
        strategy=SimpleNamespace(root_device=torch.device("cpu")),
        **attributes,
    )


def test_speed_is_that_of_the_steps_since_the_last_log_or_validation(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    measurements, task, trainer = Measurements(), Stub(), running(10)

    def logged(step: int, seconds: float) -> dict[str, float]:
        trainer.global_step, clock[0] = step, seconds
        trainer.logged_metrics.clear()
        measurements.on_train_batch_end(trainer, task)
        return {name: float(value) for name, value in trainer.logged_metrics.items()}

    measurements.on_train_start(trainer, task)
    task.reported["train/loss"] = torch.tensor(3.0)
    assert logged(14, 15.0) == {}
    pace = {"train/samples_per_second": 6.0, "train/seconds_per_step": 4.0}
    assert logged(15, 20.0) == {"train/loss": 3.0, "train/epochs": 15 * 24 / 60} | pace
    assert logged(15, 21.0) == {}  # gradients are accumulated
    trainer.global_step, clock[0] = 17, 100.0
    measurements.on_validation_end(trainer, task)
    pace = {"train/samples_per_second": 12.0, "train/seconds_per_step": 2.0}
    assert logged(20, 106.0) == {"train/epochs": 20 * 24 / 60} | pace


def test_a_checkpoint_holds_the_hours_and_the_greatest_memory_of_all_parts_of_a_run(monkeypatch):
    clock, memory = [100.0], SimpleNamespace(ru_maxrss=3 * 2**20)
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(perf_counter=lambda: clock[0]))
    monkeypatch.setattr(callbacks, "getrusage", lambda _: memory)
    monkeypatch.setattr(callbacks, "sys", SimpleNamespace(platform="linux"))
    measurements, task, trainer = Measurements(), Stub(), running(10)
    earlier = {"facts": {"training": {"hours": 1.5, "memory_gib": 2.0}}}
    measurements.on_load_checkpoint(trainer, task, earlier)
    measurements.on_train_start(trainer, task)
    for seconds, kilobytes, hours, gib in (
        (1900.0, 3 * 2**20, 2.0, 3.0),
        (3700.0, 2**20, 2.5, 2.0),
    ):
        clock[0], memory.ru_maxrss = seconds, kilobytes
        measurements.on_save_checkpoint(trainer, task, {})
        training = task.facts["training"]
        assert (training["hours"], training["memory_gib"], training["processes"]) == (hours, gib, 3)


def test_samples_are_written_at_the_first_chance_after_their_number_of_steps(tmp_path, monkeypatch):
    """A resumed run counts from the step at which it resumes."""
    written = []
    monkeypatch.setattr(
        SampleMotions, "write", lambda _, trainer, __: written.append(trainer.global_step)
    )
    samples = SampleMotions(str(tmp_path), every_n_steps=50, prompts=[], seconds=1.0)
    task = Stub(generator=SimpleNamespace(condition=None))
    task.facts = {"actions": []}
    samples.on_train_start(running(120), task)
    for step in (149, 169, 170, 171, 219, 230, 231, 269, 270):
        samples.on_train_batch_end(running(step), task)
    assert written == [170, 230, 270]
    # With validation clips, samples are written when the model is validated.
    validated = running(350)
    validated.datamodule.val = range(3)
    samples.on_train_batch_end(validated, task)
    assert written == [170, 230, 270]
    samples.on_validation_epoch_start(validated, task)
    assert written == [170, 230, 270, 350]


@pytest.mark.parametrize(("count", "stride"), [(130, 3), (64, 1), (65, 2)])
def test_metrics_of_real_motions_are_those_of_up_to_64_clips_with_all_requested_attributes(
    tmp_path, count, stride
):
    """Every second clip lacks an attribute that all prompts request."""

    class Motions(list[Any]):
        def __init__(self) -> None:
            self.clips = [
                SimpleNamespace(
                    attributes={"action": k, "speed": -k, "hand": 0} if k % 2 else {"speed": k}
                )
                for k in range(2 * count)
            ]

        def __getitem__(self, index: Any) -> Any:
            return "", torch.full((3, 1), float(index[0]))

    prompts = [("walks", {"action": 1, "speed": 2}), ("jumps", {"action": 1})]
    samples = SampleMotions(str(tmp_path), every_n_steps=1, prompts=prompts, seconds=1.0)
    measured: list[Any] = []
    samples.measure = lambda motions, requested: measured.extend((motions, requested)) or {}  # type: ignore[method-assign]
    representation = SimpleNamespace(mean=torch.zeros(1), to_joints=lambda x: x)
    task = Stub(generator=SimpleNamespace(representation=representation))
    samples._measure_real(Motions(), task)  # type: ignore[arg-type]
    motions, requested = measured
    rows = list(range(1, 2 * count, 2))[::stride]
    assert [int(motion[0, 0]) for motion in motions] == rows
    assert requested == [{"action": row, "speed": -row} for row in rows]


def test_a_loss_is_bad_above_a_thousand_times_the_median_of_the_interval_before(tmp_path):
    guard, task = BadLoss(str(tmp_path)), Stub()
    trainer = running(0, global_rank=0, is_global_zero=True)
    trainer.world_size, trainer.log_every_n_steps = 1, 3
    batch = MotionBatch(torch.zeros(1, 2, 1), torch.ones(1, 2) > 0, ["clip"])

    def end(step: int, loss: float) -> None:
        trainer.global_step = step
        guard.on_train_batch_end(trainer, task, {"loss": torch.tensor(loss)}, batch, step - 1)

    for step, loss in enumerate((1.0, 2.0, 900.0, 3.0, 1999.0, 1.0, 2.0, 2999.0), start=1):
        end(step, loss)
    with pytest.raises(UserError, match=r"the loss at step 9 is 3001 \(typical: 3\)"):
        end(9, 3001.0)
    bad = json.loads((tmp_path / "bad_batch.json").read_text())
    assert (bad["step"], bad["usual_loss"], bad["batches"][0]["loss"]) == (9, "3.0", "3001.0")
    assert (bad["batches"][0]["batch"], bad["batches"][0]["ids"]) == (8, ["clip"])


@pytest.mark.parametrize(("step", "kept"), [(4, [1, 3]), (3, [1]), (0, [])])
def test_a_resumed_run_keeps_the_lines_of_the_steps_that_it_does_not_repeat(tmp_path, step, kept):
    """Steps are counted from 0: four steps are 0, 1, 2 and 3."""
    lines = [{"step": number, "train/loss": number + 0.5} for number in (1, 3, 4, 5)]
    (tmp_path / HISTORY).write_text("".join(json.dumps(line) + "\n" for line in lines))
    history = History(tmp_path, step)
    history.log_metrics({"train/loss": 9.0}, step + 1)
    history.log_metrics({"train/loss": 8.0}, step + 3)
    expected = {number: number + 0.5 for number in kept} | {step + 1: 9.0, step + 3: 8.0}
    assert read_history(tmp_path)["train/loss"] == expected
    assert len((tmp_path / HISTORY).read_text().splitlines()) == len(expected)


def test_the_summary_counts_trained_weights_and_clips_of_all_processes(tmp_path, monkeypatch):
    facts: list[dict[str, Any]] = []
    lines: list[str] = []
    monkeypatch.setattr(provenance, "say", lambda *texts: lines.extend(texts))
    monkeypatch.setattr(provenance, "save", lambda *_, **__: None)
    monkeypatch.setattr(provenance, "write_json", lambda _, content: facts.append(content))
    task = Stub(generator=SimpleNamespace(describe=lambda: "Network"))
    task.frozen = torch.nn.Linear(10, 10).requires_grad_(False)
    task.trained = torch.nn.Linear(123, 1000)
    task.facts = {"dataset": "synthetic", "vocabulary": ["walks"], "verbs": [], "captions": []}
    trainer = running(3, is_global_zero=True, max_steps=50)
    info = {"dataset": "synthetic", "representation": "humanml3d", "hours": 1.5}
    trainer.datamodule.store = SimpleNamespace(info=info)
    trainer.datamodule.counts = lambda store: []
    config = {
        "experiment": "mine",
        "run": {"dir": str(tmp_path), "speed": "fast"},
        "data": {"batch_size": 4},
        "optimizer": {"lr": 0.1},
    }
    provenance.WriteProvenance(config).on_train_start(trainer, task)
    (content,) = facts
    assert (content["parameters"], content["data"]) == (124_000, {"dataset": "synthetic"})
    assert lines[0] == "mine: Network, 0.12 M trainable parameters"
    assert lines[1] == "data: synthetic as humanml3d; 1.5 hours"
    assert lines[2].endswith(", 32-true, speed=fast")
    # 24 clips in each of 50 steps are 20 times 60 clips.
    assert lines[3:] == [
        "batch: 24 clips = 4 x 3 processes x 2 accumulated; optimizer.lr=0.1 is not scaled with the batch size",
        "steps: 3 to 50, 24 clips per step, 20 epochs",
    ]


def test_setup_collects_facts_and_encodes_captions_and_prompts_once(tmp_path):
    facts: dict[str, Any] = {}
    moved: list[Any] = []
    store = SimpleNamespace(
        info={"dataset": "synthetic"}, fingerprint="f00", licenses=lambda: ["CC-BY-4.0"]
    )
    data = SimpleNamespace(
        store=store,
        choose_device=lambda size: ("device", size),
        crop=SimpleNamespace(longest=lambda: 60, max_frames=62),
        captions=lambda: ["walks", "sits", "walks"],
        folder=tmp_path / "data" / "synthetic-humanml3d",
    )
    encoder = SimpleNamespace(load_cache=lambda *_: 7, move_cache=moved.append)
    prompts = SimpleNamespace(texts=["jumps", "sits"])
    stub: Any = SimpleNamespace(
        data=data,
        trainer=SimpleNamespace(callbacks=[prompts, object()]),
        encoder=lambda: encoder,
        named_buffers=lambda: [("mean", None)],
        add_facts=facts.update,
    )
    stub._captions = lambda: Task._captions(stub)
    Task.setup(stub, "fit")
    assert facts == {
        "dataset": "synthetic",
        "fingerprint": "f00",
        "max_frames": 60,
        "licenses": ["CC-BY-4.0"],
    }
    assert moved == [("device", 7)]
    assert Task._captions(stub) == (["jumps", "sits", "walks"], tmp_path / "data" / "text")


@pytest.mark.parametrize(("distance", "same"), [(0.009, True), (0.011, False)])
def test_motions_are_the_same_if_no_joint_differs_by_a_centimeter(distance, same):
    """Lengths may differ."""
    motions = [Motion(np.zeros((frames, 22, 3)), 20.0) for frames in (8, 6, 7)]
    motions[1].joints[3, 20, 1] = distance
    motions[0].joints[6:] = 5.0
    assert callbacks.are_same(motions) == same
    assert not callbacks.are_same(motions[:1])


def test_metrics_are_explained_beside_those_of_real_motions():
    class Share(MeanMetric):
        """Share of prompts that are followed.

        Details.
        """

        higher_is_better = True

    values = {"share/walk": 0.25, "share": 0.5, "shared": 3.0}
    lines = callbacks.explain_metrics(values, {"share": 0.75}, {"share": Share(), "other": Share()})
    assert lines == [
        "share: Share of prompts that are followed. Higher is better.",
        f"  share/walk: {number(0.25)}",
        f"  share: {number(0.5)} (real motions: {number(0.75)})",
    ]


def test_lengths_of_training_are_multiples_of_the_unit_of_the_crop():
    assert _length_unit({"data": {"crop": {"unit": 4}}}) == 4
    assert [_length_unit(config) for config in ({}, {"data": {"crop": {}}})] == [1, 1]


CHANGES = {
    "seed": 1,
    "optimizer.lr": 0.5,
    "data.batch_size": 7,
    "data.crop.max_frames": 40,
    "ema.decay": 0.5,
    "trainer.precision": "64-true",
    "trainer.gradient_clip_val": 0.5,
    "trainer.accumulate_grad_batches": 2,
    "task.cond_drop_prob": 0.5,
    "lr_decay": 0.1,
}


def test_a_run_resumes_with_other_machines_and_lengths_but_not_with_other_training(
    tmp_path, monkeypatch, subtests
):
    saved = compose("quickstart")
    monkeypatch.setattr(start, "read_saved", lambda _: saved)
    start._check_same(tmp_path, saved)
    for name in ("trainer.max_steps", "trainer.devices", "data.num_workers", "data.resident"):
        with subtests.test(name=name):
            start._check_same(tmp_path, with_value(saved, name, 3))
    for name, value in CHANGES.items():
        with subtests.test(name=name), pytest.raises(UserError, match=f"{name} .*{value} here"):
            start._check_same(tmp_path, with_value(saved, name, value))


def with_value(config: Any, name: str, value: Any) -> Any:
    """A copy of a configuration with another value of a key, such as "trainer.max_steps"."""
    first, _, rest = name.partition(".")
    return config | {first: with_value(config.get(first) or {}, rest, value) if rest else value}


def test_the_draws_of_a_step_depend_on_seed_batch_and_process(monkeypatch):
    numbers = []

    def seeded(number: int, device: torch.device) -> None:
        numbers.append(number)
        raise StopIteration

    monkeypatch.setattr(task_module, "seed_generator", seeded)
    for seed, batch, rank in ((0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1), (1, 0, 0)):
        stub: Any = SimpleNamespace(seed=seed, global_rank=rank, device=torch.device("cpu"))
        with pytest.raises(StopIteration):
            GeneratorTask.training_step(stub, cast(Any, None), batch)
    assert len(set(numbers)) == 4
    assert numbers[1] == numbers[4]


def test_a_clip_is_validated_with_its_own_time_noise_and_target_in_every_batch(monkeypatch):
    drawn: list[tuple[Any, ...]] = []
    monkeypatch.setattr(
        task_module, "_conditioned", lambda _, __, batch, v: drawn.append((v,)) or (batch, None)
    )

    def loss_terms(batch: MotionBatch, cond: Any, u: Any, noise: Any) -> dict[str, Any]:
        drawn[-1] = (*drawn[-1], u, noise)
        return {}

    stub: Any = SimpleNamespace(
        device=torch.device("cpu"), generator=None, targets=None, loss_terms=loss_terms
    )
    for names in (["a", "b"], ["b", "c", "a"]):
        batch = MotionBatch(torch.zeros(len(names), 4, 3), torch.ones(len(names), 4) > 0, names)
        GeneratorTask.losses_of(stub, batch)
    first, second = drawn
    for one, other in zip(first, second, strict=True):
        assert torch.equal(one, other[[2, 0]])
        assert not torch.equal(other[0], other[1])
    assert not torch.equal(first[0], first[1])


@pytest.mark.parametrize("collapsed", [False, True])
def test_samples_that_do_not_depend_on_the_input_are_reported(
    trained, tmp_path, capsys, collapsed: bool
):
    task = object.__new__(GeneratorTask)
    model = load(trained)
    task.__dict__["generator"] = model
    if collapsed:
        torch.nn.init.zeros_(cast(Any, model.denoiser).output.weight)
    prompts = ["a person walks", "a person jumps", "a person waves"]
    samples = SampleMotions(str(tmp_path), every_n_steps=1, prompts=prompts, seconds=0.5)
    trainer = SimpleNamespace(
        global_step=5, global_rank=0, world_size=1, is_global_zero=True, loggers=[]
    )
    samples.write(trainer, task)  # type: ignore[arg-type]
    warning = (
        "warning: step 5: all 3 samples are the same motion. The network's output no longer depends"
    )
    assert (warning in capsys.readouterr().out) == collapsed


def test_values_are_reported_in_the_steps_that_end_a_log_interval():
    """A step is computed before it is counted: steps 5 and 10 are those after 4 and 9 steps."""
    task, reported = Stub(), {}
    weight = torch.ones((), requires_grad=True)
    for step in range(10):
        task._trainer = running(step)
        task.report({"train/loss": weight * step, "train/lr": 0.5})
        reported |= {step: float(task.reported["train/loss"])} if task.reported else {}
        assert not any(getattr(x, "requires_grad", False) for x in task.reported.values())
        task.reported.clear()
    assert reported == {4: 4.0, 9: 9.0}
    task._trainer = None
    assert task.is_reported, "without a trainer, every step is reported"


def written_checkpoints(
    tmp_path: Path, monkeypatch: Any, steps: range, **attributes: Any
) -> tuple[list[tuple[int, str]], int | None]:
    """Steps and names of the checkpoints of a run, and the step at which a signal has stopped it.

    A checkpoint is due every 4 steps and is kept every 6 steps. Each step accumulates 2 batches.
    `signal` is a step and a signal that arrives in it.
    """
    written: list[tuple[int, str]] = []
    signal_at, signum = attributes.pop("signal", (-1, 0))
    last_step = attributes.pop("should_stop_at", -1)
    checkpoints, task = Checkpoints(str(tmp_path), 4, 6), Stub()
    monkeypatch.setattr(checkpoints.stop, "install", lambda: None)
    trainer = running(steps.start, should_stop=False, **{"max_steps": 13} | attributes)
    trainer.world_size = 1
    trainer.save_checkpoint = lambda path: written.append((trainer.global_step, Path(path).name))
    checkpoints.on_train_start(trainer, task)
    checkpoints.on_train_batch_end(trainer, task)
    for trainer.global_step in steps[1:]:
        trainer.should_stop = trainer.global_step == last_step
        if trainer.global_step == signal_at:
            checkpoints.stop.signum = signum
        try:
            for _ in range(2):
                checkpoints.on_train_batch_end(trainer, task)
        except Interrupted as stop:
            return written, stop.step if stop.signum == signum else -1
    return written, None


def test_checkpoints_are_written_on_time_at_the_end_and_before_a_stop(tmp_path, monkeypatch):
    last, kept = "last.ckpt", "step={:07d}.ckpt".format
    written = partial(written_checkpoints, tmp_path, monkeypatch)
    usual = [(4, last), (6, kept(6)), (8, last), (12, last), (12, kept(12))]
    assert written(range(14)) == ([*usual, (13, last)], None)
    assert written(range(8, 12), max_steps=11) == ([(11, last)], None)
    assert written(range(14), max_steps=-1) == (usual, None)
    assert written(range(6), should_stop_at=5) == ([(4, last), (5, last)], None)
    assert written(range(14), signal=(6, 15)) == ([(4, last), (6, last), (6, kept(6))], 6)


@pytest.mark.parametrize(
    ("fps", "seconds", "frames"),
    [(20.0, 2.48, 50), (30.0, 1.66, 50), (30.0, 1.54, 46), (20.0, 9.0, 60)],
)
def test_samples_have_the_nearest_number_of_frames_and_processes_share_the_prompts(
    tmp_path, monkeypatch, fps, seconds, frames
):
    monkeypatch.setattr(callbacks, "resolve", lambda request, *_, **__: request)
    monkeypatch.setattr(callbacks, "sample", lambda _, request: request)
    model: Any = SimpleNamespace(
        conditioned_on="text", representation=SimpleNamespace(fps=fps), facts={"max_frames": 60}
    )
    samples = SampleMotions(str(tmp_path), 1, ["a", "b", "c"], seconds)
    first, second = (cast(Any, samples._sample(model, rank, 2)) for rank in (0, 1))
    assert (first.texts, second.texts) == (("a", "c"), ("b",))
    assert (first.frames, first.samples, first.seed, first.split) == (frames, 1, 0, False)
    model.conditioned_on = "action"
    assert cast(Any, samples._sample(model, 1, 2)).actions == ("b",)
    assert samples._sample(model, 3, 4) == []
    model.conditioned_on = "none"
    unprompted = SampleMotions(str(tmp_path), 1, None, seconds)
    assert cast(Any, unprompted._sample(model, 0, 2)).samples == callbacks.UNCONDITIONED
    assert unprompted._sample(model, 1, 2) == []


class FramesOfAttributes(Metric):
    """Numbers of real frames, weighted by the number of the motion, and requested speeds."""

    def __init__(self) -> None:
        super().__init__()
        self.add_state("frames", torch.zeros(()), dist_reduce_fx="sum")
        self.add_state("speed", torch.zeros(()), dist_reduce_fx="sum")

    def update(self, joints: torch.Tensor, mask: torch.Tensor, keys: Any, requested: Any) -> None:
        assert joints.shape[:2] == mask.shape
        self.frames += mask.sum() * (1 + keys[0])
        self.speed += requested[0].get("speed", 0)

    def compute(self) -> dict[str, Any]:
        return {"frames": self.frames, "speed": self.speed, "unknown": None}


class CountOfMotions(MeanMetric):
    def update(self, joints: torch.Tensor) -> None:  # type: ignore[override]
        super().update(float(len(joints)))


def test_metrics_of_samples_are_those_of_these_samples_alone(tmp_path):
    metrics: dict[str, Metric] = {"of": FramesOfAttributes(), "count": CountOfMotions()}
    samples = SampleMotions(str(tmp_path), 1, None, 1.0, metrics)
    motions = [torch.zeros(3, 22, 3), torch.zeros(5, 22, 3)]
    requested = [{"speed": 2.0}, {}]
    for _ in range(2):
        values = samples.measure(motions, requested)
        assert values == {"of/frames": 3 + 2 * 5, "of/speed": 2.0, "count": 1.0}
    assert samples.measure(motions[1:], requested[:1])["of/frames"] == 5


def test_the_seed_of_a_recipe_reaches_torch_the_data_and_the_task(tmp_path, monkeypatch):
    passed: list[dict[str, Any]] = []

    def build(node: Any, *_: Any, **derived: Any) -> Any:
        if "batch_size" in node:
            passed.append(derived)
            raise StopIteration
        return instantiate(node)

    monkeypatch.setattr(fit_module, "instantiate", build)
    config = compose("quickstart", [*TINY, "seed=7"])
    with pytest.raises(StopIteration):
        fit_module.fit(tmp_path, config)
    assert torch.initial_seed() == passed[0]["seed"] == 7
    assert GeneratorTask.build(config, passed[0]["representation"]).seed == 7


@pytest.mark.parametrize("differing", [[], ["commit"], ["changed", "packages"]])
def test_a_run_that_resumes_with_other_code_or_packages_says_which(
    tmp_path, monkeypatch, differing
):
    kinds = {"commit": "code", "changed": "uncommitted changes", "packages": "packages"}
    lines: list[str] = []
    before = provenance.environment() | dict.fromkeys(differing, "other")
    monkeypatch.setattr(provenance, "say", lambda *texts: lines.extend(texts))
    monkeypatch.setattr(provenance, "save", lambda *_, **__: None)
    monkeypatch.setattr(provenance, "read_json", lambda *_: SimpleNamespace(**before))
    (tmp_path / provenance.PROVENANCE).touch()
    task = Stub(generator=SimpleNamespace(describe=lambda: ""))
    trainer = running(3, is_global_zero=True, max_steps=50)
    trainer.datamodule.store = SimpleNamespace(
        info={"dataset": "", "representation": "", "hours": 1.0}
    )
    trainer.datamodule.counts = lambda _: []
    sections = {"run": {"dir": str(tmp_path)}, "data": {"batch_size": 4}, "optimizer": {}}
    provenance.WriteProvenance(sections | {"experiment": ""}).on_train_start(trainer, task)
    names = " and ".join(kinds[name] for name in differing)
    warnings = [line for line in lines if line.startswith("resuming")]
    assert len(warnings) == bool(differing)
    assert all(line.startswith(f"resuming with different {names}: results") for line in warnings)


def test_an_extractor_is_suggested_only_for_the_representation_of_its_training():
    trained = read_model_file(SHIPPED["motion_clip_synthetic"])["config"]["representation"]
    facts = {"dataset": "synthetic", "captions": ["a person walks"]}
    suggested = partial(callbacks._extractor_in_package, {"representation": trained})
    assert suggested(facts) == "motion_clip_synthetic"
    assert suggested({"dataset": "synthetic"}) == ""
    assert suggested(facts | {"dataset": "humanml3d"}) == ""
    other = {"representation": trained | {"fps": 33}}
    assert callbacks._extractor_in_package(other, facts) == ""


RESUMABLE = {
    "data_root",
    "data.root",
    "data.num_workers",
    "data.source.path",
    "trainer.max_steps",
    "trainer.devices",
    "trainer.num_nodes",
    "trainer.accelerator",
    "trainer.strategy",
    "trainer.log_every_n_steps",
    "trainer.val_check_interval",
}
"""Keys of the recipes, except for callbacks and loggers, that may differ when a run is resumed."""


@pytest.mark.parametrize("name", ["bandai/mfm_medium_distilled", "humanml3d/flame", "package"])
def test_every_key_that_decides_the_training_must_be_the_same_when_a_run_resumes(
    tmp_path, monkeypatch, name
):
    saved = recipe(name)
    monkeypatch.setattr(start, "read_saved", lambda _: saved)
    accepted = set()
    for key in flatten(saved):
        with suppress(UserError):
            start._check_same(tmp_path, with_value(saved, key, "other"))
            accepted.add(key)
    expected = RESUMABLE & flatten(saved).keys()
    assert {key for key in accepted if not key.startswith(("callbacks.", "logger."))} == expected
    assert {key for key in flatten(saved) if key.startswith("callbacks.")} <= accepted


def test_a_run_resumes_with_another_data_root_which_is_no_change_of_the_recipe(
    tmp_path, monkeypatch
):
    """AMASS lies in the data root too, but in the folder of another user it is another one."""
    saved, other = recipe("humanml3d/flame"), compose("humanml3d/flame", ["data_root=/data/sets"])
    assert other["data"]["source"]["amass"] == "/data/sets/raw/amass"
    monkeypatch.setattr(start, "read_saved", lambda _: saved)
    start._check_same(tmp_path, other)
    assert start.recipe_changes(other) == []
    foreign = with_value(other, "data.source.amass", "/data/others/raw/amass")
    with pytest.raises(UserError, match=r"data\.source\.amass \(.*/raw/amass there, /data/others"):
        start._check_same(tmp_path, foreign)
    assert start.recipe_changes(foreign) == ["data.source.amass=/data/others/raw/amass"]


def gathered(monkeypatch: Any, *others: Any) -> None:
    """Makes this process the second of two or more; the first one and the last ones hold `others`."""

    def all_gather(parts: list[Any], own: Any) -> None:
        parts[:] = [others[0], own, *others[1:]]

    monkeypatch.setattr(torch.distributed, "all_gather", all_gather)
    monkeypatch.setattr(torch.distributed, "all_gather_object", all_gather)


def test_a_bad_loss_of_any_process_stops_all_of_them_at_its_step(tmp_path, monkeypatch):
    guard, task = BadLoss(str(tmp_path), factor=10.0), Stub()
    trainer = running(0, global_rank=1, is_global_zero=False)
    trainer.log_every_n_steps = 4
    batch = MotionBatch(torch.zeros(1, 2, 1), torch.ones(1, 2) > 0, ["clip"])

    def end(*losses: float) -> None:
        for loss in losses:
            trainer.global_step += 1
            output = {"loss": torch.tensor(loss)}
            guard.on_train_batch_end(trainer, task, output, batch, trainer.global_step - 1)

    gathered(monkeypatch, torch.full((4,), 7.0), torch.full((4,), 8.0))
    end(1.0, 1.0, 1.0, 1.0)
    assert guard.usual == 7.0, "the median over all processes"
    first, last = torch.tensor([7.0, 7.0, 7.0, 99.0]), torch.tensor([7.0, 71.0, 7.0, 7.0])
    gathered(monkeypatch, first, last)
    with pytest.raises(UserError, match=r"the loss at step 6 is 71 \(typical: 7\)"):
        end(1.0, 2.0, 3.0, 4.0)


def test_a_checkpoint_is_not_written_after_a_bad_loss_between_two_log_steps(tmp_path):
    guard, task = BadLoss(str(tmp_path)), Stub()
    trainer = running(1, global_rank=0, is_global_zero=True)
    trainer.world_size = 1
    batch = MotionBatch(torch.zeros(1, 2, 1), torch.ones(1, 2) > 0, ["clip"])
    guard.on_train_batch_end(trainer, task, {"loss": torch.tensor(1.0)}, batch, 0)
    guard.on_save_checkpoint(trainer, task, {})
    guard.on_save_checkpoint(trainer, task, {})
    guard.on_train_batch_end(trainer, task, torch.tensor(float("inf")), batch, 1)
    with pytest.raises(UserError, match=r"is inf \(typical: 1\)"):
        guard.on_save_checkpoint(trainer, task, {})


@pytest.mark.parametrize(("own", "other"), [(signal.SIGTERM, 0), (0, signal.SIGTERM)])
def test_processes_stop_together_one_step_after_one_of_them_received_a_signal(
    tmp_path, monkeypatch, own, other
):
    received = {3: other}

    def all_reduce(values: torch.Tensor, operation: Any) -> None:
        assert operation == torch.distributed.ReduceOp.MAX
        values.clamp_(min=received.get(trainer.global_step, 0))

    monkeypatch.setattr(torch.distributed, "all_reduce", all_reduce)
    written: list[int] = []
    checkpoints, task = Checkpoints(str(tmp_path), 100), Stub()
    monkeypatch.setattr(checkpoints.stop, "install", lambda: None)
    trainer = running(0, should_stop=False, max_steps=50)
    trainer.save_checkpoint = lambda _: written.append(trainer.global_step)
    checkpoints.on_train_start(trainer, task)
    for trainer.global_step in (1, 2, 3):
        checkpoints.stop.signum = own if trainer.global_step == 3 else 0
        checkpoints.on_train_batch_end(trainer, task)
    trainer.global_step = 4
    with pytest.raises(Interrupted) as stop:
        checkpoints.on_train_batch_end(trainer, task)
    assert (stop.value.signum, stop.value.step, written) == (signal.SIGTERM, 4, [4])


def test_samples_of_all_processes_are_measured_in_the_order_of_the_prompts(tmp_path, monkeypatch):
    """Three processes sample five prompts: 0 and 3, 1 and 4, and 2."""
    motions = [Motion(np.full((4, 22, 3), float(number)), 20.0) for number in range(5)]
    gathered(monkeypatch, motions[0::3], motions[2::3])
    prompts = [(f"text {number}", {"speed": number}) for number in range(5)]
    samples = SampleMotions(str(tmp_path), 1, prompts, 1.0)
    measured: list[Any] = []
    written: list[Any] = []
    logged: list[Any] = []
    monkeypatch.setattr(samples, "_sample", lambda _, rank, world: motions[rank::world])
    monkeypatch.setattr(samples, "measure", lambda *pair: measured.append(pair) or {"skating": 0.5})
    monkeypatch.setattr(callbacks, "write_motions", lambda *values: written.append(values))
    monkeypatch.setattr(callbacks, "log_video", lambda *values: logged.append(values))
    logger = SimpleNamespace(log_metrics=lambda *values: logged.append(values))
    trainer = running(40, global_rank=1, is_global_zero=True)
    trainer.loggers = [logger]
    samples.write(trainer, Stub(generator=None))
    ((joints, requested),) = measured
    assert [float(motion[0, 0, 0]) for motion in joints] == [0, 1, 2, 3, 4]
    assert requested == [{"speed": number} for number in range(5)]
    ((folder, shown, facts),) = written
    assert (folder, shown) == (tmp_path / "step_0000040", motions)
    assert (facts["seed"], facts["step"]) == (0, 40)
    # Lightning counts steps from 0.
    video = (logger, "samples", folder / "motions.gif", 39)
    assert logged == [video, ({"samples/skating": 0.5}, 39)]


@pytest.mark.parametrize(
    ("texts", "expected"),
    [(["x", "y"], ["walk", "sit"]), (["x"] * 4, ["walk", "sit", "jump"]), (["x", "sit"], None)],
)
def test_a_model_of_actions_is_sampled_with_its_first_actions_instead_of_texts(
    tmp_path, texts, expected
):
    samples = SampleMotions(str(tmp_path), 1, texts, 1.0)
    task = Stub(generator=SimpleNamespace(condition=ActionLabels(3, 8)))
    task.facts = {"actions": ["walk", "sit", "jump"]}
    samples.on_train_start(running(0), task)
    assert samples.texts == (expected or texts)
    if expected:
        assert [requested["action"] for _, requested in samples.prompts] == expected


def test_a_table_is_logged_as_lines_of_markdown_with_its_step():
    texts: list[tuple[Any, ...]] = []

    class Board(TensorBoardLogger):
        def __init__(self) -> None: ...

        @property
        def experiment(self) -> Any:
            return SimpleNamespace(add_text=lambda *values: texts.append(values))

    log_table(Board(), "evaluation/own", ["metric", "mean"], [["fid", 0.5], ["kid", None]], 7)
    table = "| metric | mean |\n| --- | --- |\n| fid | 0.5 |\n| kid | None |"
    assert texts == [("evaluation/own", table, 7)]


@pytest.mark.parametrize(
    ("higher_is_better", "text"),
    [(True, " Higher is better."), (False, " Lower is better."), (None, "")],
)
def test_metrics_say_which_values_are_better_unless_neither_is(higher_is_better, text):
    class Share(MeanMetric):
        """Share of frames."""

    Share.higher_is_better = higher_is_better
    lines = callbacks.explain_metrics({"share": 0.0}, {"share": 0.0}, {"share": Share()})
    assert lines == [f"share: Share of frames.{text}", "  share: 0 (real motions: 0)"]


@pytest.mark.parametrize(
    ("kind", "facts", "words"),
    [
        ("text", {"captions": ["a person limps"]}, "'text=a person limps'"),
        ("text", {}, "'text=a person walks'"),
        ("action", {"actions": ["sit down", "walk"]}, "'action=sit down'"),
        ("none", {}, "unconditioned=true"),
    ],
)
def test_the_next_command_suits_the_condition_of_the_model(
    tmp_path, monkeypatch, capsys, kind, facts, words
):
    monkeypatch.setattr(callbacks, "write_report", lambda folder: folder / "report.html")
    task = Stub(generator=SimpleNamespace(conditioned_on=kind), config={})
    task.facts = {"actions": [], "dataset": "mine"} | facts
    trainer = running(12, is_global_zero=True)
    trainer.callback_metrics = {"val/loss": torch.tensor(0.0), "train/loss": torch.tensor(2 / 3)}
    callbacks.Report(tmp_path).on_fit_end(trainer, task)
    loss, report, sampling, evaluation = capsys.readouterr().out.splitlines()
    texts = "0.6667 on the last batch, 0 on the validation clips"
    assert loss.startswith(f"loss after 12 steps: {texts} (lower is better")
    assert report == f"report: {tmp_path / 'report.html'}"
    assert sampling == f"next: flame-mdm sample {tmp_path} {words}"
    assert evaluation.split() == [
        "flame-mdm",
        "evaluate",
        str(tmp_path),
        "extractor=none",
        "quick=true",
    ]


@pytest.mark.parametrize(("threads", "text"), [(1, "1 thread"), (8, "8 threads")])
def test_the_device_counts_processes_and_threads(monkeypatch, threads, text):
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"cpu_name": "EPYC"})
    assert provenance.device_name(running(0)) == f"3 x EPYC, {text}"
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: f"H200 {device.index}")
    gpus = running(0)
    gpus.strategy.root_device = torch.device("cuda", 1)
    assert provenance.device_name(gpus) == "3 x H200 1"


def test_the_bar_of_a_resumed_run_begins_at_its_step_and_advances_by_optimizer_steps():
    progress, task = callbacks.Progress(), Stub()
    trainer = running(20, is_global_zero=True, max_steps=30)
    progress.on_train_start(trainer, task)
    bar = progress.bar
    assert bar is not None
    assert (bar.n, bar.total) == (20, 30)
    trainer.callback_metrics = {"train/loss": torch.tensor(0.0), "val/loss": torch.tensor(1 / 3)}
    for trainer.global_step, postfix in ((20, ""), (24, ""), (25, "train/loss=0, val/loss=0.3333")):
        progress.on_train_batch_end(trainer, task)
        assert (bar.n, bar.postfix or "") == (trainer.global_step, postfix)
    progress.on_train_end()
    endless = callbacks.Progress()
    endless.on_train_start(running(0, is_global_zero=False, max_steps=-1), task)
    assert endless.bar is not None
    assert (endless.bar.total, endless.bar.disable) == (None, True)


def test_a_gif_is_logged_with_its_size_and_step(tmp_path):
    Image.new("P", (30, 20)).save(tmp_path / "motions.gif")
    logged: list[tuple[Any, int]] = []

    class Board(TensorBoardLogger):
        def __init__(self) -> None: ...

        @property
        def experiment(self) -> Any:
            writer = SimpleNamespace(add_summary=lambda *values: logged.append(values))
            return SimpleNamespace(_get_file_writer=lambda: writer)

    log_video(Board(), "samples", tmp_path / "motions.gif", 7)
    ((summary, step),) = logged
    (value,) = summary.value
    assert (value.tag, value.image.width, value.image.height, step) == ("samples", 30, 20, 7)
    assert value.image.encoded_image_string == (tmp_path / "motions.gif").read_bytes()


class WandbStub(WandbRun):
    """A logger whose Weights & Biases run counts and stores its rows."""

    def __init__(self, folder: Path):
        self.stored: list[tuple[dict[str, Any], int | None]] = []
        self.finished: list[int] = []
        super().__init__(str(folder))
        self._experiment = SimpleNamespace(  # type: ignore[assignment]
            id="f00",
            step=0,
            log=self._log,
            finish=lambda exit_code: self.finished.append(exit_code),
        )

    @property
    def experiment(self) -> Any:
        return self._experiment

    def _log(self, row: dict[str, Any], step: int | None = None) -> None:
        self.stored.append((row, step))
        self.experiment.step = (self.experiment.step if step is None else step) + bool(row)


def test_a_resumed_wandb_run_continues_its_rows_and_repeats_no_step(tmp_path):
    def steps(logger: WandbStub) -> list[int]:
        return [row["trainer/global_step"] for row, _ in logger.stored if row]

    first = WandbStub(tmp_path)
    for step in (0, 1, 2):
        first.log_metrics({"loss": 0.5}, step)
    assert steps(first) == [0, 1, 2]
    assert json.loads((tmp_path / "wandb.json").read_text()) == {"id": "f00", "step": 2, "rows": 3}
    second = WandbStub(tmp_path)
    assert second._wandb_init["id"] == "f00"
    for step in (0, 1, 2, 3):
        second.log_metrics({"loss": 0.5}, step)
    # The values of a step may be logged in several rows, so the last step may continue.
    assert steps(second) == [2, 3]
    assert second.stored[0] == ({}, 3), "the first row after the three of the first part"
    assert json.loads((tmp_path / "wandb.json").read_text())["rows"] == 5


@pytest.mark.parametrize(("status", "code"), [("success", 0), ("failed", 1)])
def test_a_wandb_run_ends_with_the_exit_code_of_the_training(tmp_path, monkeypatch, status, code):
    monkeypatch.setattr(WandbLogger, "finalize", lambda *_: None)
    logger = WandbStub(tmp_path)
    logger.finalize(status)
    assert (logger.finished, logger._experiment) == ([code], None)


def test_wandb_gets_tables_with_their_step_and_the_recipe_with_the_provenance(
    tmp_path, monkeypatch
):
    tables: list[dict[str, Any]] = []
    parameters: list[dict[str, Any]] = []
    monkeypatch.setattr(
        WandbLogger, "log_table", lambda _, name, **table: tables.append({"name": name, **table})
    )
    monkeypatch.setattr(WandbLogger, "log_hyperparams", lambda _, values: parameters.append(values))
    logger = WandbStub(tmp_path)
    log_table(logger, "evaluation/own", ["metric", "mean"], [("fid", 0.5)], 7)
    log_config(logger, {"seed": 3}, {"commit": "f00"})
    columns, data = ["metric", "mean"], [["fid", 0.5]]
    assert tables == [{"name": "evaluation/own", "columns": columns, "data": data, "step": 7}]
    assert parameters == [{"seed": 3, "provenance": {"commit": "f00"}}]


def test_tensorboard_gets_all_values_but_the_epoch(monkeypatch):
    logged: list[Any] = []
    monkeypatch.setattr(TensorBoardLogger, "log_metrics", lambda _, *values: logged.append(values))
    board = object.__new__(TensorBoardRun)
    board.log_metrics({"epoch": 0, "train/loss": 0.0, "train/epochs": 1.5}, 4)
    assert logged == [({"train/loss": 0.0, "train/epochs": 1.5}, 4)]


def fitted(tmp_path: Path, monkeypatch: Any, stop: BaseException | None, **changes: Any) -> Any:
    """Runs `fit` without data and network; `stop` ends the training. Returns the options of the trainer."""
    passed: dict[str, Any] = {}

    def fit(*_: Any, **__: Any) -> None:
        if stop:
            raise stop

    def build(node: Any, *_: Any, **options: Any) -> Any:
        if "precision" not in node:
            return SimpleNamespace(actions=[], node=node, num_workers=0)
        passed.update(node | options)
        return SimpleNamespace(
            fit=fit,
            is_global_zero=changes.get("is_first", True),
            strategy=SimpleNamespace(launcher=None),
        )

    for name in (
        "skip_empty_hooks",
        "skip_exchange_of_signals",
        "check_devices",
        "seed_everything",
    ):
        monkeypatch.setattr(fit_module, name, lambda *_, **__: None)
    monkeypatch.setattr(fit_module, "instantiate", build)
    task_class = SimpleNamespace(build=lambda *_, **__: Stub())
    monkeypatch.setattr(fit_module, "get_class", lambda _: task_class)
    monkeypatch.setattr(fit_module, "newest", lambda _: changes.get("resumed"))
    monkeypatch.setattr(fit_module, "_check_same_data", lambda *_: None)
    monkeypatch.setattr(fit_module, "check_optimizers", lambda *_: None)
    monkeypatch.setattr(Stub, "make_optimizer", lambda _: None)
    config = {name: {"_target_": name} for name in ("representation", "data", "task", "logger")}
    config |= {"seed": 0, "run": {"dir": str(tmp_path)}, "ema": {"decay": 0.5}}
    config |= {"callbacks": {"first": {"_target_": "x"}, "absent": None, "last": {"_target_": "y"}}}
    trainer = {"max_steps": 9, "precision": "32-true"} | changes.get("trainer", {})
    fit_module.fit(tmp_path, config | {"trainer": trainer})
    return passed


def test_averages_come_before_the_callbacks_that_validate_and_the_history_at_the_resumed_step(
    tmp_path, monkeypatch
):
    monkeypatch.delenv("SLURM_NTASKS", raising=False)
    resumed = SimpleNamespace(step=8, path=tmp_path / "last.ckpt", content={})
    options = fitted(tmp_path, monkeypatch, None, resumed=resumed)
    kinds = [type(callback).__name__ for callback in options["callbacks"]]
    own, after = ["WriteProvenance", "MovingAverage"], ["Measurements", "Progress", "Report"]
    assert kinds == [*own, "SimpleNamespace", "SimpleNamespace", *after]
    assert [callback.node["_target_"] for callback in options["callbacks"][2:4]] == ["x", "y"]
    *_, history = options["logger"]
    assert (history.step, history.path) == (8, tmp_path / HISTORY)
    (plugin,) = options["plugins"]
    assert (plugin.folder, plugin.resumed) == (tmp_path / "checkpoints", resumed)
    assert (options["precision"], options["enable_progress_bar"]) == ("32-true", False)
    quiet = fitted(
        tmp_path, monkeypatch, None, trainer={"enable_progress_bar": False, "profiler": "x"}
    )
    assert "Progress" not in [type(callback).__name__ for callback in quiet["callbacks"]]
    assert quiet["profiler"] == "x"
    assert fitted(tmp_path, monkeypatch, None, resumed=resumed, trainer={"max_steps": 8}) == {}
    endless = {"max_steps": -1}
    assert fitted(tmp_path, monkeypatch, None, resumed=resumed, trainer=endless)["max_steps"] == -1


@pytest.mark.parametrize(
    ("signum", "job", "requeued"),
    [
        (signal.SIGUSR1, "12", True),
        (signal.SIGUSR2, "12", True),
        (signal.SIGUSR1, None, False),
        (signal.SIGTERM, "12", False),
    ],
)
def test_a_job_that_slurm_is_about_to_end_is_requeued_by_its_first_process(
    tmp_path, monkeypatch, capsys, signum, job, requeued
):
    commands: list[list[str]] = []
    run_command = SimpleNamespace(
        run=lambda words, **_: commands.append(words),
        CalledProcessError=subprocess.CalledProcessError,
    )
    monkeypatch.setattr(fit_module, "subprocess", run_command)
    monkeypatch.delenv("SLURM_JOB_ID", raising=False)
    if job:
        monkeypatch.setenv("SLURM_JOB_ID", job)
    with pytest.raises(SystemExit) as stop:
        fitted(tmp_path, monkeypatch, Interrupted(signum, 7))
    assert stop.value.code == 128 + signum
    assert commands == [["scontrol", "requeue", "12"]] * requeued
    lines = capsys.readouterr().out.splitlines()
    requeue = ["job 12 was requeued"] * requeued
    assert lines == ["stopped at step 7. Run the same command to resume", *requeue]
    fitted(tmp_path, monkeypatch, Interrupted(signum, 7), is_first=False)
    assert len(commands) == requeued


@pytest.mark.parametrize(("platform", "unit"), [("linux", 2**10), ("darwin", 1)])
def test_memory_is_in_gibibytes_on_every_system_and_device(monkeypatch, platform, unit):
    monkeypatch.setattr(callbacks, "sys", SimpleNamespace(platform=platform))
    usage = SimpleNamespace(ru_maxrss=3 * 2**30 // unit)
    monkeypatch.setattr(callbacks, "getrusage", lambda _: usage)
    measurements, task, trainer = Measurements(), Stub(), running(5)
    measurements.on_save_checkpoint(trainer, task, {})
    assert task.facts["training"]["memory_gib"] == 3
    monkeypatch.setattr(Stub, "device", torch.device("cuda"))
    monkeypatch.setattr(torch.cuda, "max_memory_allocated", lambda _: 5 * 2**29)
    monkeypatch.setattr(callbacks, "device_name", lambda _: "1 x H200")
    measurements.on_save_checkpoint(trainer, task, {})
    training = task.facts["training"]
    assert (training["memory_gib"], training["device"]) == (2.5, "1 x H200")
    measurements.on_train_batch_end(trainer, task)
    assert float(trainer.logged_metrics["train/gpu_memory_gib"]) == 2.5


@pytest.mark.parametrize(
    ("warmup", "decay", "factors"),
    [
        (4, 0.0, [0.25, 0.5, 0.75, 1, 1, 1, 1, 1]),
        (None, 1.0, [1, 7 / 8, 6 / 8, 5 / 8, 4 / 8, 3 / 8, 2 / 8, 1 / 8]),
        (0, 0.25, [1, 1, 1, 1, 1, 1, 1, 0.5]),
        (6, 1.0, [1 / 6, 2 / 6, 3 / 6, 5 / 8, 4 / 8, 3 / 8, 2 / 8, 1 / 8]),
    ],
)
def test_the_learning_rate_rises_and_falls_linearly(warmup, decay, factors):
    optimizer = torch.optim.SGD([torch.nn.Parameter(torch.zeros(1))], lr=2.0)
    stub: Any = SimpleNamespace(
        make_optimizer=lambda: optimizer,
        config={"lr_warmup": warmup, "lr_decay": decay},
        trainer=SimpleNamespace(max_steps=8),
    )
    schedule = cast(Any, Task.configure_optimizers(stub))["lr_scheduler"]
    assert schedule["interval"] == "step"
    rates = []
    for _ in range(8):
        rates.append(optimizer.param_groups[0]["lr"])
        optimizer.step()
        schedule["scheduler"].step()
    assert rates == pytest.approx([2 * factor for factor in factors])
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.0 if decay else 2.0)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"lr_decay": 1.01}, "lr_decay=1.01: expected a fraction"),
        ({"lr_decay": -0.01}, "lr_decay=-0.01"),
        ({"lr_warmup": -1}, "lr_warmup=-1: expected a number of steps"),
        ({}, ""),
    ],
)
def test_schedules_out_of_range_are_refused_and_none_leaves_the_rate(options, message):
    stub: Any = SimpleNamespace(
        make_optimizer=lambda: "optimizer", config=options, trainer=SimpleNamespace(max_steps=8)
    )
    if message:
        with pytest.raises(UserError, match=message):
            Task.configure_optimizers(stub)
    else:
        assert Task.configure_optimizers(stub) == "optimizer"


def test_sampling_ignores_dropout_and_leaves_a_model_in_its_mode(trained):
    model, mask = load(trained), torch.ones(1, 20, dtype=torch.bool)
    for module in model.denoiser.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.5
    batch = MotionBatch(torch.zeros(1, 20, 1), mask, ["a"], text=["a person walks"])
    expected = model.eval().generate(batch)
    assert not model.training
    torch.testing.assert_close(model.train().generate(batch), expected)
    assert model.training
    assert model.denoiser.training


@pytest.mark.parametrize(
    ("kind", "expected"),
    [
        ("text", {"vocabulary": ["sits", "walks"], "captions": ["walks"], "verbs": ["walks"]}),
        ("action", {}),
        ("none", {}),
    ],
)
def test_only_captions_that_may_be_shared_become_facts(monkeypatch, kind, expected):
    facts: dict[str, Any] = {}
    clips = [
        SimpleNamespace(captions=["walks"], license="free"),
        SimpleNamespace(captions=["sits"], license="closed"),
    ]
    source = SimpleNamespace(may_share_captions=lambda name: name == "free", verbs=["walks"])
    data = SimpleNamespace(
        store=SimpleNamespace(info={"actions": ["walk"]}),
        crop=SimpleNamespace(draw=lambda length, _: (0, length - 4), min_frames=24),
        train=SimpleNamespace(clips=clips),
        source=source,
    )
    monkeypatch.setattr(Task, "setup", lambda *_: None)
    denoiser = SimpleNamespace(context_frames=19)
    generator = SimpleNamespace(conditioned_on=kind, denoiser=denoiser, add_facts=facts.update)
    task = Stub(generator=generator, checkpoints_activations=False, compiles=False)
    task._trainer = cast(Any, SimpleNamespace(datamodule=data))
    task.setup("fit")
    assert facts == expected | ({} if kind == "action" else {"actions": ["walk"]})
    source.may_share_captions = lambda _: False
    facts.clear()
    task.setup("fit")
    assert "captions" not in facts
    denoiser.context_frames = 20
    with pytest.raises(UserError, match="20 frames has no frames left after a prefix of 20 frames"):
        task.setup("fit")


@pytest.mark.parametrize("variance", ["fixed_small", "learned_range"])
def test_the_options_of_samples_are_tried_before_the_first_step(variance):
    generator = SimpleNamespace(
        process=GaussianDiffusion(50, variance=variance),
        representation=SimpleNamespace(features=3),
        sampler_options=SamplerOptions(sampler="ddim", num_inference_steps=5),
    )
    task = Stub(generator=generator)
    task.on_fit_start()
    for sampler, steps, message in (
        ("euler", 5, "unknown sampler 'euler'"),
        ("ddim", 51, "num_inference_steps=51"),
    ):
        generator.sampler_options = SamplerOptions(sampler=sampler, num_inference_steps=steps)
        with pytest.raises(UserError, match=message):
            task.on_fit_start()
