"""What sampling makes of texts: known forms of words, unknown words, and sentences of several actions."""

import numpy as np
import pytest

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.conditions.vocabulary import (
    MAX_CAPTIONS,
    advice,
    check_known,
    hashed,
    in_parts,
    known_form,
    nearest,
    vocabulary,
    words,
)
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError

CAPTIONS = ["A person walks forward.", "a person waves with the left hand", "someone jumps"]


def test_a_vocabulary_holds_every_word_once_and_captions_only_if_they_may_be_shared():
    kept = vocabulary([*CAPTIONS, *CAPTIONS], share=False)
    assert kept == {"vocabulary": sorted(set(" ".join(CAPTIONS).lower().replace(".", "").split()))}
    assert vocabulary(CAPTIONS, share=True)["captions"] == sorted(CAPTIONS)
    many = [f"caption {number:05d}" for number in range(3 * MAX_CAPTIONS)]
    assert vocabulary(many, share=True)["captions"] == many[::3]
    assert vocabulary([], share=True) == {"vocabulary": [], "captions": []}


def test_unseen_and_unread_words_are_named_once_with_one_suggestion():
    facts = vocabulary(CAPTIONS, share=True)
    assert advice("A person WAVES, with the hand! They were walking", facts) == []  # walks; function words
    (line,) = advice("a person dances the flamenco and dances with the left foot", facts)
    assert line == f"never seen in training: dances, flamenco, foot. Did you mean '{CAPTIONS[1]}'?"
    (line,) = advice("A person wakls forwrad.", facts)
    assert line == "never seen in training: wakls, forwrad. Did you mean 'a person walks forward.'?"
    assert advice("a person walks happily", {"vocabulary": ["walks"]}) == ["never seen in training: happily."]
    text = "a person walks forward and then jumps"
    assert advice(text, {}, max_words=5) == ["only the first 5 words are read, not 'then jumps'"]
    assert advice(text, {}, max_words=7) == []
    for text, first in (("walks", 0), ("jumps", 2), ("the left hand of a person", 1)):
        assert nearest(text, CAPTIONS)[0] == CAPTIONS[first]


@pytest.mark.parametrize("text", ["un uomo cammina in avanti", "人が歩く", "a person"])
def test_a_text_without_a_known_word_is_refused(text, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    model = flame_mdm.load("quickstart")
    with pytest.raises(UserError, match=r"the model knows no word of it that says what happens\. Did you mean"):
        flame_mdm.generate(model, text)
    with pytest.raises(UserError, match="knows no word"):
        flame_mdm.edit(model, np.zeros((30, 22, 3)), text, fps=20, region="prefix")
    assert main(["sample", "quickstart", f"text={text}"]) == 1
    assert "knows no word of it" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
    check_known(text, {})  # models without a vocabulary read every word


def test_words_are_read_in_a_known_form_and_unknown_ones_are_dropped():
    forms = {"walks": "walked", "wave": "waving", "hop": "hopping", "ball": "balls", "sits": "sit"}
    assert {known_form(word, forms) for word in forms.values()} == set(forms)
    assert [known_form(word, forms) for word in ("string", "hip", "s", "walkie")] == [None] * 4
    tokens = LearnedTokens(features=8, heads=1, buckets=64)
    every = tokens.rows("he walked moonily to the ball")
    tokens.seen = {*forms, "the", "he"}
    assert tokens.rows("he walked moonily to the balls") == tokens.rows("he walks the ball") == [
        every[0], every[1], hashed("walks", 64), every[5], every[6]
    ]  # fmt: skip


SENTENCES = {
    "walks forward. then he sits down. then he waves": ["walks forward", "he sits down", "he waves"],
    "walks forward, turns left and waves": ["walks forward", "turns left", "waves"],
    "First he walks forward. After that he quickly sits down; finally, he claps!":
        ["he walks forward", "he quickly sits down", "he claps"],
    "A man is walking forward and then turns left, and then a woman waves":
        ["A man is walking forward", "turns left", "a woman waves"],
    "raises both hands and waves": None, "bows forward and stands up again": None, "A woman is walking slowly.": None,
    "stands still, waving": None, "walks forward. Slowly, very slowly": None,
    "walks forward, head down": None, "Run!": None,
}  # fmt: skip


def test_sentences_of_several_actions_are_split_at_their_verbs():
    for text, parts in SENTENCES.items():
        assert in_parts(text, Synthetic.verbs) == (parts or [text])
    assert in_parts("walks forward, turns left. Then waves", ()) == ["walks forward, turns left", "waves"]
    assert in_parts("walks, then turns in limp style.", ()) == ["walks in limp style", "turns in limp style"]


def test_checkpoints_know_the_words_of_their_training_clips(trained):
    facts = read_checkpoint(trained)["facts"]
    assert {"a", "person", "walks"} <= set(facts["vocabulary"])
    assert facts["vocabulary"] == sorted({word for caption in facts["captions"] for word in words(caption)})
