"""Configurations out of somebody else's files: no code runs, nothing leaks, and absurd content is one line."""

import io
import json
import os
import pickle
import re
import subprocess
import sys
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from support.fixtures import ROOT
from support.refusals import bounded, one_line
from support.runs import TINY

from evaluators.protocol import load_protocol
from flame_mdm.checkpoints.hub import card, export
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.model_files import KEY, content_sha256, read_checkpoint, read_model_file
from flame_mdm.checkpoints.released_weights import read_released
from flame_mdm.checkpoints.torch_files import read_torch
from flame_mdm.config import compose, instantiate, plain
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
    with bounded(), pytest.raises(UserError, match=re.escape(says)) as error:
        load(path)
    assert "\n" not in str(error.value), path


def model_file(path: Path, trained: Path, text: str | None = None, **recipe: Any) -> Path:
    """A model file with other content in its metadata, and a right checksum."""
    file = export(trained, path)
    with safe_open(file, "pt") as opened:
        metadata, weights = opened.metadata(), load_file(file)
    content = json.loads(metadata[KEY])
    for key, value in recipe.items():
        content = change(content, key.replace("__", "."), value)
    text = json.dumps(content) if text is None else text
    save_file(weights, file, metadata | {KEY: text, "sha256": content_sha256(text, weights)})
    return file


def test_interpolations_in_models_are_refused(attacked, trained, changed, bad, tmp_path):
    marker, says = tmp_path / "owned", "contains the interpolation"
    for value in (
        exploit(marker),
        [{"a": exploit(marker)}],
        {exploit(marker): 1},
        "x${oc.env:HOME}",
    ):
        refuses(changed(config__data__batch_size=value), says)
    refuses(changed(facts__dataset=exploit(marker)), says)
    path = changed(config__denoiser__latent_dim=exploit(marker))
    attacked("evaluate", f"ckpt={trained}", f"extractor={path}", "quick=true", says="interpolation")
    attacked("export", str(path), "out=out", says=says)
    refuses(
        model_file(bad / "x.safetensors", trained, config__denoiser__latent_dim=exploit(marker)),
        says,
    )
    assert not marker.exists()


def test_interpolations_in_saved_runs_and_protocols_are_refused(
    attacked, trained, bad, tmp_path, subtests
):
    marker, says = tmp_path / "owned", "contains the interpolation"
    saved, own = (trained.parent.parent / "config.yaml").read_text(), bad / "protocol.yaml"
    assert "${run.dir}" in saved
    protocol = (ROOT / "experiments/evaluation/synthetic.yaml").read_text()
    representation = load(trained).representation
    own.write_text(protocol)
    metrics = load_protocol(str(own), representation).metrics
    assert metrics["jitter"]["fps"] == representation.fps, (
        "a protocol knows the representation alone"
    )
    for value in (
        json.dumps(exploit(marker)),
        "${oc.env:HOME}",
        "x${representation.fps}",
        "${run.dir}${seed}",
    ):
        with subtests.test(value=value):
            (bad / "config.yaml").write_text(f"{saved}\nx: {value}\n")
            own.write_text(f"{protocol}\nsmoothing: {value}\n")
            with pytest.raises(UserError, match=f"config.yaml: x {says}"):
                compose(str(bad / "config.yaml"))
            with pytest.raises(UserError, match=says):
                load_protocol(str(own), representation)
    for words in (["train", "quickstart", *TINY, f"run.dir={bad}"], ["report", str(bad)]):
        attacked(*words, says=f"config.yaml: x {says}")
    # Checkpoints of such a run would be refused.
    attacked("train", "quickstart", r"run.dir='x\${a}'", says=says)
    assert not marker.exists()


def test_parts_are_built_as_hydra_builds_them_without_resolving_anything(tmp_path, subtests):
    node = {"_target_": "builtins.dict", "a": exploit(tmp_path / "owned"), "b": ["${oc.env:HOME}"]}
    assert instantiate({"_target_": "collections.OrderedDict", "x": {"y": "${z}"}}) == {
        "x": {"y": "${z}"}
    }
    assert instantiate(node) == {"a": node["a"], "b": node["b"]}
    assert not (tmp_path / "owned").exists()
    inner = {"_target_": "fractions.Fraction", "numerator": 3}
    assert instantiate({"_target_": "builtins.dict", "a": [inner], "b": {"c": inner}}) == {
        "a": [3],
        "b": {"c": 3},
    }
    kept = instantiate({"_target_": "builtins.dict", "_recursive_": False, "a": inner})
    assert (kept, kept["a"] is inner) == ({"a": inner}, False)
    for key in ("_args_", "_partial_", "_convert_"):
        with subtests.test(key=key), pytest.raises(UserError, match=key):
            instantiate({"_target_": "fractions.Fraction", key: [3, 4]})
    assert instantiate({"_target_": "builtins.dict", "a": {"_target_": "no.such"}}, a=1) == {"a": 1}
    for node in ({}, {"_target_": 3}, {"_target_": "os.none"}, {"_target_": "x"}, {"_target_": ""}):
        with subtests.test(node=node), pytest.raises(UserError):
            instantiate(node)


def test_text_encoders_of_models_run_no_code(attacked, bad, trained, monkeypatch, subtests):
    """Neither a package that is imported to look for a part of it, nor code beside a language model."""
    Path("lm").mkdir()
    for path in ("evil_package.py", "lm/evil.py"):
        Path(path).write_text("import pathlib\npathlib.Path('RAN').touch()\nclass Cfg: pass\n")
    Path("lm/config.json").write_text(
        '{"auto_map": {"AutoConfig": "evil.Cfg"}, "model_type": "zzz"}'
    )
    monkeypatch.syspath_prepend(str(Path.cwd()))
    monkeypatch.setattr("sys.stdin", io.StringIO("y\ny\ny\n"))
    whole, path = read_checkpoint(trained), bad / "model.ckpt"
    text = {
        "_target_": "flame_mdm.conditions.text.PretrainedText",
        "model": "lm",
        "features": 16,
        "max_tokens": 8,
    }
    package = {"package": "evil_package.x", "sha256": "0"}
    for options in (
        {"freeze": True} | package,
        {"freeze": True},
        {"freeze": False} | package,
        {"freeze": False},
    ):
        with subtests.test(options=options):
            condition = text | {"pooling": "mean"} | options
            torch.save(whole | {"config": whole["config"] | {"condition": condition}}, path)
            attacked("sample", f"ckpt={path}", TEXT)
            attacked("sample", f"ckpt={path}", "unconditioned=true")
            assert not Path("RAN").exists()


def test_plain_values(subtests):
    deep: Any = []
    for _ in range(100_000):
        deep = [deep]
    itself: list[Any] = [1]
    itself.extend([itself, itself])
    for value in (
        {"a": {"b": "x${c}"}},
        {"${a}": 1},
        {"a": [b"x"]},
        {"a": {(1,): 2}},
        {"a": deep},
        {"a": itself},
    ):
        with subtests.test(value=value), pytest.raises(UserError, match="the file"):
            plain(value, "the file")
    with pytest.raises(UserError, match=r"\$\{oc"):
        plain({"a": "${run.dir}${oc.env:HOME}"}, "x", but="${run.dir}")
    plain({"a": "${run.dir}/b", "c": [1, 1.5, None, True, "$", "{"]}, "x", but="${run.dir}")


def test_absurd_sizes(attacked, changed):
    text = {
        "_target_": "flame_mdm.conditions.text.PretrainedText",
        "model": "a/b",
        "features": 60_000,
    }
    for key, value in (
        *(("process__num_train_timesteps", 10**9), ("task__num_inference_steps", 10**9)),
        *(
            ("denoiser__num_layers", 10**7),
            ("denoiser__num_layers", 90_000),
            ("denoiser__ff_size", 10**12),
        ),
        *(
            ("denoiser__latent_dim", 10**7),
            ("denoiser__latent_dim", 60_000),
            ("condition__features", 60_000),
        ),
        ("condition", text | {"max_tokens": 5, "pooling": "pooler"}),
    ):
        path = changed(**{f"config__{key}": value})
        refuses(path, str(path))
    attacked("sample", f"ckpt={path}", TEXT, says=str(path))


def test_files_that_are_no_files(attacked, trained, bad):
    (bad / "zero.safetensors").symlink_to("/dev/zero")
    for name in ("pipe.ckpt", "pipe.yaml"):
        os.mkfifo(bad / name)
    for name in ("zero.safetensors", "pipe.ckpt"):
        refuses(bad / name, "not a regular file")
        attacked("import", "flame", str(bad / name), "out=x", says="not a regular file")
    attacked(
        "evaluate",
        f"ckpt={trained}",
        "extractor=none",
        f"protocol={bad / 'pipe.yaml'}",
        says="not a regular file",
    )
    attacked("train", str(bad / "pipe.yaml"), says="pipe.yaml")


def test_nested_pickles(bad):
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
    refuses(bad / "raw.ckpt", "raw.ckpt")


@pytest.mark.filterwarnings("ignore:torch.quantize")
def test_absurd_facts_and_weights(attacked, trained, changed):
    refuses(changed(facts__max_frames=10**12), "max_frames")
    state = read_checkpoint(trained)["state_dict"]
    name = max(state, key=lambda name: state[name].numel())
    weights = state[name].float()
    for value in (
        torch.zeros(1).expand(10**9, 10**9),
        torch.zeros(5, device="meta"),
        torch.zeros(3).to_sparse(),
    ):
        attacked(
            "export", str(changed(state_dict=state | {name: value})), "out=x", says="its weights"
        )
    odd = [weights.to(torch.complex64), weights.to(torch.float8_e4m3fn)]
    for value in (*odd, torch.quantize_per_tensor(weights, 0.1, 0, torch.qint8)):
        path = changed(state_dict=state | {name: value})
        attacked("export", str(path), "out=x", says="damaged")
        refuses(path, "damaged" if value.is_quantized else str(value.dtype))


def test_packed_checkpoints(attacked, trained, bad):
    path = bad / "bomb.ckpt"
    with (
        zipfile.ZipFile(trained) as source,
        zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target,
    ):
        for member in source.namelist():
            target.writestr(member, source.read(member))
        with target.open("archive/data/bomb", "w") as file:
            for _ in range(200):
                file.write(bytes(2**20))
    refuses(path, "bomb.ckpt: damaged")
    attacked("import", "flame", str(path), "out=x", says="bomb.ckpt: damaged")


def test_values_of_wrong_kinds_are_refused_when_a_model_is_loaded(attacked, trained, changed, bad):
    steps = (None, 0, 1.5, True, ["x"], [0, 10**9], [0, True])
    for key, name, values in (
        (
            "config__representation__fps",
            "fps",
            (0, float("nan"), "x", 1e-300, -5, None, [], True, "20"),
        ),
        ("config__task__num_inference_steps", "num_inference_steps", steps),
        (
            "config__denoiser__num_heads",
            "num_heads",
            (True, [2], {"_target_": "flame_mdm.denoisers.mdm.MDMEncoder"}),
        ),
        ("config__experiment", "damaged", (3,)),
        ("facts__dataset", "damaged", (3,)),
        ("facts__actions", "damaged", ([1],)),
        ("facts__training", "damaged", ("x", {"hours": "x"})),
    ):
        for value in values:
            refuses(changed(**{key: value}), name)
    for value in ([3, 1], [0, 99_999]):
        path = changed(config__task__num_inference_steps=value)
        attacked("sample", f"ckpt={path}", TEXT, says="increasing steps")
    attacked("evaluate", f"ckpt={changed(config__data=3)}", "extractor=none", "quick=true")
    refuses(
        model_file(bad / "x.safetensors", trained, text='{"a":' * 100_000),
        "x.safetensors is damaged",
    )


def test_incomplete_checkpoints(attacked, trained, changed, bad):
    whole = read_checkpoint(trained)
    for part, name in (("facts", "max_frames"), ("facts", "actions"), ("config", "experiment")):
        lacking = {key: value for key, value in whole[part].items() if key != name}
        torch.save(whole | {part: lacking}, bad / "bad.ckpt")
        refuses(bad / "bad.ckpt", f"bad.ckpt is damaged: {part} has no {name}")
    torch.save({"state_dict": {}}, bad / "bad.ckpt")
    refuses(bad / "bad.ckpt", "contains no recipe")
    says = "the weights do not match the recipe saved with them: size mismatch"
    refuses(changed(config__denoiser__latent_dim=32), says)
    attacked("export", str(changed(config__denoiser={})), "out=x", says="damaged: config.denoiser")
    best = changed("best.ckpt", config__callbacks={"best": 5})
    attacked(
        "evaluate",
        f"ckpt={best}",
        "extractor=none",
        "quick=true",
        says="damaged: config.callbacks.best is 5",
    )
    path = model_file(bad / "x.safetensors", trained, origin=None)
    attacked("push", str(path), "a/b", "dry_run=true", says="x.safetensors is damaged")
    facts = {
        name: value
        for name, value in whole["facts"].items()
        if name not in ("dataset", "fingerprint")
    }
    assert "| data | unknown |" in card(
        read_model_file(export(changed(facts=facts), bad)), "a/b", ""
    )


def test_bombs_of_yaml(bad, subtests):
    """Aliases that multiply, and nesting, are cases of table specs, which are read by the same function."""
    path = bad / "config.yaml"
    for text, says in (
        ("a: &x [*x]", "not a readable YAML file"),
        ('a: "\\ud800"', "not a readable YAML file"),
        (f"{10**20}: x", "a whole number of more than 20 digits"),
        ("a: [" + "1," * 2**17 + "]", "at most 256 KiB"),
    ):
        with subtests.test(text=text, says=says):
            path.write_text(text)
            with bounded(), pytest.raises(UserError, match=says):
                compose(str(path))


def test_options_and_weights_of_released_models(attacked, bad):
    options, path = bad / "args.json", bad / "model.pt"
    words = [str(path), str(options), "out=x"]
    torch.save({"x": torch.zeros(1)}, path)
    options.write_text("[" * 100_000)
    for kind in ("mdm", "mfm"):
        attacked("import", kind, *words)
    wrong = {
        "dataset": [1],
        "num_heads": "4",
        "cond_mask_prob": {},
        "lambda_rcxyz": [1],
        "num_frames": 1e300,
    }
    for name, value in (*wrong.items(), ("noise_schedule", 5), ("num_heads", 0)):
        options.write_text(json.dumps({name: value}))
        attacked("import", "mdm", *words, says=f"{name} is")
    options.write_text("{}")
    name, rest, one = (
        "input_process.poseEmbedding.weight",
        "output_process.poseFinal.weight",
        torch.zeros(8, 8),
    )
    cases: list[dict] = [{5: one}, {"state_dict": [1]}, {"state_dict": {"net.a": 5}}]
    cases += [{"model_avg": {name: 5, rest: [1]}}, {"model_avg": {name: one}, "model": "x"}]
    cases += [{name: torch.zeros(1).expand(2**31, 263), rest: one}]
    cases += [
        {name: one[0], rest: one[0]},
        {name: one.to(torch.complex64), rest: one},
        {name: one, rest: one},
    ]
    for content in cases:
        torch.save(content, path)
        for kind, *more in (("mdm", str(options)), ("flame",), ("mclip",)):
            attacked("import", kind, str(path), *more, "out=x", says="model.pt: ")


def test_little_memory_is_one_line(trained, tmp_path):
    """While Python imports. With more memory, it is a library that runs out, and not in our words."""
    program = (
        f"import resource; resource.setrlimit(resource.RLIMIT_AS, ({300 << 20},) * 2)\n"
        f"import sys; from flame_mdm.__main__ import main\nsys.exit(main(['sample', 'ckpt={trained}', {TEXT!r}]))"
    )
    line, threads = (
        [sys.executable, "-c", program],
        {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
    )
    ended = subprocess.run(
        line, capture_output=True, text=True, cwd=tmp_path, check=False, env=os.environ | threads
    )
    assert (ended.returncode, one_line(ended.stderr)) == (1, True), ended.stderr


def with_keys(keys: list[Any], path: Path, *, legacy: bool = False) -> Path:
    """A file of `torch.save` with a dictionary of any keys; `torch.load` is not used to make or check it."""
    torch.save({"facts": dict.fromkeys(keys)}, path, _use_new_zipfile_serialization=not legacy)
    return path


MODULUS = 2**61 - 1  # whole numbers that differ by a multiple of it have the same hash
SAME_HASH: dict[str, list[Any]] = {
    "whole numbers": [number * MODULUS for number in range(50)],
    "negative": [-number * MODULUS for number in range(1, 50)],
    "tuples": [(number, 1) for number in range(50)],
    "fractions": [2.0 ** (61 * number) for number in range(17)],
}


@pytest.mark.parametrize("kind", SAME_HASH)
@pytest.mark.parametrize("legacy", [False, True])
def test_keys_that_may_share_a_hash_are_refused_before_a_dictionary_is_made(
    kind, legacy, bad, monkeypatch
):
    path = with_keys(SAME_HASH[kind], bad / "keys.ckpt", legacy=legacy)
    monkeypatch.setattr(torch, "load", lambda *_, **__: pytest.fail("PyTorch read the file"))
    refuses(path, "not text or a small whole number")
    with pytest.raises(UserError, match=r"keys\.ckpt: damaged.*small whole number"):
        read_released(path)


class Made:
    """Pickled as a call of a container's class."""

    def __init__(self, kind: type, *arguments: Any):
        self.call = kind, arguments

    def __reduce__(self) -> tuple[type, tuple[Any, ...]]:
        return self.call


@pytest.mark.parametrize("kind", [OrderedDict, set, bytearray])
def test_containers_are_made_of_checked_keys_only(kind, bad):
    keys = SAME_HASH["whole numbers"]
    arguments = {OrderedDict: [(key, 0) for key in keys], set: keys, bytearray: 10**12}
    torch.save({"facts": Made(kind, arguments[kind])}, bad / "made.ckpt")
    refuses(bad / "made.ckpt", "made.ckpt: damaged")


def test_thousands_of_states_of_an_optimizer_are_read(bad, subtests):
    step = torch.tensor(1.0)
    weights = {number: {"step": step, "exp_avg": torch.zeros(2)} for number in range(3000)}
    content = {
        "state_dict": OrderedDict(weight=torch.zeros(2)),
        "optimizer": {"state": weights},
        "seed": 2**63,
    }
    for legacy in (False, True):
        with subtests.test(legacy=legacy):
            torch.save(content, bad / "large.ckpt", _use_new_zipfile_serialization=not legacy)
            assert len(read_torch(bad / "large.ckpt")["optimizer"]["state"]) == 3000


def test_files_of_torch_with_many_members_are_refused(bad, monkeypatch):
    path = with_keys(["a"], bad / "many.ckpt")
    monkeypatch.setattr("flame_mdm.safe_io.MAX_MEMBERS", 2)
    refuses(path, "more than 2 files")
