"""Configurations out of somebody else's files: no code runs, nothing leaks, and absurd content is one line."""

import io
import json
import os
import pickle
import re
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
from support.refusals import bounded, one_line
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


def refuses(path: Path, says: str) -> None:
    """A model is not loaded, in 5 seconds and 1 GiB of memory."""
    with bounded(5), pytest.raises(UserError, match=re.escape(says)) as error:
        load(path)
    assert "\n" not in str(error.value), path


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
    marker, says = tmp_path / "owned", "holds an interpolation"
    for value in (exploit(marker), [{"a": exploit(marker)}], {exploit(marker): 1}, "x${oc.env:HOME}"):
        refuses(changed(config__data__batch_size=value), says)
    for key in ("config__callbacks__x", "config__experiment", "facts__dataset"):
        refuses(changed(**{key: exploit(marker)}), says)
    path = changed(config__denoiser__latent_dim=exploit(marker))
    attacked("sample", f"ckpt={path}", TEXT, says=says)
    attacked("evaluate", f"ckpt={path}", "extractor=none", "quick=true", says=says)
    attacked("evaluate", f"ckpt={trained}", f"extractor={path}", "quick=true", says="interpolation")
    attacked("push", str(path), "a/b", "dry_run=true", says=says)
    np.savez(bad / "x.npz", joints=np.zeros((5, 22, 3)), fps=20.0)
    attacked("edit", f"ckpt={path}", f"motion={bad / 'x.npz'}", TEXT, says=says)
    path = model_file(bad / "x.safetensors", trained, config__denoiser__latent_dim=exploit(marker))
    refuses(path, says)
    attacked("sample", f"ckpt={bad}", TEXT, says=says)
    attacked("export", str(path), "out=out", says=says)
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


def test_text_encoders_of_models_run_no_code(attacked, bad, trained, monkeypatch):
    """Neither a package that is imported to look for a part of it, nor code beside a language model."""
    code = "import pathlib\npathlib.Path('RAN').touch()\nclass Cfg: pass\n"
    Path("lm").mkdir()
    for path in ("evil_package.py", "lm/evil.py"):
        Path(path).write_text(code)
    Path("lm/config.json").write_text('{"auto_map": {"AutoConfig": "evil.Cfg"}, "model_type": "zzz"}')
    monkeypatch.syspath_prepend(str(Path.cwd()))
    monkeypatch.setattr("sys.stdin", io.StringIO("y\ny\ny\n"))
    whole, path = read_checkpoint(trained), bad / "model.ckpt"
    text = {"_target_": "flame_mdm.conditions.text.PretrainedText", "model": "lm", "features": 16, "max_tokens": 8}
    package = {"package": "evil_package.x", "sha256": "0"}
    for options in ({"freeze": True} | package, {"freeze": True}, {"freeze": False} | package, {"freeze": False}):
        condition = text | {"pooling": "mean"} | options
        torch.save(whole | {"config": whole["config"] | {"condition": condition}}, path)
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
    for name in ("part", "generate"):
        with pytest.raises(UserError, match="no such class or function"):
            parameters(f"flame_mdm.task.{name}")


def test_interpolations_in_saved_runs_are_refused(attacked, trained, bad, tmp_path):
    marker = tmp_path / "owned"
    whole = (trained.parent.parent / "config.yaml").read_text()
    assert "${run.dir}" in whole
    says = "config.yaml: x holds an interpolation"
    for value in (json.dumps(exploit(marker)), "${oc.env:HOME}", "${experiment}", "${run.dir}${seed}"):
        (bad / "config.yaml").write_text(f"{whole}\nx: {value}\n")
        with pytest.raises(UserError, match=says):
            compose(str(bad / "config.yaml"))
    attacked("train", str(bad / "config.yaml"), says=says)
    attacked("train", "quickstart", *TINY, f"run.dir={bad}", says=says)
    attacked("report", str(bad), says=says)
    attacked("compare", f"runs={bad} {trained.parent.parent}", says=says)
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
        with pytest.raises(UserError, match="holds an interpolation"):
            load_protocol(str(path), model.representation)
    attacked("evaluate", f"ckpt={trained}", f"protocol={path}", "extractor=none", says="holds an interpolation")
    assert not marker.exists()


def test_table_specs_hold_no_interpolations(attacked, bad):
    (bad / "table.yaml").write_text("title: ${oc.env:HOME}\n")
    attacked("tables", f"table={bad / 'table.yaml'}", says="table.yaml: title holds an interpolation")


# Sizes ----------------------------------------------------------------------------------------------------------------


def test_absurd_sizes(attacked, changed):
    sizes = {"process__num_train_timesteps": [10**9], "denoiser__num_layers": [10**7, 90_000]}
    sizes |= {"denoiser__latent_dim": [10**7, 60_000], "denoiser__ff_size": [10**12, 99_999_999]}
    sizes |= {"condition__features": [60_000], "task__num_inference_steps": [10**9]}
    for key, values in sizes.items():
        for value in values:
            path = changed(**{f"config__{key}": value})
            refuses(path, str(path))
    attacked("sample", f"ckpt={path}", TEXT, says=str(path))


def test_a_drawn_pooler_of_absurd_size(changed):
    text = {"_target_": "flame_mdm.conditions.text.PretrainedText", "model": "a/b", "features": 60_000}
    path = changed(config__condition=text | {"max_tokens": 5, "pooling": "pooler"})
    refuses(path, "the weights do not match")


@pytest.mark.filterwarnings("ignore:torch.quantize")
def test_absurd_facts_and_weights(attacked, trained, changed):
    refuses(changed(facts__max_frames=10**12), "max_frames")
    state = read_checkpoint(trained)["state_dict"]
    name = max(state, key=lambda name: state[name].numel())
    weights = state[name].float()
    for value in (torch.zeros(1).expand(10**9, 10**9), torch.zeros(5, device="meta"), torch.zeros(3).to_sparse()):
        attacked("export", str(changed(state_dict=state | {name: value})), "out=x", says="its weights")
    odd = [weights.to(torch.complex64), weights.to(torch.float8_e4m3fn)]
    for value in (*odd, torch.quantize_per_tensor(weights, 0.1, 0, torch.qint8)):
        path = changed(state_dict=state | {name: value})
        attacked("export", str(path), "out=x", says="bad.ckpt: damaged")
        refuses(path, "bad.ckpt: damaged" if value.is_quantized else str(value.dtype))


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
        refuses(bad / "bad.ckpt", f"has no {name}")
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
        refuses(bad / name, "not a file")
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
    refuses(path, "bomb.ckpt: damaged")
    attacked("import", "flame", str(path), "out=x", says="bomb.ckpt: damaged")


def test_nested_pickles(attacked, bad):
    deep: Any = {}
    for _ in range(400):
        deep = {"a": deep}
    itself: list[Any] = []
    itself.extend([itself, itself])
    for number, config in enumerate((deep, {"a": itself})):
        path = bad / f"{number}.ckpt"
        torch.save({"config": config, "facts": {"actions": []}, "state_dict": {}}, path)
        refuses(path, "nested too deeply")
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


def test_odd_lists_of_sampling_steps(attacked, changed):
    for value in ([], [3], [3, 1], [0, 99_999]):
        path = changed(config__task__num_inference_steps=value)
        attacked("sample", f"ckpt={path}", TEXT, says="sampling steps must be")


def test_odd_recipes(attacked, trained, changed, bad):
    cases = [("config__run", "x"), ("config__data_root", []), ("config__experiment", 3), ("facts__dataset", 3)]
    cases += [("config__representation", "x"), ("facts__actions", [1]), ("facts__fingerprint", [])]
    cases += [("facts__training", "x"), ("facts__training", {"hours": "x"})]
    for key, value in cases:
        refuses(changed(**{key: value}), "damaged")
    for value in (3, None, {"_target_": "evaluators.metrics.physics.Jitter", "fps": 20}):
        attacked("evaluate", f"ckpt={changed(config__data=value)}", "extractor=none", "quick=true")
    path = model_file(bad / "x.safetensors", trained, origin=[1])
    attacked("push", str(path), "a/b", "dry_run=true", says="origin")
    path = model_file(bad / "x.safetensors", trained, text='{"a":' * 100_000)
    refuses(path, "x.safetensors: damaged")


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
    says = {"digits": "a whole number of more than 20 digits", "long": "at most 256 KiB"}
    path = str(bad / "config.yaml")
    for name, text in reversed(bombs.items()):
        Path(path).write_text(text)
        with bounded(5), pytest.raises(UserError, match=says.get(name, "config.yaml: not a readable YAML file")):
            compose(path)
    for line in (
        *(f"train {path}", f"train quickstart run.dir={bad}", f"report {bad}", f"tables table={path}"),
        *(f"evaluate ckpt={trained} extractor=none protocol={path}", f"import mdm {trained} {path} out=x"),
    ):
        attacked(*line.split(), says="config.yaml: not a readable YAML file")
    attacked("compare", f"runs={bad} {trained.parent.parent}", says="config.yaml: not a readable YAML file")
    (bad / "config.yaml").write_text("experiment: x\ntrainer: {max_steps: 1, x: '${run.dir}'}\n")
    attacked("report", str(bad), says="config.yaml")
    attacked("train", "quickstart", f"run.dir={bad}", says="config.yaml")


def test_options_of_released_models(attacked, bad):
    torch.save({"x": torch.zeros(1)}, bad / "model.pt")
    words = [str(bad / "model.pt"), str(bad / "args.json"), "out=x"]
    for text in ("", "3", "[1]", "[" * 100_000):
        (bad / "args.json").write_text(text)
        for kind in ("mdm", "mfm"):
            attacked("import", kind, *words)
    for name, value in {
        **{"dataset": [1], "num_heads": "4", "diffusion_steps": [1], "text_encoder_type": [1], "cond_mask_prob": {}},
        **{"lambda_rcxyz": [1], "arch": {}, "num_frames": 1e300, "noise_schedule": 5, "ode_kwargs": [1]},
    }.items():
        (bad / "args.json").write_text(json.dumps({name: value}))
        attacked("import", "mdm", *words, says=f"args.json: {name} is")
    (bad / "args.json").write_text('{"num_heads": 0}')
    attacked("import", "mdm", *words, says="num_heads is 0")
    (bad / "args.json").write_text("{}")
    attacked("import", "mdm", *words, "num_heads=0", says="num_heads=0")
    for dtype in ("S3", "c8", "M8[s]"):
        for name in ("Mean.npy", "Std.npy"):
            np.save(bad / name, np.zeros(263, dtype))
        attacked("import", "mdm", *words, f"stats={bad}", says="Mean.npy: ")


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


def test_little_memory_is_one_line(trained, tmp_path):
    """While Python imports. With more memory, it is a library that runs out, and not in our words."""
    program = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({300 << 20},) * 2)\n"
        f"import sys; from flame_mdm.__main__ import main\nsys.exit(main(['sample', 'ckpt={trained}', {TEXT!r}]))"
    )
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    words: dict[str, Any] = {"capture_output": True, "text": True, "cwd": tmp_path, "check": False, "env": environment}
    ended = subprocess.run([sys.executable, "-c", program], **words)
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    assert one_line(ended.stderr), ended.stderr
