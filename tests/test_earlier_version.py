"""Files that the version of 20 November 2026 wrote: checkpoints, a store, a result and a model file still work.

`golden/earlier_version.tar.xz` holds them: a tiny quick-start run and a tiny motion-CLIP, the store of 16 synthetic
clips that they were trained on, the result of evaluating the one with the other, and joints that the model generated.
"""

import json
import shutil
import tarfile
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import ROOT

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint, weights_sha256
from flame_mdm.data.store import Store
from flame_mdm.safe_io import sha256

RUN = "runs/quickstart/default"
CLIP = "runs/motion_clip/synthetic/default"
SIZES = [
    *("data.source.clips=16", "data.batch_size=4", "denoiser.latent_dim=16", "denoiser.ff_size=16"),
    *("denoiser.num_layers=1", "denoiser.num_heads=2", "condition.features=16", "process.num_train_timesteps=10"),
    *("task.num_inference_steps=5", "trainer.accelerator=cpu", "trainer.enable_progress_bar=false"),
    *("callbacks.samples=null", "callbacks.best=null"),
]


THEN = [
    "denoiser=mdm_encoder_small",
    "losses.foot_contact=0.0",
    "optimizer.lr=0.001",
    "lr_decay=0.0",
    "ema.decay=0.998",
]
"""Settings of the recipe in that version."""


@pytest.fixture
def earlier(tmp_path, monkeypatch) -> Path:
    """The folder of these files, which is the current one."""
    with tarfile.open(ROOT / "tests" / "golden" / "earlier_version.tar.xz") as archive:
        archive.extractall(tmp_path, filter="data")
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("FLAME_MDM_DATA", raising=False)
    return tmp_path


@pytest.mark.parametrize("source", [RUN, f"{RUN}/checkpoints/last.ckpt", "model.safetensors"])
def test_models_generate_the_same_motion(earlier, source):
    motion = flame_mdm.generate(flame_mdm.load(source), "a person walks forward", seconds=2, seed=3)[0]
    np.testing.assert_allclose(motion.joints, np.load("joints.npy"), atol=1e-5)


def test_the_best_checkpoint_of_a_run_is_named(earlier, capsys):
    best = Path(RUN) / "checkpoints" / "best.ckpt"
    assert main(["sample", RUN, "which=best", "text=a person walks"]) == 1
    assert "best.ckpt: no such checkpoint. The run has last.ckpt" in capsys.readouterr().err
    shutil.copy(best.with_name("last.ckpt"), best)
    assert main(["export", RUN, "out.safetensors", "which=best"]) == 0
    assert main(["export", RUN, "out.safetensors", "which=newest"]) == 1
    assert "which=newest: write last or best" in capsys.readouterr().err


def test_a_folder_of_runs_lists_them(earlier, capsys):
    assert main(["sample", "runs/quickstart", "text=a person walks"]) == 1
    assert f"Name a run: {RUN}" in capsys.readouterr().err
    assert main(["sample", f"{RUN[:-1]}", "text=a person walks"]) == 1
    assert "no such checkpoint. Did you mean default?" in capsys.readouterr().err


def test_a_store_opens(earlier):
    store = Store(Path("data/synthetic-humanml-clean-smpl22"))
    store.verify()
    assert (store.fingerprint, len(store.clips)) == ("66a94ef9a72405fc", 16)


def test_a_run_resumes(earlier):
    assert main(["train", "quickstart", *THEN, *SIZES, "speed=reference", "trainer.max_steps=3"]) == 0
    assert read_checkpoint(Path(RUN) / "checkpoints" / "last.ckpt")["global_step"] == 3


def test_a_saved_configuration_trains(earlier):
    shutil.copy(f"{RUN}/config.yaml", "saved.yaml")
    assert main(["train", "saved.yaml", "run.dir=again", "trainer.max_steps=1"]) == 0
    assert torch.isfinite(
        read_checkpoint(Path("again/checkpoints/last.ckpt"))["state_dict"]["denoiser.input.weight"]
    ).all()


def test_an_evaluation_gives_the_same_result(earlier):
    words = [f"extractor={CLIP}/checkpoints/last.ckpt", "split=train", "samples=8", "replications=1"]
    assert main(["evaluate", f"{RUN}/checkpoints/last.ckpt", "again.json", *words, "multimodality=false"]) == 0
    before, now = (json.loads(Path(name).read_text()) for name in ("result.json", "again.json"))
    assert now["protocol"]["sha256"] == before["protocol"]["sha256"]
    hashes = {name: value for name, value in before["checkpoint"].items() if name.endswith("sha256")}
    assert {name: now["checkpoint"][name] for name in hashes} == hashes
    clip = Path(CLIP, "checkpoints", "last.ckpt")
    assert before["extractor"]["sha256"] == sha256(clip)  # the earlier version hashed the file
    assert now["extractor"]["sha256"] == weights_sha256(clip)
    assert now["values"].keys() == before["values"].keys()
    for name, value in before["values"].items():
        mean = now["values"][name]["mean"]
        assert mean is None if value["mean"] is None else mean == pytest.approx(value["mean"], rel=1e-3, abs=1e-4), name


def test_pages_read_runs_and_results(earlier):
    folder = Path(RUN) / "evaluation" / "synthetic-1" / "earlier"
    folder.mkdir(parents=True)
    shutil.copy("result.json", folder / "result.json")
    assert main(["report", RUN]) == 0
    assert "fid" in Path(RUN, "report.html").read_text()
    assert main(["compare", RUN, CLIP]) == 0
