"""Students, on Gaussian data, for which everything is known, and of models; adapters, from clips to a prompt."""

import itertools
import json
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from support.analytic import NO_CONDITION, CountedDenoise, drawn, real, sample
from support.refusals import error_of
from support.runs import RUN, TINY, TWO, finish, inputs_of, reference, spawn
from torch import Tensor, nn
from torch.nn.utils import parameters_to_vector

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.batch import Condition, Denoise, MotionBatch, length_mask
from flame_mdm.checkpoints.adapters import About, attach, copy_weights, word_rows, write_adapter
from flame_mdm.checkpoints.hub import export
from flame_mdm.checkpoints.locating import find
from flame_mdm.checkpoints.model_files import read_checkpoint, weights_sha256, write_model_file
from flame_mdm.conditions.tokens import START, LearnedTokens
from flame_mdm.conditions.vocabulary import hashed
from flame_mdm.config import compose, instantiate, sweeps
from flame_mdm.data.store import Store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.demo.request import DemoRequest
from flame_mdm.demo.studio import Studio
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import DistilledGenerator, MotionGenerator
from flame_mdm.losses import masked_mse
from flame_mdm.processes import Process
from flame_mdm.processes.consistency import consistency_terms
from flame_mdm.processes.diffusion import GaussianDiffusion
from flame_mdm.processes.flow_matching import FlowMatching
from flame_mdm.safe_io import read_yaml
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.training import adaptation, distillation

MEAN, VARIANCE = torch.tensor([0.5, -1.0, 0.0]).double(), torch.tensor([0.3, 1.0, 2.0]).double()
"""Of the data: independent normal features."""
PROCESSES: list[Process] = [GaussianDiffusion(50), GaussianDiffusion(1000, prediction="velocity")]
PROCESSES += [FlowMatching(), FlowMatching(prediction="x0")]


def name(process: Process) -> str:
    return f"{type(process).__name__}-{process.prediction}"


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


def denoiser(process: Process, gain: Callable[[Tensor, Tensor, Tensor], Tensor]) -> Denoise:
    """The denoiser with f = mean + gain(a, s, t) (x - a mean)."""

    def denoise(x_t: Tensor, table_time: Tensor, *_: object) -> Tensor:
        t = table_time / 1000 if isinstance(process, FlowMatching) else table_time
        a, s = coefficients(process, t)
        f = MEAN + gain(a, s, t) * (x_t - a * MEAN)
        return process.target(f, (x_t - a * f) / s, t)

    return denoise


def posterior(a: Tensor, s: Tensor, *_: Tensor) -> Tensor:
    """The gain of E[x | x_t], which a trained denoiser returns."""
    return a * VARIANCE / (a**2 * VARIANCE + s**2)


def path(a: Tensor, s: Tensor, *_: Tensor) -> Tensor:
    """The gain along the path of infinitely many steps."""
    return (VARIANCE / (a**2 * VARIANCE + s**2)).sqrt()


def loss(process: Process, student: Denoise, times: Tensor) -> Tensor:
    """Of each step of the grid, for random data."""
    x = MEAN + VARIANCE.sqrt() * torch.randn(10, 2, 3).double()
    parts = process, student, student, denoiser(process, posterior), x, real(x), NO_CONDITION
    draws = {"times": times, "index": torch.arange(10), "noise": torch.randn_like(x)}
    return consistency_terms(*parts, **draws, auxiliary=lambda *_: {})["loss"]


@pytest.mark.parametrize("process", PROCESSES, ids=name)
def test_the_exact_student_of_gaussian_data_has_no_loss(process):
    torch.manual_seed(0)
    times = torch.tensor(process.grid(10)).double()
    exact = gains(process, times)
    student = denoiser(
        process, lambda a, s, t: exact[(t[:, None] - times).abs().argmin(1)][:, None]
    )
    assert loss(process, student, times).max() < 1e-9
    exact[0] += 0.1
    assert loss(process, student, times)[0] > 1e-3


@pytest.mark.parametrize("process", PROCESSES, ids=name)
def test_padding_is_no_part_of_the_losses_of_a_student(process):
    times = torch.tensor(process.grid(4)).double()
    x, noise = torch.randn(2, 2, 6, 3, generator=torch.Generator().manual_seed(0)).double()
    mask = length_mask(torch.tensor([6, 2]))

    def denoise(x_t: Tensor, *_: object) -> Tensor:
        return 0.3 * x_t

    def student(x_t: Tensor, *_: object) -> Tensor:
        return torch.where(mask[..., None], 0.5 * x_t, 100.0)

    def losses(rows: slice, frames: int, network: Denoise) -> dict[str, Tensor]:
        return consistency_terms(
            process,
            network,
            denoise,
            denoise,
            x[rows, :frames],
            mask[rows, :frames],
            NO_CONDITION,
            times=times,
            index=torch.tensor([1, 2])[rows],
            noise=noise[rows, :frames],
            auxiliary=lambda *motions: {"same": masked_mse(*motions)},
        )

    padded = losses(slice(None), 6, student)
    alone = losses(slice(1, None), 2, lambda x_t, *_: 0.5 * x_t)
    for term in ("consistency", "same", "loss"):
        torch.testing.assert_close(padded[term][1:], alone[term])
    # Geometric losses are computed between the same motions.
    torch.testing.assert_close(padded["same"], padded["consistency"])
    torch.testing.assert_close(padded["loss"], 2 * padded["same"])


@pytest.mark.parametrize("process", PROCESSES[1:], ids=name)
def test_fine_grids_lead_to_the_data_and_so_do_one_two_and_four_calls(process, subtests):
    times = torch.tensor(process.grid(400)).double()
    a, s = (value[:, 0] for value in coefficients(process, times))
    torch.testing.assert_close(gains(process, times), path(a, s), atol=0.02, rtol=0)
    for steps in (1, 2, 4):
        with subtests.test(steps=steps):
            counted = CountedDenoise(denoiser(process, path))
            noise = drawn((1000, 20, 3), torch.float64)
            x = sample(process, counted, noise, sampler="consistency", num_inference_steps=steps)
            assert counted.calls == steps
            torch.testing.assert_close(x.mean((0, 1)), MEAN, atol=0.05, rtol=0)
            torch.testing.assert_close(x.var((0, 1)), VARIANCE, atol=0.01, rtol=0.05)


SHORT = ["callbacks.checkpoints.every_n_steps=2", "trainer.max_steps=4"]


@pytest.fixture(scope="module")
def student(trained, data_root, tmp_path_factory) -> Path:
    """The run directory of a student after 4 steps."""
    folder = tmp_path_factory.mktemp("student") / "run"
    assert main(["distill", str(trained), str(folder), *SHORT, f"data.root={data_root}"]) == 0
    return folder


def test_a_student_starts_as_its_teacher_and_keeps_its_hash_data_and_text_encoder(
    trained, student, subtests
):
    content, teacher = (
        read_checkpoint(student / "checkpoints" / "last.ckpt"),
        read_checkpoint(trained),
    )
    assert content["config"]["distillation"]["teacher"] == str(trained)
    assert content["facts"]["teacher"] == weights_sha256(trained)
    assert content["facts"]["fingerprint"] == teacher["facts"]["fingerprint"]
    for name, value in teacher["state_dict"].items():
        with subtests.test(name=name):
            after = content["state_dict"][name]
            assert torch.equal(value, after) == (not name.startswith("denoiser")), name
            torch.testing.assert_close(after, value, atol=0.05, rtol=0)


def test_the_target_of_a_student_has_its_averaged_weights(
    trained, data_root, tmp_path, monkeypatch
):
    students, targets = [], []

    def recorded(
        process: Process, student: nn.Module, follower: nn.Module, *rest: Any, **options: Any
    ) -> Any:
        if torch.is_grad_enabled():  # not in validation
            students.append(parameters_to_vector(student.parameters()).detach())
            targets.append(parameters_to_vector(follower.parameters()).detach())
        return consistency_terms(process, student, follower, *rest, **options)

    monkeypatch.setattr(distillation, "consistency_terms", recorded)
    words = [*SHORT, f"data.root={data_root}", "ema.decay=0.5"]
    assert main(["distill", str(trained), str(tmp_path / "run"), *words]) == 0
    initial, first, second, third = students
    assert not torch.equal(second, third)
    average = (first + second) / 2
    for target, expected in zip(
        targets, (initial, first, average, (average + third) / 2), strict=True
    ):
        torch.testing.assert_close(target, expected)


def recorded_terms(
    monkeypatch,
    step: int,
    u: Tensor | None = None,
    cond: Condition = NO_CONDITION,
    **changes: Any,
) -> Any:
    """Returns the arguments and options of the loss in one of 100 training steps of a student."""
    passed: list[Any] = []
    monkeypatch.setattr(
        distillation,
        "consistency_terms",
        lambda *values, **options: passed.extend((values, options)),
    )
    stub = SimpleNamespace(
        _trainer=SimpleNamespace(global_step=step, max_steps=100),
        config={"distillation": {"intervals": [8, 4, 1]}},
        generator=SimpleNamespace(
            process=FlowMatching(),
            denoiser="student",
            condition=SimpleNamespace(features=1),
            representation=SimpleNamespace(features=3),
        ),
        grids={},
        device=torch.device("cpu"),
        target=["average"],
        teacher=["teacher"],
        teacher_guidance=None,
        losses="losses",
    )
    vars(stub).update(changes)
    stub.generator.condition.features = changes.get("features", 1)
    x = torch.zeros(4, 2, 3)
    batch = MotionBatch(x, x[..., 0] == 0, list("abcd"))
    distillation.DistillationTask.loss_terms(cast(Any, stub), batch, cond, u)
    return passed


@pytest.mark.parametrize(
    ("step", "count"), [(0, 8), (33, 8), (34, 4), (66, 4), (67, 1), (99, 1), (100, 1)]
)
def test_each_number_of_intervals_is_used_for_an_equal_share_of_the_training(
    monkeypatch, step, count
):
    (_, student, follower, teacher, *_), options = recorded_terms(monkeypatch, step)
    assert (student, follower, teacher) == ("student", "average", "teacher")
    assert options["times"].tolist() == [number / count for number in range(count)]
    assert options["auxiliary"] == "losses"
    assert ((options["index"] >= 0) & (options["index"] < count)).all()


def test_students_are_validated_on_the_last_grid_with_times_that_are_equally_likely(monkeypatch):
    u = torch.tensor([0.0, 0.24, 0.26, 0.999])
    config = {"distillation": {"intervals": [8, 4]}}
    (_, student, follower, *_), options = recorded_terms(monkeypatch, 0, u, config=config)
    assert (student, follower) == ("student", "student")
    assert options["index"].tolist() == [0, 0, 1, 3]
    assert options["times"].tolist() == [0, 0.25, 0.5, 0.75]


@pytest.mark.parametrize(
    ("scale", "features", "value"),
    [(3.0, 1, -4.0), (1.0, 1, 2.0), (None, 1, 2.0), (3.0, 0, 2.0)],
)
def test_the_teacher_alone_is_guided_if_there_is_a_condition(monkeypatch, scale, features, value):
    """The prediction is the condition, 2, and without a condition, 5; 5 + 3 (2 - 5) is -4."""

    def teacher(x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        return cond.pooled[:, None].expand_as(x_t)

    null = Condition(torch.tensor([[5.0]]), torch.zeros(1, 0, 1), None)
    cond = Condition(torch.full((4, 1), 2.0), torch.zeros(4, 0, 1), None, null)
    changes: dict[str, Any] = {"teacher": [teacher], "teacher_guidance": scale}
    passed, _ = recorded_terms(monkeypatch, 0, cond=cond, **changes, features=features)
    _, student, follower, guided, x, mask, passed_cond = passed
    assert (student, follower) == ("student", "average")
    prediction = guided(x, torch.zeros(4), mask, passed_cond)
    torch.testing.assert_close(prediction, torch.full_like(x, value))


def started(monkeypatch, scale: float | None = None, **facts: Any) -> Any:
    """A student after its start from a teacher; `now` and `before` are the prints of their data."""
    teacher = SimpleNamespace(
        config={part: {} for part in distillation.PARTS[1:]},
        facts={"fingerprint": facts.get("before")},
        state_dict=lambda: nn.Linear(1, 1).state_dict(),
        sampler_options=SimpleNamespace(guidance_scale=2.5),
    )
    for function, result in (("find", None), ("read_teacher", teacher), ("weights_sha256", "a")):
        monkeypatch.setattr(distillation, function, lambda _, result=result: result)
    generator = nn.Linear(1, 1)
    generator.denoiser = nn.Linear(1, 1)
    generator.load_state_dict = lambda state: None  # type: ignore[assignment]
    options = {"teacher": "base", "guidance_scale": scale}
    stub: Any = SimpleNamespace(
        config=teacher.config | {"distillation": options},
        facts={"dataset": "walks", "fingerprint": facts.get("now")},
        generator=generator,
    )
    distillation.DistillationTask.start_from_teacher(stub)
    return stub


@pytest.mark.parametrize(("chosen", "expected"), [(None, 2.5), (4.0, 4.0), (1.0, 1.0)])
def test_the_teacher_is_guided_as_the_recipe_says_or_else_as_by_default(
    monkeypatch, chosen, expected
):
    stub = started(monkeypatch, chosen)
    denoiser = stub.generator.denoiser
    assert stub.teacher_guidance == expected
    assert stub.target == [denoiser]
    assert stub.teacher[0] is not denoiser
    assert not any(weight.requires_grad for weight in stub.teacher[0].parameters())
    assert all(weight.requires_grad for weight in denoiser.parameters())


def test_a_student_has_the_data_of_its_teacher_as_far_as_both_are_known(monkeypatch):
    for before, now in (("f1", "f1"), (None, "f1"), ("f1", None)):
        assert started(monkeypatch, before=before, now=now).facts["teacher"] == "a"
    with pytest.raises(UserError, match="fingerprint f1, but walks has fingerprint f2"):
        started(monkeypatch, before="f1", now="f2")


def test_a_student_is_sampled_edited_led_chained_and_exported_without_its_teacher(
    trained, student, tmp_path
):
    assert main(["export", str(student), str(tmp_path / "student.safetensors")]) == 0
    hidden = trained.rename(trained.with_suffix(".away"))
    try:
        model = flame_mdm.load(tmp_path / "student.safetensors")
    finally:
        hidden.rename(trained)
    text = {"texts": "a person walks", "seconds": 1.0}
    with inputs_of(model.denoiser) as seen:
        motion = flame_mdm.generate(model, **text)[0]
    assert [len(x_t) for x_t, *_ in seen] == [1] * 4
    assert len(flame_mdm.generate(model, "a person walks @1 | a person waves @1")[0].joints) == 40
    targets = {"root": [{"time": 0.8, "position": [0.1, 0.2]}]}
    assert (
        abs(
            flame_mdm.generate(model, targets=targets, **text)[0].joints[16, 0, [0, 2]] - [0.1, 0.2]
        ).max()
        < 0.01
    )
    edited = flame_mdm.edit(
        model, motion, "a person waves", joints="left_arm", num_inference_steps=1
    )[0]
    assert edited.feature_error < 1e-5
    with pytest.raises(
        UserError, match="guidance_scale=2: the guidance is built into this distilled model"
    ):
        flame_mdm.generate(model, guidance_scale=2, **text)
    with pytest.raises(UserError, match="Pass a text"):
        flame_mdm.generate(model)


def test_a_student_refuses_guidance_but_a_scale_of_one():
    student: Any = SimpleNamespace(condition=SimpleNamespace(features=1, reads="text"))
    for options in (None, SamplerOptions(), SamplerOptions(guidance_scale=1.0)):
        DistilledGenerator.check_request(student, options, False)
    with pytest.raises(UserError, match=r"guidance_scale=0\.0: the guidance is built into"):
        DistilledGenerator.check_request(student, SamplerOptions(guidance_scale=0.0), False)
    with pytest.raises(UserError, match="Pass a text"):
        DistilledGenerator.check_request(student, None, True)
    student.condition.features = 0  # trained without conditions
    DistilledGenerator.check_request(student, None, True)


def as_version_0_2(run: Path, name: str, old_name: str) -> None:
    """Gives the task in the files of a run the name that it had in version 0.2."""
    last = run / "checkpoints" / "last.ckpt"
    content = torch.load(last, weights_only=True)
    assert name in content["config"]["task"]["_target_"]
    content["config"]["task"]["_target_"] = content["config"]["task"]["_target_"].replace(
        name, old_name
    )
    torch.save(content, last)
    config = (run / "config.yaml").read_text()
    assert name in config
    (run / "config.yaml").write_text(config.replace(name, old_name))


@pytest.mark.slow
def test_a_resumed_distillation_ends_in_the_same_weights(
    trained, data_root, tmp_path, capsys, subtests
):
    run, last = tmp_path / "run", tmp_path / "run" / "checkpoints" / "last.ckpt"
    words = ["distill", str(trained), str(run), *SHORT, f"data.root={data_root}"]
    words.append("logger._target_=lightning.pytorch.loggers.TensorBoardLogger")
    assert main(words) == 0
    once = read_checkpoint(last)
    last.with_name("previous.ckpt").rename(last)
    as_version_0_2(run, "DistillationTask", "ConsistencyDistillation")
    assert read_checkpoint(last)["global_step"] == 2
    assert main(words) == 0
    again = torch.load(last, weights_only=True)
    for key in ("state_dict", "current_model_state"):
        with subtests.test(key=key):
            torch.testing.assert_close(again[key], once[key], atol=0, rtol=0)
    capsys.readouterr()
    again["facts"]["teacher"] = "another"
    torch.save(again, last)
    assert "weights have changed since this run began" in error_of(
        capsys, *words, "trainer.max_steps=6"
    )


@pytest.mark.parametrize(
    "words", [["seed=1,2", "--multirun"], ["launch=local", "seed=1,2"], ["launch=local"]]
)
def test_a_sweep_of_students_starts_from_a_recipe_that_all_nodes_read(
    trained, tmp_path, monkeypatch, capsys, words
):
    started = []
    monkeypatch.setattr(
        sweeps, "hydra_main", lambda **source: lambda _: lambda: started.append((source, sys.argv))
    )
    run = tmp_path / "run"
    assert main(["distill", str(trained), str(run), *words]) == 0, capsys.readouterr().err
    ((source, argv),) = started
    assert (source["config_path"], source["config_name"]) == (str(run), "student")
    assert read_yaml(run / "student.yaml")["distillation"]["teacher"] == str(trained)
    assert argv[1] == "--multirun"
    assert ("+launch=local" in argv) == ("launch=local" in words)
    assert ("seed=1,2" in argv) == ("seed=1,2" in words)


@pytest.mark.robustness
def test_two_processes_are_one_with_both_batches(student, tmp_path):
    config, run = str(student / "config.yaml"), tmp_path / "run"
    parts = ("speed=reference", "logger=csv", "callbacks.best=null")
    words = [
        "run.speed=reference",
        "lr_decay=0",
        *(word for word in RUN if word not in parts),
        f"run.dir={run}",
    ]
    code, _, err = finish(spawn(["flame_mdm", "train", config, *words, *TWO]))
    assert code == 0, err
    ours = read_checkpoint(run / "checkpoints" / "last.ckpt")["state_dict"]
    torch.testing.assert_close(ours, reference(words, 4, config), rtol=1e-4, atol=1e-6)


def test_a_model_that_cannot_be_a_teacher_gets_one_line(
    trained, student, data_root, tmp_path, capsys, monkeypatch, subtests
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLAME_MDM_DATA", str(data_root))
    content = torch.load(trained, weights_only=True)
    torch.save(content | {"global_step": 0}, tmp_path / "untrained.ckpt")
    for part, change in (("process", {"prediction": "epsilon"}), ("representation", {"fps": 30})):
        config = content["config"] | {part: content["config"][part] | change}
        torch.save(content | {"config": config}, tmp_path / f"{part}.ckpt")
    own = [trained, "out", *SHORT]
    for words, says in (
        (["trainer.max_steps=4"], "ckpt is missing. Usage: flame-mdm distill CKPT"),
        (["runs/no/model"], "runs/no/model: no such checkpoint"),
        ([student], f"a distilled model. Use its teacher, {trained}"),
        (["process.ckpt"], "predicts noise, so computing the clean estimate would divide"),
        (["untrained.ckpt"], "not trained with this framework"),
        (
            [*own, "distillation.teacher=representation.ckpt"],
            "the teacher has representation.fps=30, but the student has 20. Both",
        ),
        (
            [*own, "distillation.teacher=gone.ckpt"],
            "distillation.teacher=gone.ckpt: no such checkpoint",
        ),
    ):
        with subtests.test(words=words, says=says):
            assert says in error_of(capsys, "distill", *words)
    assert {path.stem for path in tmp_path.iterdir()} == {"untrained", "process", "representation"}


ABOUT: About = {
    "name": "",
    "action": False,
    "rank": 2,
    "words": [],
    "rows": [],
    "captions": [],
    "base": "",
}


def build(*words: str) -> MotionGenerator:
    config = compose("quickstart", [*TINY, *words])
    task = MotionGenerator.build(config, instantiate(config["representation"]))
    task.facts |= {
        "max_frames": 40,
        "vocabulary": ["a", "person", "walks"],
        "captions": ["a person walks"],
    }
    return task.eval()


def write(task: MotionGenerator, about: About, file: Path) -> None:
    """Writes the checkpoint of an adaptation, and its adapter next to it."""
    content = {
        "config": task.config | {"adapter": about},
        "facts": task.facts,
        "state_dict": task.state_dict(),
    }
    torch.save(content | {"global_step": 3, "flame_mdm_format": 2}, file.with_suffix(".ckpt"))
    write_adapter(file, file.with_suffix(".ckpt"))


@pytest.fixture(scope="module")
def taught(tmp_path_factory):
    """Files of a base, of the checkpoint of an adaptation to it, and of two adapters."""
    folder = tmp_path_factory.mktemp("adapters")
    torch.manual_seed(0)
    base = build()
    write_model_file(
        folder / "base.safetensors",
        base.state_dict(),
        config=base.config,
        facts=base.facts,
        origin={},
    )
    sha = weights_sha256(folder / "base.safetensors")
    for name in ("limp", "march"):
        task, new = build(), [name, "in", "style"]
        assert isinstance(task.condition, LearnedTokens)
        rows = word_rows(task.condition, new, base.facts["vocabulary"])
        about: About = {
            **ABOUT,
            "name": name,
            "words": new,
            "rows": rows,
            "captions": ["a person limps"],
            "base": sha,
        }
        attach(task, about)
        copy_weights(task, folder / "base.safetensors")
        task.facts["vocabulary"] = [*base.facts["vocabulary"], name, "in", "style"]
        trainable = [parameter for parameter in task.parameters() if parameter.requires_grad]
        assert len(trainable) == 2 * 4 + 1  # two parts of four weights, and the words
        for parameter in trainable:
            torch.nn.init.normal_(parameter, std=0.3)
        write(task, about, folder / f"{name}.safetensors")
    return folder


def sampled(model, text="a person walks in limp style") -> torch.Tensor:
    (motion,) = flame_mdm.generate(model, text, frames=20, seed=1)
    return torch.from_numpy(motion.features)


def test_strength_0_is_the_base_and_1_the_trained_model(taught):
    file, adapter = taught / "base.safetensors", taught / "limp.safetensors"
    none, full = (
        sampled(flame_mdm.load(file, adapter=adapter, strength=strength)) for strength in (0, 1)
    )
    base = sampled(flame_mdm.load(file))
    assert torch.equal(none, base)
    unmerged, checkpoint = build(), read_checkpoint(taught / "limp.ckpt")
    attach(unmerged, checkpoint["config"]["adapter"])
    unmerged.load_state_dict(checkpoint["state_dict"])
    unmerged.condition.seen = frozenset(checkpoint["facts"]["vocabulary"])
    for trained_model in (unmerged, flame_mdm.load(taught / "limp.ckpt")):
        torch.testing.assert_close(full, sampled(trained_model), rtol=0, atol=1e-5)
    assert not torch.allclose(full, base, atol=1e-2)


def test_several_adapters_add_up_and_export_merges_them(taught, tmp_path, subtests):
    files = [taught / "limp.safetensors", taught / "march.safetensors"]
    both = flame_mdm.load(taught / "base.safetensors", adapter=files, strength=[0.5, 2])
    name, table = "denoiser.transformer.layers.0.feed_forward.0.weight", "condition.words.weight"
    expected = read_checkpoint(taught / "base.safetensors")["state_dict"]
    for strength, file in zip((0.5, 2), files, strict=True):
        part, rows = (
            load_file(file),
            read_checkpoint(file.with_suffix(".ckpt"))["config"]["adapter"]["rows"],
        )
        expected[name] = expected[name] + strength * part[f"{name}.up"] @ part[f"{name}.down"]
        expected[table] = expected[table].index_add(
            0, torch.tensor(rows), strength * 10 * part[f"{table}.vectors"]
        )
    for key in (name, table):
        with subtests.test(key=key):
            torch.testing.assert_close(both.state_dict()[key], expected[key])
    merged = export(
        taught / "base.safetensors",
        tmp_path / "merged.safetensors",
        adapter=files,
        strength=[0.5, 2],
    )
    assert torch.equal(sampled(flame_mdm.load(merged)), sampled(both))


@pytest.mark.parametrize(
    ("format_", "module", "function"),
    [("safetensors", "hub", "export"), ("onnx", "onnx_export", "export_onnx")],
)
def test_the_command_exports_with_all_adapters_and_their_strengths(
    monkeypatch, format_, module, function
):
    exported = list[tuple[Any, ...]]()

    def export_to(source: Path, out: str, **keys: Any) -> str:
        exported.append((source, out, keys))
        return out

    monkeypatch.setattr(f"flame_mdm.checkpoints.{module}.{function}", export_to)
    words = ["adapter=a.safetensors b.safetensors", "adapter_strength=[0.5,2]", "half=true"]
    assert main(["export", "quickstart", "out", f"format={format_}", *words]) == 0
    ((source, out, keys),) = exported
    assert (source, out) == (find("quickstart"), "out")
    adapters = ["a.safetensors", "b.safetensors"]
    assert keys == {"half": True, "adapter": adapters, "strength": [0.5, 2]}


def test_words_and_captions_of_an_adapter_come_first_unless_its_strength_is_zero(taught):
    files = [taught / "limp.safetensors", taught / "march.safetensors"]
    base = flame_mdm.load(taught / "base.safetensors").facts
    facts = flame_mdm.load(taught / "base.safetensors", adapter=files, strength=[0, 0.5]).facts
    assert facts["vocabulary"] == ["march", "in", "style", *base["vocabulary"]]
    assert facts["captions"] == ["a person limps", *base["captions"]]
    opposite = flame_mdm.load(taught / "base.safetensors", adapter=files[1], strength=-1).facts
    assert opposite["vocabulary"] == facts["vocabulary"]
    without = flame_mdm.load(taught / "base.safetensors", adapter=files, strength=0).facts
    assert without == base


def test_what_is_no_adapter_of_the_base_is_refused(taught, tmp_path, subtests):
    with safe_open(taught / "limp.safetensors", "pt") as file:
        about = json.loads(file.metadata()["flame_mdm_adapter"])
    for change, message in (
        ({"base": "0" * 64}, r"a model with other weights \(hash 000000000000"),
        ({"rank": "2"}, "rank"),
        ({"rows": [10**6]}, "does not match the weights"),
        (None, "not an adapter"),
    ):
        with subtests.test(change=change, message=message):
            metadata = {} if change is None else {"flame_mdm_adapter": json.dumps(about | change)}
            save_file(load_file(taught / "limp.safetensors"), tmp_path / "x.safetensors", metadata)
            with pytest.raises(UserError, match=message):
                flame_mdm.load(taught / "base.safetensors", adapter=tmp_path / "x.safetensors")
    with pytest.raises(
        UserError, match="expected one number, or one number for each of the 1 adapters"
    ):
        flame_mdm.load(
            taught / "base.safetensors", adapter=taught / "limp.safetensors", strength=[1, 2]
        )
    with pytest.raises(UserError, match="an adapter, not a model"):
        flame_mdm.load(taught / "limp.safetensors")
    model = build()
    model.denoiser = torch.nn.Linear(1, 1)  # type: ignore[assignment]
    with pytest.raises(UserError, match="has no attention"):
        attach(model, ABOUT)


@pytest.mark.parametrize(("action", "kept"), [(False, {"1", "2"}), (True, {"0", "1", "2"})])
def test_files_contain_the_changes_of_later_layers_and_for_actions_of_all(tmp_path, action, kept):
    about: About = {**ABOUT, "action": action}
    model = build("denoiser.num_layers=3")
    attach(model, about)
    assert (
        len([parameter for parameter in model.parameters() if parameter.requires_grad]) == 3 * 2 * 4
    )
    write(model, about, tmp_path / "limp.safetensors")
    assert {
        name.split("layers.")[1][0] for name in load_file(tmp_path / "limp.safetensors")
    } == kept


@pytest.mark.parametrize("rank", [2, 32])
def test_a_new_adapter_changes_nothing_and_its_first_gradients_do_not_depend_on_the_width(rank):
    """`up` is zero, and `down` has the variance of a usual linear layer at every rank."""
    about: About = {**ABOUT, "rank": rank, "rows": [3, 5]}
    model = build("denoiser.ff_size=400")
    before = {name: value.clone() for name, value in model.state_dict().items()}
    torch.manual_seed(0)
    attach(model, about)
    for name, module in model.named_modules():
        if f"{name}.weight" in before and hasattr(module, "parametrizations"):
            assert torch.equal(module.weight, before[f"{name}.weight"])  # type: ignore[arg-type]
    parts = dict(model.named_parameters())
    downs = {name: value for name, value in parts.items() if name.endswith(".down")}
    assert {value.shape[0] for value in downs.values()} == {rank}
    assert {value.shape[1] for value in downs.values()} >= {400}
    scaled = [(down.detach() * down.shape[1] ** 0.5).flatten() for down in downs.values()]
    assert float(torch.cat(scaled).std()) == pytest.approx(1, rel=0.1)
    (vectors,) = (value for name, value in parts.items() if name.endswith(".vectors"))
    assert (len(vectors), vectors.count_nonzero()) == (2, 0)


def test_new_words_get_rows_that_no_known_word_has():
    encoder = LearnedTokens(16, buckets=50, heads=2)
    (row,) = word_rows(encoder, ["limp"], [])
    first, second = hashed("limp", 50)
    other = next(
        w for n in range(10**4) if first in hashed(w := f"w{n}", 50) and second not in hashed(w, 50)
    )
    assert (row, word_rows(encoder, ["limp"], [other])) == (first, [second])
    # The rows of the token that begins every caption are not free either.
    begin = hashed(START, 50)
    rows = (hashed(f"w{n}", 50) for n in range(10**4))
    number = next(n for n, (one, two) in enumerate(rows) if one in begin and two not in begin)
    word = f"w{number}"
    assert word_rows(encoder, [word], []) == [hashed(word, 50)[1]]


STYLED = "A person hobbles in limp style"
STEPS = ["data.batch_size=4", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false"]
STEPS += [
    "callbacks.samples.seconds=0.5",
    "callbacks.checkpoints.every_n_steps=2",
    "trainer.val_check_interval=2",
    "lr_decay=0",
]


@pytest.fixture
def clips(tmp_path) -> Path:
    folder = tmp_path / "clips"
    folder.mkdir()
    for clip in Synthetic(clips=3).clips(30.0):
        np.savez(folder / clip.id, joints=clip.motion, fps=30)
        (folder / f"{clip.id}.txt").write_text("A person hobbles.\n")
    return folder


@pytest.mark.slow
def test_from_clips_to_a_prompt_and_resumed(
    trained, clips, tmp_path, monkeypatch, data_root, capsys
):
    monkeypatch.setattr(adaptation, "SAMPLED", 10)
    monkeypatch.chdir(tmp_path)
    words = ["adapt", str(trained), "whole", f"source={clips}", "name=limp", *STEPS]
    for steps, out in ((4, "whole"), (2, "parts"), (4, "parts")):
        words[2] = out
        if (Path(out) / "config.yaml").exists():
            as_version_0_2(Path(out), "training.adaptation.AdaptationTask", "task.MotionGeneration")
        assert main([*words, f"trainer.max_steps={steps}"]) == 0
    whole, parts = (load_file(Path(out) / "limp.safetensors") for out in ("whole", "parts"))
    torch.testing.assert_close(parts, whole, rtol=0, atol=0)
    assert any(value.any() for name, value in whole.items() if name.endswith(".up"))
    page = Path("whole/adaptation.html").read_text()
    assert "hobbles in limp style" in page
    assert "sampling 10 motions from the base model instead" in capsys.readouterr().out
    store, base = Store(next(Path("whole/data").glob("limp-*"))), flame_mdm.load(trained)
    np.testing.assert_array_equal(store.mean, base.representation.mean)
    assert {clip.captions[0] for clip in store.clips if not clip.source.startswith("prior/")} == {
        STYLED
    }
    assert (
        main(
            [
                "sample",
                str(trained),
                "out",
                f"text={STYLED}",
                "adapter=whole/limp.safetensors",
                "samples=1",
                "seconds=0.5",
            ]
        )
        == 0
    )
    assert "never seen" not in capsys.readouterr().out


def test_an_adaptation_keeps_the_captions_of_the_users_clips_and_the_text_encoder(monkeypatch):
    config = compose("quickstart", [*TINY, "task.cond_drop_prob=1"])
    task = adaptation.AdaptationTask.build(config, instantiate(config["representation"]))
    batch = MotionBatch(
        torch.zeros(3, 2, 263),
        torch.ones(3, 2, dtype=torch.bool),
        ["limp", "prior/limp", "a/prior/b"],
    )
    assert task.dropped(batch).tolist() == [False, True, False]
    monkeypatch.setattr(task.generator.condition, "pretrain", lambda *_: pytest.fail("trained"))
    task.pretrain()


@pytest.mark.slow
def test_all_weights_and_half_of_each_batch_from_the_data_of_the_base(
    trained, clips, tmp_path, data_root, monkeypatch, subtests
):
    monkeypatch.setenv("FLAME_MDM_DATA", str(data_root))
    words = [
        "adapt",
        str(trained),
        str(tmp_path / "run"),
        f"source={clips}",
        "name=limp",
        "full=true",
        *STEPS,
    ]
    assert main([*words, "trainer.max_steps=2"]) == 0
    model, base = flame_mdm.load(tmp_path / "run" / "limp.safetensors"), flame_mdm.load(trained)
    assert not torch.equal(*(of.state_dict()["denoiser.output.weight"] for of in (model, base)))
    root = {"root": str(tmp_path / "run" / "data")}
    data = instantiate(model.config["data"] | root, representation=model.representation)
    data.setup("fit")
    for number, batch in enumerate(itertools.islice(data.train_dataloader(), 3)):
        with subtests.test(batch=number):
            assert [name.startswith("prior/") for name in batch.ids] == [False, False, True, True]


def test_samples_of_the_base_cover_its_captions_evenly_and_a_tenth_is_for_validation(monkeypatch):
    requested: list[Any] = []

    def generated(_: Any, texts: list[str], *, frames: int, seed: int) -> list[Any]:
        requested.append((len(texts), frames, seed))
        return [SimpleNamespace(features=np.zeros((frames, 3)), text=text) for text in texts]

    monkeypatch.setattr(adaptation, "generate", generated)
    model: Any = SimpleNamespace(
        facts={"max_frames": 50}, representation=SimpleNamespace(name="humanml3d")
    )
    clips = list(adaptation._Samples(model, ["runs", "sits", "walks"]).clips(20.0))
    assert [clip.captions for clip in clips] == [["runs"]] * 100 + [["sits"]] * 100 + [
        ["walks"]
    ] * 100
    assert [row for row, clip in enumerate(clips) if clip.split == "val"] == list(range(0, 300, 10))
    assert len({clip.id for clip in clips}) == 300
    assert requested == [(min(32, 300 - seed), 50, seed) for seed in range(0, 300, 32)]


def test_an_adaptation_has_the_rate_and_the_crops_of_its_base_unless_they_are_chosen(
    monkeypatch, tmp_path
):
    def resolved(recipe: Any, words: list[str], *_: Any) -> Any:
        return {
            "run": {},
            "data": {"crop": {"max_frames": 196, "unit": 4}, "source": {}},
            "optimizer": {"lr": 0.5 if "optimizer.lr=0.5" in words else 0.001},
            "callbacks": {"samples": {}},
        }

    monkeypatch.setattr(adaptation, "resolve", resolved)
    monkeypatch.setattr(adaptation, "prepare_overrides", lambda _, words: (words,))
    monkeypatch.setattr(adaptation, "needs_rotations", lambda _: True)
    parts = {part: {"of": part} for part in adaptation.OF_BASE}
    base: dict[str, Any] = parts | {
        "task": {"_target_": "flame_mdm.task.GeneratorTask", "cond_drop_prob": 0.2},
        "optimizer": {"lr": 0.0123},
        "data": {"crop": {"max_frames": 52, "unit": 2}},
    }
    facts = {"max_frames": 63, "captions": ["a person sits", "a person runs", "he bows", "he hops"]}
    model: Any = SimpleNamespace(config=base, facts=facts, representation=None)
    captions = [f"text {number}" for number in range(7)]

    def recipe(*words: str) -> Any:
        return adaptation._recipe(model, captions, "limp", tmp_path, words)

    taught = recipe()
    assert (taught["optimizer"]["lr"], taught["data"]["crop"]) == (0.0123, base["data"]["crop"])
    assert (taught["data"]["name"], taught["data"]["source"]["motion"]) == ("limp", "smpl")
    assert taught["callbacks"]["samples"]["prompts"] == [
        f"{text} in limp style"
        for text in ("text 0", "text 3", "text 6", "a person sits", "a person runs", "he bows")
    ]
    assert taught["task"] == {"_target_": adaptation.TASK, "cond_drop_prob": 0.2}
    assert all(taught[part] == parts[part] for part in parts if part != "task")
    # A released model has no data: crops are as long as its longest motion, in multiples of 4 frames.
    model.config = {name: value for name, value in base.items() if name != "data"}
    taught = recipe("optimizer.lr=0.5")
    assert (taught["optimizer"]["lr"], taught["data"]["crop"]["max_frames"]) == (0.5, 60)
    with pytest.raises(UserError, match="keeps the denoiser of its base model"):
        recipe("denoiser.latent_dim=8")


def test_unusable_requests_are_refused(refused, trained, clips, tmp_path):
    for name in ("limp 2", "", "../x"):
        refused("adapt", str(trained), f"source={clips}", f"name={name}", says="expected one word")
    lesson = ["adapt", str(trained), f"source={clips}", "name=limp"]
    refused(*lesson[:2], says="source is missing")
    refused(*lesson, "rank=0", says="rank=0: must be at least 1")
    refused(*lesson, "losses.velocity=3", says="keeps the losses of its base")
    refused(*lesson[:2], f"source={tmp_path / 'none'}", "name=limp", says="no such folder")
    joints = next(iter(Synthetic(clips=1).clips(20.0))).motion
    np.savez(
        clips / "rising",
        joints=joints + np.linspace(0, 0.3, len(joints))[:, None, None] * [0, 1, 0],
        fps=20,
    )
    refused(*lesson, says="1 of 4 motions have no caption")
    (clips / "rising.txt").write_text("a person rises")
    refused(*lesson, says="rising drifts upward by")


def test_the_demo_offers_a_model_with_and_without_an_adapter(taught):
    base, adapter = str(taught / "base.safetensors"), str(taught / "limp.safetensors")
    studio = Studio([base, f"{base} + {adapter}"], "cpu")
    expected = flame_mdm.load(base, adapter=adapter).state_dict()
    torch.testing.assert_close(
        studio.model(f"{base} + {adapter}").state_dict(), expected, rtol=0, atol=0
    )
    request = DemoRequest(model=f"{base} + {adapter}", text="a person walks")
    assert f"flame_mdm.load({base!r}, adapter={adapter!r})" in request.python("text", "cpu")


@pytest.mark.robustness
def test_two_processes(trained, clips, tmp_path, data_root):
    words = ["adapt", str(trained), str(tmp_path / "run"), f"source={clips}", "name=limp", *STEPS]
    words.append("trainer.max_steps=2")
    code, _, err = finish(spawn(["flame_mdm", *words, *TWO, f"data_root={data_root}"]))
    assert code == 0, err
    assert (tmp_path / "run" / "limp.safetensors").stat().st_size < 300_000


def test_the_data_of_the_base_is_used_only_if_it_has_not_changed(tmp_path, monkeypatch):
    written: list[tuple[Path, list[str]]] = []

    def write_store(folder: Path, samples: Any, representation: Any) -> None:
        written.append((folder, samples.captions))
        folder.mkdir(parents=True)
        (folder / "store.json").touch()

    monkeypatch.setattr(adaptation, "write_store", write_store)
    monkeypatch.setattr(adaptation, "Store", lambda _: SimpleNamespace(fingerprint="f1"))
    monkeypatch.setattr(adaptation, "SAMPLED", 2)
    data, out = tmp_path / "walks-humanml", tmp_path / "run"
    data.mkdir()
    (data / "store.json").touch()
    model: Any = SimpleNamespace(
        config={"data": {"name": "walks"}},
        facts={"fingerprint": "f1"},
        representation=SimpleNamespace(name="humanml"),
    )
    assert adaptation._prior(model, tmp_path, out, ["own"]) == data
    assert written == []
    model.facts = {"fingerprint": "f2", "captions": ["walks", "sits"]}
    for _ in range(2):  # a resumed adaptation keeps its samples
        assert adaptation._prior(model, tmp_path, out, ["own"]) == out / "prior-humanml"
    model.facts, model.config = {}, {}
    adaptation._prior(model, tmp_path, tmp_path / "other", ["own"])
    assert written == [
        (out / "prior-humanml", ["walks", "sits"]),
        (tmp_path / "other" / "prior-humanml", ["own", "own"]),
    ]


def test_an_adapter_describes_its_style_its_new_words_and_its_base(tmp_path, monkeypatch):
    monkeypatch.setattr(adaptation, "read_merged", lambda file: {"state_dict": f"of {file}"})
    monkeypatch.setattr(adaptation, "state_sha256", lambda state: f"hash {state}")
    facts = {"vocabulary": ["a", "person", "in"]}
    model: Any = SimpleNamespace(condition=None, facts=facts)
    captions = [f"a person hobbles {number}." for number in "abc" * 9]
    about = adaptation._about(model, captions, "limp", 5, Path("base"), True)
    assert about["captions"] == [f"{text[:-1]} in limp style" for text in captions[:20]]
    assert about["words"] == ["hobbles", "limp", "style", "b", "c"]
    assert (about["name"], about["action"], about["rank"]) == ("limp", True, 5)
    assert (about["rows"], about["base"]) == ([], "hash of base")


def test_the_page_of_an_adaptation_compares_both_models_on_the_clips_of_each_kind(monkeypatch):
    """There are 3 clips of the user, and 70 others, of which every third is compared."""
    shown: list[list[Motion]] = []
    rendered: dict[str, Any] = {}
    own, others = [7, 8, 9], [row for row in range(73) if row not in (7, 8, 9)]
    clips = [SimpleNamespace(captions=[f"text {row}"]) for row in range(73)]
    train = SimpleNamespace(clips=clips, __getitems__=lambda draws: draws)
    data: Any = SimpleNamespace(
        train=train,
        setup=lambda _: None,
        halves=lambda: [np.array(own), np.array(others)],
        crop=SimpleNamespace(longest=lambda: 6),
        store=SimpleNamespace(motion=lambda _: np.zeros((9, 1))),
    )

    def generated(model: Any, texts: Any, frames: int = 4) -> list[Motion]:
        texts = [texts] if isinstance(texts, str) else texts
        joints = np.zeros((frames, 22, 3))
        return [Motion(joints, 20.0, text=f"{model.name}: {text}") for text in texts]

    def task(name: str, extra: float) -> Any:
        return SimpleNamespace(
            generator=SimpleNamespace(name=name, representation=None),
            losses_of=lambda draws: {"loss": torch.tensor([draws[-1][0], len(draws)]) + extra},
        )

    monkeypatch.setattr(adaptation, "generate", generated)
    monkeypatch.setattr(adaptation, "collate", lambda draws: draws)
    monkeypatch.setattr(
        adaptation,
        "decoded",
        lambda _, features, text, id: Motion(
            np.zeros((len(features), 22, 3)), 20.0, text=text, id=id
        ),
    )
    monkeypatch.setattr(adaptation, "player_page", lambda motions, *_, **__: shown.append(motions))
    monkeypatch.setattr(adaptation, "render", lambda _, **values: rendered.update(values))
    adaptation._comparison("limp", data, task("base", 0.5), task("adapted", 0.25))
    assert rendered["rows"] == [
        ["loss on 3 of your clips", "6.5", "6.25"],
        ["loss on 24 clips from its own data", "48.5", "48.25"],
    ]
    pairs, beside = shown
    texts = [f"text {row}" for row in own]
    texts += [f"text {row} in limp style" for row in (0, 3, 6)]
    texts += [f"text {row}" for row in (0, 3, 6)]
    assert [(motion.id, motion.text) for motion in pairs] == [
        (label, f"{name}: {text}")
        for text in texts
        for label, name in (("before", "base"), ("after", "adapted"))
    ]
    assert [(motion.id, motion.text, len(motion.joints)) for motion in beside] == [
        (label, f"{prefix}text {row}", 6)
        for row in own
        for label, prefix in (("your clip", ""), ("model", "adapted: "))
    ]
