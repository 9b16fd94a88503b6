"""Classifiers to train: what they learn, over several processes too, and action-to-motion measured with them."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.runs import TINY

from evaluators.extractors import OwnClassifierExtractor
from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.classifier import ClassifierTask
from flame_mdm.__main__ import main
from flame_mdm.batch import length_mask
from flame_mdm.config import compose, instantiate
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.representations.rot6d import Rot6D

DATA = ("data=synthetic", "data.source.clips=600")
RUN = ["data.source.clips=600", "data.batch_size=32", "logger=csv", "trainer.accelerator=cpu"]
RUN += ["trainer.enable_progress_bar=false", "trainer.log_every_n_steps=5"]


@pytest.fixture(scope="module")
def data(data_root) -> str:
    return f"data_root={data_root}/classifier"


@pytest.fixture(scope="module")
def trained(tmp_path_factory, data) -> Path:
    """Checkpoint of a small classifier after 120 steps."""
    folder = tmp_path_factory.mktemp("classifier")
    options = [data, f"run.dir={folder}", "trainer.max_steps=120", "trainer.val_check_interval=60"]
    options += ["task.network.hidden=48", "task.network.num_layers=1", "optimizer.lr=0.004"]
    assert main(["train", "classifier/synthetic", *RUN, *options]) == 0
    return folder / "checkpoints" / "last.ckpt"


def measure(out: Path, *words: str) -> dict:
    assert main(["evaluate", f"out={out}", "device=cpu", "replications=1", "samples=150", *words]) == 0
    return json.loads(out.read_text())


def validated(trained: Path) -> list[float]:
    lines = (trained.parent.parent / "metrics.jsonl").read_text().splitlines()
    return [row["val/accuracy"] for row in map(json.loads, lines) if "val/accuracy" in row]


@pytest.mark.slow
def test_training_by_recipe_learns_the_actions(trained, data, tmp_path):
    assert validated(trained)[-1] > 0.5  # by chance: about 1 in 11
    result = measure(
        tmp_path / "real.json",
        *("baseline=shuffled", *DATA, data, "protocol=action_to_motion_own", f"extractor={trained}"),
    )
    assert result["ground_truth"]["accuracy"]["mean"] > 0.5, "motions that were not trained on"
    assert result["values"]["accuracy"]["mean"] < 0.2, "those of other actions"
    assert all(value["mean"] is not None for value in result["values"].values())
    assert result["extractor"]["data"] == result["data"]["fingerprint"]


@pytest.mark.slow
def test_a_model_of_actions_is_measured_by_it(trained, data, tmp_path):
    words = [word for word in TINY if not word.startswith(("condition", "data.source"))]
    words += [RUN[0], "condition=action", "condition.features=16", data, f"run.dir={tmp_path / 'run'}"]
    assert main(["train", "quickstart", *words, "trainer.max_steps=1"]) == 0
    shown = sorted((tmp_path / "run" / "samples" / "step_0000001").glob("*.npz"))
    texts = [str(np.load(file)["text"]) for file in shown]
    assert texts == list(Synthetic.actions)[: len(texts)], "actions instead of the recipe's prompts"
    model = tmp_path / "run" / "checkpoints" / "last.ckpt"
    result = measure(tmp_path / "result.json", f"ckpt={model}", f"extractor={trained}", "num_inference_steps=2")
    assert result["protocol"]["name"] == "action_to_motion_own"
    assert result["values"]["accuracy"]["mean"] < result["ground_truth"]["accuracy"]["mean"]
    assert result["values"]["fid"]["mean"] > 2 * result["ground_truth"]["fid"]["mean"]


@pytest.mark.slow
def test_what_was_not_made_for_one_another_is_refused(trained, data, tmp_path, capsys):
    extractor = OwnClassifierExtractor(str(trained))
    own = extractor.task.representation
    extractor.check(own, "synthetic")
    with pytest.raises(UserError, match=r"trained on the data set synthetic, but the motions are from bandai"):
        extractor.check(own, "bandai")
    with pytest.raises(UserError, match=r"the motions are rot6d-25 at 20\. Train one with make train EXP=classifier"):
        extractor.check(Rot6D(), "synthetic")

    released = tmp_path / "released.tar"
    torch.save({"model": ActionGRU().state_dict()}, released)
    for protocol, file, message in (
        ("action_to_motion", trained, "For classifiers of make train"),
        ("action_to_motion_own", released, f"{released}: not a checkpoint of this framework"),
    ):
        words = ["baseline=real", *DATA, data, f"protocol={protocol}", f"extractor={file}"]
        assert main(["evaluate", *words]) == 1
        assert message in capsys.readouterr().err


def test_data_without_labels_is_refused(monkeypatch, tmp_path, capsys):
    config = compose("classifier/synthetic")
    for actions in ([], ["walk"]):
        with pytest.raises(UserError, match=f"with at least two actions, but this one has {len(actions)}"):
            ClassifierTask.build(config, instantiate(config["representation"]), actions=actions)

    whole = Synthetic.clips

    def bare(self, fps):
        return (replace(clip, action=None if clip.id.endswith("7") else clip.action) for clip in whole(self, fps))

    monkeypatch.setattr(Synthetic, "clips", bare)
    words = ["data.source.clips=40", "data.batch_size=8", f"data_root={tmp_path}", f"run.dir={tmp_path / 'run'}"]
    assert main(["train", "classifier/synthetic", *RUN, *words]) == 1
    assert re.search(r"\d clips have no action label, such as synthetic_0_0000\d7\.", capsys.readouterr().err)


def test_recipes_build_the_sizes_of_their_data():
    for words in (["synthetic"], ["synthetic", "task=classifier_stgcn"], ["humanact12"], ["uestc"]):
        config = compose(f"classifier/{words[0]}", words[1:])
        task = ClassifierTask.build(config, instantiate(config["representation"]), actions=list("abcdefg"))
        joints = torch.randn(2, 12, len(task.representation.skeleton.parents), 3)
        mask = length_mask(torch.tensor([12, 7]))
        assert task.logits(joints, mask).shape == (2, 7)
        assert len(task(joints, mask)) == 2
