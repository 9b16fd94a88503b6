"""What sampling says about words that a model has not seen in training."""

from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.conditions.vocabulary import MAX_CAPTIONS, advice, nearest, vocabulary, words

CAPTIONS = ["A person walks forward.", "a person waves with the left hand", "someone jumps"]


def test_a_vocabulary_holds_every_word_once_and_captions_only_if_they_may_be_shared():
    kept = vocabulary([*CAPTIONS, *CAPTIONS], share=False)
    assert kept == {"vocabulary": sorted(set(" ".join(CAPTIONS).lower().replace(".", "").split()))}
    assert vocabulary(CAPTIONS, share=True)["captions"] == sorted(CAPTIONS)
    many = [f"caption {number:05d}" for number in range(3 * MAX_CAPTIONS)]
    assert vocabulary(many, share=True)["captions"] == many[::3]
    assert vocabulary([], share=True) == {"vocabulary": [], "captions": []}


def test_unseen_and_unread_words_are_named_once_with_the_captions_that_share_most_words():
    facts = vocabulary(CAPTIONS, share=True)
    assert advice("A person WAVES, with the hand!", facts) == []
    (line,) = advice("a person dances the flamenco and dances", facts)
    assert line.startswith("never seen in training: dances, flamenco, and. ")
    assert line.endswith(f". The nearest training captions: '{CAPTIONS[1]}', '{CAPTIONS[0]}'")
    (line,) = advice("人が歩く", facts)
    assert line == "never seen in training: 人が歩く. The model guesses from the other words"
    text = "a person walks forward and then jumps"
    assert advice(text, {}, max_words=5) == ["only the first 5 words are read, not 'then jumps'"]
    assert advice(text, {}, max_words=7) == []
    for text, first in (("walks", 0), ("jumps", 2), ("the left hand of a person", 1)):
        assert nearest(text, CAPTIONS)[0] == CAPTIONS[first]


def test_checkpoints_know_the_words_of_their_training_clips(trained):
    facts = read_checkpoint(trained)["facts"]
    assert {"a", "person", "walks"} <= set(facts["vocabulary"])
    assert facts["vocabulary"] == sorted({word for caption in facts["captions"] for word in words(caption)})
