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


@pytest.mark.parametrize(
    ("every", "least"),
    [
        pytest.param(3, 0.85, marks=pytest.mark.slow),
        pytest.param(1, 0.85, marks=[pytest.mark.slow, pytest.mark.robustness]),
    ],
)
def test_the_model_understands_sentences_as_people_type_them(every, least):
    """A motion is right if it shows every attribute that its sentence states; a list holds what fits."""
    assert len(SENTENCES) == len({sentence["text"].lower() for sentence in SENTENCES}) == 300
    model, sentences, known = flame_mdm.load("quickstart"), SENTENCES[::every], []
    for sentence in sentences:
        with suppress(UserError):
            check_known(sentence["text"], model.facts)
            known.append(sentence)
    texts = [sentence["text"] for sentence in known]
    right = 0
    for motion, sentence in zip(
        flame_mdm.generate(model, texts, cleanup=True, num_inference_steps=10), known, strict=True
    ):
        seen = read_attributes(motion.joints, motion.fps)
        stated = {name: value if isinstance(value, list) else [value] for name, value in sentence.items()}
        right += all(seen.get(name) in values for name, values in stated.items() if name != "text")
    assert right / len(sentences) >= least


def test_sentences_of_several_actions_become_sequences():
    model = flame_mdm.load("quickstart")
    text = "a man walks forward. then he sits down, turns left and waves"
    (motion,) = flame_mdm.generate(model, text, num_inference_steps=3)
    parts = ["a man walks forward", "he sits down", "turns left", "waves"]
    assert [part for part, _, _ in motion.parts] == parts
    (same,) = flame_mdm.generate(model, " | ".join(parts), num_inference_steps=3)
    np.testing.assert_array_equal(motion.joints, same.joints)
    assert not flame_mdm.generate(model, text, split=False, num_inference_steps=3)[0].parts
    assert not flame_mdm.generate(model, "raises both hands and waves", num_inference_steps=3)[0].parts


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
