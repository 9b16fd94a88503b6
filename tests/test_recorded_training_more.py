"""Results of recipes, configurations, signatures and command lines, as recorded."""

import errno
import itertools
import os
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
from support.outcomes import printed, without, workspace
from support.recorded import Case, cases_of, check, outcome, record

from flame_mdm import errors
from flame_mdm.config import building, command_line, composition, jobs, options, signatures, sweeps

NAME = "training_more"


# Configurations ----------------------------------------------------------------------------------


def plain_configurations() -> Any:
    cyclic: list[Any] = []
    cyclic.append(cyclic)

    def nested(levels: int) -> Any:
        value: Any = 1
        for _ in range(levels):
            value = {"a": value}
        return value

    values: list[Any] = [
        {"a": [1, 2.5, None, True, "x"]},
        {"a": "${b}"},
        {"a": "${run.dir}/x"},
        {"a": "x${run.dir}"},
        {"a": "${run.dir}${c}"},
        "${x}",
        {"${k}": 1},
        {1.5: 2},
        {"a": {None: 1}},
        {2: (1, "s")},
        {1, 2},
        {"a": {"b": np.float64(1)}},
        {"a": {"b": b"x"}},
        {"a": [[object]]},
        cyclic,
        nested(49),
        nested(50),
        nested(51),
        "${" + "x" * 99,
    ]
    rows: list[Any] = [building.MOST_VALUES, building.MOST_LEVELS]
    with mock.patch.object(building, "MOST_VALUES", 21):
        rows += [outcome(building.plain, [0] * size, "f.yaml") for size in (9, 10, 11)]
    for value in values:
        rows.append(outcome(building.plain, value, "f.yaml"))
        rows.append(outcome(building.plain, value, Path("f.yaml"), but="${run.dir}"))
    return rows


def renamed_classes() -> Any:
    old, new, other = "flame_mdm.task.MotionGeneration", "flame_mdm.task.GeneratorTask", "mine.Task"
    distilled = "flame_mdm.training.distillation.ConsistencyDistillation"
    rows = []
    for target, base in itertools.product(
        (old, new, other, distilled, None, 3), (None, "", "quickstart")
    ):
        config = {
            "task": {"x": 1, "_target_": target},
            "seed": 0,
            **({} if base is None else {"base": base}),
        }
        rows.append(building.renamed(config))
    return rows, building.renamed({"task": "x"}), building.renamed({})


def saved_configurations() -> Any:
    texts = [
        "run: {dir: r, name: 3}\na: ${run.dir}/x",
        "run: {}\na: x${run.dir}",
        "a: 1",
        "run: 3",
        "- 1",
        "",
        "run: {}\ntask: {_target_: flame_mdm.task.MotionGeneration}\nbase: x",
    ]
    with workspace():
        rows = []
        for text in texts:
            Path("c.yaml").write_text(text)
            rows.append(outcome(building.read_saved, Path("c.yaml")))
        for head in ((), ("A run.",)):
            building.save(
                {"b": [1, {"x": None}], "a": "${run.dir}/y", "c": 1e-5}, Path("s.yaml"), *head
            )
            rows.append(Path("s.yaml").read_text())
        return rows


def moved_paths() -> Any:
    folders = {"/a/b": "X", "/a": "Y", "r": "${run.dir}"}
    values = [
        "/a/b",
        "/a/b/c",
        "/a/bc",
        "/a",
        "/a/",
        "r",
        "r/x",
        "rx",
        "x/r",
        "",
        3,
        None,
        ["/a"],
        {"/a": "/a/b/q"},
    ]
    config = {
        "run": {"dir": "/runs/q", "name": "/runs/q"},
        "x": "/runs/q/y",
        "z": {"w": "/runs/q", "v": "/runs/qq"},
        "l": ["/runs/q"],
        "n": 3,
    }
    flat = [{}, {"a": {}}, {"a": {"b": {"c": 1, "d": [1, {"x": 2}]}, "e": None}, "f": 2}, 3]
    return [
        [building.moved(value, folders) for value in values],
        building.movable(config),
        [building.flatten(value) for value in flat],
        building.flatten({"a": {"b": 1}}, "p"),
    ]


def instances() -> Any:
    rows: list[Any] = []
    nodes: list[Any] = [
        {"_target_": "collections.Counter", "a": 2, "b": [1, (2,)]},
        {
            "_target_": "builtins.dict",
            "x": {"_target_": "builtins.dict", "y": 1},
            "l": [{"_target_": "builtins.list"}],
        },
        {
            "_target_": "builtins.dict",
            "_recursive_": False,
            "x": {"_target_": "builtins.list", "y": [1]},
        },
        {
            "_target_": "builtins.dict",
            "_recursive_": True,
            "m": {"q": ({"_target_": "builtins.list"},)},
        },
        {"a": 1},
        {"_target_": 3},
        [1],
        {"_target_": "fractions.Fraction", "numerator": 3, "denominator": 0},
        {"_target_": "fractions.Fraction", "nume": 3},
        {"_target_": "flame_mdm.none.X"},
        {"_target_": "plain"},
        {"_target_": "flame_mdm.sampler_options.SamplerOptions", "eta": 3},
    ]
    for node in nodes:
        rows.append(outcome(building.instantiate, node))
    crop = {"_target_": "flame_mdm.sampler_options.SamplerOptions", "eta": 0.5, "sampler": "ddim"}
    rows += [
        building.instantiate(crop, {"eta": 0.25, "other": 3}).chosen(),
        building.instantiate(crop, {}, eta=0.125).chosen(),
        building.instantiate(crop, {"eta": 0.75}, eta=0.125).chosen(),
        building.instantiate(crop, {"other": 3}, spacing="stride").chosen(),
        outcome(building.instantiate, crop, None, other=1),
        outcome(building.instantiate, {"_target_": "pathlib.Path.open"}),
        building.instantiate(
            {"_target_": "flame_mdm.config.options.option", "default": 1, "help": "h"}
        ).metadata,
        outcome(
            building.instantiate,
            {"_target_": "flame_mdm.checkpoints.locating.find", "source": "gone.ckpt"},
        ),
    ]
    node = {"_target_": "builtins.dict", "_recursive_": False, "x": [1]}
    building.instantiate(node)["x"].append(2)
    return [str(row) for row in rows], node


def trusted_configurations() -> Any:
    rows: list[Any] = []
    targets = (
        "flame_mdm.task.GeneratorTask",
        "flame_mdm.training.adaptation.AdaptationTask",
        "torch.optim.AdamW",
        "torch.optim.adamw.AdamW",
        "flame_mdm.denoisers.mdm.MDMEncoder",
        "flame_mdm.denoisers.MDMEncoder",
        "flame_mdm.denoisers.mdm.ceil_div",
        "os.system",
        "mine.Net",
        "flame_mdm.safe_io.write_text",
        "",
        "flame_mdm.processes.diffusion.Diffusion",
        "flame_mdm.processes.Diffusion",
        "flame_mdm.denoisersx.X",
        3,
        None,
        "flame_mdm.conditions.clip.CLIPTokens",
        "flame_mdm.representations.smpl.SMPL",
        "flame_mdm.task.Tensor",
    )
    for part, target in itertools.product(
        ("task", "denoiser", "optimizer", "process", "other"), targets
    ):
        rows.append([part, target, outcome(building.trust, {part: {"_target_": target}})])
    for value in ("mine", "a, mine ,b", " , ", "mined"):
        with mock.patch.dict(os.environ, {"FLAME_MDM_TRUST": value}):
            rows.append(outcome(building.trust, {"task": {"_target_": "mine.Net"}}))
            rows.append(outcome(building.trust, {"x": [{"_target_": "os.system"}]}, "the file"))
    rows.append(
        outcome(
            building.trust,
            {"denoiser": {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder", "latent": 1}},
        )
    )
    rows.append(outcome(building.trust, {"_target_": "flame_mdm.task.GeneratorTask"}))
    shipped = building.__dict__["_shipped"]
    rows += [
        [part, sorted(shipped(part))] for part in (*building.MODULES, "logger", "launch", "none")
    ]
    return rows


KINDS = (
    "int",
    "float",
    "bool",
    "str",
    "None",
    "int | None",
    "str | int | float",
    "list[str]",
    "Sequence[int | None]",
    "tuple[float, float]",
    "tuple[int, ...]",
    "Literal['a', 'b', 1]",
    "Literal['a']",
    "dict[str, Any]",
    "Mapping[str, int]",
    "Optional[int]",
    "Union[str, list[int]]",
    "Tensor | float",
    "Tensor",
    "Any",
    "",
    "'int | str'",
    "torch.Tensor",
    "Tuple[int, str]",
    "List[list[int]]",
    "Metric",
    "nn.Module | None",
    "int | Sequence[int]",
    "tuple[Tensor | int, bool]",
    "Callable[[int], int]",
    "lowercase",
    "typing.Literal['x']",
    "tuple[int]",
    "T | bool",
)
VALUES: tuple[Any, ...] = (
    1,
    1.5,
    True,
    "a",
    "x",
    None,
    [1, 2],
    ["a"],
    [1.5, 2.5],
    [1, None],
    [],
    [1, "a"],
    {"a": 1},
    {"_target_": "x"},
    float("nan"),
    float("inf"),
    [[1], [2, "b"]],
    (1, 2.5, 3),
    [1, True],
    [float("nan"), 1.0],
    0,
    "",
)


def kinds_of_values() -> Any:
    return {
        kind: [
            str(outcome(signatures.check_kind, "k", value, kind)).removeprefix("UserError: ")
            for value in VALUES
        ]
        for kind in KINDS
    }


SOURCE = """
from dataclasses import dataclass
from fractions import Fraction as Ratio
from pathlib import *
if True:
    def inside(a: int, /, b, *, c: "str" = "x", **others): ...
try:
    class InTry: ...
except ImportError:
    class InExcept:
        def __init__(self, q): ...
with open("x") as f:
    def in_with(): ...
class Base:
    def other(self, no): ...
    def __init__(self, first: int, second: float = 1.0): ...
class Passing(Base):
    def __init__(self, third, **kwargs): ...
class Plain(Base): ...
class Closed(Base):
    def __init__(self, only: str): ...
class Generic(Passing[int]): ...
class Two(Plain, Closed): ...
class Loop(Loop): ...
@dataclass(frozen=True)
class Data(Base):
    x: int
    y: list[str] = None
class NotData:
    x: int
def outer():
    def nested(): ...
async def waits(a): ...
"""


def signatures_of_sources() -> Any:
    with workspace() as folder, mock.patch.object(sys, "path", [str(folder), *sys.path]):
        Path("recorded_own").mkdir()
        Path("recorded_own/__init__.py").write_text(
            "from .deep import Plain as Again\nfrom . import deep\nfrom .ring import R"
        )
        Path("recorded_own/deep.py").write_text(SOURCE)
        Path("recorded_own/ring.py").write_text(
            "from . import R\nfrom .ring import S\nfrom ..x import T"
        )
        Path("recorded_broken.py").write_text("def x(:")
        rows: list[Any] = []
        for name in (
            "inside",
            "InTry",
            "InExcept",
            "in_with",
            "Base",
            "Passing",
            "Plain",
            "Closed",
            "Generic",
            "Two",
            "Loop",
            "Data",
            "NotData",
            "nested",
            "outer",
            "waits",
            "Ratio",
            "Path",
            "none",
        ):
            rows.append([name, outcome(signatures.parameters, f"recorded_own.deep.{name}")])
            rows.append(outcome(signatures.__dict__["_signature"], f"recorded_own.deep.{name}"))
        for name in ("Again", "R", "deep"):
            rows.append(outcome(signatures.parameters, f"recorded_own.{name}"))
        for name in (
            "recorded_own.ring.S",
            "recorded_broken.x",
            "recorded_none.x",
            "x",
            "",
            "../etc.x",
            "recorded_own.none.y",
        ):
            rows.append(str(outcome(signatures.parameters, name)).partition("Python: ")[0])
        for name in (
            "recorded_own",
            "recorded_own.deep",
            "a/b",
            "recorded_gone",
            "flame_mdm.config",
            "1x",
            "",
        ):
            source = signatures.source_file(name)
            rows.append(source and f"{source.parent.name}/{source.name}")
        definition = signatures.definition("recorded_own", "Again")
        rows.append(definition and definition[0])
        return without(folder, rows)


def checked_configurations() -> Any:
    net = {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder"}
    configs: list[Any] = [
        {"denoiser": net},
        {"denoiser": net | {"latent_dim": 8}},
        {"denoiser": net | {"latent_dim": "8"}},
        {"denoiser": net | {"latnt_dim": 8}},
        {"denoiser": net | {"_x": 8}},
        {"denoiser": {"_target_": None}},
        {"a": {"b": [net, net | {"layers": 1}]}},
        {"denoiser": {"_target_": "flame_mdm.none.X"}},
        {"d": {"_target_": "gone_package.X"}},
        {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder", "q": 1},
        net | {"dropout": None},
    ]
    return [outcome(signatures.check, config) for config in configs]


def checked_top_levels() -> Any:
    generation = {"_target_": "flame_mdm.task.GeneratorTask"}
    configs: list[dict[str, Any]] = [
        {},
        {"seed": 1.5},
        {"seed": True},
        {"run": {"name": 3, "dir": 4}},
        {"run": {"speed": None}},
        {"run": 3},
        {"callbacks": None},
        {"losses": None},
        {"losses": None, "task": generation},
        {"losses": None, "task": None},
        {"losses": {"joints": 1.0}},
        {"losses": {"joint": 1.0}},
        {"losses": {"feet": [1]}},
        {"losses": {"joints": "x"}},
        {"ema": {"decay": 0.5}},
        {"ema": {"decays": 1}},
        {"ema": {"decay": None}},
        {"ema": 3},
        {"lr_warmup": 1.5},
        {"lr_decay": 1},
        {"logger": None, "experiment": None},
        {"sed": 1},
        {"callback": {}},
        {"my_own": 1},
        {"initial_weight": 1},
        {"losses": None, "task": {"_target_": "flame_mdm.metrics.x"}},
        {"data_root": 3},
        {"ema": {}},
    ]
    return [outcome(signatures.check_top_level, config) for config in configs]


def kinds_that_stay_the_same() -> Any:
    base: dict[str, Any] = {
        "a": 1,
        "b": "x",
        "c": {"d": 1.5, "e": None},
        "part": {"_target_": "x", "k": 1, "deep": {"z": 1}},
        "callbacks": {"s": {"_target_": "y"}, "n": 3},
        "l": [1],
        "flag": True,
        "run": {"q": 1},
        "losses": {"j": 0.5},
        "outer": {"inner": {"v": 2, "_target_": "p"}},
    }
    changes: list[dict[str, Any]] = [
        {},
        {"a": 1.5},
        {"a": "1"},
        {"a": True},
        {"b": 3},
        {"b": 2.5},
        {"b": True},
        {"b": None},
        {"c": None},
        {"c": 3},
        {"c": {"d": 1}},
        {"c": {"d": 1, "e": [1]}},
        {"c": {"e": 1}},
        {"part": {"_target_": "x"}},
        {"part": None},
        {"part": {"k": "s"}},
        {"callbacks": None},
        {"callbacks": {"n": 3}},
        {"callbacks": {"s": None}},
        {"l": 3},
        {"flag": 1},
        {"run": None},
        {"losses": None},
        {"losses": 3},
        {"outer": {"inner": {"v": "x"}}},
        {"outer": {}},
        {"outer": {"inner": 2}},
    ]
    rows = [outcome(signatures.check_same_kinds, base, base | change) for change in changes]
    for name in base:
        lacking = {key: value for key, value in base.items() if key != name}
        rows += [
            outcome(signatures.check_same_kinds, base, lacking),
            outcome(signatures.check_same_kinds, base, lacking, "callbacks."),
        ]
        rows.append(
            outcome(
                signatures.check_same_kinds,
                base | {"_target_": "x"},
                lacking | {"_target_": "y"},
                "p.",
            )
        )
    return rows


def unknown_keys() -> Any:
    config = {
        "denoiser": {
            "_target_": "flame_mdm.denoisers.mdm.MDMEncoder",
            "latent_dim": 1,
            "num_heads": 1,
        },
        "optimizer": {"lr": 1.0},
        "trainer": {"max_steps": 1, "limit": 2},
        "list": [{"depth": 1}],
    }
    rows = []
    for key in (
        "data.x",
        "datas.x",
        "denoiser.latent",
        "denoiser.dropot",
        "max_steps",
        "lr",
        "optimizer.lrr",
        "xyzzy",
        "list.0.dept",
        "trainer.max_step.x",
        "a.depth",
        "data",
        "denoiser.latent_dim",
        "num_head",
    ):
        parts = key.split(".")
        for depth in range(len(parts)):
            node: Any = config
            for part in parts[:depth]:
                node = node.get(part, 3) if isinstance(node, dict) else node
            rows.append([key, depth, signatures.unknown_key(config, parts, depth, node)])
    return rows, [["/".join(path), list(node)] for path, node in signatures.walk(config)]


# Recipes -----------------------------------------------------------------------------------------


def names_of_recipes() -> Any:
    parts = {group: composition.__dict__["_options"](group) for group in composition.groups()}
    return composition.groups(), composition.recipes(), parts


def quoted_and_parsed_words() -> Any:
    words = [
        "a=b",
        "a=it's",
        "a=x\\",
        "a=\\'q",
        "a=${x}",
        "a=\\\\'",
        "a=",
        "a",
        "a=b=c",
        "k.l=ü ' \\ ${",
    ]
    quoted = [composition.quoted(word) for word in words]
    rows: list[Any] = [quoted, [composition.parse([word])[0].value() for word in quoted]]
    for line in (
        "a=1,2",
        "a=1",
        "seed=range(1,4)",
        "denoiser=glob(mdm_*_small)",
        "denoiser=glob(zz*)",
        "a=[1,2]",
        "~a",
        "+b=2,3",
        "denoiser=glob(*,exclude=[m*,d*])",
        "++c=x",
        "a=choice(x,y)",
        "a=null",
    ):
        override = composition.parse([line])[0]
        rows.append([line, composition.choices(override), composition.first_choice(override)])
    for line in (["a b"], ["=x"], ["a=[1"], ["a=1", "b={"], []):
        rows.append(str(outcome(composition.parse, line))[:160])
    return rows


def composed_recipes() -> Any:
    rows: list[Any] = []
    for name, *words in (
        ("humanml3d/mfm",),
        ("synthetic/dip", "denoiser=dip", "ema=null"),
        (
            "quickstart",
            "condition=none",
            "denoiser.latent_dim=8",
            "denoiser.dropout=0.5",
            "~callbacks.best",
            "optimizer.lr=1e-3",
            "seed=3",
            "++losses.joints=1.5",
            "lr_decay=0.25",
            "data.num_workers=0",
            "run.name=a",
        ),
    ):
        with mock.patch.dict(os.environ, {}):
            os.environ.pop("FLAME_MDM_DATA", None)
            rows.append(
                outcome(lambda n, w: building.flatten(composition.compose(n, w)), name, words)
            )
    for name, words in (
        ("quickstat", []),
        ("gone.yaml", []),
        ("quickstart", ["denoiser=mdm"]),
        ("quickstart", ["denoiser.latnt_dim=3"]),
        ("quickstart", ["seed=x"]),
        ("quickstart", ["launch=slurmy"]),
        ("quickstart", ["callbacks.samples.prompts.0=x"]),
        ("quickstart", ["a"]),
        ("quickstart", ["~seed"]),
        ("quickstart", ["xyz=1"]),
        ("quickstart", ["callbacks=null"]),
        ("quickstart", ["data.sourc.clips=3"]),
        ("quickstart", ["~denoiser"]),
    ):
        config = outcome(composition.compose, name, words)
        rows.append(config if isinstance(config, str) else len(building.flatten(config)))
    rows.append(composition.compose_data("synthetic"))
    rows.append(composition.compose_data("folder", ["data.source.path=x"], data_root="it's"))
    rows.append(outcome(composition.compose_data, "synthetics"))
    return rows


def prepared_overrides() -> Any:
    source = composition.find_recipe("quickstart")
    rows: list[Any] = [list(source)[1:]]
    for words in (
        [],
        ["seed=3"],
        ["denoiser=mdm_encoder,mdm_gru", "denoiser.latent_dim=1,2"],
        ["denoiser.dropout=0.5"],
        ["hydra.x=1"],
        ["++a.b=1", "~ema", "+c=2"],
        ["trainer.limit_val_batches=2", "callbacks.samples.prompts.0=x"],
    ):
        prepared = outcome(composition.prepare_overrides, source, words)
        rows.append(prepared if isinstance(prepared, str) else [prepared[0], len(prepared[1])])
    rows.append(composition.prepare_overrides(source, [], ["first=1"])[0])
    return rows


def own_recipes() -> Any:
    texts = {
        "saved.yaml": "run: {dir: r}\nseed: 0\na: ${run.dir}/x\ntask: {_target_: flame_mdm.task.MotionGeneration}",
        "bad.yml": "a: ${oc.env:HOME}",
        "list.yaml": "- 1",
        "missing.yaml": "a: ???\nrun: {}",
        "ring.yaml": "a: ${b}\nb: ${a}\ndefaults: []",
    }
    with workspace() as folder:
        rows: list[Any] = []
        for name, text in texts.items():
            Path(name).write_text(text)
            rows.append([name, outcome(composition.find_recipe, name)])
            rows.append(outcome(composition.compose, name))
            for words in (["seed=1"], ["denoiser=mdm_encoder"], ["launch=local"], ["task.x=1"]):
                rows.append([words, outcome(composition.compose, name, words)])
        return without(folder, rows)


# Command lines -----------------------------------------------------------------------------------


def _positive(key: str, value: Any) -> None:
    if value <= 0:
        raise errors.UserError(f"{key}={value}: must be positive")


@dataclass
class Base:
    """Settings of several commands."""

    seed: int = options.option(0, "the seed")
    shared: bool = options.option(True, "whether it is shared")


@dataclass(kw_only=True)
class Command(Base):
    """usage: command OBJECT NAMES [key=value ...]

    Does nothing.
    """

    OBJECTS = ("source", "names")
    SWEEPS = True
    COMPOSED = ("denoiser", "--flag")

    source: str = options.required("what to read, " + "a long text that is wrapped " * 6)
    names: list[str] = options.option(list, "some names")
    size: float | None = options.option(None, "a size", _positive)
    steps: int | list[int] | None = options.option(3, "steps", lambda k, v: None)
    text: str | None = options.option("a b", "any text")
    out: str | None = options.option(None, "where to write")
    composed: tuple[str, ...] = ()
    hidden: int = 5


@dataclass
class Simple:
    """usage: simple"""

    size: int = options.same_option(Command, "steps", _positive)
    other: float = options.same_option(Command, "size", default=2.5)
    listed: list[str] = options.option(lambda: ["a", "b"], "a list")


LINES = [
    ["x"],
    [],
    ["x", "a", "b c"],
    ["x", "names=a 'b c'"],
    ["source=x"],
    ["x", "source=y"],
    ["x", "a", "names=b"],
    ["x", "size=2.5"],
    ["x", "size=0"],
    ["x", "size=null"],
    ["x", "size=abc"],
    ["x", "steps=[1,2]"],
    ["x", "steps=1,2"],
    ["x", "steps=x"],
    ["x", "text=null"],
    ["x", "text=it's, [a"],
    ["x", "names="],
    ["x", "names='a"],
    ["x", "names=a ''"],
    ["x", "-v"],
    ["x", "--flag"],
    ["x", "=3"],
    ["x", "seed=1", "late"],
    ["x", "sed=1"],
    ["x", "hidden=1"],
    ["x", "a.b=1"],
    ["x", "denoiser=mdm_gru"],
    ["x", "shared=false"],
    ["x", "shared=1"],
    ["x", "seed=null"],
    ["x", "seed=1.5"],
    ["x", "composed=1"],
    ["x=1"],
    ["here/a=b", "n"],
    ["source=null"],
    ["x", "size=nan"],
    ["x", "text="],
    ["x", "names=[a,b]"],
]


def settings_of_command_lines() -> Any:
    rows: list[Any] = []
    with workspace():
        Path("here").mkdir()
        Path("here/a=b").write_text("")
        for line, kind in itertools.product(LINES, (Command, Simple)):
            rows.append(outcome(command_line.checked_settings, kind, line))
        for line in (
            ["size=4", "listed=q r"],
            ["size=-1"],
            ["size=1,2"],
            ["other=3"],
            ["other=null"],
            [],
        ):
            rows.append(outcome(command_line.checked_settings, Simple, line))
            rows.append(outcome(command_line.read_settings, Simple, line))
        rows += [
            command_line.is_text(Command, key)
            for key in ("source", "text", "size", "names", "none")
        ]
        rows += [command_line.__dict__["_help"](kind) for kind in (Command, Simple, Base)]
        rows.append(command_line.with_keys(Simple, ["a", "b=1", "c"]))
        return rows


def runs_of_commands() -> Any:
    def act(settings: Any) -> None:
        actions: dict[str, BaseException] = {
            "user": errors.UserError("x:\ny\nz"),
            "bug": ValueError("bug"),
            "exit": SystemExit(7),
            "none": SystemExit(),
            "stop": KeyboardInterrupt(),
            "memory": MemoryError(),
            "torch": RuntimeError("DefaultCPUAllocator: can't allocate memory"),
            "gone": FileNotFoundError("no file"),
            "os": OSError(2, "No such", "f"),
            "full": OSError(errno.ENOSPC, "full"),
            "bare": OSError("odd"),
        }
        errors.say(f"acts on {settings.source}")
        if settings.source in actions:
            raise actions[settings.source]

    rows: list[Any] = []
    names = (
        "fine",
        "user",
        "bug",
        "exit",
        "none",
        "stop",
        "memory",
        "torch",
        "gone",
        "os",
        "full",
        "bare",
    )
    for name, trace in itertools.product(names, ("0", "1")):
        with mock.patch.dict(os.environ, {"FLAME_MDM_TRACEBACK": trace}):
            code, out, err = printed(command_line.run, act, Command, [name])
        rows.append([name, code, out, err.startswith("Traceback"), err.strip().rpartition("\n")[2]])
    for line in (["x", "--help"], ["-h"], ["seed=x"]):
        rows.append(printed(command_line.run, act, Command, line))
    with mock.patch.dict(os.environ, {"MAKEFLAGS": " -- SEED=4 EXP=made"}):
        rows.append(printed(command_line.run, act, Command, ["--from-make"]))
    for text in (
        "out of memory",
        "std::bad_alloc",
        "can't start new thread",
        "could not create a primitive",
        "failed to map segment",
        "x",
    ):
        rows.append(outcome(command_line.explanation, RuntimeError(f"{text} z")))
    return rows


def variables_of_make() -> Any:
    flags = [
        "",
        "k",
        "k -- EXP=q SEED=3",
        " -- out=a\\ b EXP=x",
        "k -- B=1 A=2 EXP=e",
        " -- P=$$HOME Mixed=3 PYTHON=p VENV=v",
        "-- X=1",
        "w -- a=x\\\\y -- b=2",
    ]
    rows = []
    for value in flags:
        with mock.patch.dict(os.environ, {"MAKEFLAGS": value}):
            rows.append(command_line.make_variables())
    return rows


def sweeps_of_commands() -> Any:
    def act(settings: Any) -> None:
        errors.say(
            f"{settings.source} {settings.seed} {settings.steps} {settings.text} {settings.composed}"
        )
        if settings.seed == 5:
            raise errors.UserError("five")
        if settings.seed == 9:
            raise SystemExit(143)

    lines = [
        ["x", "seed=1"],
        ["x", "seed=1,2", "-m"],
        ["x", "seed=1,2"],
        ["x,y", "seed=1,5,3", "--multirun"],
        ["x", "seed=1,9,3", "-m"],
        ["x", "seed=1,2", "steps=3,4", "text=a,b", "-m"],
        ["x", "seed=1,2", "out=o", "-m"],
        ["x", "seed=1", "out=o", "-m"],
        ["x", "seed=1,z", "-m"],
        ["x", "denoiser=glob(mdm_gru*)", "-m"],
        ["-h", "-m"],
        ["x", "late", "word", "-m"],
        ["x", "seed=range(1,4)", "a.b=1,2", "-m"],
        ["x", "launch=none"],
        ["x", "seed=1,2", "hydra.x=1", "launch=slurmy"],
    ]
    with workspace():
        return [printed(jobs.run_jobs, act, Command, line) for line in lines]


def command_lines_of_training() -> Any:
    configs: list[Any] = []

    def train(config: Any) -> None:
        configs.append(
            [
                config["seed"],
                config["run"],
                config["denoiser"].get("latent_dim"),
                list(sys.argv[1:]),
            ]
        )
        if config["seed"] == 5:
            raise errors.UserError("five")

    lines = [
        [],
        ["-h"],
        ["quickstart"],
        ["quickstart", "seed=3"],
        ["quickstart", "seed=1,2"],
        ["seed=3"],
        ["-m"],
        ["quickstart", "-x"],
        ["quickstart", "seed=5"],
        ["quickstart", "seed=-1"],
        ["quickstart", "seed=4294967296"],
        ["quickstart", "denoiser.latent_dim=-8"],
        ["quickstart", "trainer.log_every_n_steps=0"],
        ["quickstart", "trainer.val_check_interval=0.5"],
        ["quickstart", "trainer.accumulate_grad_batches=-1"],
        ["quickstart", "launch=local", "trainer.devices=2"],
        ["quickstart", "run.dir="],
        ["quickstart", "seed=7", "denoiser=mdm_gru", "run.name=z"],
        ["quickstart", "launch=slurm"],
    ]
    rows: list[Any] = []
    with (
        workspace() as folder,
        mock.patch.object(sys, "argv", ["program"]),
        mock.patch("shutil.which", return_value=None),
    ):
        for line in lines:
            configs.clear()
            rows.append(
                [line, printed(sweeps.run_recipe, train, "\nusage: train\n", line), list(configs)]
            )
        return without(folder, rows)


def incomplete_recipes() -> Any:
    whole: dict[str, Any] = {
        "experiment": "e",
        "seed": 0,
        "ema": None,
        "logger": None,
        "run": {"dir": "r"},
        "callbacks": {},
        "trainer": {"_target_": "t", "max_steps": 1},
        **{part: {"_target_": "t"} for part in ("data", "representation", "task", "optimizer")},
    }
    check_whole = sweeps.__dict__["_check_whole"]
    rows = [
        outcome(check_whole, {k: v for k, v in whole.items() if k != name}, "n") for name in whole
    ]
    changes: list[dict[str, Any]] = [
        {},
        {"run": {}},
        {"run": {"dir": ""}},
        {"trainer": {"_target_": "t"}},
        {"trainer": {"max_steps": 1}},
        {"task": {}},
        {"denoiser": None},
        {"process": {}},
        {"condition": 3},
        {"denoiser": {"_target_": "t", "a": -1}},
        {"denoiser": {"_target_": "t", "a": -0.5, "b": 0}},
        {"seed": -1},
        {"seed": 2**32},
        {"seed": 2**32 - 1},
        {"seed": "x"},
        {"x": "${y}"},
        {"callbacks": None},
    ]
    for key, value in itertools.product(sweeps.LATE, (0, -1, 0.5, 1, None, "x")):
        changes.append({"trainer": {**whole["trainer"], key: value}})
    return rows + [outcome(check_whole, whole | change, "n") for change in changes]


def fields_of_options() -> Any:
    @dataclass
    class Kind:
        a: int = options.option(1, "ha", _positive)
        b: list[int] = options.option(list, "hb")
        c: int = field(default=3)

    rows: list[Any] = []
    for kind in (Kind, Command, Simple):
        for name, entry in kind.__dataclass_fields__.items():
            rows.append(
                [
                    name,
                    str(entry.default)[:40],
                    callable(entry.default_factory),
                    entry.metadata.get("help"),
                    entry.metadata.get("check") is not None,
                ]
            )
    return rows


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
