"""The model in the package."""

from contextlib import suppress

import numpy as np
import pytest
import torch
from support.fixtures import ROOT

import flame_mdm
from evaluators.metrics.attributes import read_attributes
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.locating import SHIPPED, find
from flame_mdm.conditions.vocabulary import check_known
from flame_mdm.data.synthetic import prompts
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_yaml, sha256


@pytest.mark.slow
def test_the_model_follows_its_prompts():
    model = flame_mdm.load("quickstart")
    assert all(value.dtype == torch.float32 for value in model.parameters())
    texts, expected = zip(*prompts(), strict=True)
    motions = flame_mdm.generate(model, texts, seconds=2.5, num_inference_steps=10, cleanup=True)
    read = [read_attributes(motion.joints, 20) for motion in motions]
    assert np.mean([a.get("action") == b["action"] for a, b in zip(read, expected, strict=True)]) >= 0.6


SENTENCES = read_yaml(ROOT / "tests" / "fixtures" / "sentences.yaml")


@pytest.mark.slow
@pytest.mark.parametrize("every", [3, pytest.param(1, marks=pytest.mark.robustness)])
def test_the_model_understands_sentences_as_people_type_them(every):
    """A motion is right if it shows every attribute that its sentence states; a list holds what fits."""
    assert len(SENTENCES) == len({sentence["text"].lower() for sentence in SENTENCES}) == 300
    model, known = flame_mdm.load("quickstart"), {}
    for sentence in SENTENCES[::every]:
        with suppress(UserError):
            check_known(sentence["text"], model.facts)
            known[sentence["text"]] = {key: value for key, value in sentence.items() if key != "text"}
    right, motions = 0, flame_mdm.generate(model, list(known), cleanup=True, num_inference_steps=10)
    for motion, stated in zip(motions, known.values(), strict=True):
        seen = read_attributes(motion.joints, motion.fps)
        right += all(seen.get(key) in (value if isinstance(value, list) else [value]) for key, value in stated.items())
    assert right / len(SENTENCES[::every]) >= 0.85


def test_sentences_of_several_actions_become_sequences():
    model, text = flame_mdm.load("quickstart"), "a man walks forward. then he sits down, turns left and waves"
    parts = ["a man walks forward", "he sits down", "turns left", "waves"]
    motion, same = (flame_mdm.generate(model, t, num_inference_steps=3)[0] for t in (text, " | ".join(parts)))
    assert [part for part, _, _ in motion.parts] == parts
    np.testing.assert_array_equal(motion.joints, same.joints)
    assert not flame_mdm.generate(model, text, split=False, num_inference_steps=3)[0].parts


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
