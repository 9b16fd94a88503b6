"""Training: what a run leaves, resuming and signals; sampling from its checkpoint."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from PIL import Image
from support.runs import TINY, ended, forked
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torchmetrics import MeanMetric

from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load, load_task
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import compose, instantiate
from flame_mdm.progress import ProgressBar
from flame_mdm.runs import read_history
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.generation import generate
from flame_mdm.task import GeneratorTask
from flame_mdm.training.callbacks import SampleMotions

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
            "initial_weights=motion_clip_synthetic: no weight matches a weight",
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
    words = ["train", "quickstart", *tiny, *STEPS, "trainer.max_steps=100000"]
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
