"""Runs that were never trained, results that were never measured, and what pages show of them."""

import json
import re
from html import unescape
from pathlib import Path
from typing import Any

import numpy as np

PROMPTS = ("a person walks", "a person jumps", "a person <waves> & bows")


def a_run(folder: Path, name: str = "default", **changes: Any) -> Path:
    """The folder of a run of 10 logged steps; `changes` are keys of its configuration."""
    folder.mkdir(parents=True)
    config = {
        "experiment": "mine",
        "run": {"name": name, "dir": str(folder)},
        "trainer": {"max_steps": 20},
        **changes,
    }
    (folder / "config.yaml").write_text(json.dumps(config))
    lines = [
        {"step": k, "train/loss": 2.0**-k, "val/p/fid": 3.0 + k, "val/p/fid/ci": 0.5}
        for k in range(10)
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


def motions(folder: Path, prompts: tuple[str, ...] = PROMPTS, at: float = 0.0) -> Path:
    """A folder of motion files, as `make sample` writes them; all stand at x = `at`."""
    folder.mkdir(parents=True, exist_ok=True)
    joints = np.random.default_rng(0).random((8, 22, 3)).astype(np.float32)
    joints[..., 0] += at
    for number, text in enumerate(prompts):
        np.savez(folder / f"motion_{number:03d}.npz", joints=joints, fps=20.0, text=text)
    (folder / "player.html").write_text("")
    return folder


def result(**changes: Any) -> dict[str, Any]:
    """A result of an evaluation, as far as pages read it."""
    value = {"ci": 0.25, "replications": 2, "n": 64}
    checkpoint = {
        "path": "last.ckpt",
        "sha256": "0123456789",
        "sampler": "ddim",
        "num_inference_steps": 5,
    }
    return {
        **{
            "quick": False,
            "invalid_because": [],
            "changed": {},
            "split": "test",
            "seed": 0,
            "device": "cpu",
        },
        **{
            "protocol": {"name": "p", "version": 3},
            "data": {"dataset": "synthetic", "fingerprint": "abc"},
        },
        **{"extractor": None, "checkpoint": checkpoint | {"guidance_scale": 2.5}},
        "values": {"fid": {"mean": 4.5, **value}, "kid": {"mean": None, **value, "ci": None}},
        "ground_truth": {"fid": {"mean": 0.125, **value}},
        **{"not_computed": {"kid": "too few <samples>"}, "cost": {"seconds_per_sample": 0.5}},
        **changes,
    }


def put(folder: Path, name: str = "x", **changes: Any) -> None:
    """Writes a result into a run."""
    path = folder / "evaluation" / "p-3" / name / "result.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(result(**changes)))


def data_of(page: str) -> Any:
    """The data of the script of a page."""
    return json.loads(re.findall(r'id="data">(.*?)</script>', page, re.DOTALL)[0])


def players(page: str) -> list[list[dict[str, Any]]]:
    """The motions in each player of a page."""
    return [data_of(unescape(source)) for source in re.findall(r'srcdoc="([^"]*)"', page)]
