"""Recipes, command lines, the check of signatures, and devices that are not there."""

import os
import re
import subprocess
import sys
import textwrap
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import MISSING, dataclass, fields, replace
from importlib import import_module
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, get_type_hints

import numpy as np
import pytest
import torch
import yaml
from support.fixtures import recipe
from support.motions import synthetic
from support.refusals import one_error

import flame_mdm
from evaluators.evaluation_request import EvaluationRequest
from flame_mdm import config
from flame_mdm.__main__ import COMMANDS, main
from flame_mdm.checkpoints.hub import export
from flame_mdm.checkpoints.loading import NO_GPU, load
from flame_mdm.checkpoints.onnx_export import export_onnx
from flame_mdm.checkpoints.released import import_released
from flame_mdm.commands import WritingSettings, device_name, distill, prepare
from flame_mdm.commands.adapt import AdaptSettings
from flame_mdm.commands.audit import AuditSettings
from flame_mdm.commands.benchmark import BenchmarkSettings
from flame_mdm.commands.browse import BrowseSettings
from flame_mdm.commands.compare import CompareSettings
from flame_mdm.commands.convert import ConvertSettings, _targets
from flame_mdm.commands.demo import DemoSettings
from flame_mdm.commands.edit import EditSettings
from flame_mdm.commands.evaluate import EvaluateSettings
from flame_mdm.commands.export import ExportSettings
from flame_mdm.commands.import_released import ImportSettings
from flame_mdm.commands.inspect import InspectSettings
from flame_mdm.commands.judge import JudgeSettings
from flame_mdm.commands.prepare import PrepareSettings
from flame_mdm.commands.push import PushSettings
from flame_mdm.commands.sample import SampleSettings
from flame_mdm.commands.tables import TablesSettings
from flame_mdm.config import (
    check,
    compose,
    compose_data,
    guarded,
    instantiate,
    jobs,
    parameters,
    recipes,
    sweeps,
    trust,
)
from flame_mdm.config.building import MOST_LEVELS, flatten, moved, plain
from flame_mdm.config.command_line import make_variables, read_settings, run
from flame_mdm.config.composition import choices, first_choice, parse, quoted
from flame_mdm.config.jobs import run_jobs
from flame_mdm.config.options import option
from flame_mdm.config.signatures import check_kind, source_file
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.demo.app import serve
from flame_mdm.demo.request import PLUS
from flame_mdm.errors import UserError
from flame_mdm.formats.layouts import head_height, leg_length
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import read_package_yaml, read_yaml
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.motion_request import EditRequest, SamplingRequest
from flame_mdm.sampling.reading import read_motion
from flame_mdm.training.adaptation import adapt
from flame_mdm.training.fit import check_devices

PARTS = ("task", "representation", "process", "condition", "denoiser", "data")


def is_optimizer(name: str) -> bool:
    value = getattr(torch.optim, name)
    return (
        isinstance(value, type)
        and issubclass(value, torch.optim.Optimizer)
        and value is not torch.optim.Optimizer
    )


def test_every_recipe_composes_is_short_and_says_what_it_is():
    wrong = []
    for name in recipes():
        composed = recipe(name)
        lines = (config.EXPERIMENTS / f"{name}.yaml").read_text().splitlines()
        whole = (
            composed["experiment"] == name
            and {"data", "representation", "task", "trainer"} <= composed.keys()
        )
        if not (
            whole
            and len(lines) <= 28
            and lines[0] == "# @package _global_"
            and lines[1].startswith("# ")
        ):
            wrong.append(name)
    assert wrong == []


def faults_of_yaml(path: Path) -> list[str]:
    """Returns what `read_package_yaml` reads in another way than `read_yaml`.

    Numbers such as 1e-4 and dates have other types, and of keys of the same name, the last counts.
    """
    faults, nodes = [], [yaml.compose(path.read_text(), yaml.CSafeLoader)]
    while nodes:
        node = nodes.pop()
        if isinstance(node, yaml.ScalarNode):
            number = not node.style and re.fullmatch(r"[-+]?\d+[eE][-+]?\d+", node.value)
            if number or node.tag.endswith(":timestamp"):
                faults.append(f"{path.name}: {node.value}")
        elif isinstance(node, yaml.MappingNode):
            keys = [key.value for key, _ in node.value]
            faults += [
                f"{path.name}: {key} twice" for key in dict.fromkeys(keys) if keys.count(key) > 1
            ]
            nodes += [value for _, value in node.value]
        elif node is not None:
            nodes += node.value
    return faults


def test_yaml_files_of_the_package_mean_the_same_to_both_readers(tmp_path):
    folders = [Path(flame_mdm.__file__).parent, config.EXPERIMENTS]
    assert [
        fault for folder in folders for p in folder.rglob("*.yaml") for fault in faults_of_yaml(p)
    ] == []
    path = tmp_path / "a.yaml"
    path.write_text("{a: 1e-4, b: 2020-01-01, c: [{d: 1.0, d: 2}]}")
    assert faults_of_yaml(path) == ["a.yaml: d twice", "a.yaml: 2020-01-01", "a.yaml: 1e-4"]
    content = read_yaml(config.EXPERIMENTS / "base.yaml")
    assert content == read_package_yaml(config.EXPERIMENTS / "base.yaml")


WRONG = {
    "trainer.max_step=5": "unknown config key 'trainer.max_step'. Did you mean trainer.max_steps",
    "denoiser=mdm_encodr": "unknown denoiser 'mdm_encodr'. Did you mean mdm_encoder",
    "data.source.clip=3": "Did you mean data.source.clips",
    "trainer.max_steps=[1": "cannot read an override",
    "+denoiser.heads=3": "unknown config key 'denoiser.heads'. Did you mean denoiser.num_heads?",
    "denoiser._target_=flame_mdm.denoisers.mdm.Encoder": "no such class or function",
    "denoiser.num_heads=true": "denoiser.num_heads=True: must be a whole number",
    "optimizer.lr=inf": "optimizer.lr=inf: must be a finite number",
}


@pytest.mark.slow
def test_a_wrong_override_is_one_line_with_the_nearest_names(subtests):
    for override, message in WRONG.items():
        with (
            subtests.test(override=override, message=message),
            pytest.raises(UserError, match=rf"\A[^\n]*{re.escape(message)}[^\n]*\Z"),
        ):
            compose("quickstart", [override])


def test_what_lightning_checks_late_is_checked_before_the_data(
    capsys, tmp_path, monkeypatch, subtests
):
    monkeypatch.setattr(os, "cpu_count", lambda: 3)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    for word, reason in (
        *((f"trainer.{key}=0", "must be greater than 0") for key in sweeps.LATE),
        (
            "trainer.devices=99",
            f"this machine has 3 CPU cores, and {NO_GPU}. Use at most trainer.devices=3",
        ),
    ):
        with subtests.test(word=word, reason=reason):
            folders = [f"run.dir={tmp_path / 'run'}", f"data_root={tmp_path}"]
            assert main(["train", "quickstart", *folders, "trainer.accelerator=auto", word]) == 1
            assert one_error(capsys) == f"error: {word}: {reason}"
    assert list(tmp_path.iterdir()) == []


def test_parts_are_swapped_whole_except_in_a_saved_configuration(tmp_path):
    composed = compose(
        "quickstart", ["denoiser=mdm_encoder", "representation=humanml_legacy", "seed=3"]
    )
    assert (composed["denoiser"]["latent_dim"], composed["representation"]["variant"]) == (
        512,
        "legacy",
    )
    config.save(composed, tmp_path / "config.yaml", head="a run")
    assert compose(str(tmp_path / "config.yaml")) == composed
    assert compose(str(tmp_path / "config.yaml"), ["optimizer.lr=1.0"])["optimizer"]["lr"] == 1.0
    with pytest.raises(UserError, match="denoiser=mdm_encoder replaces a part of a recipe"):
        compose(str(tmp_path / "config.yaml"), ["denoiser=mdm_encoder"])


def test_recipes_outside_the_repository(tmp_path, subtests):
    text = "# @package _global_\n# Mine.\ndefaults:\n  - /quickstart\n  - _self_\nseed: 5\n"
    (tmp_path / "mine.yaml").write_text(text)
    composed = compose(str(tmp_path / "mine.yaml"))
    assert (composed["seed"], composed["experiment"]) == (5, "mine")
    (tmp_path / "bad.yaml").write_text("a: [1\nb: {")
    for name, message in (
        (str(tmp_path / "bad.yaml"), r"bad\.yaml: not a readable YAML file"),
        (str(tmp_path / "absent.yaml"), "no such file"),
        ("quikstart", r"unknown experiment 'quikstart'\. Did you mean quickstart"),
    ):
        with subtests.test(message=message), pytest.raises(UserError, match=message):
            compose(name)


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("losses: {nope: 1}", "unknown config key 'losses.nope'"),
        ("losses: {joints: x}", "losses.joints=x: must be a finite number"),
        ("losses: null", "losses=None: must be a mapping"),
        ("losses: {feet: [1]}", "unknown config key 'losses.feet'"),
        ("ema: 1", "ema=1: must be a mapping of keys to values or null"),
        ("ema: {decay: x}", "ema.decay=x: must be a finite number"),
        ("ema: {decays: 0.9}", "unknown config key 'ema.decays'"),
        ("seed: abc", "seed=abc: must be a whole number"),
        ("seed: -1", "seed=-1: must be between 0 and"),
        ("seed: 4294967296", "seed=4294967296: must be between 0 and 4294967295"),
        ("initial_weights: 3", "initial_weights=3: must be a string or null"),
        ("lr_decay: x", "lr_decay=x: must be a finite number or null"),
        ("lr_warmup: 1.5", "lr_warmup=1.5: must be a whole number or null"),
        ("data_root: [a]", "data_root=['a']: must be a string"),
        ("run: {dir: 3}", "run.dir=3: must be a string"),
        ("callbacks: 3", "callbacks=3: must be a mapping"),
        ("logger: x", "logger=x: must be a mapping"),
        ("losess: {joints: 1.0}", "unknown config key 'losess'. Did you mean losses"),
        ("optimizer: {lr: abc}", "optimizer.lr=abc: must be a finite number"),
        ("condition: {buckets: 0}", "condition.buckets=0: must be at least 1"),
    ],
)
def test_a_recipe_file_is_checked_like_the_command_line(tmp_path, monkeypatch, capsys, line, says):
    monkeypatch.chdir(tmp_path)
    head = "# @package _global_\ndefaults: [/quickstart, _self_]\n"
    (tmp_path / "mine.yaml").write_text(f"{head}{line}\n")
    overrides = ["data.source.clips=8"] if "buckets" in line else []
    assert main(["train", "mine.yaml", *overrides]) == 1
    assert says in one_error(capsys)
    assert "buckets" in line or [path.name for path in tmp_path.iterdir()] == ["mine.yaml"]


def test_a_recipe_file_may_have_keys_of_its_own_to_which_others_refer(tmp_path):
    head = "# @package _global_\ndefaults: [/quickstart, _self_]\n"
    (tmp_path / "mine.yaml").write_text(
        f"{head}width: 32\nlr_decay: 0.5\ndenoiser: {{latent_dim: '${{width}}'}}\n"
    )
    assert compose(str(tmp_path / "mine.yaml"))["denoiser"]["latent_dim"] == 32


@pytest.mark.parametrize("name", [name for name in dir(torch.optim) if is_optimizer(name)])
def test_each_argument_of_an_optimizer_of_a_wrong_type_is_named_with_its_value(name, subtests):
    target = f"torch.optim.{name}"
    # The arguments that are left out are texts.
    for key in parameters(target) - {
        "params",
        "line_search_fn",
        "adjust_lr_fn",
    }:
        with (
            subtests.test(key=key),
            pytest.raises(UserError, match=rf"^optimizer\.{key}=abc: must be "),
        ):
            check({"optimizer": {"_target_": target, key: "abc"}})
    for value in ([0.9], [0.9, "x"], 0.9):
        with subtests.test(value=value):
            if "betas" in parameters(target) and name != "Adafactor":
                with pytest.raises(UserError, match=r"^optimizer\.betas=.*: must be a list"):
                    check({"optimizer": {"_target_": target, "betas": value}})
    check(
        {
            "optimizer": {
                "_target_": target,
                **({"betas": [0.9, 0.99]} if "betas" in parameters(target) else {}),
            }
        }
    )


def test_signatures_are_read_through_reexports_bases_and_dataclasses():
    assert {"lr", "weight_decay", "fused"} <= parameters("torch.optim.AdamW")
    assert {"monitor", "save_top_k"} <= parameters("lightning.pytorch.callbacks.ModelCheckpoint")
    assert {"keep", "known", "mode"} <= parameters("flame_mdm.batch.Edit")
    with pytest.raises(UserError, match="no such class"):
        parameters("torch.optim.Adamm")
    with pytest.raises(
        UserError, match=r"unknown config key 'a\.0\.lrr'\. Did you mean a\.0\.lr\?"
    ):
        check({"a": [{"_target_": "torch.optim.AdamW", "lrr": 1}]})


def test_values_are_checked_against_annotations(subtests):
    for annotation, legal, illegal in (
        ("int", [3], [True, 3.0, "3", None]),
        ("float | None", [3, 0.5, None], [True, float("nan"), float("-inf"), "x"]),
        ("Optional[Union[int, float]]", [3, 0.5, None], [False, float("nan"), "x", [1]]),
        ("bool", [True], [1, 0, "true"]),
        ("str", ["x"], [3, None, True]),
        ("Literal['a', 'b'] | None", ["a", None], ["c", 1]),
        ("typing.Optional[typing.Literal['last', 'best']]", ["last", None], ["x"]),
        ("list[int | None]", [[1, None], []], [[True], ["x"], 3, None]),
        (
            "Sequence[float] | Sequence[Sequence[float]]",
            [[1, 2], [[1, 2], [3, 4]]],
            [["x"], [[None]], 3],
        ),
        ("'int'", [3], ["x"]),
        ("Denoiser", ["x", {}], [3, None, True]),
        ("dict[str, Any]", [{}, {"a": 1}], [3, "x", None]),
        ("", [None, 3], []),
    ):
        with subtests.test(annotation=annotation, legal=legal, illegal=illegal):
            for value in legal:
                check_kind("key", value, annotation)
            for value in illegal:
                with pytest.raises(UserError, match="must be "):
                    check_kind("key", value, annotation)


ENCODER = {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder"}
UNTRUSTED = [
    *(
        "os.system",
        "builtins.eval",
        "subprocess.Popen",
        "torch.load",
        "torch.hub.load",
        "torch.nn.Identity",
    ),
    *("torch.utils.collect_env.run", "lightning.pytorch.Trainer"),
    *("flame_mdm.config.run", "flame_mdm.data.restricted_pickle.read"),  # functions
    # Names that a trusted module imports.
    *(
        "flame_mdm.data.store.shutil.rmtree",
        "flame_mdm.data.store.Path",
    ),
    *("flame_mdm.task.torch.load", "flame_mdm.denoisers.mdm"),
    "flame_mdm.training.callbacks.Checkpoints",  # writes files
    # Classes of another part.
    *(
        "flame_mdm.conditions.text.PretrainedText",
        "evaluators.extractors.MotionCLIPExtractor",
    ),
    *("evaluators", "evaluators.", ".system", "", "${oc.decode:os.system}", eval, None),
]


def test_a_checkpoint_names_only_own_classes_and_those_that_the_user_trusts(monkeypatch, subtests):
    for wrong in (
        {"num_heads": True},
        {"latent_dim": ENCODER},
        {"latent_dims": 3},
        {"dropout": float("nan")},
    ):
        with subtests.test(wrong=wrong), pytest.raises(UserError, match=r"denoiser\."):
            trust({"denoiser": ENCODER | wrong})
    for name in recipes():
        trust({part: recipe(name)[part] for part in PARTS if part in recipe(name)})
    monkeypatch.setenv("FLAME_MDM_TRUST", ",")
    for target in UNTRUSTED:
        for hidden in (
            {"_target_": target},
            {"a": [1, {"b": ({"_target_": target},)}]},  # a tuple, which Hydra takes as a list
            ENCODER | {"_args_": [{"_partial_": True, "_target_": target}]},
        ):
            for part in ("denoiser", "callbacks"):
                with (
                    subtests.test(part=part),
                    pytest.raises(
                        UserError,
                        match=rf"names .* at {part}.*\. Code from this package is run only if you trust it",
                    ),
                ):
                    trust({part: hidden})
    monkeypatch.setenv("FLAME_MDM_TRUST", "decimal, fractions ")
    trust({"denoiser": {"_target_": "fractions.Fraction"}})
    # A name is the whole name of a package
    for names in ("frac", "fractions.Fraction", "ractions", "fractions2"):
        monkeypatch.setenv("FLAME_MDM_TRUST", f"decimal,{names}")
        with (
            subtests.test(names=names),
            pytest.raises(UserError, match="FLAME_MDM_TRUST=fractions"),
        ):
            trust({"denoiser": {"_target_": "fractions.Fraction"}})


def test_no_class_path_names_a_file_outside_of_packages(tmp_path, monkeypatch, subtests):
    (tmp_path / "evil.py").write_text("class MDMEncoder: pass")
    monkeypatch.setattr("ast.parse", lambda *_: pytest.fail("a file was parsed"))
    for module in (
        f"flame_mdm.denoisers./{tmp_path}/evil",
        "flame_mdm.denoisers.../../evil",
        "flame_mdm/denoisers",
    ):
        with subtests.test(module=module):
            assert source_file(module) is None
            with pytest.raises(UserError, match="Code from this package is run only if you"):
                trust({"denoiser": {"_target_": f"{module}.MDMEncoder"}})


def test_own_classes_outside_the_repository_need_no_registration(tmp_path, monkeypatch):
    (tmp_path / "my_parts.py").write_text("class Mine:\n    def __init__(self, width: int): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    assert type(instantiate({"_target_": "my_parts.Mine", "width": 3})).__name__ == "Mine"
    with pytest.raises(UserError, match="Did you mean width"):
        check({"_target_": "my_parts.Mine", "widht": 3})


def test_classes_of_a_generic_base_take_its_arguments(tmp_path, monkeypatch):
    code = "from typing import Generic, TypeVar\n\nT = TypeVar('T')\n\n\n"
    code += "class Base(Generic[T]):\n    def __init__(self, width: int): ...\n\n\nclass OfTexts(Base[str]): ...\n"
    (tmp_path / "generic_parts.py").write_text(code)
    monkeypatch.syspath_prepend(tmp_path)
    check({"_target_": "generic_parts.OfTexts", "width": 3})
    with pytest.raises(UserError, match="Did you mean width"):
        check({"_target_": "generic_parts.OfTexts", "widht": 3})


@dataclass(frozen=True, kw_only=True)
class Example:
    """usage: example FILE [NAME ...]"""

    OBJECTS: ClassVar = ("file", "names")
    file: str | None = option(None, "a file")
    names: list[str] | None = option(None, "names")
    text: str = option("", "any text")
    steps: int | Sequence[int] = option(3, "steps")
    which: Literal["last", "best"] = option("last", "last or best")
    rate: float | None = option(None, "a rate")
    loop: bool = option(False, "true or false")


def test_words_become_typed_settings(subtests):
    for words, values in (
        (["a b", "n", "m o"], {"file": "a b", "names": ["n", "m o"]}),
        (["file=x", "names=a 'b c'"], {"file": "x", "names": ["a", "b c"]}),
        (["text=it's ${a} (b), c=d; \\ [e]"], {"text": "it's ${a} (b), c=d; \\ [e]"}),
        (
            ["steps=[0,2]", "rate=1e-3", "loop=true", "which=best", "file=null"],
            {"steps": [0, 2], "rate": 1e-3},
        ),
        (["rate=null", "steps=5"], {"rate": None, "steps": 5}),
    ):
        with subtests.test(words=words, values=values):
            seen: list[Example] = []
            assert run(seen.append, Example, words) == 0
            assert {key: getattr(seen[0], key) for key in values} == values


def test_wrong_words_are_one_line(capsys, subtests):
    for words, message in (
        (["flie=x"], "unknown config key 'flie'. Did you mean file?"),
        (["x", "file=y"], "file is given twice"),
        (["steps=1.5"], "steps=1.5: must be a whole number or a list"),
        (["loop=yes"], "loop=yes: must be true or false"),
        (["rate=nan"], "rate=nan: must be a finite number or null"),
        (["rate=1,2"], "rate=1,2: got several values. Use a single value, or a list: rate=[1,2]"),
        (["which=first"], "which=first: must be one of last, best"),
        (["names='a"], "No closing quotation"),
        (["--fast"], "unknown option --fast"),
        (["=", "x"], "'=' has no key. Write key=value, without spaces around the = sign"),
        (["=x"], "'=x' has no key"),
    ):
        with subtests.test(words=words, message=message):
            assert run(lambda _: pytest.fail("it ran"), Example, words) == 1
            assert message in one_error(capsys)


def test_a_sweep_runs_each_combination(capsys):
    seen: list[Example] = []
    words = ["file", "rate=1,2", "steps=3,4", "text=a,b", "-m"]
    assert run_jobs(seen.append, Example, words) == 0
    jobs = [(job.file, job.rate, job.steps, job.text) for job in seen]
    assert jobs == [("file", rate, steps, "a,b") for rate in (1, 2) for steps in (3, 4)]
    assert "job 2 of 4: rate=1 steps=4\n" in capsys.readouterr().out

    def fail(job: Example) -> None:
        raise UserError(f"failed at {job.rate}")

    assert run_jobs(fail, Example, ["rate=1,2", "-m"]) == 1
    assert capsys.readouterr().err == "error: failed at 1\nerror: failed at 2\n"

    def fail_first(job: Example) -> None:
        if job.rate == 1:
            fail(job)

    assert run_jobs(fail_first, Example, ["rate=1,2", "-m"]) == 1, "the last job succeeds"
    assert capsys.readouterr().err == "error: failed at 1\n"
    assert run_jobs(lambda _: pytest.fail("it ran"), Example, ["rate=1,x", "-m"]) == 1
    assert "rate=x: must be a finite number" in one_error(capsys)
    assert run_jobs(seen.append, Example, ["rate=3"]) == 0
    assert seen[-1].rate == 3


def test_evaluations_are_swept_and_launched(tmp_path, monkeypatch, capsys, subtests):
    monkeypatch.chdir(tmp_path)
    Path("model.ckpt").touch()
    evaluated, started = [], []
    monkeypatch.setattr("evaluators.evaluation.evaluate", evaluated.append)
    words = ["evaluate", "model.ckpt", "extractor=none", "guidance_scale=1,2.5", "seed=0,1"]
    assert main([*words, "--multirun"]) == 0, capsys.readouterr().err
    sampled = [(request.options.guidance_scale, request.seed) for request in evaluated]
    assert sampled == [(1, 0), (1, 1), (2.5, 0), (2.5, 1)]

    def hydra_main(**source: Any) -> Callable:
        return lambda job: lambda: started.append((source["config_name"], sys.argv[1:], job))

    monkeypatch.setattr("flame_mdm.config.sweeps.hydra_main", hydra_main)
    monkeypatch.setattr(sys, "argv", ["flame-mdm"])
    assert main([*words, "launch=local", "hydra.launcher.timeout_min=5"]) == 0, (
        capsys.readouterr().err
    )
    ((name, argv, job),) = started
    assert name is None
    assert {"--multirun", "+launch=local", "hydra.launcher.timeout_min=5", "+job=0,1,2,3"} <= set(
        argv
    )
    job({"job": 2})
    assert (evaluated[-1].options.guidance_scale, evaluated[-1].seed) == (2.5, 0)

    monkeypatch.setenv("PATH", "")  # no srun
    for extra, message in (
        (["launch=slurm"], "launch=slurm: this machine has no srun"),
        (["launch=nothing"], "unknown launch 'nothing'"),
        (["--multirun", "out=a.json"], "out=a.json: 4 jobs would write to this path. Remove out="),
        (["--fast", "--multirun"], "unknown option --fast"),
        (
            [],
            "guidance_scale=1,2.5: several values define a sweep with one job per value. Add --multirun",
        ),
    ):
        with subtests.test(extra=extra, message=message):
            assert main([*words, *extra]) == 1
            assert message in one_error(capsys)
    assert len(evaluated) == 5
    assert len(started) == 1


def test_every_command_lists_its_keys_with_defaults_and_help(capsys, subtests):
    for command in COMMANDS:
        with subtests.test(command=command):
            module = import_module(
                f"flame_mdm.commands.{'import_released' if command == 'import' else command}"
            )
            assert main([command, "--help"]) == 0
            shown = capsys.readouterr().out
            assert shown.startswith(f"usage: flame-mdm {command} ")
            if command != "train":
                kind = get_type_hints(module.main)["settings"]
                listed = [
                    line
                    for line in shown.partition("defaults:\n")[2].splitlines()
                    if line[2:3] != " "
                ]
                names = {entry.name for entry in fields(kind)} - {"composed"}
                assert {line.split("=")[0].strip() for line in listed} == names


def test_make_variables_are_read_without_a_shell(monkeypatch):
    flags = r"""s -- q=#hash UNCONDITIONED=1 TEXT=100%\ a\ --\ b\ $$5 x.y=a\ "c"\ (d)\ ;$$HOME a.b=[1,\ 2] EXP=q"""
    monkeypatch.setenv("MAKEFLAGS", flags)
    words = [
        "q",
        "a.b=[1, 2]",
        'x.y=a "c" (d) ;$HOME',
        "text=100% a -- b $5",
        "unconditioned=1",
        "q=#hash",
    ]
    assert make_variables() == words
    monkeypatch.setenv("MAKEFLAGS", "")
    assert make_variables() == []


def test_settings_with_a_data_set_compose_it(tmp_path, subtests):
    nodes = compose_data(
        "synthetic", ["representation=smpl", "data.source.clips=5"], data_root=f"{tmp_path}/${{a}}"
    )
    assert nodes["representation"]["_target_"].endswith("SMPL")
    assert (nodes["data"]["source"]["clips"], nodes["data"]["root"]) == (5, f"{tmp_path}/${{a}}")
    settings = read_settings(EvaluateSettings, ["ckpt=x", "data=synthetic", "data.source.clips=5"])
    assert settings.nodes["data"]["source"]["clips"] == 5
    assert read_settings(InspectSettings, ["motion=synthetic"]).data == "synthetic"
    for line, message in (
        ("data=synthetic data.source.clip=5", r"Did you mean data\.source\.clips"),
        ("data.x=5", "no data set"),
        ("data=syntetic", "unknown data 'syntetic'"),
    ):
        with subtests.test(line=line, message=message), pytest.raises(UserError, match=message):
            read_settings(EvaluateSettings, line.split())


REFUSED = """train quickstart trainer.max_step=1
sample absent text=a
sample quickstart text=a device=meta
sample quickstart text=a after=absent.npz
sample quickstart text=a body=x
edit quickstart motion=walk.xyz text=a
convert absent.npz x.glb
inspect absent.npz
evaluate absent extractor=none
export absent out=x
import mdm absent.pt out=x
browse syntetic
prepare
trian"""


@pytest.mark.slow
def into_a_closed_pipe(*words: str) -> tuple[int, str]:
    """Exit code, and what is written to stderr, of a command whose output nobody reads."""
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "flame_mdm", *words]
    result = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True, check=False)
    os.close(writer)
    return result.returncode, result.stderr


@pytest.mark.parametrize(
    "words", [["--help"], ["train", "--help"], ["sample", "--help"], ["inspect", "--help"]]
)
def test_help_may_be_read_in_part(words):
    assert into_a_closed_pipe(*words) == (0, "")


def test_a_command_finishes_its_work_if_nobody_reads_its_output(tmp_path):
    joints = next(iter(Synthetic(clips=1).clips(20.0))).motion
    Motion(joints, 20.0, SMPL22).save(tmp_path / "walk.npz")
    code, err = into_a_closed_pipe(
        "inspect", str(tmp_path / "walk.npz"), f"out={tmp_path / 'out.html'}"
    )
    assert code in (0, 3)  # 3 = the motion has faults
    assert err == ""
    assert "</html>" in (tmp_path / "out.html").read_text()


def test_help_and_wrong_words_do_not_wait_for_torch():
    program = f"""
        import sys
        from flame_mdm.__main__ import main
        assert main(["train", "--help"]) == 0
        for line in {REFUSED.splitlines()}:
            assert main(line.split()) == 1, line
            assert "torch" not in sys.modules and "lightning" not in sys.modules, line
    """
    words = [sys.executable, "-c", textwrap.dedent(program)]
    result = subprocess.run(words, capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr.count("error: ")) == (0, len(REFUSED.splitlines())), (
        result.stderr
    )
    assert (
        "error: unknown command: trian. Did you mean train? `flame-mdm --help` lists the commands\n"
        in result.stderr
    )
    assert dir(flame_mdm) == ["Motion", "adapt", "edit", "generate", "judge", "load", "stream"]


def test_only_errors_that_the_user_can_fix_are_one_line(capsys, monkeypatch, subtests):
    def fail() -> None:
        raise error

    for error, line in (  # noqa: B007
        (UserError("wrong: x. Do y"), "error: wrong: x. Do y"),
        (FileNotFoundError("x.npz: no such file"), "error: x.npz: no such file"),
        (
            PermissionError(13, "Permission denied", "x.npz"),
            "error: [Errno 13] Permission denied: 'x.npz'",
        ),
        (OSError(28, "No space left on device"), "error: [Errno 28] No space left on device"),
        (MemoryError(), "error: out of memory (MemoryError). Free memory, or reduce the size"),
        (
            RuntimeError("CUDA out of memory. Tried"),
            "error: out of memory (CUDA out of memory. Tried).",
        ),
        (ValueError("setting an array element with a sequence"), None),
        (OSError(24, "Too many open files"), None),
        (KeyError("x"), None),
    ):
        with subtests.test(line=line):
            assert guarded(fail) == (70 if line is None else 1)
            shown = capsys.readouterr().err
            assert shown.startswith(line or "Traceback")
            assert ("bug in flame_mdm. Please report it" in shown) == (line is None)
            assert line is None or shown.count("\n") == 1
    monkeypatch.setenv("FLAME_MDM_TRACEBACK", "1")
    error = UserError("wrong")
    guarded(fail)
    assert "Traceback" in capsys.readouterr().err


@pytest.mark.parametrize(
    "strategy",
    [
        "fsdp",
        "fsdp_cpu_offload",
        "deepspeed_stage_2",
        {"_target_": "lightning.pytorch.strategies.model_parallel.ModelParallelStrategy"},
        {"_target_": "lightning.pytorch.strategies.FSDPStrategy"},
    ],
)
def test_strategies_that_divide_a_model_are_refused(strategy):
    with pytest.raises(UserError, match=r"^trainer\.strategy=.*Use trainer\.strategy=ddp; "):
        check_devices({"accelerator": "cpu", "strategy": strategy})


@pytest.mark.parametrize("strategy", ["auto", "ddp", "ddp_find_unused_parameters_true"])
def test_other_strategies_are_allowed(strategy):
    check_devices({"accelerator": "cpu", "strategy": strategy})


@pytest.mark.parametrize(
    ("gpus", "accelerator", "devices", "message"),
    [
        *(
            (
                0,
                name,
                1,
                f"trainer.accelerator={name}: {NO_GPU}. Remove this key to train on the CPU",
            )
            for name in ("gpu", "cuda")
        ),
        (1, "auto", 2, "trainer.devices=2: this machine has 1 GPU. Use at most trainer.devices=1"),
        (2, "gpu", 4, "trainer.devices=4: this machine has 2 GPUs. Use at most trainer.devices=2"),
        # A CPU may run more processes than it has cores
        *(
            (0, "cpu", 2, ""),
            (2, "auto", 2, ""),
            (2, "cpu", 8, ""),
        ),
    ],
)
def test_training_names_the_devices_that_are_missing(
    gpus, accelerator, devices, message, monkeypatch
):
    monkeypatch.setattr(os, "cpu_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: gpus)
    with pytest.raises(UserError, match=f"^{message}$") if message else nullcontext():
        check_devices({"accelerator": accelerator, "devices": devices})


def test_paths_below_a_moved_folder_move_and_folders_with_similar_names_do_not():
    folders = {"runs/x/default": "${run.dir}"}
    node = {"a": "runs/x/default", "b": ["runs/x/default/c.ckpt"], "d": "runs/x/default/c.ckpt"}
    node |= {"e": "runs/x/default2/c.ckpt", "f": "x/runs/x/default", "g": 3}
    assert moved(node, folders) == node | {"a": "${run.dir}", "d": "${run.dir}/c.ckpt"}


@pytest.mark.parametrize(
    "text",
    ["it's", "a\\", "a\\'b", "\\\\", "'", "[1, 2]", "{a: 1}", "a, b=c", " x ", "", "null", "1e-3"],
)
def test_quoted_values_are_taken_literally(text):
    (override,) = parse([quoted(f"run.dir={text}")])
    assert (override.key_or_group, override.value()) == ("run.dir", text)


@pytest.mark.parametrize(
    ("word", "values", "first"),
    [
        ("seed=3,4", ["3", "4"], "seed=3"),
        ("+seed=range(1,4)", ["1", "2", "3"], "+seed=1"),
        ("optimizer.lr=choice(1e-3,0.5)", ["0.001", "0.5"], "optimizer.lr=0.001"),
        ("launch=glob(l*)", ["local"], "launch=local"),
        ("a=[1,2]", ["[1, 2]"], "a=[1,2]"),
        ("a=b", ["b"], "a=b"),
    ],
)
def test_a_sweep_is_checked_with_the_first_of_its_values(word, values, first):
    (override,) = parse([word])
    assert choices(override) == values
    assert first_choice(override) == first


def test_help_shows_defaults_as_they_are_typed(capsys):
    assert run(lambda _: pytest.fail("it ran"), Example, ["x", "--help"]) == 0
    lines = capsys.readouterr().out.partition("defaults:\n")[2].splitlines()
    assert [line.split()[0] for line in lines] == [
        "file=null",
        "names=null",
        "text=",
        "steps=3",
        "which=last",
        "rate=null",
        "loop=false",
    ]
    assert lines[3] == f"  {'steps=3':30} steps"


@pytest.mark.parametrize(
    ("stop", "code"), [(SystemExit(), 0), (SystemExit(3), 3), (KeyboardInterrupt(), 130)]
)
def test_exit_codes_of_stopped_commands(stop, code):
    def action() -> None:
        raise stop

    assert guarded(action) == code


@pytest.mark.parametrize(("code", "count"), [(130, 1), (143, 1), (129, 1), (128, 2), (3, 2)])
def test_a_signal_ends_a_sweep_and_a_failed_job_does_not(code, count):
    started = []

    def end(job: Example) -> None:
        started.append(job.rate)
        raise SystemExit(code)

    assert run_jobs(end, Example, ["rate=1,2", "-m"]) == code
    assert started == [1, 2][:count]


@pytest.mark.parametrize("code", [1, 70, 130])
def test_a_failed_job_of_a_launcher_ends_with_its_code(tmp_path, monkeypatch, code):
    """Otherwise, the cluster would list the job as completed."""
    monkeypatch.chdir(tmp_path)
    launched: list[Callable[[Any], None]] = []
    monkeypatch.setattr(jobs, "hydra_sweep", lambda job, *_: launched.append(job))

    def end(job: Example) -> None:
        raise SystemExit(code if job.rate == 2 else 0)

    assert run_jobs(end, Example, ["rate=1,2", "launch=local"]) == 0
    (job,) = launched
    job({"job": 0})
    with pytest.raises(SystemExit) as stop:
        job({"job": 1})
    assert stop.value.code == code


@pytest.mark.parametrize(("launcher", "ends"), [(["launch=local"], True), (["--multirun"], False)])
def test_a_failed_training_ends_its_job_only_if_a_launcher_started_it(
    tmp_path, monkeypatch, launcher, ends
):
    stops: list[Any] = []
    monkeypatch.setattr(sys, "argv", ["flame-mdm", "train"])
    monkeypatch.chdir(tmp_path)

    def sweep(job: Callable[[Any], None], *_: Any) -> None:
        overrides = SimpleNamespace(task=["seed=1", "+launch=local"])
        runtime = SimpleNamespace(output_dir=str(tmp_path))
        hydra = SimpleNamespace(overrides=overrides, runtime=runtime)
        state = SimpleNamespace(get=lambda: hydra, instance=SimpleNamespace)
        monkeypatch.setattr(sweeps, "HydraConfig", state)
        try:
            job(None)
        except SystemExit as stop:
            stops.append(stop.code)

    def composed(_: str, words: list[str]) -> Any:
        assert words == ["seed=1", f"run.dir='{tmp_path}'"]
        return {"run": {"dir": str(tmp_path)}}

    def train(_: Any) -> None:
        raise UserError("failed")

    monkeypatch.setattr(sweeps, "hydra_sweep", sweep)
    monkeypatch.setattr(sweeps.composition, "compose", composed)
    assert sweeps.run_recipe(train, "usage", ["quickstart", "seed=0,1", *launcher]) == 1
    assert stops == [1] * ends


def test_limits_of_a_configuration_are_allowed(subtests):
    for seed in (0, 2**32 - 1):
        with subtests.test(seed=seed):
            sweeps._check_whole(compose("quickstart", [f"seed={seed}"]), "quickstart")
    with pytest.raises(UserError, match=r"denoiser\.num_layers=-1: must not be negative"):
        sweeps._check_whole(compose("quickstart", ["denoiser.num_layers=-1"]), "quickstart")
    node: Any = 1
    for _ in range(MOST_LEVELS):
        node = {"a": node}
    plain(node, "deep.yaml")
    with pytest.raises(UserError, match=r"deep\.yaml: not a configuration"):
        plain({"a": node}, "deep.yaml")


def test_flat_keys_keep_lists_and_empty_mappings():
    flat = flatten({"a": {"b": [1, {"x": 2}], "c": {}}, "d": None, "e": {"f": {"g": 0}}})
    assert flat == {"a.b": [1, {"x": 2}], "a.c": {}, "d": None, "e.f.g": 0}


def test_the_path_of_a_file_is_an_object_even_if_it_contains_an_equals_sign(tmp_path, capsys):
    path, seen = tmp_path / "rate=3.npz", list[Example]()
    path.touch()
    assert run(seen.append, Example, [str(path), "a=b", "rate=2"]) == 1
    assert "unknown config key 'a'" in one_error(capsys)
    assert run(seen.append, Example, [str(path), "word", "rate=2"]) == 0
    assert (seen[0].file, seen[0].names, seen[0].rate) == (str(path), ["word"], 2)
    path.unlink()
    assert run(seen.append, Example, [str(path)]) == 1


@pytest.mark.parametrize(
    ("codes", "expected", "count"), [((1, 0), 1, 2), ((0, 70), 70, 2), ((143, 0), 143, 1)]
)
def test_a_sweep_of_trainings_ends_with_the_worst_code_and_a_signal_ends_it(
    codes, expected, count, tmp_path, monkeypatch
):
    seeds: list[int] = []
    monkeypatch.setattr(sys, "argv", ["flame-mdm", "train"])

    def sweep(job: Callable[[Any], None], *_: Any) -> None:
        for seed in (0, 1):
            hydra = SimpleNamespace(
                overrides=SimpleNamespace(task=[f"seed={seed}"]),
                runtime=SimpleNamespace(output_dir=f"{tmp_path}/{seed}"),
            )
            state = SimpleNamespace(get=lambda hydra=hydra: hydra, instance=SimpleNamespace)
            monkeypatch.setattr(sweeps, "HydraConfig", state)
            job(None)

    def composed(_: str, words: list[str]) -> Any:
        return {"seed": int(words[0].removeprefix("seed=")), "run": {"dir": words[1]}}

    monkeypatch.setattr(sweeps, "hydra_sweep", sweep)
    monkeypatch.setattr(sweeps.composition, "compose", composed)

    def train(node: Any) -> None:
        seeds.append(node["seed"])
        raise SystemExit(codes[node["seed"]])

    words = ["quickstart", "seed=0,1", "--multirun", f"run.dir={tmp_path / 'sweep'}"]
    assert sweeps.run_recipe(train, "usage", words) == expected
    assert seeds == [0, 1][:count]
    assert sweeps.run_recipe(train, "usage", []) == 2
    assert sweeps.run_recipe(train, "usage", ["--help"]) == 0


SAME_AS_PYTHON: dict[type[Any], list[tuple[Callable[..., Any], dict[str, str]]]] = {
    AdaptSettings: [(adapt, {})],
    DemoSettings: [(serve, {})],
    ExportSettings: [(export, {}), (export_onnx, {}), (load, {"adapter_strength": "strength"})],
    ImportSettings: [(import_released, {})],
    ConvertSettings: [(Motion.save, {}), (read, {})],
    EditSettings: [(read_motion, {}), (EditRequest, {}), (SamplerOptions, {})],
    SampleSettings: [(SamplingRequest, {}), (SamplerOptions, {})],
    EvaluateSettings: [(EvaluationRequest, {}), (SamplerOptions, {})],
    AuditSettings: [(EvaluationRequest, {})],
    TablesSettings: [(EvaluationRequest, {})],
    BenchmarkSettings: [(TablesSettings, {})],
}
"""Settings of commands, and the functions and classes to which they pass the keys of the same name."""

OTHER_DEFAULTS = {
    "SampleSettings.samples": None,  # 3, or 1 for a file
    "EditSettings.samples": 3,
    "ExportSettings.adapter": None,
    "ConvertSettings.body": "mannequin",
    "AuditSettings.resamples": 100,
    "BenchmarkSettings.out": None,
    "AuditSettings.protocol": None,  # depends on the data set
    "TablesSettings.out": "runs/tables",
    "AuditSettings.out": "runs/audit",
    "TablesSettings.batch_size": 64,
    "AuditSettings.batch_size": 64,
    "AdaptSettings.data_root": "data",  # or FLAME_MDM_DATA
    "EvaluateSettings.data_root": "",
}


@pytest.mark.parametrize("kind", SAME_AS_PYTHON)
def test_defaults_of_a_command_are_those_of_the_function_that_it_calls(kind, monkeypatch):
    monkeypatch.delenv("FLAME_MDM_DATA", raising=False)
    defaults = {
        entry.name: entry.default_factory() if callable(entry.default_factory) else entry.default
        for entry in fields(kind)
    }
    compared = 0
    for function, names in SAME_AS_PYTHON[kind]:
        parameters_of = signature(function).parameters
        for key, default in defaults.items():
            parameter = parameters_of.get(names.get(key, key))
            if parameter is None or parameter.default is parameter.empty or default is MISSING:
                continue
            expected = OTHER_DEFAULTS.get(f"{kind.__name__}.{key}", parameter.default)
            if repr(expected) == "<factory>":
                continue
            values = [tuple(x) if isinstance(x, list) else x for x in (default, expected)]
            assert values[0] == values[1], (key, function)
            compared += 1
    assert compared > 0


def test_defaults_of_commands_without_a_function_are_those_that_their_pages_state():
    defaults = {
        f"{kind.__name__}.{entry.name}": entry.default
        for kind in (
            BrowseSettings,
            InspectSettings,
            JudgeSettings,
            CompareSettings,
            TablesSettings,
        )
        for entry in fields(kind)
        if isinstance(entry.default, int)
    } | {
        f"{kind.__name__}.{entry.name}": entry.default
        for kind in (AuditSettings, BenchmarkSettings, PrepareSettings, PushSettings)
        for entry in fields(kind)
        if isinstance(entry.default, int)
    }
    off = [
        *("CompareSettings.rate", "TablesSettings.force", "PrepareSettings.check"),
        *("PrepareSettings.verify", "PrepareSettings.force", "PushSettings.private"),
        "PushSettings.dry_run",
    ]
    assert defaults == dict.fromkeys(off, False) | {
        "BrowseSettings.clips": 200, "InspectSettings.clips": 24,
        "JudgeSettings.clips": 24, "CompareSettings.seed": 0,
        "TablesSettings.evaluate": True, "TablesSettings.batch_size": 64, "AuditSettings.seed": 0,
        "AuditSettings.resamples": 100, "AuditSettings.batch_size": 64, "BenchmarkSettings.jobs": 1,
        "BenchmarkSettings.batch_size": 64,
    }  # fmt: skip


def called_with(monkeypatch: pytest.MonkeyPatch, path: str) -> list[tuple[Any, ...]]:
    """Replaces a function, and returns a list to which the arguments of its calls are added."""
    calls: list[tuple[Any, ...]] = []

    def function(*values: Any, **keywords: Any) -> str:
        calls.append((*values, keywords))
        return "the result"

    monkeypatch.setattr(path, function)
    return calls


def test_export_push_and_demo_pass_their_keys_on(tmp_path, monkeypatch, capsys):
    file = tmp_path / "last.ckpt"
    file.touch()
    graphs = called_with(monkeypatch, "flame_mdm.checkpoints.onnx_export.export_onnx")
    single = called_with(monkeypatch, "flame_mdm.checkpoints.hub.export")
    words = [f"ckpt={file}", "out=x", "half=true", "adapter=a.safetensors b.safetensors"]
    assert main(["export", *words, "adapter_strength=[0.5,0]"]) == 0
    assert main(["export", *words[:2], "format=onnx"]) == 0
    assert main(["export", *words[:2], "adapter=a", "adapter_strength=0"]) == 0
    adapted = {"adapter": ["a.safetensors", "b.safetensors"], "strength": [0.5, 0]}
    without = {"half": False, "adapter": ["a"], "strength": 0}  # the model without its adapter
    assert single == [(file, "x", {"half": True} | adapted), (file, "x", without)]
    assert graphs == [(file, "x", {"half": False, "adapter": (), "strength": 1.0})]
    assert capsys.readouterr().out == "written: the result\n" * 3

    pushed = called_with(monkeypatch, "flame_mdm.checkpoints.hub.push")
    assert main(["push", str(file), "me/walks", "private=true"]) == 0
    assert main(["push", str(file), "me/walks", "out=here", "dry_run=true"]) == 0
    folder = Path("push/walks")
    assert pushed[0] == (file, "me/walks", folder, {"upload": True, "private": True})
    assert pushed[1] == (file, "me/walks", "here", {"upload": False, "private": False})
    printed = ["uploaded to me/walks: the result", "not uploaded: the result"]
    assert capsys.readouterr().out.splitlines() == printed

    served = called_with(monkeypatch, "flame_mdm.demo.app.serve")
    assert main(["demo"]) == 0
    assert main(["demo", "ckpt=a b", "adapter=x y", "port=0", "host=0.0.0.0", "hosts=m n"]) == 0
    assert served[0][:4] == (["package", "package_dip"], "127.0.0.1", 7860, None)
    sources = ["a", "b", f"a{PLUS}x", f"a{PLUS}y"]  # adapters are for the first model
    assert served[1][:5] == (sources, "0.0.0.0", 0, None, ["m", "n"])
    for port in (-1, 65536):
        assert main(["demo", f"port={port}"]) == 1
    assert len(served) == 2


def test_adapt_and_import_pass_their_keys_on(tmp_path, monkeypatch):
    file = tmp_path / "last.ckpt"
    file.touch()
    monkeypatch.setenv("FLAME_MDM_DATA", "elsewhere")
    adapted = called_with(monkeypatch, "flame_mdm.training.adaptation.adapt")
    words = ["source=mine", "name=limp", "rank=4", "action=true", "trainer.max_steps=9"]
    assert main(["adapt", str(file), *words]) == 0
    ((base, keywords),) = adapted
    assert base == file
    assert keywords == {
        "source": "mine", "name": "limp", "out": None, "action": True, "full": False, "force": False,
        "rank": 4, "data_root": "elsewhere", "overrides": ("trainer.max_steps=9",),
    }  # fmt: skip
    assert main(["adapt", str(file), "source=mine", "name=limp", "rank=0"]) == 1
    imported = called_with(monkeypatch, "flame_mdm.checkpoints.released.import_released")
    assert main(["import", "mdm", str(file), "out=x", "averaged=false", "num_heads=8"]) == 0
    ((keywords,),) = imported
    assert (keywords["kind"], keywords["file"], keywords["out"]) == ("mdm", str(file), "x")
    assert (keywords["averaged"], keywords["num_heads"]) == (False, 8)
    assert (keywords["time_token"], keywords["run_code"], keywords["stats"]) == (False, False, None)


def test_a_data_set_of_a_command_has_its_root_representation_and_source(tmp_path, monkeypatch):
    monkeypatch.setenv("FLAME_MDM_DATA", str(tmp_path))
    words = ["data=synthetic", "representation=smpl", "data.source.seed=7"]
    settings = read_settings(PrepareSettings, words)
    data = settings.data_node()
    assert (data["source"]["seed"], data["root"]) == (7, str(tmp_path))
    assert settings.nodes["representation"]["_target_"].endswith("SMPL")
    assert PrepareSettings(data="synthetic", data_root="").data_node()["root"] == "data"
    source = PrepareSettings(data="humanml3d").data_node("here")["source"]
    assert source["path"] == "here"
    with pytest.raises(UserError, match=r"^source=here: synthetic is generated and has no source"):
        settings.data_node("here")


@pytest.mark.parametrize("kind", [PrepareSettings, BrowseSettings, InspectSettings])
def test_commands_that_only_open_a_data_set_have_no_seed(kind):
    words = ["motion=synthetic"] if kind is InspectSettings else ["data=synthetic"]
    with pytest.raises(UserError, match="seed"):
        read_settings(kind, [*words, "seed=1"])


@pytest.mark.parametrize(("name", "is_valid"), [
    ("cpu", True), ("cuda", True), ("cuda:0", True), ("cuda:12", True), ("mps", True), ("xpu", True),
    ("cuda:", False), ("cuda:a", False), ("gpu", False), ("cpu:0", False), ("CUDA", False), ("", False),
])  # fmt: skip
def test_names_of_devices(name: str, is_valid: bool):
    with nullcontext() if is_valid else pytest.raises(UserError, match=rf"^device={name}: unknown"):
        device_name("device", name)


def test_a_motion_is_resampled_only_if_a_rate_is_chosen():
    motion = Motion(np.zeros((21, 22, 3), np.float32), 20.0)
    assert WritingSettings().at_rate(motion) is motion
    changed = WritingSettings(resample=30).at_rate(motion)
    assert (changed.fps, len(changed.joints)) == (30, 31)
    with pytest.raises(UserError, match="resample"):
        WritingSettings(resample=0).at_rate(motion)


@pytest.mark.parametrize(("argv", "code", "stream"), [
    ([], 2, "out"), (["--help"], 0, "out"), (["-h"], 0, "out"), (["sampel"], 1, "err"),
])  # fmt: skip
def test_the_list_of_commands_is_shown_and_an_unknown_one_is_an_error(argv, code, stream, capsys):
    assert main(argv) == code
    shown = getattr(capsys.readouterr(), stream)
    if stream == "err":
        assert shown.startswith("error: unknown command: sampel. Did you mean sample?")
    else:
        assert all(f"  {name:10} {purpose}\n" in shown for name, purpose in COMMANDS.items())


def test_convert_reads_resamples_and_writes_with_the_keys_of_the_command(
    tmp_path, monkeypatch, capsys
):
    motion = replace(synthetic("walk", size=40), notes=("a note",))
    saved: list[tuple[Any, ...]] = []

    def save(written: Motion, path: Path, *values: Any) -> str:
        saved.append((written.fps, len(written.joints), written.poses is None, path, *values))
        return f"written: {path.name}"

    for name in ("a.glb", "deep/b.glb"):
        motion.save(tmp_path / "in" / name, rig="mixamo")
    frames = len(motion.joints)
    readings: list[tuple[Any, ...]] = []

    def read_stub(*values: Any, **keywords: Any) -> Motion:
        readings.append((*values, keywords))
        return replace(motion)

    monkeypatch.setattr("flame_mdm.formats.readers.read", read_stub)
    monkeypatch.setattr(Motion, "save", save)
    source, words = tmp_path / "in" / "a.glb", ["fps=10", "unit=0.5", "up=z", "animation=Walk"]
    keys = ["rest_pose=true", "rig=soma", "root_motion=true", "resample=40"]
    assert main(["convert", str(source), str(tmp_path / "o.glb"), *words, *keys]) == 0
    assert readings == [(source, 10, 0.5, "z", {"animation": "Walk"})]
    assert saved == [(40, 2 * frames - 1, True, tmp_path / "o.glb", True, "soma", None, None, True)]
    legs, head = leg_length(motion.joints), head_height(motion.joints)
    assert capsys.readouterr().out.splitlines() == [
        "written: o.glb", f"{source}: a note", f"legs {legs:.2f} m, head joint at {head:.2f} m",
    ]  # fmt: skip
    saved.clear()
    assert main(["convert", str(tmp_path / "in"), str(tmp_path / "out"), "format=npz"]) == 0
    assert [row[3] for row in saved] == [tmp_path / "out" / "a.npz", tmp_path / "out/deep/b.npz"]
    assert [row[:3] for row in saved] == [(20, frames, False)] * 2  # AMASS files have rotations
    assert [row[4:] for row in saved] == [(False, None, None, None, False)] * 2
    hero = tmp_path / "hero.GLB"
    hero.touch()
    settings = ConvertSettings(motion="x", out="out", character=str(hero))
    targets = _targets(settings, tmp_path / "in", Path("out"))
    assert list(targets) == [Path("out/a.glb"), Path("out/deep/b.glb")]
    with pytest.raises(UserError, match="Also set the format of the files"):
        _targets(ConvertSettings(motion="x", out="out"), tmp_path / "in", Path("out"))


@pytest.mark.parametrize(("words", "is_prepared", "failures", "code", "calls"), [
    ([], False, [], 0, ["write"]), ([], True, [], 0, []), (["force=true"], True, [], 0, ["write"]),
    ([], False, ["a.bvh: damaged"], 1, ["write"]), (["check=true"], True, [], 0, ["check"]),
    (["check=true"], False, ["a.bvh: damaged"], 1, ["check"]), (["verify=true"], True, [], 0, ["verify"]),
])  # fmt: skip
def test_prepare_writes_checks_or_verifies_and_fails_if_files_failed(
    words, is_prepared, failures, code, calls, tmp_path, monkeypatch, capsys
):
    done: list[str] = []
    info = {
        "dataset": "mine", "representation": "raw", "fps": 12.5, "hours": 1.25, "shape": [900, 263],
        "excluded": {"short": 3, "long": 1},
    }  # fmt: skip
    store = SimpleNamespace(info=info, fingerprint="f00d")
    source = SimpleNamespace(
        failures=failures, suit=lambda _: None, check=lambda fps: done.append("check") or [f"{fps}"],
        findings=lambda: ["a finding"], changed=lambda path: [f"changed since {path.name}"],
        failure_lines=lambda: failures,
    )  # fmt: skip
    data = SimpleNamespace(
        folder=tmp_path, source=source, open=lambda: store, counts=lambda _: ["the counts"]
    )
    if is_prepared:
        (tmp_path / "store.json").touch()
    monkeypatch.setattr(
        prepare, "instantiate",
        lambda node, **keywords: data if keywords else SimpleNamespace(fps=12.5),
    )  # fmt: skip
    monkeypatch.setattr(
        "flame_mdm.data.store.write_store", lambda *_: done.append("write") or store
    )
    monkeypatch.setattr("flame_mdm.data.verify.report", lambda _: done.append("verify"))
    monkeypatch.setattr("flame_mdm.data.verify.lines", lambda _: ["a line"])
    monkeypatch.setattr("flame_mdm.data.verify.deviations", lambda _: ["12 clips, published 13"])
    assert main(["prepare", "synthetic", *words]) == code
    assert done == calls
    shown = capsys.readouterr().out.splitlines()
    if words == ["verify=true"]:
        assert shown[:3] == [
            "a line", "DIFFERS from the published numbers:", "  12 clips, published 13",
        ]  # fmt: skip
    elif words == ["check=true"]:
        assert shown == ["12.5"]
    else:
        assert shown[0] == "a finding" if calls else "already prepared (force=true" in shown[0]
        assert ("changed since store.json" in shown) == (not calls)
        assert shown[-4 - len(failures) :] == [
            "mine as raw at 12.5 fps; 1.25 hours", "the counts", "excluded: 3 short, 1 long",
            f"900 frames with 263 features, fingerprint f00d: {tmp_path}", *failures,
        ]  # fmt: skip


@pytest.mark.parametrize(("code", "exists", "starts", "remains"), [
    (0, False, True, True), (1, False, False, False), (1, False, True, True), (3, True, False, True),
])  # fmt: skip
def test_the_folder_of_a_student_is_removed_only_if_it_is_new_and_no_training_started(
    code, exists, starts, remains, tmp_path, monkeypatch
):
    folder = tmp_path / "student"
    if exists:
        folder.mkdir()
    passed: list[list[str]] = []

    def run_recipe(function: Any, usage: str, words: list[str]) -> int:
        passed.append(words)
        if starts:
            (folder / "config.yaml").touch()
        return code

    monkeypatch.setattr(distill, "student_recipe", lambda _: {"run": {"dir": str(folder)}})
    monkeypatch.setattr(distill, "run_recipe", run_recipe)
    settings = distill.DistillSettings(ckpt="x", composed=("seed=1,2", "--multirun"))
    with nullcontext() if code == 0 else pytest.raises(SystemExit) as error:
        distill.main(settings)
    assert error is None or error.value.code == code
    assert passed == [[str(folder / "student.yaml"), "seed=1,2", "--multirun"]]
    assert folder.exists() == remains
