"""Distillation: Gaussian data, for which everything is known; and runs of a student, from the command to the motion."""

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from support.analytic import NO_CONDITION, drawn, real, sample
from support.runs import RUN, TWO, finish, reference, spawn
from torch import Tensor

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.batch import Denoise
from flame_mdm.checkpoints.model_files import read_checkpoint, weights_sha256
from flame_mdm.errors import UserError
from flame_mdm.processes import Process
from flame_mdm.processes.consistency import consistency_terms
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.processes.samplers import CountedDenoise

MEAN, VARIANCE = torch.tensor([0.5, -1.0, 0.0]).double(), torch.tensor([0.3, 1.0, 2.0]).double()
"""Of the data: independent normal features."""
PROCESSES: list[Process] = [
    GaussianDiffusion(50),
    GaussianDiffusion(1000, prediction="velocity"),
    FlowMatching(),
    FlowMatching(prediction="x0"),
]


def coefficients(process: Process, t: Tensor) -> tuple[Tensor, Tensor]:
    """Signal a and noise s (B, 1, 1) at times (B,)."""
    zero, one = torch.zeros(len(t), 1, 1).double(), torch.ones(len(t), 1, 1).double()
    return process.corrupt(one, zero, t), process.corrupt(zero, one, t)


def gains(process: Process, times: Tensor) -> Tensor:
    """Gains k (N, D) of the exact f(x, t) = mean + k (x - a mean) after DDIM steps of the exact denoiser."""
    a, s = (value[:, 0] for value in coefficients(process, times))
    k = posterior(a, s)
    for n in reversed(range(len(times) - 1)):
        k[n] = k[n + 1] * (a[n + 1] * k[n] + s[n + 1] / s[n] * (1 - a[n] * k[n]))
    return k


def denoiser(process: Process, gain: Callable[[Tensor, Tensor], Tensor]) -> Denoise:
    """The denoiser with f = mean + gain(a, s) (x - a mean)."""

    def denoise(x_t: Tensor, table_time: Tensor, *_: object) -> Tensor:
        t = table_time / 1000 if isinstance(process, FlowMatching) else table_time
        a, s = coefficients(process, t)
        f = MEAN + gain(a, s) * (x_t - a * MEAN)
        return process.target(f, (x_t - a * f) / s, t)

    return denoise


def posterior(a: Tensor, s: Tensor) -> Tensor:
    """The gain of E[x | x_t], which a trained denoiser returns."""
    return a * VARIANCE / (a**2 * VARIANCE + s**2)


def path(a: Tensor, s: Tensor) -> Tensor:
    """The gain along the path of infinitely many steps."""
    return (VARIANCE / (a**2 * VARIANCE + s**2)).sqrt()


def loss(process: Process, student: Denoise, times: Tensor) -> Tensor:
    """Of each step of the grid, for random data."""
    x = MEAN + VARIANCE.sqrt() * torch.randn(10, 2, 3).double()
    parts = process, student, student, denoiser(process, posterior), x, real(x), NO_CONDITION
    draws = {"times": times, "index": torch.arange(10), "noise": torch.randn_like(x)}
    return consistency_terms(*parts, **draws, auxiliary=lambda *_: {})["loss"]


@pytest.mark.parametrize("process", PROCESSES, ids=lambda process: f"{type(process).__name__}-{process.prediction}")
def test_the_exact_student_of_gaussian_data_has_no_loss(process):
    torch.manual_seed(0)
    times = torch.tensor(process.grid(10)).double()
    exact = gains(process, times)

    def student(x_t: Tensor, table_time: Tensor, *_: object) -> Tensor:
        t = table_time / 1000 if isinstance(process, FlowMatching) else table_time
        a, s = coefficients(process, t)
        f = MEAN + exact[(t[:, None] - times).abs().argmin(1)][:, None] * (x_t - a * MEAN)
        return process.target(f, (x_t - a * f) / s, t)

    assert loss(process, student, times).max() < 1e-9
    exact[0] += 0.1
    assert loss(process, student, times)[0] > 1e-3


@pytest.mark.parametrize("process", PROCESSES[1:], ids=lambda process: f"{type(process).__name__}-{process.prediction}")
def test_fine_grids_lead_to_the_data_and_so_do_one_two_and_four_calls(process):
    times = torch.tensor(process.grid(400)).double()
    a, s = (value[:, 0] for value in coefficients(process, times))
    torch.testing.assert_close(gains(process, times), path(a, s), atol=0.02, rtol=0)
    for steps in (1, 2, 4):
        counted = CountedDenoise(denoiser(process, path))
        noise = drawn((1000, 20, 3), torch.float64)
        x = sample(process, counted, noise, sampler="consistency", num_inference_steps=steps)
        assert counted.calls == steps
        torch.testing.assert_close(x.mean((0, 1)), MEAN, atol=0.05, rtol=0)
        torch.testing.assert_close(x.var((0, 1)), VARIANCE, atol=0.01, rtol=0.05)


# Runs -----------------------------------------------------------------------------------------------------------------

SHORT = ["callbacks.checkpoints.every_n_steps=2", "trainer.max_steps=4"]


def error(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """The only line that a failing command prints as an error."""
    assert main([str(word) for word in words]) == 1
    (line,) = [line for line in capsys.readouterr().err.splitlines() if line.startswith("error: ")]
    return line


@pytest.fixture(scope="module")
def student(trained, data_root, tmp_path_factory) -> Path:
    """The run directory of a student after 4 steps."""
    folder = tmp_path_factory.mktemp("student") / "run"
    assert main(["distill", str(trained), str(folder), *SHORT, f"data.root={data_root}"]) == 0
    return folder


def test_a_student_starts_as_its_teacher_and_keeps_its_hash_data_and_text_encoder(trained, student):
    content, teacher = read_checkpoint(student / "checkpoints" / "last.ckpt"), read_checkpoint(trained)
    assert content["config"]["distillation"]["teacher"] == str(trained)
    assert content["facts"]["teacher"] == weights_sha256(trained)
    assert content["facts"]["fingerprint"] == teacher["facts"]["fingerprint"]
    for name, value in teacher["state_dict"].items():
        after = content["state_dict"][name]
        assert torch.equal(value, after) == (not name.startswith("denoiser")), name
        torch.testing.assert_close(after, value, atol=0.05, rtol=0)


def test_a_student_is_sampled_edited_led_chained_and_exported_without_its_teacher(trained, student, tmp_path):
    assert main(["export", str(student), str(tmp_path / "student.safetensors")]) == 0
    hidden = trained.with_suffix(".away")
    trained.rename(hidden)
    try:
        model = flame_mdm.load(tmp_path / "student.safetensors")
    finally:
        hidden.rename(trained)
    calls = []
    model.denoiser.register_forward_pre_hook(lambda _, arguments: calls.append(len(arguments[0])))
    text = {"texts": "a person walks", "seconds": 1.0}
    motion = flame_mdm.generate(model, **text)[0]
    assert calls == [1] * 4
    assert len(flame_mdm.generate(model, "a person walks @1 | a person waves @1")[0].joints) == 40
    targets = {"root": [{"time": 0.8, "position": [0.1, 0.2]}]}
    assert abs(flame_mdm.generate(model, targets=targets, **text)[0].joints[16, 0, [0, 2]] - [0.1, 0.2]).max() < 0.01
    edited = flame_mdm.edit(model, motion, "a person waves", joints="left_arm", num_inference_steps=1)[0]
    assert edited.feature_error < 1e-5
    with pytest.raises(UserError, match="guidance_scale=2: the guidance is built into this distilled model"):
        flame_mdm.generate(model, guidance_scale=2, **text)
    with pytest.raises(UserError, match="needs a text"):
        flame_mdm.generate(model)


def test_a_resumed_distillation_ends_in_the_same_weights(trained, data_root, tmp_path, capsys):
    run = tmp_path / "run"
    words = ["distill", str(trained), str(run), *SHORT, f"data.root={data_root}"]
    words.append("logger._target_=lightning.pytorch.loggers.TensorBoardLogger")
    assert main(words) == 0
    once = read_checkpoint(run / "checkpoints" / "last.ckpt")
    (run / "checkpoints" / "previous.ckpt").rename(run / "checkpoints" / "last.ckpt")
    assert read_checkpoint(run / "checkpoints" / "last.ckpt")["global_step"] == 2
    assert main(words) == 0
    again = read_checkpoint(run / "checkpoints" / "last.ckpt")
    for key in ("state_dict", "current_model_state"):
        torch.testing.assert_close(again[key], once[key], atol=0, rtol=0)
    capsys.readouterr()
    content = torch.load(run / "checkpoints" / "last.ckpt", weights_only=True)
    content["facts"]["teacher"] = "another"
    torch.save(content, run / "checkpoints" / "last.ckpt")
    assert "weights have changed since this run began" in error(capsys, *words, "trainer.max_steps=6")


@pytest.mark.slow
def test_two_processes_are_one_with_both_batches(student, tmp_path):
    config, run = str(student / "config.yaml"), tmp_path / "run"
    parts = ("speed=reference", "logger=csv", "callbacks.best=null")
    words = ["run.speed=reference", "lr_decay=0", *(word for word in RUN if word not in parts), f"run.dir={run}"]
    code, _, err = finish(spawn(["flame_mdm", "train", config, *words, *TWO]))
    assert code == 0, err
    ours = read_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    torch.testing.assert_close(ours, reference(words, 4, config), rtol=1e-4, atol=1e-6)


def test_a_model_that_cannot_be_a_teacher_gets_one_line(trained, student, data_root, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLAME_MDM_DATA", str(data_root))
    assert "no checkpoint given" in error(capsys, "distill", "trainer.max_steps=4")
    assert "runs/no/model: no such checkpoint" in error(capsys, "distill", "runs/no/model")
    assert f"distilled already. Give its teacher, {trained}" in error(capsys, "distill", student)
    content = torch.load(trained, weights_only=True)
    content["config"]["process"] |= {"prediction": "epsilon"}
    torch.save(content, tmp_path / "noise.ckpt")
    assert "predicts noise, whose clean estimate is divided" in error(capsys, "distill", "noise.ckpt")
    content["config"]["process"] |= {"prediction": "x0"}
    torch.save(content | {"global_step": 0}, tmp_path / "untrained.ckpt")
    assert "was not trained by this framework" in error(capsys, "distill", "untrained.ckpt")
    content["config"]["representation"] |= {"fps": 30}
    torch.save(content, tmp_path / "other.ckpt")
    line = error(capsys, "distill", trained, "out", *SHORT, "distillation.teacher=other.ckpt")
    assert "has representation.fps=30, but the student has 20. Both need the same parts" in line
    line = error(capsys, "distill", trained, "out", *SHORT, "distillation.teacher=gone.ckpt")
    assert "distillation.teacher=gone.ckpt: no such checkpoint" in line
    assert sorted(path.name for path in tmp_path.iterdir()) == ["noise.ckpt", "other.ckpt", "untrained.ckpt"]
