"""Near-miss captions: the same action, one attribute contradicted."""

from dataclasses import replace

from evaluators.near_misses import near_misses
from flame_mdm.data.bandai import captions as bandai_captions
from flame_mdm.data.bandai import side_of
from flame_mdm.data.store import Entry
from flame_mdm.data.synthetic import Synthetic


def clip(name: str, captions: list[str], **attributes: str | int | list[str]) -> Entry:
    return Entry(name, 0, 40, "test", name, captions, None, attributes)


def bandai(content: str, style: str, dataset: int = 2) -> Entry:
    side = side_of(content)
    facts = {"content": content, "style": style, "dataset": dataset} | (
        {"side": side} if side else {}
    )
    return clip(f"{content}-{style}-{dataset}", bandai_captions(content, style, side), **facts)


def test_attributes_of_one_clip_alone_do_not_matter():
    slow = clip("a", ["walks forward slowly"], action="walk", direction="forward", speed="slow")
    fast = clip("b", ["walks forward quickly"], action="walk", direction="forward", speed="fast")
    back = clip("c", ["walks backward"], action="walk", direction="backward")
    assert near_misses([slow, fast, back]) == [
        {"direction": ["walks backward"], "speed": ["walks forward quickly"]},
        {"direction": ["walks backward"], "speed": ["walks forward slowly"]},
        {"direction": ["walks forward quickly", "walks forward slowly"]},
    ]
    slow = clip("a", ["walks slowly"], action="walk", speed="slow")
    assert near_misses([slow, clip("b", ["walks"], action="walk", speed="normal")]) == [
        {},
        {"speed": ["walks slowly"]},
    ]


def test_texts_differ_from_all_captions_of_the_same_attributes():
    clips = [
        clip("a", ["kicks", "kicks left"], action="kick", side="left"),
        clip("b", ["does a kick"], action="kick", side="left"),
        clip("c", ["kicks", "does a kick", "kicks right"], action="kick", side="right"),
    ]
    assert near_misses(clips) == [{"side": ["kicks right"]}] * 2 + [{"side": ["kicks left"]}]


def test_the_action_of_bandai_contains_no_side():
    clips = [
        bandai(f"wave-{hands}", style)
        for hands in ("left-hand", "both-hands")
        for style in ("angry", "active")
    ]
    clips += [
        bandai("raise-up-left-hand", "angry"),
        bandai("walk-left", "angry"),
        bandai("walk", "angry", 1),
    ]
    left = near_misses(clips)[0]
    assert set(left) == {"side", "style"}
    assert left["side"] == sorted(clips[2].captions)
    assert left["style"] == sorted(clips[1].captions)
    assert near_misses(clips)[4:] == [{}, {}, {}]


def test_one_style_in_both_sets_of_bandai_and_clips_without_an_action_have_no_near_misses():
    assert near_misses([bandai("walk", "feminine", 1), bandai("walk", "feminine", 2)]) == [{}, {}]
    assert near_misses(
        [clip("a", ["x"], side="left"), clip("b", ["y"], side="right", tokens=["y/VERB"])]
    ) == [{}, {}]


def test_near_misses_of_synthetic_clips_state_wrong_attributes():
    synthetic = Synthetic(clips=120, seed=3).clips(20.0)
    clips = [clip(source.id, source.captions, **dict(source.attributes)) for source in synthetic]
    states = {text: entry.attributes for entry in clips for text in entry.captions}
    texts_of = near_misses(clips)
    assert sum(map(bool, texts_of)) > 60
    for own, wrong in zip(clips, texts_of, strict=True):
        for name, text in ((name, text) for name, texts in wrong.items() for text in texts):
            shared = own.attributes.keys() & states[text].keys()
            assert [key for key in shared if states[text][key] != own.attributes[key]] == [name]
    assert (
        near_misses([replace(entry, id=f"other {entry.id}") for entry in reversed(clips)])[::-1]
        == texts_of
    )
