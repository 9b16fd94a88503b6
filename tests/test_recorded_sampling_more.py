"""How sentences are understood and how the referee judges motions, as recorded."""

import hashlib
import json
from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
import pytest
from support.recorded import (
    Case,
    cases_of,
    check,
    combinations,
    outcome,
    record,
    some_bodies,
    summary,
)

from flame_mdm.conditions.language import clauses, matching, meaning, morphology, spelling, tables
from flame_mdm.conditions.language import tokens as words
from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.parsing import is_explained, understand
from flame_mdm.conditions.language.reading import Reader
from flame_mdm.conditions.language.understanding import Mention, Understanding
from flame_mdm.conditions.language.vectors import WordTable, word_table
from flame_mdm.conditions.language.wording import attribute_words, caption, predicate
from flame_mdm.data.synthetic import prompts
from flame_mdm.demo.chips import _with_action, chips
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import KIT21
from flame_mdm.sampling.motion_request import read_parts
from flame_mdm.sampling.referee import judging, kinds, movements, postures, readings, sentences
from flame_mdm.sampling.referee.body import Body, rate_of
from flame_mdm.sampling.referee.claims import Claim, falsified, unique

NAME = "sampling_more"

SIDED = [
    "raise hand", "hand above head", "hand to head", "hand down", "hand on hip", "raise foot",
    "one leg", "kick", "strike", "count kicks", "count punches", "count raises",
]  # fmt: skip
DIRECTED = {
    "travel": ("forward", "backward", "left", "right"),
    "step": ("forward", "left"),
    "turn": ("left", "right", "clockwise", "counterclockwise"),
    "turn around": ("left", "clockwise"),
    "turn angle": ("", "right", "counterclockwise"),
    "circle": ("left", "right", "clockwise", "counterclockwise"),
    "veer": ("left", "right"),
    "lean": ("left", "right"),
}


def digest(value: Any) -> str:
    """A hash of texts and whole numbers."""
    text = json.dumps(summary(value), sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


@cache
def shaken(fps: float, count: int, seed: int = 0) -> dict[str, np.ndarray]:
    """Bodies of several sizes; small noise prevents ties between frames."""
    rng = np.random.default_rng(seed)
    listed = some_bodies(count, 20.0 if fps != 30.0 else fps, seed)
    return {
        name: (motion + rng.normal(0, 0.003, motion.shape)) * (0.8 + 0.1 * (number % 5))
        for number, (name, motion) in enumerate(listed.items())
    }


@cache
def measured(fps: float, count: int, seed: int = 0) -> list[Body]:
    return [Body(joints, fps) for joints in shaken(fps, count, seed).values()]


def claims_of(kind: str) -> list[Claim]:
    """Claims of a kind with all sides, directions, speeds and some amounts that it can have."""
    if kind in ("use hand", "use foot"):
        return [Claim(kind, side=side) for side in ("left", "right")]
    if kind == "pace":
        return [Claim(kind, speed=speed) for speed in ("slow", "fast")]
    listed = [Claim(kind)] if kind not in ("veer", "lean") else []
    if kind in SIDED:
        listed += [Claim(kind, side=side) for side in ("left", "right", "both")]
    listed += [Claim(kind, direction=one) for one in DIRECTED.get(kind, ()) if one]
    if kind == "turn angle":
        listed += [Claim(kind, amount=number, direction="left") for number in (90, 360)]
    elif kind.startswith("count"):
        amounts = (1, 2, 3, 6)
        listed += [Claim(kind, amount=number) for number in amounts]
        if kind in SIDED:
            listed += [Claim(kind, amount=2, side=side) for side in ("left", "right", "both")]
    return listed


def table(listed: list[readings.Reading]) -> dict[str, Any]:
    """Scores, numbers, times and texts of readings."""

    def plain(value: float | None) -> float:
        return -7.5 if value is None or np.isnan(value) else float(value)

    times = [time for one in listed for span in one.spans for time in span]
    signals = [one.signal for one in listed if one.signal is not None]
    texts = [f"{one.joint}; {one.unit}; {one.unclear}; {len(one.spans)}" for one in listed]
    return {
        "scores": np.array([plain(one.score) for one in listed]),
        "numbers": np.array([plain(one.number) for one in listed]),
        "levels": np.array([plain(one.level) for one in listed]),
        "times": np.array([*times, *[0.0] * 5]),
        "signals": np.concatenate([*signals, np.zeros(5)]),
        "texts": digest(texts),
    }


# Bodies and measurements -----------------------------------------------------------------------


def bodies_as_the_referee_sees_them() -> Any:
    names = (
        "joints", "scale", "seconds", "floor", "height", "forward", "left", "yaw", "seen",
        "velocity", "speed", "tilt", "hand_speed", "foot_speed", "reach",
    )  # fmt: skip
    listed = [*measured(20.0, 3), *measured(30.0, 2, 5), *measured(12.5, 1, 6)]
    listed += [Body(joints, 59.94) for joints in shaken(20.0, 1, 8).values()]
    walk = next(iter(shaken(20.0, 1, 9).values()))
    listed += [Body(walk[:frames] + np.array([4.0, 0.2, -3.0]), 20.0) for frames in (1, 2, 3, 4)]
    return [(len(body), {name: getattr(body, name) for name in names}) for body in listed]


def refusals_of_bodies() -> Any:
    walk = next(iter(shaken(20.0, 1).values()))
    wrong: list[np.ndarray] = [
        walk[:, :21], walk[:0], walk[0], np.where(walk > 1, np.nan, walk), walk * 1e-4, walk * 2e-3,
        np.where(walk > 1, np.inf, walk),
    ]  # fmt: skip
    return [outcome(lambda joints=joints: len(Body(joints, 20.0))) for joints in wrong]


def _rows(names: list[str]) -> Any:
    listed = [*measured(20.0, 36), *measured(30.0, 6, 3), *measured(12.5, 4, 4)]
    rows: dict[str, Any] = {}
    for kind in names:
        for claim in claims_of(kind):
            measure = kinds.KINDS[kind].measure
            rows[str(claim)] = table([measure(body, claim) for body in listed])
    return rows


def measurements_of_movements() -> Any:
    return _rows([name for name, kind in kinds.KINDS.items() if kind.group == "movement"])


def measurements_of_postures() -> Any:
    return _rows([name for name, kind in kinds.KINDS.items() if kind.group == "posture"])


def measurements_of_contacts() -> Any:
    return _rows([name for name, kind in kinds.KINDS.items() if kind.group == "contact"])


def measurements_of_directions_and_sides() -> Any:
    groups = ("direction", "side", "speed", "end")
    return _rows([name for name, kind in kinds.KINDS.items() if kind.group in groups])


def measurements_of_counts() -> Any:
    return _rows([name for name, kind in kinds.KINDS.items() if kind.group == "count"])


def helpers_of_measurements() -> Any:
    body = measured(20.0, 5)
    return [
        ([movements.gait_speed(one) for one in body], [movements.flight(one) for one in body]),
        [postures.thighs(one) for one in body],
        [postures.last_part(one) for one in body],
        [rate_of(values) for values in (np.zeros((1, 2)), np.arange(12.0).reshape(4, 3) ** 2)],
    ]


def bodies_on_the_floor_and_with_folded_limbs() -> Any:
    """Bodies turned to lie, bent at the hips, and with lowered pelvis, measured for all postures."""
    listed = []
    rng = np.random.default_rng(3)
    for number, motion in enumerate(list(shaken(20.0, 6, 11).values())):
        angle = np.linspace(0, (0.9, 1.5, -1.2, 0.5, 1.1, 1.4)[number], len(motion))
        pivot = motion[:, :1] if number % 2 else motion[:, :1] * [1.0, 0.0, 1.0]
        sine, cosine = np.sin(angle)[:, None], np.cos(angle)[:, None]
        local = motion - pivot
        upper = [3, 6, 9, 12, 13, 14, 15, 16, 17, 18, 19, 20, 21]
        rows = upper if number % 2 else list(range(22))
        turned = local.copy()
        turned[:, rows, 1] = cosine * local[:, rows, 1] - sine * local[:, rows, 2]
        turned[:, rows, 2] = sine * local[:, rows, 1] + cosine * local[:, rows, 2]
        turned += pivot - [0.0, rng.uniform(0, 0.1), 0.0]
        if number in (1, 3):  # a pelvis that sinks while the feet stay
            sink = np.linspace(0, 0.55, len(motion))[:, None]
            turned[:, [0, 1, 2, *upper], 1] -= sink
            turned[:, [4, 5], 2] += sink * 0.8
        listed.append(Body(turned, 20.0))
    chosen = [name for name, kind in kinds.KINDS.items() if kind.group in ("posture", "contact")]
    chosen += ["count push-ups", "count bends", "count squats", "return pose", "jumping jack"]
    reversed_in_time = [
        Body(motion[::-1], 20.0) for motion in (one.joints / one.scale for one in listed[:3])
    ]
    return {
        str(claim): table(
            [kinds.KINDS[kind].measure(one, claim) for one in [*listed, *reversed_in_time]]
        )
        for kind in chosen
        for claim in claims_of(kind)
    }


def evidence_in_signals() -> Any:
    rng = np.random.default_rng(1)
    times = np.arange(97) / 30.0
    waves = [
        np.sin(times * speed + phase) * size + rng.normal(0, 0.02, 97) + times * trend
        for speed, phase, size, trend in
        ((3, 0.3, 1, 0), (5, 2, 0.5, 0.3), (2, 4, 0.8, -0.5), (9, 1, 0.2, 0), (4.0, 1.6, 0.3, 0.0))
    ]  # fmt: skip
    results: list[Any] = []
    for wave in waves:
        results.append([readings.spans_of(wave > 0.1, least) for least in (0.0, 0.2, 0.5)])
        results.append([readings.held(wave, seconds) for seconds in (0.0, 0.1, 0.5, 99.0)])
        results.append([readings.cycles(wave, depth) for depth in (0.1, 0.4, 1.2)])
        results.append([readings._is_cut(wave, depth) for depth in (0.1, 0.4, 1.2)])
        for unit, seconds, share in (("m", 0.1, 0.5), ("m apart", 0.3, 0.4), ("m from x", 0.2, 1)):
            results.append(table([readings.existence(wave, unit, "x", seconds, share)]))
        results.append(table([readings.existence(wave, "m above the floor", "hand")]))
        for amount in (None, 1, 2, 3, 4, 6, 9):
            one = readings.counted(wave, (0.2, 0.6), amount, "arm", "times")
            results.append((one.score, one.number, len(one.spans)))
    return results


def readings_of_sides() -> Any:
    results = []
    for left, right in ((0.5, 0.4), (0.4, 0.5), (0.9, 0.2), (0.2, 0.9), (0.6, 0.4)):
        for limb, signals in (("foot", True), ("wrist", True), ("hand", False)):
            pair = [
                readings.Reading(
                    score, score, "m", f"{side} {limb}", signal=np.arange(6.0) * score
                    if signals and (limb != "foot" or side == "left") else None,
                )
                for side, score in (("left", left), ("right", right))
            ]  # fmt: skip
            for side in ("", "left", "right", "both"):
                one = readings.of_side(pair, side, 0.2)
                results.append((one.joint, one.score, one.unclear, one.signal))
    return results


# Claims and verdicts ---------------------------------------------------------------------------


CLAIMED = [
    "a person walks forward, then turns left and sits down slowly",
    "A man waves with his right hand twice and then kicks with the left leg.",
    "a person starts standing, walks backwards quickly and ends up kneeling",
    "she begins sitting on the floor, stands up and raises both arms above her head",
    "a person stands still for three seconds",
    "walks for 4 seconds before jumping three times",
    "he turns around 180 degrees clockwise after bending down",
    "a person makes a quarter turn to the right",
    "a person does five jumping jacks, then claps twice",
    "the person leans to the left with his arms out to the sides",
    "a person hops on one leg",
    "walks in a circle counter-clockwise",
    "a person runs and veers to the right, then stops",
    "takes four steps forward and two steps back",
    "a person punches with both fists, then with the left hand",
    "kicks with the right foot, then with the left foot",
    "someone crouches down, crawls on hands and knees and lies down at the end",
    "he puts his left hand on his hip and his right hand on his head",
    "a person is not walking",
    "a person walks sideways to the left then returns to the starting position",
    "they go back to where they started",
    "a person ends in a seated position",
    "a person does two squats, bows three times and does 6 push ups",
    "a person spins around twice to the left",
    "walks slowly and then fast",
    "a person stands up after a bow",
    "stands still while walking",
    "throws with the left arm; at the same time raises the right leg",
    "a person lifts one of the legs as if kicking",
    "a person stretches both arms and crosses them",
    "kicks once again",
    "kicks at once", "jumps once", "jumps once more", "picks something up with both hands",
    "a person steps diagonally forward to the right", "walks with arms forward",
    "the person jumps forward", "jumps 3 times backwards", "turns 45 degrees left and right",
    "walks up, turns 90 degrees to the left, walks on", "looks like a zombie walking",
    "finally kneels", "a person sits for twenty seconds", "waves his other hand",
    "raises the left hand for two more seconds and then the right one", "runs zig zag forward",
    "walks left arm raised", "raises his right arm five times", "claps his hands 4 times",
    "a person who was sitting stands up", "a person steps back", "he punches 12 times",
    "does a backflip", "", "   ", "paints a wall", "takes thirteen steps", "takes 12 quick steps",
]  # fmt: skip


def claims_in_sentences() -> Any:
    return {
        text: [
            f"{claim} | {claim.words}" if not claim.parts else f"{claim}"
            for claim in sentences.read_claims(text)
        ]
        for text in CLAIMED
    }


def claims_in_combined_sentences() -> Any:
    listed = combinations(
        5,
        160,
        subject=("a person", "he", "the old man"),
        verb=(
            "walks", "is running", "jumped", "kicks", "punches", "turns", "steps", "sits",
            "raises a hand", "bends", "bows", "starts to run", "ends lying", "waves", "claps",
            "squats", "spins", "circles", "leans", "veers",
        ),
        aside=("", "to the left", "with the right hand", "forward", "backwards", "clockwise",
               "with his left leg", "to both sides", "with both arms", "with the right"),
        count=("", "twice", "three times", "for 5 seconds", "slowly", "very fast", "90 degrees"),
        after=("", ", then sits down", " and later kicks", " while waving the left arm",
               " before turning right", " after he kneels", " and returns to the start"),
    )  # fmt: skip
    lines = [
        " ".join(f"{one['subject']} {one['verb']} {one['aside']} {one['count']}".split())
        + one["after"]
        for one in listed
    ]
    return {
        line: "; ".join(
            f"{claim}" + (f" [{claim.when} {claim.seconds or ''}]" if claim.when else "")
            for claim in sentences.read_claims(line)
        )
        for line in lines
    }


def changed_claims() -> Any:
    listed = [claim for text in CLAIMED for claim in sentences.read_claims(text)]
    listed += [
        Claim("sit", when="start"), Claim("kneel", when="end"), Claim("upright", when="end"),
        Claim("walk", seconds=1), Claim("walk", seconds=5, speed="slow"), Claim("kick", amount=2),
        Claim("count kicks", amount=1, side="right"), Claim("turn", direction="clockwise"),
        Claim("return pose", when="end"), Claim("raise hand", when="start", side="both"),
    ]  # fmt: skip
    results = {}
    for claim in listed:
        wrong = "; ".join(f"{kind}: {one}" for kind, one in falsified(claim))
        results[f"{claim}"] = (
            f"{claim.mirrored} | {wrong} | {kinds.group_of(claim)} | "
            f"{kinds.threshold_key(claim)} | {kinds.band(claim)}"
        )
    doubled = [*listed, *[Claim(one.kind, "other words") for one in listed[:5]], *listed[3:6]]
    return results, [str(one) for one in unique(doubled)]


def bands_of_all_kinds() -> Any:
    return {
        str(claim): (kinds.group_of(claim), kinds.threshold_key(claim), kinds.band(claim))
        for kind in kinds.KINDS
        for claim in claims_of(kind)
    }


def verdicts_on_sentences() -> Any:
    """Answers and evidence of motions for their own and other sentences."""
    results: dict[str, Any] = {}
    texts = [text for text in CLAIMED if sentences.read_claims(text)]
    for number, (name, joints) in enumerate(shaken(20.0, 24, 2).items()):
        fps = (20.0, 30.0, 12.5)[number % 3]
        for offset in range(4):
            text = texts[(number * 4 + offset) % len(texts)]
            judgment = judging.judge(joints, text, fps)
            lines = [
                f"{one.answer}: {one.group}; {one.reading.joint}; {one.reading.unclear}; "
                f"{len(one.reading.spans)}"
                for one in judgment.verdicts
            ]
            numbers = [one.reading.number for one in judgment.verdicts]
            numbers += [
                -9.0 if np.isnan(s) else s for s in (v.reading.score for v in judgment.verdicts)
            ]
            marks = [one.marks(fps, len(joints)) for one in judgment.verdicts]
            results[f"{name}: {text}"] = (
                str(judgment), judgment.accuracy, digest(lines), np.array([*numbers, *[0.0] * 5]),
                sum(end - begin for row in marks for begin, end, *_ in row),
            )  # fmt: skip
    return results


def decisions_at_ends_for_durations_and_in_order() -> Any:
    listed = [
        Claim(kind, when=when)
        for kind in ("sit", "upright", "crouch", "bend", "raise hand", "walk", "run", "jump",
                     "kick", "strike", "arms out", "travel")
        for when in ("start", "end")
    ]  # fmt: skip
    listed += [
        Claim(kind, seconds=seconds)
        for kind in ("walk", "stand still", "raise hand", "bend", "crouch", "run", "upright")
        for seconds in (1, 2, 5)
    ]
    events = [Claim(kind) for kind in ("walk", "turn", "jump", "kick", "crouch", "raise hand")]
    listed += [
        Claim("order", parts=(first, second))
        for first in events
        for second in events
        if first is not second
    ]
    chosen = measured(20.0, 16, 2)
    results = {}
    for claim in listed:
        rows = [judging.decide(body, claim) for body in chosen]
        answers = "".join({"yes": "y", "no": "n"}.get(row.answer, "?") for row in rows)
        results[f"{claim}"] = (answers, table([row.reading for row in rows]))
    return results


def judgments_of_motions() -> Any:
    listed = list(shaken(20.0, 5, 4).items())
    motions = [
        Motion(joints.astype(np.float32), 20.0, text=text, id=name)
        for (name, joints), text in zip(
            listed,
            ("a person walks", "he kicks and turns left", "", "a person paints", "jumps twice"),
            strict=True,
        )
    ]
    rest = motions[0].joints
    motions += [Motion(rest[:frames], 20.0, text="a person walks") for frames in (9, 10, 11)]
    motions += [Motion(rest[:, :21], 20.0, KIT21, "a person walks", "kit")]
    refused = [
        lambda: judging.judge(motions[-1]), lambda: judging.judge(rest, "walks"),
        lambda: judging.judge(motions[2]), lambda: judging.judge(rest, "  ", 20.0),
        lambda: judging.judge(rest[:7], "walks", 20.0),
    ]  # fmt: skip
    scores = judging.claim_score(motions)
    return {
        "texts": [str(judging.try_judge(motion)) for motion in motions],
        "marks": [[row[:2] for row in judging.evidence_marks(motion)] for motion in motions],
        "scores": [scores, judging.claim_score([])],
        "verdicts": [
            [(one.group, one.answer) for one in judging.judge(motion, "turns, then walks").verdicts]
            for motion in motions[:5]
        ],
        "refused": [outcome(lambda call=call: str(call())) for call in refused],
        "empty": str(judging.judge(motions[0], "paints a wall")),
    }


# Language --------------------------------------------------------------------------------------


TYPED = [
    "walk", "wlak", "a person walks forward slowly", "A man waves twice with the left hand.",
    "kicks three times, then sits down and stands up again", "while walking, a man waves",
    "before sitting down, the person turns around", "after jumping twice, a person bows",
    "walk until he sits down", "persn wlaks foward", "kik with teh left leg", "jupms and sist",
    "a man hurls a grenade with the left hand", "a person walks four meters",
    "kicks four times with the right leg", "a person walks four steps nervously", "limps",
    "turn 180 degrees", "turns a quarter to the left", "turns halfway around", "turn 90 left",
    "turn around quickly", "looks around", "walks in a circle to the left",
    "walks clockwise in a circle", "runs counter-clockwise", "walks left in a circle forward",
    "does five quick push-ups", "a couple of kicks", "two of the kicks", "x 3 kick", "kick x 2",
    "steps back", "scratches his back", "goes up the stairs", "go", "he goes", "the guard stands",
    "raises both hands", "raises arms above the head", "raises a hand", "lifts the right foot",
    "shoulders the left bag", "looks over the left shoulder", "left-handed punch", "with the right",
    "punches using the left hand", "not walking", "does not jump but sits", "never kicks",
    "walks, waving", "stands still, waving", "walking, waving", "walks followed by a jump",
    "then faster", "walks, then faster", "walks then to the left", "walks and waves then slower",
    "simultaneously waves and jumps", "walks and meanwhile waves", "walks. at the same time waves",
    "jumps once", "once they have looked around, they sit", "walks as he waves", "sit as a dog",
    "next to the table a man sits", "sits next", "sits later", "later that day he runs",
    "geht nach links", "una persona camina", "человек идёт", "un homme marche vite", "走路",
    "xyzzy", "qwrt zzkk", "", "?!", "12", "a person", "doge to the left", "dansing", "flosses",
    "paints a fence with a brush", "eats an apple", "chairs", "swims like a fish", "meanders",
    "sprint", "slow sprint fast", "walks slowly then walks quickly", "walks walks", "jog on the spot",
    "kick kick kick", "raise left hand and raise right hand", "stretches both arms and leans left",
    "a person stretches both arms and leans to the left", "picks up a box and throws it",
    "walks in limp style", "walks in old age style.", "a person jumps twelve times",
    "a person kicks 13 times", "claps 7 times", "waves 5 times", "punches six times", "step left",
    "takes two steps to the left", "sidesteps 3 steps right", "jumps up and down", "look up",
    "crouch", "crawls backward", "a zombie walks", "moonwalk", "salutes happily", "bow, then",
    "afterwards sits", "finally, he bows", "first he runs then later he stops", "and then",
    "when he jumps he waves", "till he falls", "sit | stand", "sit; stand: bow\nwave!", "Walk!?",
    "1 jump", "1000 jumps", "999 jumps", "a single jump", "kick 2 more times", "kicks of two times",
    "three left kicks", "two hands waving", "on the left side he kicks", "turns to his left",
]  # fmt: skip


def understood_text(understood: Understanding) -> str:
    """Steps, rest, corrections and nearest actions of a sentence as one line."""
    steps = [
        " + ".join(
            f"{one.action}{sorted(one.attributes.items(), key=str)}'{one.text}'"
            f"{one.start}-{one.end}{one.typed}"
            for one in step
        )
        for step in understood.steps
    ]
    return (
        f"{' > '.join(steps)} | {understood.objects} | {understood.unknown} | "
        f"{dict(understood.corrected)} | {understood.is_foreign} | {understood.nearest}"
    )


def understood_sentences() -> Any:
    return {text: understood_text(understand(text)) for text in TYPED}


def sentences_of_parts() -> list[str]:
    listed = combinations(
        9,
        170,
        first=("", "a man", "she", "before", "while", "after", "once he"),
        verb=("walks", "jumping", "kick", "waves", "turns", "runs", "sits down", "looks", "spins",
              "raises", "crawls", "punches", "leans", "throws a ball", "steps", "is bowing"),
        aside=("", "left", "to the right", "with the left hand", "both arms", "backwards", "around",
               "in a circle", "the right leg", "slowly to the left", "up", "clockwise"),
        count=("", "twice", "4 times", "5 steps", "quickly", "one time", "fast again"),
        link=("", ", then", " and", " while", ". Next", ", ", " or", " until", " as he", " after"),
        other=("", "sits", "waving", "stands still", "walks slowly", "jumps up", "he kicks twice"),
    )  # fmt: skip
    return [
        " ".join(
            f"{one['first']} {one['verb']} {one['aside']} {one['count']}{one['link']} "
            f"{one['other']}".split()
        )
        for one in listed
    ]


def understood_combined_sentences() -> Any:
    lines = sentences_of_parts()
    return {
        line: " > ".join(
            " + ".join(
                f"{one.action} {' '.join(f'{key}={one.attributes[key]}' for key in sorted(one.attributes))}"
                for one in step
            )
            for step in understand(line).steps
        )
        + f" | {' '.join(understand(line).unknown)} | {' '.join(understand(line).objects)}"
        for line in lines
    }


@cache
def facts() -> dict[str, Any]:
    """Facts of a model of the synthetic set."""
    texts = [text for text, _ in prompts()]
    return {
        "actions": list(dict.fromkeys(str(stated["action"]) for _, stated in prompts())),
        "verbs": ["walks"],
        "vocabulary": sorted({word for text in texts for word in text.lower().split()} | {"sits"}),
        "captions": texts,
    }


@cache
def readers() -> dict[str, Reader]:
    """Readers of models with captions, without them, with simultaneous actions, and with few words."""
    few = ["walk", "wave", "sit_down", "side step", "kick", "nothing"]
    both = [*facts()["captions"], "a person walks forward while waving", "a person frobs"]
    words_of_both = sorted({*facts()["vocabulary"], "while", "waving", "frobs"})
    return {
        "all": Reader(facts()),
        "no captions": Reader({**facts(), "captions": []}),
        "both": Reader({**facts(), "captions": both, "vocabulary": words_of_both}),
        "few": Reader({**facts(), "actions": few}),
    }


def _reading(reader: Reader, text: str) -> Any:
    reading = reader.read(text)
    return (
        f"{reading.summary()} | {list(reading.captions)} | {list(reading.texts)} | "
        f"{reading.warnings()} | {[s and round(s, 3) for s in reading.seconds()]}"
    )


def readings_of_models() -> Any:
    results: dict[str, Any] = {}
    for number, text in enumerate(TYPED + sentences_of_parts()[:60]):
        for place, (name, reader) in enumerate(readers().items()):
            if number % 4 == place or (number < len(TYPED) and place == 0):
                results[f"{name}: {text}"] = outcome(
                    lambda reader=reader, text=text: _reading(reader, text)
                )
    return results


def abilities_of_models() -> Any:
    results: dict[str, Any] = {}
    for name, reader in readers().items():
        abilities = reader.abilities
        results[name] = {
            "actions": digest(abilities.actions),
            "count": len(abilities.actions),
            "simultaneous": abilities.is_simultaneous,
            "choices": digest({action: abilities.choices(action) for action in tables.actions()}),
            "supported": digest(
                [
                    abilities.supports(action, key, value)
                    for action in ("walk", "kick", "turn", "wave", "side step", "jump")
                    if action in tables.actions()
                    for key, value in (
                        ("count", 2),
                        ("count", 7),
                        ("side", "left"),
                        ("speed", "fast"),
                        ("amount", "half"),
                        ("direction", "left"),
                    )
                ]
            ),
            "ranked": [abilities.ranked(action)[:5] for action in ("walk", "kick", "wave", "sit")],
            "nearest": [
                abilities.nearest(understand(text))
                for text in ("paints", "xyzzy", "swims far", "12")
            ],
        }
    keys = ("verbs", "actions", "vocabulary")
    results["fits"] = [Reader.fits({**facts(), key: ()}) for key in keys] + [
        Reader.fits(facts()), Reader.fits({}),
    ]  # fmt: skip
    results["words"] = [
        readers()["all"].abilities.has_words(text) for text in ("walks", "walks-sits", "frob", "")
    ]
    return results


def words_and_typos() -> Any:
    listed = [
        "waving", "studies", "ties", "tied", "hopping", "goes", "passes", "dancin", "falling",
        "running", "ran", "boxes", "is", "as", "left", "knelt", "sat", "cries", "ing", "led", "begin",
        "wlak", "walkk", "jmup", "kcik", "dancee", "rigth", "forwrd", "tow", "kneee", "stnad", "a1b",
        "perosn", "xalk", "balk", "twise", "sliwly", "counterclokwise", "zzz", "trow", "trhow",
        "walkkk", "wakl", "hands", "knees", "painter", "dodge", "table", "apple", "brisk", "x", "12",
        "camina", "nach", "café", "sprintt", "wavee", "aplaud", "aplause", "crouhc",
    ]  # fmt: skip
    return {
        word: (
            f"{morphology.base_forms(word)} {morphology.inflections(word)} "
            f"{morphology._doubles(word)} {spelling.corrections(word)} {is_explained(word)} "
            f"{words.is_known(word)} {words.is_english(word)} {meaning.is_thing(word)} "
            f"{word_table().rank(word)} {word_table().has(word)} "
            f"{[name for name, _ in meaning.nearest_actions(word)[:4]]}"
        )
        for word in listed
    }


def distances_of_words() -> Any:
    pairs = ("wlak walk", "dance walk", "abc acb", "abcd badc", "kitten sitting", "ca abc", "a b",
             "same same", "jump jumped", "left felt", "turn", "wave vawe", "waves wav")  # fmt: skip
    return [
        spelling.distance(first, second, most)
        for first, _, second in (pair.partition(" ") for pair in pairs)
        for most in (0, 1, 2, 3, 6)
    ]


def meanings_of_words() -> Any:
    names = list(tables.actions())
    return {
        "similar": np.array(
            [meaning.similarity(first, second) for first in names[::6] for second in names[3::5]]
        ),
        "nearest": [
            [(name, score) for name, score in meaning.nearest_to(listed)[:3]]
            for listed in (["paint", "wall"], ["fast", "swim"], ["zzkk"], ["the", "dog", "barks"])
        ],
        "words": [
            meaning.similar_word(word, listed)
            for word in ("leap", "automobile", "zzkk", "walk")
            for listed in (["jump", "sit"], ["zzkk"], [], ["stroll", "run", "walk"])
        ],
        "means": [
            word_table().mean(listed)
            for listed in (["walk"], ["the", "walk", "zzkk"], ["jumps", "a"])
        ],
        "none": [word_table().mean([]), word_table().vector("zzkk")],
        "small": WordTable(["b", "a", "walk"], np.eye(3) + 0.2).mean(["walks", "a", "b", "q"]),
    }


def tables_of_words() -> Any:
    return {
        "actions": digest(
            [
                (name, [(p.words, p.action, dict(p.attributes)) for p in entry.phrases],
                 sorted(entry.takes), entry.say, entry.part, dict(entry.ways), entry.usual,
                 entry.joins, entry.before_side, entry.names,
                 [(p.words, p.action, dict(p.attributes)) for p in entry.like])
                for name, entry in tables.actions().items()
            ]
        ),
        "first": digest({k: [p.words for p in v] for k, v in tables.phrases_by_first_word().items()}),
        "values": digest([tables.word_values("direction"), tables.word_values("speed")]),
        "words": digest([sorted(spelling.action_words()), list(spelling._correct_words())]),
        "foreign": digest({k: sorted(v) for k, v in words._foreign().items()}),
        "listed": digest(sorted(words._listed())),
    }  # fmt: skip


def tokens_phrases_and_clauses() -> Any:
    results = {}
    for text in TYPED:
        typed = words.tokenize(text)
        corrected = words.corrected(typed)
        matches = matching.find_phrases(corrected)
        split = clauses.split(corrected, matches)
        results[text] = digest(
            [
                [(token.word, token.start, token.end, token.is_word) for token in corrected],
                [(match.phrase.words, match.used, match.is_weak) for match in matches],
                [
                    (one.numbers, one.link, one.is_first, one.after_comma, len(one.matches))
                    for one in split
                ],
                [(one.numbers, one.link, one.is_first) for one in clauses.joined(split)],
                words.is_foreign(typed),
                [token.word for token in words.corrected_to_action(typed, range(len(typed)))],
            ]
        )
    return results


def wordings_of_actions() -> Any:
    def lines() -> Iterator[str]:
        for name, entry in tables.actions().items():
            options: dict[str, tuple[Any, ...]] = {
                "side": ("left", "both"), "count": (1, 3, 8), "speed": ("slow", "normal", "fast"),
                "direction": ("left", "forward", "circle"), "amount": ("half", "quarter"),
            }  # fmt: skip
            yield predicate(Mention(name))
            for key, values in options.items():
                yield from (
                    predicate(Mention(name, {key: v})) for v in values if key in entry.takes
                )
            stated = {key: values[0] for key, values in options.items() if key in entry.takes}
            yield caption((Mention(name, stated), Mention("wave"), Mention("jump", {"count": 2})))

    attributes = [
        attribute_words(key, value)
        for key, value in (("count", 1), ("count", 9), ("amount", "half"), ("amount", "quarter"),
                           ("direction", "left"), ("direction", "odd"), ("speed", "slow"),
                           ("speed", "normal"), ("side", "both"), ("other", "x"))
    ]  # fmt: skip
    every = list(lines())
    return every[::7], digest(every), attributes


def chips_of_texts() -> Any:
    results = {}
    for text in ("kicks twice with the left leg @1.5 | a person walks <b>", "jumps nervously & sits",
                 "walks slowly @2 | turns left | paints and waves 3 times", "walks while waving",
                 "raises both arms"):  # fmt: skip
        for name in ("all", "both", "few"):
            reader = readers()[name]
            parts = read_parts(text)
            page = outcome(
                lambda reader=reader, parts=parts: chips(
                    reader.abilities, parts, [reader.read(phrase) for phrase, _ in parts]
                )
            )
            results[f"{name}: {text}"] = (len(page), digest(page), page[:160])
    kept = _with_action(Mention("kick", {"count": 2, "side": "left", "speed": "fast"}), "walk")
    return results, [kept.action, dict(kept.attributes)], chips(Abilities(facts()), [], [])


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
