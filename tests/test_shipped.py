"""The model in the package."""

import numpy as np
import torch
from support.fixtures import ROOT

import flame_mdm
from evaluators.metrics.attributes import read_attributes
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.locating import SHIPPED, find
from flame_mdm.data.synthetic import prompts
from flame_mdm.safe_io import sha256


def test_the_model_follows_its_prompts():
    model = flame_mdm.load("quickstart")
    assert all(value.dtype == torch.float32 for value in model.parameters())
    texts, expected = zip(*prompts(), strict=True)
    motions = flame_mdm.generate(model, texts, seconds=2.5, num_inference_steps=10, cleanup=True)
    read = [read_attributes(motion.joints, 20) for motion in motions]
    assert np.mean([a.get("action") == b["action"] for a, b in zip(read, expected, strict=True)]) >= 0.7


def test_shipped_names_come_after_paths(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert find("quickstart") == SHIPPED["quickstart"]
    assert main(["sample", "quikstart", "text=a person walks"]) == 1
    assert "Did you mean quickstart?" in capsys.readouterr().err
    (tmp_path / "quickstart").mkdir()
    (tmp_path / "quickstart" / "mine.safetensors").touch()
    assert find("quickstart").name == "mine.safetensors"


def test_the_documented_file_is_in_the_package():
    assert sha256(SHIPPED["quickstart"]) in (ROOT / "docs" / "checkpoints.md").read_text()
    assert SHIPPED["quickstart"].stat().st_size < 4.6e6
    assert "license: mit" in SHIPPED["quickstart"].with_suffix(".md").read_text()
