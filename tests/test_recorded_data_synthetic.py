"""Results of the synthetic data, as recorded."""

from functools import partial
from itertools import islice
from typing import Any

import numpy as np
import pytest
from support.recorded import Case, bodies, cases_of, check, combinations, record
from support.recorded_data import described, outcome, projected

from flame_mdm.data import (
    synthetic,
    synthetic_actions,
    synthetic_sequences,
)
from flame_mdm.data.synthetic_motions import body as synthetic_body
from flame_mdm.data.synthetic_motions import gestures, joining, locomotion

NAME = "data_synthetic"


# Synthetic motions ------------------------------------------------------------------------------


def motions_of_all_actions() -> Any:
    results: dict[str, Any] = {}
    for number, (name, action) in enumerate(synthetic_actions.ACTIONS.items()):
        for seed in range(4):
            rng = np.random.default_rng((seed, number))
            attributes = action.draw(rng, name)
            seconds = max(action.seconds, 2.0, 0.35 + 0.8 * int(attributes.get("count", 0)))
            fps = (20, 12.5, 30, 20)[seed]
            t = np.arange(round((seconds + 0.2 * seed) * fps)) / fps
            motion = synthetic._joints(rng, t, attributes)
            results[f"{name} {seed}"] = [attributes, *projected(motion)]
    return results


def motions_of_all_attributes() -> Any:
    results: dict[str, Any] = {}
    for number, (name, action) in enumerate(synthetic_actions.ACTIONS.items()):
        seen = set[str]()
        for seed in range(60):
            attributes = action.draw(np.random.default_rng(seed), name)
            if str(attributes) not in seen and len(seen) < 14:
                seen.add(str(attributes))
                t = np.arange(46) / 16
                rng = np.random.default_rng((3, number, seed))
                results[str(attributes)] = projected(synthetic._joints(rng, t, attributes), 3)[2:]
    return results


def examples_of_bodies() -> Any:
    names = list(bodies(20.0))
    return {name: projected(bodies(20.0)[name], 2) for name in names[:: len(names) // 12]}


def cycles_and_simultaneous_actions() -> Any:
    results: dict[str, Any] = {}
    t = np.arange(48) / 20
    for number, name in enumerate(synthetic_actions.CYCLES):
        for seed in range(3):
            rng = np.random.default_rng((seed, number))
            drawn = synthetic_actions.CYCLES[name].draw(rng, name)
            attributes: Any = {"action": name, "ends": "cycle"} | drawn
            results[f"{name} {seed}"] = [drawn, *projected(synthetic._joints(rng, t, attributes))]
    for base in synthetic_actions.BASES:
        for number, gesture in enumerate(synthetic_actions.GESTURES):
            rng = np.random.default_rng(number)
            added = synthetic_actions.GESTURES[gesture].draw(rng, gesture)
            added["while"] = added.pop("action")
            attributes = synthetic_actions.BASES[base].draw(rng, base) | added
            results[str(attributes)] = projected(synthetic._joints(rng, t, attributes), 3)
    return results


def clips_of_the_synthetic_data() -> Any:
    results: dict[str, Any] = {}
    options: list[dict[str, Any]] = [
        {"clips": 30},
        {"clips": 70, "seed": 3, "actions": "all"},
        {"clips": 24, "actions": "all", "core_share": 0.5, "seed": 1},
        {"clips": 24, "often": ["walk", "jump"], "often_share": 0.4},
        {"clips": 24, "often": ["hop"], "often_share": 1.0, "actions": "all"},
        {
            "clips": 24,
            "often": ["hop", "sit"],
            "often_share": 0.3,
            "actions": "all",
            "core_share": 0.9,
        },
    ]
    for one in options:
        source = synthetic.Synthetic(workers=1, **one)
        clips = [
            {**described(clip), "motion": projected(clip.motion, 2)}
            for clip in source.clips((20.0, 12.5)[len(one) % 2])
        ]
        for clip in clips:
            clip["captions"] = clip["captions"][:2]
        facts = [source.options, len(source.actions), len(source.verbs), source.count()]
        results[str(one)] = [facts, clips]
    return results


def clips_of_the_synthetic_sequences() -> Any:
    sources = [
        synthetic_sequences.SyntheticSequences(60, workers=1),
        synthetic_sequences.SyntheticSequences(26, 5, 1, ["crawl", "type", "walk"], 0.7),
    ]
    return [
        [
            source.options,
            source.count(),
            clip.id,
            projected(clip.motion),
            clip.captions[:2],
            clip.split,
            dict(clip.attributes),
        ]
        for number, source in enumerate(sources)
        for clip in source.clips((20.0, 15.0)[number])
    ]


def earlier_motions() -> Any:
    starts = ("standing", "seated", "lying", "on all fours", "a plank")
    return {
        start: [
            synthetic_sequences._earlier(np.random.default_rng(seed), start) for seed in range(25)
        ]
        for start in starts
    } | {
        f"{posture}, {up}": projected(
            synthetic_sequences._way(np.random.default_rng(1), posture, 20, *up).joints(), 3
        )
        for posture in synthetic_sequences.WAYS_DOWN
        for up in ((), (True,))
    }


def moved_bodies_of_sequences() -> Any:
    results: dict[str, Any] = {}
    for number, (name, action) in enumerate(synthetic_actions.ACTIONS.items()):
        for whole in ((), (False,)):
            rng = np.random.default_rng((9, number))
            body = synthetic_sequences._moved(rng, action.draw(rng, name), 12.5, *whole)
            results[f"{name}, {whole}"] = projected(body.joints(), 2)
    return results


def joined_bodies() -> Any:
    names = [
        "walk",
        "turn",
        "jump",
        "seated",
        "kneel",
        "pick",
        "crawl",
        "type",
        "clap",
        "lie",
        "spin",
    ]

    def moved(name: str, seed: int) -> synthetic_body.Body:
        rng = np.random.default_rng(seed)
        action = synthetic_actions.ACTIONS[name]
        return synthetic_sequences._moved(rng, action.draw(rng, name), 15)

    results = {}
    for number, first in enumerate(names):
        for second in names[number % 3 :: 3]:
            one, other = moved(first, number), moved(second, number + 50)
            for options in ({}, {"overlap": 0.3}, {"overlap": 9.0, "blend": 0.9}):
                joined = joining.join(one, other, **options)
                results[f"{first}, {second}, {options}"] = projected(joined.joints(), 2)
            part = joining.frames_of(one, np.array([3, 3, 1, 7, 2]))
            results[f"{first}, {second}"] = [projected(part.joints(), 2), part.t]
    return results


def curves_of_bodies() -> Any:
    t = np.linspace(-0.3, 3.1, 35)
    rng = np.random.default_rng(0)
    start, end, toward = (rng.normal(0, 0.3, (6, 3)) for _ in range(3))
    end[0] = start[0] + [0.9, 0, 0]
    end[1] = start[1] + [0.01, 0, 0]
    body = partial(synthetic_body.Body, rng, t[5:])
    return {
        "ease": synthetic_body.ease(t, 0.2, 1.7),
        "pulse": synthetic_body.pulse(t, 0.1, 0.5, 1.9, 2.6),
        "rotations": [synthetic_body.rotation(axis, t[:3]).ravel().tolist() for axis in (0, 1, 2)],
        "limbs": [projected(x) for x in synthetic_body.bent(start, end, 0.3, 0.2, toward)],
        "beat": [synthetic_body.beat(t, 1.3), synthetic_body.beat(t, 0.7, 0.2)],
        "flight": synthetic_body.flight(t, 0.4, 0.5),
        "events": [
            synthetic_body.events(np.random.default_rng(seed), t[5:], count, slowest)
            for seed in range(3)
            for count, slowest in ((1, 0.8), (3, 0.9), (3, 1.9), (2, 4.0))
        ],
        "widths": [projected(body(*width).joints(), 2) for width in ((), (0.2,), ([0.1, 0.3],))],
    }


def reaching_bodies() -> Any:
    t = np.arange(24) / 12
    rng = np.random.default_rng(2)
    results = []
    for number, options in enumerate(
        combinations(
            1, 24, side=(0, 1), frame=("world", "chest", "head"), keeps=(False, True), far=(0, 1)
        )
    ):
        body = synthetic_body.Body(np.random.default_rng(number), t)
        body.heading += np.linspace(2.5, 4.0, len(t))
        body.spine += rng.normal(0, 0.3, (3, 1))
        body.pelvis += rng.normal(0, 0.2, (3, 1))
        body.head += rng.normal(0, 0.3, (3, 1))
        body.shoulders[options["side"]] += 0.2
        body.foot_pitch += rng.normal(0, 0.5, (2, len(t)))
        body.foot_yaw += rng.normal(0, 0.5, (2, len(t)))
        body.keeps_legs = options["keeps"]
        body.ankles[:, :, 2] += 0.5 * options["far"]
        if number % 3 == 0:
            body.reach(options["side"], t / 2, (0.1, 0.4, 0.3))
        target = rng.normal(0.2, 0.2, (len(t), 3))
        body.reach(options["side"], synthetic_body.ease(t, 0, 1), target, options["frame"])
        body.move_arm(1 - options["side"], t / 2, (0.4, t, -0.2, 0.9))
        synthetic_body.step(
            body, 1, 0.2, 0.9, (0.2, 0.1 * (number % 2), 0.3), *((0.2, 0.1)[: number % 3])
        )
        if number % 4 == 1:
            synthetic_body.follow_feet(body)
        results.append([options, projected(body.joints())])
    return results


def gaits() -> Any:
    t = np.arange(60) / 20
    results = []
    for seed, options in enumerate(
        combinations(
            0,
            12,
            direction=tuple(synthetic_actions.WAYS),
            speed=("slow", "normal", "fast"),
        )
    ):
        body = synthetic_body.Body(np.random.default_rng(seed), t)
        locomotion.walk(body, np.random.default_rng(seed), t, dict(options))
        results.append([options, projected(body.joints(), 3)])
    for seed in range(4):
        body = synthetic_body.Body(np.random.default_rng(seed), t)
        gestures.seat(body, t / 3, np.sin(t) ** 2)
        results.append(projected(body.joints(), 3))
    return results


def captions_of_attributes() -> Any:
    results: dict[str, Any] = {}
    for number, (name, action) in enumerate(synthetic_actions.ACTIONS.items()):
        for seed in range(3):
            rng = np.random.default_rng((number, seed))
            attributes = action.draw(rng, name)
            texts, stated = synthetic.draw_captions(
                rng, attributes, 3 + seed, *((seed == 1,)[: seed % 2])
            )
            results[f"{name} {seed}"] = [attributes, texts, stated]
    return results


def grammar_of_the_synthetic_data() -> Any:
    grammar = synthetic.content()
    rng = np.random.default_rng
    attributes_of: list[Any] = [{"action": "a", "x": "b"}, {"action": "a"}, {"action": "c"}]
    return {
        "keys": {name: len(part) for name, part in grammar.items()},
        "verbs": grammar["verbs"],
        "core": grammar["core_verbs"],
        "entries": [
            synthetic.entry({"a b": 1, "a": 2, "c d": 3}, attributes)
            for attributes in attributes_of
        ],
        "conjugated": [
            synthetic._conjugated(rng(seed), "slowly <walk> and <-jump/hop> a arm <wave>", tenses)
            for seed in range(3)
            for tenses in grammar["tenses"].values()
        ],
        "draws": [
            synthetic_actions.drawn_from(rng(seed), actions)
            for actions in (synthetic_actions.ACTIONS, synthetic_actions.BASES)
            for seed in range(20)
        ],
        "prompts": [len(synthetic.prompts(*count)) for count in ((), (0,), (3,))],
        "first": synthetic.prompts(4),
        "examples": [
            projected(synthetic.example(attributes, *fps), 2)
            for _, attributes in islice(synthetic.prompts(), 0, 60, 4)
            for fps in ((), (12.5,))
        ],
    }


def refusals_of_the_synthetic_data() -> Any:
    def refusal(**options: Any) -> Any:
        return outcome(lambda: synthetic.Synthetic(**options).options)

    return [
        refusal(clips=0),
        refusal(clips=1),
        refusal(seed=-1),
        refusal(actions="some"),
        refusal(core_share=1.0),
        refusal(core_share=1.01, actions="all"),
        refusal(core_share=1.0, actions="all"),
        refusal(core_share=-0.1, actions="all"),
        refusal(often=["hop"], often_share=0.5),
        refusal(often=["wlk"], often_share=0.5),
        refusal(often=["walk"]),
        refusal(often=["walk"], often_share=1.1),
        refusal(often_share=0.5),
        refusal(often=["walk"], often_share=1.0),
    ]


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
