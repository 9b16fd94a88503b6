"""The benchmarks of speed: every script at a toy size, the authors' step, and the page rendered from the figures."""

import json
import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import ROOT

from flame_mdm.records import Value
from flame_mdm.runs import Run

sys.path.append(str(ROOT / "benchmarks"))  # the scripts import each other

import authors
import averaging
import quality
import run
import steps
from sections import Settings, section, take_turns


def stub(name: str, settings: Settings) -> dict[str, Any]:
    rows = {"steps": [{"training": name, "ms": 1234.5}]}
    return section(f"Title of {name}", "A text.", f"Summary of {name}.", rows)


@pytest.fixture
def page(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(run, "PAGE", tmp_path / "speed.md")
    monkeypatch.setattr(run, "run", stub)
    return tmp_path / "speed.md"


def test_the_page_is_rendered_from_the_figures_and_keeps_those_that_are_not_measured_again(page):
    run.main("only=averaging,host", "device=", "mdm_repo=", "runs=")
    data = page.with_suffix(".json")
    figures = json.loads(data.read_text())
    figures["host"] |= {
        "date": "2001-02-03",
        "script": "benchmarks/host.py at commit x",
        "machine": {"cores": 1},
    }
    data.write_text(json.dumps(figures))

    run.main("only=averaging")
    again = json.loads(data.read_text())
    assert again["host"] == figures["host"]
    text = page.read_text()
    assert text == run.render(again)
    assert "Steps:\n\n| training | ms |\n| --- | ---: |\n| host | 1,234 |" in text
    assert "`benchmarks/host.py at commit x` on 2001-02-03, on machine 1." in text
    assert "`benchmarks/averaging.py` on " in text
    assert text.index("## Title of host") < text.index("## Title of averaging"), (
        "in the order of the scripts"
    )
    assert "torch: " in text.split("## Machine")[1].split("##")[0]

    run.main("only=host")
    assert "at commit x" not in page.read_text(), (
        "a section that is measured again names no earlier script"
    )


def test_all_sections_are_measured_unless_only_some_are_named(page):
    run.main()
    assert tuple(json.loads(page.with_suffix(".json").read_text())) == run.SECTIONS
    scripts = {path.stem for path in (ROOT / "benchmarks").glob("*.py")} - {
        "run",
        "sections",
        "authors",
    }
    assert scripts == {*run.SECTIONS, *run.ON_REQUEST}


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("only=host,none", "ONLY=none: no such section. Use one of steps, host, "),
        ("device=tpu", "DEVICE=tpu: unknown device. Use cpu"),
        ("only=quality", "ONLY=quality: requires RUNS="),
        ("mdm_repo=/none", "MDM_REPO=/none: contains no model/mdm.py. Use the path of a clone"),
    ],
)
def test_what_cannot_be_measured_is_refused_in_one_line(page, word, message):
    with pytest.raises(SystemExit, match=message):
        run.main(word)
    assert not page.exists()


def test_sections_of_a_gpu_are_added_to_the_page(page, monkeypatch):
    monkeypatch.setattr(run.torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match=r"^DEVICE=cuda: torch finds no CUDA GPU on this machine$"):
        run.main("device=cuda")
    run.main("only=steps")
    monkeypatch.setattr(run.torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(run.torch.cuda, "get_device_name", lambda: "Some GPU")
    run.main("device=cuda", "only=steps")
    text = page.read_text()
    assert text.index("## Title of steps\n") < text.index("## Title of steps on a GPU\n")
    assert "GPU: Some GPU" in text
    assert "machine 2." in text


def test_the_committed_page_is_rendered_from_the_committed_figures():
    figures = json.loads((ROOT / "docs" / "benchmarks" / "speed.json").read_text())
    assert (ROOT / "docs" / "benchmarks" / "speed.md").read_text() == run.render(figures)


def test_functions_alternate_and_the_first_round_is_not_counted():
    seconds, calls = 0.0, []

    def call(name: str, durations: list[float]) -> None:
        nonlocal seconds
        seconds += durations[calls.count(name)]
        calls.append(name)

    durations = {"a": [100.0, 1.0, 9.0, 2.0], "b": [100.0, 5.0, 6.0, 7.0]}
    turns = {name: lambda name=name: call(name, durations[name]) for name in durations}
    assert take_turns(turns, 3, clock=lambda: seconds) == {"a": 2.0, "b": 6.0}
    assert calls == ["a", "b"] * 4


CLONE = {
    "utils/parser_util.py": """
import argparse
def train_args():
    parser = argparse.ArgumentParser()
    parser.add_argument("--save_dir", required=True)
    parser.add_argument("--dataset")
    for name, default in (("latent_dim", 512), ("layers", 8)):
        parser.add_argument(f"--{name}", default=default, type=int)
    parser.add_argument("--lr", default=1e-2, type=float)
    parser.add_argument("--weight_decay", default=0.0, type=float)
    return parser.parse_args()
""",
    "utils/model_util.py": """
from model.mdm import MDM
from diffusion.gaussian_diffusion import Diffusion
def create_model_and_diffusion(args, data):
    assert args.dataset == "humanml" and data.dataset.num_actions == 1
    return MDM(args.latent_dim, args.layers), Diffusion()
""",
    "model/mdm.py": """
import clip
import torch
from torch import nn
from model.rotation2xyz import Rotation2xyz
class MDM(nn.Module):
    def __init__(self, width, layers):
        super().__init__()
        self.inner = nn.Sequential(nn.Linear(263, width), *(nn.Linear(width, width) for _ in range(layers)))
        self.outer = nn.Linear(width, 263)
        self.clip_model, _ = clip.load("ViT-B/32", device="cpu", jit=False)
        clip.model.convert_weights(self.clip_model)
        self.text = nn.Linear(512, width)
        self.rot2xyz = Rotation2xyz(device="cpu", dataset="humanml")
    def _apply(self, fn):
        super()._apply(fn)
        self.rot2xyz.smpl_model._apply(fn)
    def train(self, *args):
        super().train(*args)
        self.rot2xyz.smpl_model.train(*args)
    def forward(self, x, timesteps, y):
        tokens = clip.tokenize(y["text"], context_length=22, truncate=True)
        text = self.text(self.clip_model.encode_text(tokens).float())
        hidden = self.inner(x[:, :, 0].transpose(1, 2)) + text[:, None]
        return self.outer(hidden).transpose(1, 2)[:, :, None]
""",
    "diffusion/gaussian_diffusion.py": """
class Diffusion:
    losses = []
    def training_losses(self, model, motions, t, model_kwargs, dataset):
        mask = model_kwargs["y"]["mask"]
        assert motions.shape[1:3] == (263, 1) and mask.shape == (len(t), 1, 1, motions.shape[-1])
        error = ((model(motions, t, **model_kwargs) - motions) ** 2 * mask).sum((1, 2, 3))
        loss = error / mask.sum((1, 2, 3)) / 263
        self.losses.append(loss.mean().item())
        return {"loss": loss}
""",
    "diffusion/fp16_util.py": """
class MixedPrecisionTrainer:
    def __init__(self, *, model):
        self.master_params = list(model.parameters())
    def zero_grad(self):
        for parameter in self.master_params:
            parameter.grad = None
    def backward(self, loss):
        loss.backward()
    def optimize(self, optimizer):
        optimizer.step()
""",
    "diffusion/resample.py": """
import torch
class Uniform:
    def sample(self, count, device):
        return torch.zeros(count, dtype=torch.int64, device=device), torch.ones(count, device=device)
def create_named_schedule_sampler(name, diffusion):
    assert name == "uniform"
    return Uniform()
""",
}
"""A clone with the modules and signatures of the authors' code, as far as a step on HumanML3D needs them."""


def test_the_authors_step_trains_the_network_of_a_clone(tmp_path, monkeypatch):
    for name, text in CLONE.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(sys, "path", [*sys.path])
    monkeypatch.setattr(sys, "modules", {**sys.modules})
    typed = list(sys.argv)
    torch.manual_seed(0)
    step = authors.authors_step(str(tmp_path), 8, 1, "cpu")
    assert sys.argv == typed
    batch = steps.batch_of(np.array([4, 7]), 8, "cpu")
    for _ in range(3):
        step(batch)
    losses = sys.modules["diffusion.gaussian_diffusion"].Diffusion.losses
    assert losses == sorted(losses, reverse=True), "it learns the batch"


def trained(folder: Path, speed: str, seed: int, loss: float, fid: float) -> Run:
    keys: dict[str, Any] = {"speed": speed} if speed == "fast" else {}
    config = {
        "data": {"name": "own"},
        "trainer": {"max_steps": 1500},
        "ema": {"decay": 0.9},
        "run": keys,
        "seed": seed,
    }
    values = {
        "fid": Value(mean=fid, ci=0.0, replications=1, n=9, per_replication=[]),
        "jitter": None,
    }
    evaluated: Any = SimpleNamespace(values=values)
    return Run(
        folder,
        config,
        None,
        {"val/loss": {9: 100.0, 19: loss}},
        {"evaluation/result.json": evaluated},
    )


def test_quality_has_intervals_over_seeds_and_of_the_differences_of_equal_seeds(
    tmp_path, monkeypatch
):
    runs = {}
    for seed, loss in enumerate((1.0, 2.0, 3.0)):
        runs[f"a{seed}"] = trained(tmp_path, "reference", seed, loss, fid=5.0 + seed)
        runs[f"b{seed}"] = trained(tmp_path, "fast", seed, loss + 0.1, fid=5.0 - 10 * seed)
    for name in runs:
        (tmp_path / name).mkdir()
        (tmp_path / name / "config.yaml").touch()
    monkeypatch.setattr(quality, "read_run", lambda folder: runs[folder.name])
    settings = Settings(runs=str(tmp_path))
    measured = quality.measure(settings)
    ((caption, rows),) = measured["tables"].items()
    assert caption == "own, 1,500 steps, ema.decay=0.9, 3 seeds"
    assert [row["metric"] for row in rows] == ["val/loss", "FID"]
    assert rows[0]["speed=reference"] == "2.0 ± 2.5", "4.303 / sqrt(3)"
    assert rows[0]["fast − reference"].startswith("+0.10 ± 0.00")
    assert rows[1]["fast − reference"] == "-11 ± 27", "11 times as much"
    assert measured["summary"].startswith("For 1 of 2 quality figures")
    assert measured["summary"].endswith("the others: val/loss (own).")

    del runs["b2"]
    (tmp_path / "b2" / "config.yaml").unlink()
    with pytest.raises(SystemExit, match="requires at least two seeds, the same at both speeds"):
        quality.measure(settings)
    monkeypatch.setattr(
        quality, "read_run", lambda folder: Run(folder, runs["a0"].config, None, {}, {})
    )
    with pytest.raises(SystemExit, match="not validated or not evaluated"):
        quality.measure(settings)


def check_numbers(name: str, measured: dict[str, Any]) -> None:
    numbers = [
        value for rows in measured["tables"].values() for row in rows for value in row.values()
    ]
    assert all(math.isfinite(value) for value in numbers if isinstance(value, int | float))
    assert any(isinstance(value, float) for value in numbers)
    columns = [{tuple(row) for row in rows} for rows in measured["tables"].values()]
    assert all(len(names) == 1 for names in columns)
    assert measured["title"] in run.render(
        {name: measured | {"date": "2001-02-03", "machine": run.machine()}}
    )


def test_a_benchmark_runs_at_a_toy_size():
    check_numbers("averaging", averaging.measure(Settings(quick=True)))


@pytest.mark.robustness
@pytest.mark.parametrize("name", run.SECTIONS)
def test_every_benchmark_runs_at_a_toy_size_in_a_process_of_its_own(name, tmp_path, monkeypatch):
    monkeypatch.setattr(run, "PAGE", tmp_path / "speed.md")
    measured = run.run(name, Settings(quick=True))
    assert list(tmp_path.iterdir()) == []
    check_numbers(name, measured)
