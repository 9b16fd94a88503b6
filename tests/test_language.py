"""What sentences are understood to ask for, and what a model makes of them."""

import json
import re
from collections import defaultdict
from html import unescape
from itertools import chain

import numpy as np
import pytest
from support.fixtures import ROOT

from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.meaning import is_thing, nearest_actions
from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.reading import NotUnderstood, Reader
from flame_mdm.conditions.language.spelling import corrections, distance
from flame_mdm.conditions.language.tables import actions
from flame_mdm.conditions.language.tokens import corrected_to_action, tokenize
from flame_mdm.conditions.language.understanding import Mention, Understanding
from flame_mdm.conditions.language.vectors import FILE, word_table
from flame_mdm.conditions.language.wording import caption, predicate
from flame_mdm.conditions.vocabulary import known_form
from flame_mdm.data.synthetic import draw_captions, prompts
from flame_mdm.data.synthetic_actions import ACTIONS
from flame_mdm.demo.chips import _with_action, chips
from flame_mdm.errors import UserError

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
