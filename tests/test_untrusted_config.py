"""Configurations out of somebody else's files: no code runs, nothing leaks, and absurd content is one line."""

import io
import json
import os
import pickle
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from support.fixtures import ROOT
from support.refusals import one_line
from support.runs import TINY

from evaluators.protocol import load_protocol
from flame_mdm.checkpoints.hub import card, export
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.model_files import KEY, content_sha256, read_checkpoint, read_model_file
from flame_mdm.config import compose, instantiate, parameters, plain
from flame_mdm.errors import UserError

pytestmark = pytest.mark.slow

TEXT = "text=a person walks"


def exploit(marker: Path) -> str:
    """An interpolation that makes a file when it is resolved."""
    python = f"__import__('pathlib').Path('{marker}').touch() or 128"
    return f'${{oc.create:{{_target_: builtins.int, _args_: [{{_target_: sympy.sympify, a: "{python}"}}]}}}}'


def change(content: Any, key: str, value: Any) -> Any:
    """A copy with another value at a dotted key."""
    name, _, rest = key.partition(".")
    return {**content, name: change(content[name], rest, value) if rest else value}


@pytest.fixture
def changed(trained, bad) -> Callable[..., Path]:
    """Writes the checkpoint with other content; returns its path."""

    def write(name: str = "bad.ckpt", **values: Any) -> Path:
        content = read_checkpoint(trained)
        for key, value in values.items():
            content = change(content, key.replace("__", "."), value)
        torch.save(content, bad / name)
        return bad / name

    return write


def model_file(path: Path, trained: Path, text: str | None = None, **recipe: Any) -> Path:
    """A model file with other content in its metadata, and a right checksum."""
    file = export(trained, path)
    whole = file.read_bytes()
    size = int.from_bytes(whole[:8], "little")
    head = json.loads(whole[8 : 8 + size])
    content = json.loads(head["__metadata__"][KEY])
    for key, value in recipe.items():
        content = change(content, key.replace("__", "."), value)
    text = json.dumps(content) if text is None else text
    head["__metadata__"] |= {KEY: text, "sha256": content_sha256(text, load_file(file))}
    data = json.dumps(head).encode()
    file.write_bytes(len(data).to_bytes(8, "little") + data + whole[8 + size :])
    return file


# Code and environment -------------------------------------------------------------------------------------------------


def test_interpolations_in_models_are_refused(attacked, trained, changed, bad, tmp_path):
    marker = tmp_path / "owned"
    for number, key in enumerate(
        (
            "config__denoiser__latent_dim",
            "config__data__batch_size",
            "config__callbacks__x",
            "config__experiment",
            "facts__dataset",
        )
    ):
        values = (exploit(marker), [{"a": exploit(marker)}], {exploit(marker): 1}, "x${oc.env:HOME}")
        for value in values if number == 1 else values[:1]:
            path = changed(**{key: value})
            attacked("sample", f"ckpt={path}", TEXT, says="holds an interpolation")
            if number == 0:
                attacked("evaluate", f"ckpt={path}", "extractor=none", "quick=true", says="holds an interpolation")
                attacked("evaluate", f"ckpt={trained}", f"extractor={path}", "quick=true", says="interpolation")
                attacked("push", str(path), "a/b", "dry_run=true", says="holds an interpolation")
                np.savez("x.npz", joints=np.zeros((5, 22, 3)), fps=20.0)
                attacked("edit", f"ckpt={path}", "motion=x.npz", TEXT, says="holds an interpolation")
                Path("x.npz").unlink()
    path = model_file(bad / "x.safetensors", trained, config__denoiser__latent_dim=exploit(marker))
    attacked("sample", f"ckpt={path}", TEXT, says="holds an interpolation")
    attacked("sample", f"ckpt={bad}", TEXT, says="holds an interpolation")
    attacked("export", str(path), "out=out", says="holds an interpolation")
    assert not marker.exists()


def test_parts_are_built_without_resolving_anything(tmp_path):
    node = {"_target_": "builtins.dict", "a": exploit(tmp_path / "owned"), "b": ["${oc.env:HOME}"]}
    assert instantiate({"_target_": "collections.OrderedDict", "x": {"y": "${z}"}}) == {"x": {"y": "${z}"}}
    assert instantiate(node) == {"a": node["a"], "b": node["b"]}
    assert not (tmp_path / "owned").exists()


def test_parts_are_built_as_hydra_builds_them():
    inner = {"_target_": "fractions.Fraction", "numerator": 3}
    assert instantiate({"_target_": "builtins.dict", "a": [inner], "b": {"c": inner}}) == {"a": [3], "b": {"c": 3}}
    kept = instantiate({"_target_": "builtins.dict", "_recursive_": False, "a": inner})
    assert kept == {"a": inner}
    assert kept["a"] is not inner
    for key in ("_args_", "_partial_", "_convert_"):
        with pytest.raises(UserError, match=key):
            instantiate({"_target_": "fractions.Fraction", key: [3, 4]})
    assert instantiate({"_target_": "builtins.dict", "a": {"_target_": "no.such"}}, a=1) == {"a": 1}
    for node in ({}, {"_target_": 3}, {"_target_": "os.none"}, {"_target_": "x"}, {"_target_": ""}):
        with pytest.raises(UserError):
            instantiate(node)


@pytest.mark.parametrize("frozen", [True, False])
def test_text_encoders_of_models_run_no_code(attacked, bad, trained, monkeypatch, frozen):
    """Neither a package that is imported to look for a part of it, nor code beside a language model."""
    here = Path()
    for name in ("evil_package", "evil"):
        Path(f"{name}.py").write_text("import pathlib\npathlib.Path('RAN').touch()\nclass Cfg: pass\n")
    (here / "lm").mkdir()
    Path("lm/config.json").write_text('{"auto_map": {"AutoConfig": "evil.Cfg"}, "model_type": "zzz"}')
    Path("evil.py").replace("lm/evil.py")
    monkeypatch.syspath_prepend(str(here.resolve()))
    monkeypatch.setattr("sys.stdin", io.StringIO("y\ny\ny\n"))
    whole = read_checkpoint(trained)
    text = {"_target_": "flame_mdm.conditions.text.PretrainedText", "model": "lm", "features": 16, "max_tokens": 8}
    text |= {"pooling": "mean", "freeze": frozen}
    for more in ({"package": "evil_package.x", "sha256": "0"}, {}):
        path = bad / "model.ckpt"
        torch.save(whole | {"config": whole["config"] | {"condition": text | more}}, path)
        attacked("sample", f"ckpt={path}", TEXT)
        attacked("sample", f"ckpt={path}", "unconditioned=true")
        assert not Path("RAN").exists()


def test_plain_values():
    deep: Any = []
    for _ in range(100_000):
        deep = [deep]
    itself: list[Any] = [1]
    itself.extend([itself, itself])
    for value in ({"a": {"b": "x${c}"}}, {"${a}": 1}, {"a": [b"x"]}, {"a": {(1,): 2}}, {"a": deep}, {"a": itself}):
        with pytest.raises(UserError, match="the file"):
            plain(value, "the file")
    with pytest.raises(UserError, match=r"\$\{oc"):
        plain({"a": "${run.dir}${oc.env:HOME}"}, "x", but="${run.dir}")
    plain({"a": "${run.dir}/b", "c": [1, 1.5, None, True, "$", "{"]}, "x", but="${run.dir}")


def test_only_classes_at_the_top_of_a_module_are_found():
    with pytest.raises(UserError, match="no such class or function"):
        parameters("flame_mdm.task.part")
    with pytest.raises(UserError, match="no such class or function"):
        parameters("flame_mdm.task.generate")


def test_interpolations_in_saved_runs_are_refused(attacked, trained, bad, tmp_path):
    marker = tmp_path / "owned"
    whole = (trained.parent.parent / "config.yaml").read_text()
    assert "${run.dir}" in whole
    for line in (f"x: {json.dumps(exploit(marker))}", "x: ${oc.env:HOME}", "x: ${experiment}", "x: ${run.dir}${seed}"):
        (bad / "config.yaml").write_text(f"{whole}\n{line}\n")
        attacked("train", str(bad / "config.yaml"), says="config.yaml: x holds an interpolation")
        attacked("train", "quickstart", *TINY, f"run.dir={bad}", says="config.yaml: x holds an interpolation")
        attacked("report", str(bad), says="config.yaml: x holds an interpolation")
        attacked("compare", f"runs={bad} {trained.parent.parent}", says="config.yaml: x holds an interpolation")
    assert not marker.exists()


def test_a_saved_run_still_moves_with_its_folder(trained):
    saved = compose(str(trained.parent.parent / "config.yaml"), ["run.dir=elsewhere"])
    assert saved["callbacks"]["checkpoints"]["folder"] == "elsewhere/checkpoints"


def test_a_recipe_cannot_make_checkpoints_that_are_refused(attacked):
    attacked("train", "quickstart", r"run.dir='x\${a}'", says="holds an interpolation")


def test_protocols_know_the_representation_and_nothing_else(attacked, trained, bad, tmp_path):
    marker, model = tmp_path / "owned", load(trained)
    path = bad / "protocol.yaml"
    whole = (ROOT / "experiments/evaluation/synthetic.yaml").read_text()
    path.write_text(whole)
    protocol = load_protocol(str(path), model.representation)
    assert protocol.metrics["jitter"]["fps"] == model.representation.fps
    assert protocol.sha256 == load_protocol("synthetic", model.representation).sha256
    for value in (json.dumps(exploit(marker)), "${oc.env:HOME}", "${representation.name}", "x${representation.fps}"):
        path.write_text(f"{whole}\nsmoothing: {value}\n")
        attacked("evaluate", f"ckpt={trained}", f"protocol={path}", "extractor=none", says="holds an interpolation")
    assert not marker.exists()


def test_table_specs_hold_no_interpolations(attacked, bad):
    (bad / "table.yaml").write_text("title: ${oc.env:HOME}\n")
    attacked("tables", f"table={bad / 'table.yaml'}", says="table.yaml: title holds an interpolation")


# Sizes ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("process__num_train_timesteps", 10**9),
        ("denoiser__num_layers", 10**7),
        ("denoiser__num_layers", 90_000),
        ("denoiser__latent_dim", 10**7),
        ("denoiser__latent_dim", 60_000),
        ("denoiser__ff_size", 10**12),
        ("denoiser__ff_size", 99_999_999),
        ("condition__features", 60_000),
        ("task__num_inference_steps", 10**9),
    ],
)
def test_absurd_sizes(attacked, changed, key, value):
    path = changed(**{f"config__{key}": value})
    attacked("sample", f"ckpt={path}", TEXT, says=str(path))


def test_a_drawn_pooler_of_absurd_size(attacked, changed):
    text = {"_target_": "flame_mdm.conditions.text.PretrainedText", "model": "a/b", "features": 60_000}
    path = changed(config__condition=text | {"max_tokens": 5, "pooling": "pooler"})
    attacked("sample", f"ckpt={path}", TEXT, says="the weights do not match")


def test_absurd_facts_and_weights(attacked, trained, changed):
    attacked("sample", f"ckpt={changed(facts__max_frames=10**12)}", TEXT, says="max_frames")
    state = read_checkpoint(trained)["state_dict"]
    name = max(state, key=lambda name: state[name].numel())
    for value in (torch.zeros(1).expand(10**9, 10**9), torch.zeros(5, device="meta"), torch.zeros(3).to_sparse()):
        attacked("export", str(changed(state_dict=state | {name: value})), "out=x", says="its weights")


@pytest.mark.filterwarnings("ignore:torch.quantize")
@pytest.mark.parametrize("dtype", [torch.complex64, torch.float8_e4m3fn, torch.qint8])
def test_odd_kinds_of_numbers_are_refused(attacked, trained, changed, dtype):
    state = read_checkpoint(trained)["state_dict"]
    name = max(state, key=lambda name: state[name].numel())
    value = state[name].float()
    odd = torch.quantize_per_tensor(value, 0.1, 0, dtype) if dtype is torch.qint8 else value.to(dtype)
    path = changed(state_dict=state | {name: odd})
    attacked("export", str(path), "out=x", says="bad.ckpt: damaged")
    attacked("sample", f"ckpt={path}", TEXT, says=str(dtype) if dtype is not torch.qint8 else "bad.ckpt: damaged")


def test_weights_of_half_precision_are_read(trained, changed, bad):
    state = {name: value.bfloat16() for name, value in read_checkpoint(trained)["state_dict"].items()}
    state["representation.std"] = state["representation.std"].half()
    file = export(changed(state_dict=state), bad)
    assert load(file).denoiser.state_dict()["input.weight"].dtype == torch.float32


def test_incomplete_checkpoints(attacked, trained, changed, bad):
    whole = read_checkpoint(trained)
    for part, name in (("facts", "max_frames"), ("facts", "actions"), ("config", "experiment")):
        lacking = {key: value for key, value in whole[part].items() if key != name}
        torch.save(whole | {part: lacking}, bad / "bad.ckpt")
        attacked("export", str(bad / "bad.ckpt"), "out=x", says=f"bad.ckpt: damaged: {part} has no {name}")
        attacked("sample", f"ckpt={bad / 'bad.ckpt'}", TEXT, says=f"has no {name}")
    for value in (5, {"_target_": 5}, {}):
        path = changed(config__denoiser=value)
        attacked("push", str(path), "a/b", "dry_run=true", says="damaged: config.denoiser")
        attacked("export", str(path), "out=x", says="damaged: config.denoiser")
    best = changed("best.ckpt", config__callbacks={"best": 5})
    attacked("evaluate", f"ckpt={best}", "extractor=none", "quick=true", says="damaged: config.callbacks.best is 5")
    path = model_file(bad / "x.safetensors", trained, origin=None)
    attacked("push", str(path), "a/b", "dry_run=true", says="x.safetensors: damaged")


def test_facts_that_nobody_told(trained, changed):
    facts = read_checkpoint(trained)["facts"]
    path = changed(facts={name: value for name, value in facts.items() if name not in ("dataset", "fingerprint")})
    assert "| data | unknown |" in card(read_model_file(export(path, path.parent)), "a/b")


def test_files_that_are_no_files(attacked, trained, bad):
    (bad / "zero.ckpt").symlink_to("/dev/zero")
    (bad / "zero.safetensors").symlink_to("/dev/zero")
    os.mkfifo(bad / "pipe.ckpt")
    os.mkfifo(bad / "pipe.yaml")
    for name in ("zero.ckpt", "zero.safetensors", "pipe.ckpt"):
        attacked("sample", f"ckpt={bad / name}", TEXT, says="not a file")
        attacked("evaluate", f"ckpt={trained}", f"extractor={bad / name}", "quick=true", says="not a file")
        attacked("import", "flame", str(bad / name), "out=x", says="not a file")
        attacked("evaluate", f"ckpt={trained}", "extractor=none", f"protocol={bad / 'pipe.yaml'}", says="not a file")
        attacked("train", str(bad / "pipe.yaml"), says="pipe.yaml")
    attacked("sample", f"ckpt={bad}", TEXT, says="not a file")


def test_packed_checkpoints(attacked, trained, bad):
    path = bad / "bomb.ckpt"
    with zipfile.ZipFile(trained) as source, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
        for member in source.namelist():
            target.writestr(member, source.read(member))
        with target.open("archive/data/bomb", "w") as file:
            for _ in range(200):
                file.write(bytes(2**20))
    for words in (("sample", f"ckpt={path}", TEXT), ("import", "flame", str(path), "out=x")):
        attacked(*words, says="bomb.ckpt: damaged")


@pytest.mark.slow
def test_nested_pickles(attacked, bad):
    deep: Any = {}
    for _ in range(400):
        deep = {"a": deep}
    itself: list[Any] = []
    itself.extend([itself, itself])
    for number, config in enumerate((deep, {"a": itself})):
        path = bad / f"{number}.ckpt"
        torch.save({"config": config, "facts": {"actions": []}, "state_dict": {}}, path)
        attacked("sample", f"ckpt={path}", TEXT, says="nested too deeply")
    opened = pickle.dumps([], 2)[:-1]  # a list in a list in a list ...
    (bad / "raw.ckpt").write_bytes(opened[:2] + b"]" * 10**5 + b"a" * (10**5 - 1) + b".")
    attacked("sample", f"ckpt={bad / 'raw.ckpt'}", TEXT, says="raw.ckpt")


# Malformed values -----------------------------------------------------------------------------------------------------


ODD_VALUES = {
    "config__representation__fps": [0, float("nan"), float("inf"), "x", 1e-300, -5, None, [], True, "20"],
    "config__task__num_inference_steps": [None, 0, -1, "x", 1.5, True, ["x"], [0, 10**9], [0, True], [-1, 2]],
    "config__denoiser__num_heads": [True, "x", None, [2], {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder"}],
}


def test_odd_values_are_refused_when_a_model_is_loaded(changed):
    for key, values in ODD_VALUES.items():
        for value in values:
            with pytest.raises(UserError, match=key.rpartition("__")[2]):
                load(changed(**{key: value}))


@pytest.mark.parametrize("value", [[], [3], [3, 1], [0, 99_999]])
def test_odd_lists_of_sampling_steps(attacked, changed, value):
    attacked("sample", f"ckpt={changed(config__task__num_inference_steps=value)}", TEXT, says="sampling steps must be")


@pytest.mark.slow
def test_odd_recipes(attacked, trained, changed, bad):
    cases = [("config__" + part, value) for part in ("task", "denoiser", "process") for value in (None, 3, [], {})]
    cases += [("config__run", "x"), ("config__data_root", []), ("config__experiment", 3), ("facts__dataset", 3)]
    cases += [("config__representation", "x"), ("facts__actions", [1]), ("facts__fingerprint", [])]
    cases += [("facts__training", "x"), ("facts__training", {"hours": "x"})]
    for key, value in cases:
        path = changed(**{key: value})
        attacked("sample", f"ckpt={path}", TEXT, says="damaged")
    for value in (3, None, {"_target_": "evaluators.metrics.physics.Jitter", "fps": 20}):
        attacked("evaluate", f"ckpt={changed(config__data=value)}", "extractor=none", "quick=true")
    path = model_file(bad / "x.safetensors", trained, origin=[1])
    attacked("push", str(path), "a/b", "dry_run=true", says="origin")
    path = model_file(bad / "x.safetensors", trained, text='{"a":' * 100_000)
    attacked("sample", f"ckpt={path}", TEXT, says="x.safetensors: damaged")


def test_bombs_of_yaml(attacked, trained, bad):
    bombs = {
        "itself": "a: &x [*x]",
        "laughs": "a: &a [1,1,1,1,1,1,1,1,1]\n"
        + "\n".join(f"{b}: &{b} [{','.join([f'*{a}'] * 9)}]" for a, b in zip("abcdefgh", "bcdefghi", strict=True)),
        "deep": "a: " + "[" * 50_000,
        "half a character": 'a: "\\ud800"',
        "digits": f"{10**20}: x",
        "long": "a: [" + "1," * 2**17 + "]",
    }
    for name, text in bombs.items():
        folder = bad / name
        folder.mkdir()
        (folder / "config.yaml").write_text(text)
        path = str(folder / "config.yaml")
        says = {"digits": "a whole number of more than 20 digits", "long": "at most 256 KiB"}
        attacked("train", path, says=says.get(name, "config.yaml: not a readable YAML file"))
        if name != "itself":  # the others read the same way
            continue
        attacked("train", "quickstart", f"run.dir={folder}", says="config.yaml: not a readable YAML file")
        attacked("report", str(folder), says="config.yaml: not a readable YAML file")
        attacked("compare", f"runs={folder} {trained.parent.parent}", says="config.yaml: not a readable YAML file")
        attacked("evaluate", f"ckpt={trained}", "extractor=none", f"protocol={path}", says="config.yaml: not a read")
        attacked("tables", f"table={path}", says="config.yaml: not a readable YAML file")
        attacked("import", "mdm", str(trained), path, "out=x", says="config.yaml: not a readable YAML")
    (bad / "config.yaml").write_text("experiment: x\ntrainer: {max_steps: 1, x: '${run.dir}'}\n")
    attacked("report", str(bad), says="config.yaml")
    attacked("train", "quickstart", f"run.dir={bad}", says="config.yaml")


@pytest.mark.parametrize("kind", ["mdm", "mfm"])
def test_options_of_released_models(attacked, kind, bad):
    released = bad / "model.pt"
    torch.save({"x": torch.zeros(1)}, released)
    for text in ("", "3", "[1]", '{"dataset": ["a"]}', '{"ode_kwargs": [1]}', '{"num_heads": "x"}', "[" * 100_000):
        (bad / "args.json").write_text(text)
        attacked("import", kind, str(released), str(bad / "args.json"), "out=x")


def test_odd_values_of_options_are_named(attacked, bad):
    torch.save({"x": torch.zeros(1)}, bad / "model.pt")
    for name, value in {
        **{"dataset": [1], "num_heads": "4", "diffusion_steps": [1], "text_encoder_type": [1], "cond_mask_prob": {}},
        **{"lambda_rcxyz": [1], "arch": {}, "num_frames": 1e300, "noise_schedule": 5, "ode_kwargs": [1]},
    }.items():
        (bad / "args.json").write_text(json.dumps({name: value}))
        attacked("import", "mdm", str(bad / "model.pt"), str(bad / "args.json"), "out=x", says=f"args.json: {name} is")
    (bad / "args.json").write_text('{"num_heads": 0}')
    attacked("import", "mdm", str(bad / "model.pt"), str(bad / "args.json"), "out=x", says="num_heads is 0")
    (bad / "args.json").write_text("{}")
    attacked("import", "mdm", str(bad / "model.pt"), str(bad / "args.json"), "out=x", "num_heads=0", says="num_heads=0")


@pytest.mark.filterwarnings("ignore:Sparse")
def test_odd_weights_of_released_models(attacked, bad):
    (bad / "args.json").write_text("{}")
    path, name, rest = bad / "model.pt", "input_process.poseEmbedding.weight", "output_process.poseFinal.weight"
    one = torch.zeros(8, 8)
    cases = [{5: one}, {5: one, "a": one}, {"state_dict": [1]}, {"model_avg": 5}, {"model_avg": {name: 5, rest: [1]}}]
    cases += [{"state_dict": {"net.a": 5}}, {"model_avg": {name: one}, "model": "x"}, {name: one.to_sparse()}]
    cases += [{name: torch.zeros(1).expand(2**31, 263), rest: one}, {name: one[0], rest: one[0]}]
    cases += [{name: one.to(torch.complex64), rest: one}, {name: one, rest: one}]
    for content in cases:
        torch.save(content, path)
        for kind, *words in (("mdm", str(bad / "args.json")), ("flame",), ("mclip",)):
            attacked("import", kind, str(path), *words, "out=x", says="model.pt: ")
    torch.save({"model_avg": {name: one}}, path)
    attacked("import", "mdm", str(path), str(bad / "args.json"), "out=x", "averaged=false", says="model.pt: not a rel")


def test_odd_statistics_of_released_models(attacked, bad):
    torch.save({"x": torch.zeros(1)}, bad / "model.pt")
    (bad / "args.json").write_text("{}")
    for dtype in ("S3", "c8", "M8[s]"):
        for name in ("Mean.npy", "Std.npy"):
            np.save(bad / name, np.zeros(263, dtype))
        words = [str(bad / "model.pt"), str(bad / "args.json"), f"stats={bad}", "out=x"]
        attacked("import", "mdm", *words, says="Mean.npy: ")


@pytest.mark.slow
@pytest.mark.parametrize("megabytes", [300, 700])
def test_little_memory_is_one_line(trained, tmp_path, megabytes):
    """While it imports and samples. With little more, it is OpenBLAS or Pillow that runs out, and not in our words."""
    program = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({megabytes << 20},) * 2)\n"
        f"import sys; from flame_mdm.__main__ import main\nsys.exit(main(['sample', 'ckpt={trained}', {TEXT!r}]))"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(
        [sys.executable, "-c", program],
        **{"capture_output": True, "text": True, "cwd": tmp_path, "check": False, "env": environment},
    )
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    assert one_line(ended.stderr, "sample"), ended.stderr
