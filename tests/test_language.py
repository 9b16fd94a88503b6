"""How sentences are understood, and the words that a model gets for them."""

import hashlib
import json
import re
import zlib
from collections import defaultdict
from html import unescape
from itertools import chain
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from support.fixtures import ROOT

from flame_mdm.conditions.language import meaning, tokens
from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.attributes import MEASURES
from flame_mdm.conditions.language.meaning import is_thing, nearest_actions
from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.reading import NotUnderstood, Reader
from flame_mdm.conditions.language.spelling import corrections, distance
from flame_mdm.conditions.language.tables import actions, words_of
from flame_mdm.conditions.language.tokens import corrected_to_action, is_english, tokenize
from flame_mdm.conditions.language.understanding import Mention, Understanding
from flame_mdm.conditions.language.vectors import FILE, WordTable, word_table
from flame_mdm.conditions.language.wording import attribute_words, caption, predicate
from flame_mdm.conditions.prompts import read_prompt
from flame_mdm.conditions.vocabulary import (
    MAX_CAPTIONS,
    advice,
    hashed,
    in_parts,
    known_form,
    nearest,
    plainest,
    vocabulary,
)
from flame_mdm.data.synthetic import draw_captions, prompts
from flame_mdm.data.synthetic_actions import ACTIONS
from flame_mdm.demo.chips import _with_action, chips
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.sampling.motion_request import read_parts
from flame_mdm.sampling.referee.kinds import KINDS
from flame_mdm.sampling.referee.sentences import read_claims

ATTRIBUTES = ("side", "count", "direction", "speed")


def requests() -> list[dict]:
    """Requests as people type them, written before the tables of the language, with what each asks for."""
    lines = (
        (ROOT / "tests" / "fixtures" / "typed_requests.jsonl")
        .read_text(encoding="utf-8")
        .splitlines()
    )
    return [json.loads(line) for line in lines]


def checks(request: dict, understood: Understanding) -> list[bool]:
    """Which attributes of a request are understood: order, and of each action its name, side, count, ..."""
    if "refused" in request:
        reason = "language" if understood.is_foreign else "" if understood.steps else "action"
        names = {mention.action for mention in understood.mentions}
        return [reason in request["refused"] or bool(names and names <= set(request["refused"]))]

    expected, steps = request["steps"], [list(step) for step in understood.steps]
    if request.get("order") == "any":
        expected, steps = [list(chain(*expected))], [list(chain(*steps))]
    sizes = [len(step) for step in expected]
    right = [sizes == [len(step) for step in steps]]
    for number, step in enumerate(expected):
        mentions = steps[number] if number < len(steps) else []
        for action in step:
            match = next(
                (mention for mention in mentions if mention.action in action["action"]), None
            )
            right.append(match is not None)
            stated = match.attributes if match else {}
            right += [stated.get(name) == action[name] for name in ATTRIBUTES if name in action]
            right += [
                False
                for name in ("side", "count", "speed")
                if name in stated and name not in action
            ]
            if match:
                mentions.remove(match)
    right += [word in understood.objects for word in request.get("objects", [])]
    return right


@pytest.mark.parametrize("half", ["dev", "test"])
def test_requests_as_people_type_them_are_understood(half):
    """The tables were written with the first half; nothing was changed because of the second half."""
    by_kind = defaultdict(list)
    for request in requests():
        if request["half"] == half:
            by_kind[request["kind"]] += checks(request, understand(request["text"]))
    shares = {kind: sum(right) / len(right) for kind, right in by_kind.items()}
    assert min(shares.values()) >= 0.85, shares


def test_the_prompts_of_the_synthetic_set_are_understood(subtests):
    for text, attributes in prompts():
        with subtests.test(text=text):
            (step,) = understand(text).steps
            names = actions()[step[0].action].names
            assert attributes["action"] in names, text
            stated = {"count": 1, "speed": "normal", "amount": "quarter"} | dict(step[0].attributes)
            assert attributes.items() <= (stated | {"action": attributes["action"]}).items(), text


def test_captions_of_all_synthetic_actions_are_understood():
    rng = np.random.default_rng(0)
    right = []
    for name, action in ACTIONS.items():
        captions, _ = draw_captions(rng, action.draw(rng, name), 4)
        for text in captions:
            mentions = understand(text).mentions
            right.append(len(mentions) == 1 and name in actions()[mentions[0].action].names)
    assert sum(right) / len(right) >= 0.85


def test_captions_say_what_they_are_understood_to_say(subtests):
    for name, entry in actions().items():
        mentions = [Mention(name)]
        if "direction" in entry.takes:
            mentions.append(Mention(name, {"direction": "left"}))
        if "count" in entry.takes:
            mentions.append(Mention(name, {"count": 3}))
        if "side" in entry.takes:
            mentions.append(Mention(name, {"side": "right"}))
        for mention in mentions:
            with subtests.test(mention=predicate(mention)):
                if entry.takes & {"steps"} and "count" in mention.attributes:
                    continue
                (step,) = understand(caption((mention,))).steps
                assert step[0].action == name, predicate(mention)
                assert mention.attributes.items() <= step[0].attributes.items(), predicate(mention)


FACTS = {
    "actions": list(dict.fromkeys(str(attributes["action"]) for _, attributes in prompts())),
    "verbs": ["walks"],
    "vocabulary": sorted(
        {word for text, _ in prompts() for word in text.lower().split()} | {"crouches", "sits"}
    ),
    "captions": [text for text, _ in prompts()],
}


@pytest.mark.parametrize(
    ("text", "captions"),
    [
        ("walk left", ["a person walks sideways to the left"]),
        ("crouch", ["a person squats"]),
        ("a person stretches both arms above the head", ["a person raises both arms"]),
        (
            "before sitting down, the person turns around",
            ["a person turns around", "a person sits down"],
        ),
        ("after jumping twice, a person bows", ["a person jumps twice", "a person bows"]),
        (
            "a person sits down and stands up again",
            ["a person sits down", "a person stands up from a chair"],
        ),
        ("walk until he sits down", ["a person walks forward", "a person sits down"]),
        ("persn wlaks foward", ["a person walks forward"]),
        ("kik with teh left leg", ["a person kicks with the left leg"]),
        ("jupms and sist", ["a person jumps", "a person sits down"]),
        ("a man hurls a grenade with the left hand", ["a person throws a ball with the left hand"]),
        ("a person walks four meters", ["a person walks forward"]),
        ("kicks four times with the right leg", ["a person kicks twice with the right leg"] * 2),
    ],
)
def test_a_model_reads_sentences_in_its_own_words(text, captions):
    assert list(Reader(FACTS).read(text).captions) == captions


def test_a_reading_says_what_is_different_from_the_sentence():
    reader = Reader(FACTS)
    assert reader.read("a person walks four steps nervously").warnings() == [
        "not understood: nervously, 4 steps"
    ]
    assert reader.read("wlak").warnings() == ["'wlak' is read as 'walk'"]
    (line,) = reader.read("while walking, a man waves").warnings()
    assert (
        line
        == "the model cannot do 'walks forward' and 'waves' at the same time: they are sampled one after the other"
    )
    (line,) = reader.read("a person limps").warnings()
    assert (
        line
        == "the model does not know 'walks with a limp': the person walks forward slowly instead"
    )


def test_two_actions_that_a_model_knows_as_one_are_joined():
    text = "stretches both arms above the head and leans to the left"
    facts = FACTS | {"actions": [*FACTS["actions"], "stretch sideways"], "captions": []}
    facts["vocabulary"] = [*FACTS["vocabulary"], "stretches", "sideways"]
    assert Reader(facts).read(text).captions == ("a person stretches sideways to the left",)
    with pytest.raises(NotUnderstood, match="the model does not know 'leans'"):
        Reader(FACTS).read(text)


def test_actions_at_the_same_time_are_one_caption_for_a_model_that_knows_them():
    facts = FACTS | {
        "captions": [*FACTS["captions"], "a person walks forward while waving with the left hand"],
        "vocabulary": [*FACTS["vocabulary"], "while", "waving"],
    }
    (line,) = Reader(facts).read("while walking, a man waves with the left hand").captions
    assert line == "a person walks forward while waving with the left hand"


def test_words_that_no_table_lists_are_read_as_they_are_if_the_model_knows_them():
    facts = FACTS | {"vocabulary": [*FACTS["vocabulary"], "yodels", "loudly"]}
    assert Reader(facts).read("a person yodels loudly").captions == ("a person yodels loudly",)
    with pytest.raises(NotUnderstood):
        Reader(FACTS).read("a person yodels loudly")


@pytest.mark.parametrize(
    "text", ["ein Mann geht langsam", "un homme marche", "人が歩く", "человек идёт"]
)
def test_other_languages_are_refused_with_one_line(text):
    with pytest.raises(UserError, match="only English prompts are supported"):
        Reader(FACTS).read(text)


@pytest.mark.parametrize("text", ["photosynthesis", "xyzzy plugh"])
def test_words_without_a_meaning_are_refused_without_suggestions(text):
    with pytest.raises(
        NotUnderstood, match=r"no word says what happens\. Name an action"
    ) as refusal:
        Reader(FACTS).read(text)
    assert refusal.value.nearest == ()


@pytest.mark.parametrize("text", ["a blue grenade on a shelf", "backflip", "climb a ladder"])
def test_a_sentence_without_a_known_action_is_refused_with_three_actions(text, subtests):
    with pytest.raises(NotUnderstood) as refusal:
        Reader(FACTS).read(text)
    assert len(set(refusal.value.nearest)) == 3
    for suggested in refusal.value.nearest:
        with subtests.test(suggested=suggested):
            assert Reader(FACTS).read(suggested).captions


def test_a_word_in_no_table_acts_as_the_nearest_action_or_is_known_as_a_thing():
    assert nearest_actions("brawl")[0][0] == "punch"
    brawl, walk = understand("two men brawl, then walk").mentions
    assert (brawl.action, brawl.typed) == ("punch", "brawl")
    assert (walk.action, walk.typed) == ("walk", "")
    assert is_thing("helmet")
    assert "helmet" in understand("a person throws a helmet").objects
    assert nearest_actions("qwertzy") == []


def test_numbers_are_no_typos_and_no_forms_of_other_words():
    assert known_form("four", {"fours", "walks"}) is None
    assert known_form("walked", {"fours", "walks"}) == "walks"
    assert corrections("4x") == ()
    assert understand("kicks four times").mentions[0].attributes["count"] == 4


@pytest.mark.parametrize(
    ("text", "attributes"),
    [
        ("a person turns left", {"direction": "left"}),
        ("a person turns to the left", {"direction": "left"}),
        ("a person turns their left leg", {}),  # the leg is left, not the turn
        ("a person walks, left foot first", {}),
        ("a person steps left", {"direction": "left"}),
        ("a person hops to the right on the left leg", {"side": "left", "direction": "right"}),
        ("a person looks over the left shoulder", {"direction": "left"}),
        ("a person walks back", {"direction": "backward"}),
        ("a person walks with a hand on the back", {}),
        ("a person walks in a circle to the left", {"direction": "counterclockwise"}),
        ("a person walks to the right in a circle", {"direction": "clockwise"}),
        ("a person walks clockwise in a circle", {"direction": "clockwise"}),
        ("a person walks up", {}),  # only stairs and the like have a vertical direction
        ("a person climbs up", {"direction": "up"}),
    ],
)
def test_left_and_right_are_directions_unless_they_name_a_part_of_the_body(
    text: str, attributes: dict
):
    (mention,) = understand(text).mentions
    assert dict(mention.attributes) == attributes


@pytest.mark.parametrize(
    ("text", "action", "typed", "word"),
    [
        ("doge to the left", "dodge", "doge", "dodge"),
        ("a person skps", "skip", "skps", "skips"),
        # These are words of the table of vectors, but rare and far from any action.
        ("a person clans quietly", "clap", "clans", "claps"),
        ("they quietly threads to the left", "walk", "threads", "treads"),
    ],
)
def test_a_word_that_is_one_letter_from_an_action_is_read_as_this_action(
    text: str, action: str, typed: str, word: str
):
    understood = understand(text)
    assert [mention.action for mention in understood.mentions] == [action]
    assert dict(understood.corrected) == {typed: word}


def test_a_word_for_an_action_replaces_one_token_and_keeps_the_others():
    tokens = tokenize("they quietly threads to the left")
    corrected = corrected_to_action(tokens, [1, 2])
    assert [token.word for token in corrected] == ["they", "quietly", "treads", "to", "the", "left"]
    assert [token.typed for token in corrected] == [token.typed for token in tokens]
    assert (corrected[2].start, corrected[2].end) == (tokens[2].start, tokens[2].end) == (13, 20)
    assert corrected_to_action(tokens, [0, 1]) == tokens


@pytest.mark.parametrize(
    ("first", "second", "most", "expected"),
    [
        ("walk", "walk", 2, 0),
        ("wlak", "walk", 2, 1),  # swapped
        ("wak", "walk", 2, 1),  # missing
        ("waalk", "walk", 2, 1),  # additional
        ("wolk", "walk", 2, 1),  # replaced
        ("", "abc", 5, 3),
        ("kitten", "sitting", 5, 3),
        ("kitten", "sitting", 2, 3),  # more than allowed
        ("wander", "a", 2, 3),
        ("abcdef", "fedcba", 9, 5),
    ],
)
def test_letters_that_are_swapped_missing_additional_or_replaced_are_counted(
    first: str, second: str, most: int, expected: int
):
    assert distance(first, second, most) == distance(second, first, most) == expected


@pytest.mark.parametrize(
    ("word", "expected"),
    [
        ("jupm", ("jump",)),
        ("jxxp", ()),  # two letters of a short word
        ("cartwhxel", ("cartwheel",)),
        ("cxrtwhxel", ("cartwheel",)),
        ("cxrtwhxex", ()),  # three letters of a long word
    ],
)
def test_short_words_may_have_one_wrong_letter_and_long_words_two(word: str, expected: tuple):
    assert corrections(word) == expected


def test_a_word_is_not_corrected_if_it_is_english(subtests):
    for text in ("a person walks to the shelf", "a person is talking", "stairs", "reaction"):
        with subtests.test(text=text):
            assert not understand(text).corrected


def test_the_table_of_vectors_is_small_and_has_its_license_beside_it():
    assert FILE.stat().st_size <= 1.5e6
    assert "Apache License, Version 2.0" in FILE.with_suffix(".md").read_text()
    table = word_table()
    assert table.vectors.shape == (len(table.words), 64)


def test_abilities_are_read_from_the_facts_of_a_model():
    abilities = Abilities(FACTS)
    assert {"walk", "idle", "stand up", "pick up"} <= set(abilities.actions)
    assert "backflip" not in abilities.actions
    assert abilities.choices("kick") == {"count": [1, 2], "side": ["left", "right"]}
    assert not abilities.is_simultaneous


@pytest.mark.parametrize("names", [("side", "direction"), ("direction", "side")])
def test_a_side_and_a_direction_with_the_same_word_are_known_separately(names):
    captions = ["a person reaches to the left", "a person reaches with the right hand"]
    words = sorted({word for text in captions for word in text.split()} | {"left", "right"})
    abilities = Abilities({"actions": ["reach"], "vocabulary": words, "captions": captions})
    supported = {
        (name, value): abilities.supports("reach", name, value)
        for name in names
        for value in ("left", "right")
    }
    assert supported == {
        ("direction", "left"): True,
        ("direction", "right"): False,
        ("side", "left"): False,
        ("side", "right"): True,
    }


PARTS = [
    ("kicks twice with the left leg", 1.5),
    ("a person walks <b>", None),
    ("jumps nervously and sits down", None),
]


def selects() -> dict[str, list[tuple[str, bool, str]]]:
    """The options of the chips for `PARTS`: text of the form, whether it is selected, and label."""
    reader = Reader(FACTS)
    page = chips(reader.abilities, PARTS, [reader.read(words) for words, _ in PARTS])
    assert "<span>jumps</span> then <span>sits down</span> <del>" in page  # two actions in a part
    assert "<b>" not in page
    assert page.count(" then ") == 3
    options_of = {}
    for part, content in enumerate(page.split(" then ")[:2]):
        for name, options in re.findall(r'<select aria-label="(\w+)".*?>(.*?)</select>', content):
            options_of[f"{name} {part}"] = [
                (unescape(text), bool(selected), unescape(label))
                for text, selected, label in re.findall(
                    r'<option value="(.*?)"( selected)?>(.*?)</option>', options
                )
            ]
    return options_of


def test_chips_show_the_action_and_attributes_that_a_text_states():
    chosen = {
        name: [label for _, selected, label in options if selected]
        for name, options in selects().items()
    }
    assert chosen == {
        **{"Action 0": ["kicks"], "Count 0": ["twice"], "Side 0": ["left"]},
        **{"Action 1": ["walks"], "Direction 1": ["any direction"], "Speed 1": ["any speed"]},
    }


def test_another_action_keeps_the_shown_attributes_that_it_can_have():
    (mention,) = understand("turns a quarter to the left").mentions
    assert dict(mention.attributes) == {"direction": "left", "amount": "quarter"}
    assert _with_action(mention, "spin").attributes == {"direction": "left"}  # no chip for amounts
    assert _with_action(mention, "kick").attributes == {}


def test_an_option_of_a_chip_changes_one_action_or_attribute_and_keeps_all_other_parts():
    before = [understand(words).mentions[0] for words, _ in PARTS[:2]]
    labels = {"to the left": "left", "to the right": "right", "once": 1, "twice": 2}
    labels |= {"slowly": "slow", "quickly": "fast"}
    count = 0
    for name, options in selects().items():
        kind, part = name.split()[0].lower(), int(name.split()[1])
        for text, selected, label in options:
            phrases = text.split(" | ")
            phrases[0], seconds = phrases[0].split(" @")
            assert seconds == "1.5"
            others = [words for words, _ in PARTS]
            del others[part]
            (mention,) = understand(phrases.pop(part)).mentions
            assert phrases == others
            expected = dict(before[part].attributes)
            if kind == "action":
                assert (mention.action == before[part].action) == selected
                kept = set(actions()[mention.action].takes) & set(ATTRIBUTES)
                expected = {key: value for key, value in expected.items() if key in kept}
            else:
                assert mention.action == before[part].action
                expected.pop(kind, None)
                if not label.startswith("any "):
                    expected[kind] = labels.get(label, label)
            usual = actions()[mention.action].usual
            stated = {k: v for k, v in mention.attributes.items() if v != usual}
            assert stated == {k: v for k, v in expected.items() if v != usual}, (name, label)
            count += 1
    assert count > 50


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("a person walks next to the table slowly", 1),
        ("a person waves, next they jump", 2),
    ],
)
def test_next_to_a_thing_is_a_place_and_next_alone_a_time(text: str, count: int):
    assert len(understand(text).steps) == count


@pytest.mark.parametrize("text", ["three squats", "three slow squats", "three big slow squats"])
def test_words_between_a_number_and_its_action_do_not_hide_the_count(text: str):
    (mention,) = understand(text).mentions
    assert (mention.action, mention.attributes["count"]) == ("squat", 3)


def test_frequent_words_have_little_weight_in_the_mean_of_words():
    """By Zipf's law, the frequency of the word in row n is proportional to 1 / (n + 2)."""
    table = WordTable(["the", "walk", "jump", "wave"], np.eye(4))
    total = 1 / 2 + 1 / 3 + 1 / 4 + 1 / 5
    walk, wave = (1e-4 / (1e-4 + 1 / place / total) for place in (3, 5))
    expected = np.array([0, walk, 0, wave]) / np.hypot(walk, wave)
    mean = table.mean(["walks", "unlisted", "waving"])
    assert mean is not None
    np.testing.assert_allclose(mean, expected)
    assert table.mean(["unlisted"]) is None
    assert (table.rank("jumps"), table.rank("the"), table.has("jumps")) == (2, 0, False)


@pytest.mark.parametrize("word", ["brawl", "stroll", "bread", "tiptoeing"])
def test_an_action_is_as_similar_as_its_closest_word_and_the_mean_of_its_words(word: str):
    table, scores = word_table(), {}
    vector = table.vector(word)
    assert vector is not None
    for name, entry in actions().items():
        single = [phrase.words[0] for phrase in entry.phrases if phrase.size == 1]
        rows = [table.vector(other) for other in single if other not in words_of("weak")]
        rows = [row for row in rows if row is not None]
        if not rows and (mean := table.mean(list(entry.phrases[0].words))) is not None:
            rows = [mean]
        closest = max((float(row @ vector) for row in rows), default=-1.0)
        center = np.sum(rows, axis=0) if rows else np.zeros(64)
        center = center / max(np.linalg.norm(center), 1e-9)
        scores[name] = (closest + float(center @ vector)) / 2
    ranked = nearest_actions(word)
    assert dict(ranked) == pytest.approx(scores, abs=1e-5)
    assert [score for _, score in ranked] == sorted((score for _, score in ranked), reverse=True)


@pytest.mark.parametrize(
    ("count", "repeats"), [(5, ["twice", "twice", "once"]), (12, ["twice"] * 6), (13, [""])]
)
def test_up_to_twelve_repetitions_are_sampled_in_parts(count: int, repeats: list[str]):
    reading = Reader(FACTS).read(f"kicks {count} times")
    assert list(reading.captions) == [f"a person kicks {times}".strip() for times in repeats]
    is_ignored = reading.ignored == ("13 times",)
    assert is_ignored == (count == 13)
    if not is_ignored:
        numbers = {"once": 1, "twice": 2}
        seconds = [0.8 + 0.7 * numbers[times] for times in repeats]
        assert reading.seconds() == pytest.approx(seconds)


@pytest.mark.parametrize(
    ("text", "count"),
    [
        ("jumps x 3", 3),
        ("jumps 3 times", 3),
        ("jumps 3x", 3),
        ("jumps a couple of times", 2),
        ("jumps two more times", 2),
        ("jumps thrice", 3),
        ("does five quick push-ups", 5),
        ("claps 120 times", 120),
        ("claps 1200 times", None),
        ("jumps for five seconds", None),
        ("jumps over two meters", None),
        ("jumps with both arms", None),
        ("jumps on one leg", None),
        ("takes three steps", 3),
        ("jumps once", 1),
        ("jumps once he has looked around", None),
    ],
)
def test_numbers_are_counts_unless_they_measure_something_else(text: str, count: int | None):
    assert understand(text).mentions[0].attributes.get("count") == count


@pytest.mark.parametrize(
    ("text", "amount"),
    [
        ("turns 180 degrees", "half"),
        ("turns around", "half"),
        ("makes half a turn", "half"),
        ("turns 90 degrees", "quarter"),
        ("makes a quarter turn to the left", "quarter"),
        ("turns to the left", None),
    ],
)
def test_a_turn_has_an_amount_if_its_angle_is_stated(text: str, amount: str | None):
    (mention,) = understand(text).mentions
    assert (mention.action, mention.attributes.get("amount")) == ("turn", amount)


@pytest.mark.parametrize(
    ("text", "steps"),
    [
        ("a person jumps before bowing", ["jump", "bow"]),
        ("before bowing, a person jumps", ["jump", "bow"]),
        ("a person bows after jumping", ["jump", "bow"]),
        ("after jumping, a person bows", ["jump", "bow"]),
        ("once they have jumped, they bow", ["jump", "bow"]),
        ("when the person has jumped, he bows", ["jump", "bow"]),
        ("a person jumps until he bows", ["jump", "bow"]),
        ("a person jumps, bows afterwards", ["jump", "bow"]),
        ("a person jumps followed by bowing", ["jump", "bow"]),
        ("a person jumps, followed by two bows", ["jump", "bow"]),
        ("a person follows the wall", ["walk"]),
        ("a person jumps before bowing, then kicks", ["jump", "bow", "kick"]),
        ("a person walks and waves, both at the same time", ["walk+wave"]),
        ("a person jumps and bows", ["jump", "bow"]),
        ("a person kicks, jumps and bows after clapping", ["kick", "jump", "clap", "bow"]),
        ("a person waves while walking", ["wave+walk"]),
        ("while walking, a person waves", ["walk+wave"]),
        ("while walking, a person waves, then bows", ["walk+wave", "bow"]),
        ("a person walks, waving", ["walk+wave"]),
        ("a person walks and waves at the same time", ["walk+wave"]),
        ("a person kicks, then walks and waves simultaneously", ["kick", "walk+wave"]),
        ("a person jumps once", ["jump"]),
        ("a person walks next to the table", ["walk"]),
        ("a person stands still while waving", ["wave"]),
        ("a person kicks, then faster", ["kick", "kick"]),
    ],
)
def test_connectives_state_the_order_of_actions(text: str, steps: list[str]):
    understood = understand(text).steps
    assert ["+".join(mention.action for mention in step) for step in understood] == steps


def test_a_word_is_replaced_by_the_most_similar_one_from_a_cosine_of_0_65_on(monkeypatch):
    cosines = {"alpha": 1.0, "beta": 0.65, "gamma": 0.64, "delta": 0.7}
    vectors = [[cosine, (1 - cosine**2) ** 0.5] for cosine in cosines.values()]
    table = WordTable(list(cosines), np.array(vectors))
    monkeypatch.setattr(meaning, "word_table", lambda: table)
    for words, expected in (
        (["gamma"], None),
        (["gamma", "beta"], "beta"),
        (["unlisted", "beta", "delta", "gamma"], "delta"),
        (["unlisted"], None),
    ):
        assert meaning.similar_word("alpha", words) == expected
    assert meaning.similar_word("unlisted", ["alpha"]) is None


@pytest.mark.parametrize(("things", "expected"), [([0.9, 0.8, 0.7], True), ([0.9, 0.8], False)])
def test_a_word_is_a_thing_if_three_of_the_five_closest_words_are(monkeypatch, things, expected):
    def vectors(cosines: list[float]) -> np.ndarray:
        return np.array([[cosine, (1 - cosine**2) ** 0.5] for cosine in cosines])

    table = WordTable(["word"], np.array([[1.0, 0.0]]))
    listed = ["walk"], np.zeros(5, int), vectors([0.95, 0.85, 0.6, 0.5, 0.4])
    monkeypatch.setattr(meaning, "word_table", lambda: table)
    monkeypatch.setattr(meaning, "_action_vectors", lambda: listed)
    monkeypatch.setattr(meaning, "_thing_vectors", lambda: vectors(things))
    assert meaning.is_thing("word") == expected
    assert not meaning.is_thing("unlisted")


@pytest.mark.parametrize("measure", [measure for measure in MEASURES if measure != "step"])
def test_a_number_of_a_measure_is_no_count(measure: str):
    (mention,) = understand(f"a person hops 3 {measure}").mentions
    assert (mention.action, mention.attributes.get("count")) == ("hop", None)
    assert understand("a person hops 3 steps").mentions[0].attributes["count"] == 3


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("count", 1, "once"),
        ("count", 6, "six times"),
        ("count", 7, "7 times"),
        ("amount", "half", "halfway around"),
        ("amount", "quarter", "a quarter"),
        ("direction", "left", "to the left"),
        ("direction", "right", "to the right"),
        ("direction", "circle", "in a circle"),
        ("direction", "up", "up"),
        ("speed", "fast", "quickly"),
        ("speed", "normal", "normal"),
        ("side", "both", "both"),
    ],
)
def test_an_attribute_is_named_as_in_captions(name: str, value: str | int, words: str):
    assert attribute_words(name, value) == words


@pytest.mark.parametrize(("rank", "is_frequent"), [(11_999, True), (12_000, False), (None, False)])
def test_the_twelve_thousand_most_frequent_words_are_english(rank, is_frequent, monkeypatch):
    table = SimpleNamespace(rank=lambda word: rank, vector=lambda word: None)
    monkeypatch.setattr(tokens, "word_table", lambda: table)
    assert is_english("zzqxvv") == is_frequent
    doge = tokenize("doge")
    words = [token.word for token in corrected_to_action(doge, [0])]
    assert words == (["doge"] if is_frequent else ["dodge"])


def test_words_that_a_model_gets_unchanged_are_not_said_to_change():
    text = "a person kicks four times nervously"
    whole = read_prompt(text, [(text, None)], FACTS)
    assert (whole.captions, whole.changes) == ((text,), ("not understood: nervously",))
    parts = read_prompt(f"{text} | bwos", [(text, 2.0), ("bwos", None)], FACTS)
    assert parts.captions == (text, "a person bows")
    assert parts.changes == ("not understood: nervously", "'bwos' is read as 'bows'")
    split = read_prompt(text, [(text, None)], FACTS, splits=True)
    assert split.captions == ("a person kicks twice",) * 2
    assert split.changes == ("four times is sampled as 2 + 2", "not understood: nervously")


GOLDEN = ROOT / "tests" / "golden" / "language.json"
MORE_TEXTS = [
    "", "!!!", "kicks ４ times", "kicks x 3, then faster", "jumps 13 times", "walks, then slower",
    "a person jumps followed by bowing", "он идёт вперёд", "ÉLÈVE WALKS", "a person walks in limp style",
    "a person somersaults | he bows @2", "stretches both arms above the head and leans to the left",
    "while walking, a man waves with the left hand", "a man waves while walking backwards",
    "a person yodels loudly", "a person brawls", "turns 90 degrees to the left", "turns halfway around",
    "takes a few steps back", "takes three steps to the left", "walks in a circle to the right",
    "walks to the left in a circle", "walks counter-clockwise", "walks anticlockwise slowly",
    "raises both hands", "raises her arms", "raises the right arm twice", "kicks with both legs",
    "kicks a couple of times", "punches left, then right", "punches with his left fist quickly",
    "leans to the left with the right hand", "steps to the left side", "climbs up", "climbs down a ladder",
    "sits down, stands up and sits down again", "stands still, waving", "walks. Finally he sits",
    "at the same time he waves and nods", "he waves at the same time", "jumps once they have turned",
    "jumps once", "jumps next to the table", "next, he jumps", "sits in the chair later",
    "before sitting, he bows twice", "after he bows, he sits", "bows after sitting", "bows before sitting",
    "does not walk but runs", "without running he walks", "picks a box up", "picks up the box with both hands",
    "five quick push-ups", "two slow squats", "does 10 jumping jacks", "walks 5 meters", "waves for 3 seconds",
    "hops on the left foot 3 times", "hops on one leg", "looks back over the shoulder", "go running",
    "the guard walks", "a drunk man walks", "walsk and jmups", "kikcs", "doge to the left", "tims jumps",
    "crawls, crawls faster", "runs then runs backward", "walks forward and walks backward", "sprints",
    "spins clockwise twice", "turns clockwise", "swings a sword with the right hand at a goblin",
    "dances happily like a robot", "a person limps slowly", "crouches 7 times", "jumps 4 times",
    "a person walks four steps nervously", "climbs a ladder", "a person is upset", "a blue grenade",
    "walks 10 percent faster", "jumps 2 feet high", "turns a quarter", "turns a quarter to the left quickly",
]  # fmt: skip


def all_texts() -> list[str]:
    return [*(request["text"] for request in requests()), *MORE_TEXTS]


def shown_mention(mention: Mention) -> str:
    stated = "".join(f" {name}={value}" for name, value in sorted(mention.attributes.items()))
    typed = f" as {mention.typed}" if mention.typed else ""
    return f"{mention.action}{stated}{typed} '{mention.text}' {mention.start}-{mention.end}"


def shown_understanding(text: str) -> str:
    """Everything that is understood of a text, in one line."""
    understood = understand(text)
    steps = " > ".join(" + ".join(map(shown_mention, step)) for step in understood.steps)
    rest = [
        f"things: {', '.join(understood.objects)}" if understood.objects else "",
        f"unknown: {', '.join(understood.unknown)}" if understood.unknown else "",
        f"corrected: {dict(understood.corrected)}" if understood.corrected else "",
        f"nearest: {', '.join(understood.nearest)}" if understood.nearest else "",
        "foreign" if understood.is_foreign else "",
    ]
    return "; ".join(filter(None, [steps, *rest]))


def shown_reading(reader: Reader, text: str) -> str:
    """The captions that a model reads for a text, and what it says about them, in one line."""
    try:
        reading = reader.read(text)
    except UserError as error:
        return f"refused: {error}"
    captions = [
        f"{caption} ({words}, {seconds and round(seconds, 2)})"
        for caption, words, seconds in zip(
            reading.captions,
            reading.texts,
            reading.seconds() or (None,) * len(reading.texts),
            strict=True,
        )
    ]
    return "; ".join([" > ".join(captions), reading.summary(), *reading.warnings()])


def models() -> list[Reader]:
    """Readers for a model with the actions of the synthetic set, and for one that knows more words and captions."""
    both = "a person walks forward while waving with the left hand"
    added = "stretches sideways sneaks slowly limps yodels crawls somersaults"
    more = {
        "actions": [*FACTS["actions"], "stretch sideways", "sneak", "limp", "no_action"],
        "captions": [*FACTS["captions"], both],
        "vocabulary": sorted({*FACTS["vocabulary"], *both.split(), *added.split()}),
    }
    return [Reader(FACTS), Reader(FACTS | more)]


def table_rows() -> dict[str, str]:
    """The rows of the tables of words and of claims, each as the start of a hash."""
    folder = ROOT / "flame_mdm" / "conditions" / "language"
    referee = ROOT / "flame_mdm" / "sampling" / "referee"
    rows = {}
    paths = [folder / name for name in ("actions.yaml", "phrases.yaml")]
    paths += [referee / name for name in ("thresholds.yaml", "sentences.yaml")]
    for path in paths:
        content = read_package_yaml(path)
        content = content.get("thresholds", content)
        for name, row in content.items():
            text = json.dumps(row, sort_keys=True, default=str)
            rows[f"{path.stem}: {name}"] = hashlib.sha256(text.encode()).hexdigest()[:12]
    for name, kind in KINDS.items():
        text = repr((kind.group, kind.measure.__name__, kind.no, kind.yes, kind.is_timed))
        rows[f"kinds: {name}"] = hashlib.sha256(text.encode()).hexdigest()[:12]
    return rows


def chips_of(reader: Reader, text: str) -> str:
    """The chips of a text, and the values that the model knows for its actions."""
    parts = read_parts(text)
    return chips(reader.abilities, parts, [reader.read(words) for words, _ in parts])


WITH_CHIPS = [
    "kicks twice with the left leg @1.5 | walks slowly <nervously> | jumps and sits down",
    "walks backward | waves quickly with both hands @2",
    "while walking, a man waves with the left hand",
]


def golden() -> dict[str, dict[str, Any]]:
    """Contents of the committed file of understood and rewritten sentences."""
    readers = models()
    return {
        "understood": {text: shown_understanding(text) for text in all_texts()},
        "read": {text: [shown_reading(reader, text) for reader in readers] for text in all_texts()},
        "claims": {text: [f"{claim} '{claim.words}'" for claim in read_claims(text)] for text in all_texts()},
        "chips": {text: [chips_of(reader, text) for reader in readers] for text in WITH_CHIPS},
        "choices": {action: [reader.abilities.choices(action) for reader in readers] for action in actions()},
        "tables": table_rows(),
    }  # fmt: skip


@pytest.fixture(scope="module")
def committed() -> dict[str, dict[str, Any]]:
    return json.loads(GOLDEN.read_text(encoding="utf-8"))


REPEAT = "if the change is intended: PYTHONPATH=tests python tests/test_language.py"


def test_texts_are_understood_as_in_the_committed_list(committed):
    """The shares in docs/language.md leave room for single texts; this list leaves none."""
    understood = {text: shown_understanding(text) for text in all_texts()}
    assert understood == committed["understood"], REPEAT


@pytest.mark.parametrize("number", [0, 1])
def test_models_read_the_captions_of_the_committed_list(committed, number: int):
    reader = models()[number]
    read = {text: shown_reading(reader, text) for text in all_texts()}
    assert read == {text: both[number] for text, both in committed["read"].items()}, REPEAT


@pytest.mark.parametrize("number", [0, 1])
def test_chips_and_choices_are_those_of_the_committed_list(committed, number: int):
    reader = models()[number]
    shown = {text: chips_of(reader, text) for text in WITH_CHIPS}
    assert shown == {text: both[number] for text, both in committed["chips"].items()}, REPEAT
    choices = {action: reader.abilities.choices(action) for action in actions()}
    assert choices == {name: both[number] for name, both in committed["choices"].items()}, REPEAT


def test_claims_of_texts_are_those_of_the_committed_list(committed):
    claims = {
        text: [f"{claim} '{claim.words}'" for claim in read_claims(text)] for text in all_texts()
    }
    assert claims == committed["claims"], REPEAT


def test_tables_are_those_for_which_the_documented_shares_were_measured(committed):
    assert table_rows() == committed["tables"], REPEAT


if __name__ == "__main__":
    GOLDEN.write_text(json.dumps(golden(), indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


@pytest.mark.parametrize(
    ("word", "seen", "form"),
    [
        *(
            ("waving", ["wave"], "wave"),
            ("hopping", ["hop"], "hop"),
            ("walked", ["walks"], "walks"),
        ),
        *(("waves", ["waving"], "waving"), ("waved", ["waves"], "waves"), ("runs", ["run"], "run")),
        *(("kicks", ["kicking"], "kicking"), ("stretches", ["stretched"], "stretched")),
        *(("kicked", ["kicks", "kick"], "kick"), ("kicked", ["kicked", "kick"], "kicked")),
        *(("used", ["us"], None), ("goes", ["go"], None), ("hopes", ["hop"], "hop")),
        *(("ten", ["tens"], None), ("sevens", ["seven"], "seven"), ("walker", ["walk"], None)),
    ],
)
def test_a_word_stands_for_another_form_of_itself(word: str, seen: list[str], form: str | None):
    assert known_form(word, seen) == form


@pytest.mark.parametrize("count", [3, 1000, 1001, 1999, 2500])
def test_captions_of_a_checkpoint_are_evenly_spaced_in_sorted_order(count: int):
    captions = [f"walks {number:04d} times" for number in range(count)]
    facts = vocabulary([*captions, "Sits, sits"], [*captions[::-1], captions[0]])
    size = min(count, MAX_CAPTIONS)
    positions = [int(caption.split()[1]) for caption in facts["captions"]]
    assert positions == [count * number // size for number in range(size)]
    assert {len(caption.split()) for caption in facts["captions"]} == {3}
    numbers = [f"{number:04d}" for number in range(count)]
    assert facts["vocabulary"] == [*numbers, "sits", "times", "walks"]
    assert vocabulary(captions).keys() == {"vocabulary"}


@pytest.mark.parametrize("buckets", [7, 4096])
def test_the_two_rows_of_a_word_are_the_digits_of_its_checksum(buckets: int):
    for word in ("walks", "läuft"):
        number = zlib.crc32(word.encode("utf-8"))
        assert hashed(word, buckets) == (number % buckets, (number // buckets) % buckets)


def test_similar_captions_share_content_words_and_then_a_large_fraction_of_all_words():
    captions = [
        "the man sits",
        "a person waves",
        "a person walks and then waves with one hand while standing",
        "a man walks",
        "a person walks",
        "he walks and waves",
    ]
    ranked = nearest("a person walks and waves", captions, 9)
    # Two content words, then one. Among equals, the shares of common words are 5/11 and 3/5, and
    # 3/5, 3/5 and 2/6.
    assert ranked == [captions[k] for k in (5, 2, 1, 4, 3)]
    assert nearest("a person walks and waves", captions) == ranked[:3]
    assert nearest("jumps", captions) == []
    assert nearest("The man", captions, 1) == ["the man sits"]


def test_plain_captions_begin_with_a_person_and_are_short():
    captions = ["he sits", "a person walks", "a person sits", "the man runs", "a personal walk"]
    assert plainest(captions) == [*captions[2:0:-1], captions[0], captions[3], captions[4]]


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        (
            "walks, turns left and waves. Then she sits",
            ["walks", "turns left", "waves", "she sits"],
        ),
        ("raises both hands and waves", ["raises both hands and waves"]),
        ("walks, waves in limp style", ["walks in limp style", "waves in limp style"]),
        (
            "walks in limp style, waves in limp style",
            ["walks in limp style", "waves in limp style"],
        ),
        ("walks in limp style, waves", ["walks in limp style", "waves"]),
        ("walks, slowly turns", ["walks", "slowly turns"]),
        ("walks, a dog then he waves", ["walks, a dog", "he waves"]),
        ("quickly then walks", ["quickly then walks"]),
        ("first walks; afterwards sits!", ["walks", "sits"]),
        ("walks\nsits", ["walks", "sits"]),
        ("walks. Finally, sits.", ["walks", "sits"]),
        ("walks, after that waves", ["walks", "waves"]),
    ],
)
def test_a_sentence_has_one_part_per_verb(text: str, parts: list[str]):
    verbs = ["walks", "turns", "waves", "sits", "raises"]
    result = in_parts(text, verbs)
    assert result == (parts if len(parts) > 1 else [text])


@pytest.mark.parametrize(
    ("text", "suggestion"),
    [
        ("a person wlaks", "a person walks"),
        ("wlaks and wvaes", "walks and waves"),
        ("waalxs quickly", "a man walks quickly"),
        ("zalks quickly", "a man walks quickly"),
        ("Wlaks ZZYZX", None),
        ("Quickly zzyzx", "a man walks quickly"),
        ("zzyzx", None),
    ],
)
def test_typos_are_replaced_by_words_with_the_same_first_letter(text: str, suggestion: str | None):
    facts = {
        "vocabulary": ["a", "and", "man", "person", "quickly", "walks", "waves"],
        "captions": ["a person waves", "a man walks quickly"],
    }
    (line,) = advice(text, facts)
    assert line.partition(".")[2] == (f" Did you mean '{suggestion}'?" if suggestion else "")
    assert advice("a person walked", facts) == []
    assert advice("zzyzx", {}) == []


def test_parts_of_a_prompt_keep_their_durations_and_words_that_are_not_read_are_named():
    facts = {"vocabulary": ["person", "walks", "sits", "down"], "verbs": ["walks", "sits"]}
    parts = [("a person walks happily", 1.5), ("sits down", None)]
    read = read_prompt("", parts, facts, 3, splits=False)
    assert read.parts == parts
    assert read.captions == ("a person walks happily", "sits down")
    assert read.unknown == ("happily", "happily")
    assert (read.summary, read.changes, read.fitting) == ("", (), ())
    unchecked = read_prompt("", [("jumps", 2.0)], facts, 3, check_words=False)
    assert (unchecked.captions, unchecked.unknown) == (("jumps",), ("jumps",))
    with pytest.raises(UserError, match="the model knows none of its content words"):
        read_prompt("", [("walks", None), ("jumps", 2.0)], facts, 3)
