"""The actions that `Synthetic(actions="all")` adds: plausible bodies, true captions, checks; an unchanged core."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any, cast

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from evaluators.metrics.attributes import (
    UNDECIDED,
    _arms,
    _is_a_body,
    _kick,
    _locomotion,
    _lowered,
    _nods,
    read_all,
    read_attributes,
    right_attributes,
)
from evaluators.metrics.checks import CHECKED, View, check, count_rises
from flame_mdm.conditions.vocabulary import words
from flame_mdm.data import Clip
from flame_mdm.data.synthetic import Synthetic, _joints, content, draw_captions, example
from flame_mdm.data.synthetic_actions import ACTIONS, BASES, CORE, CYCLES, GESTURES, MORE
from flame_mdm.data.synthetic_motions.body import Attributes
from flame_mdm.data.synthetic_sequences import SyntheticSequences
from flame_mdm.errors import UserError
from flame_mdm.representations.skeleton import SMPL22

FPS = 20
PARENTS = list(SMPL22.parents)
SWAP = [0, 2, 1, 3, 5, 4, 6, 8, 7, 9, 11, 10, 12, 14, 13, 15, 17, 16, 19, 18, 21, 20]
SIMULTANEOUS: list[Attributes] = [
    {"action": "walk", "direction": "forward", "speed": "slow", "while": "wave", "side": "left"},
    {"action": "run", "direction": "forward", "while": "raise", "side": "both"},
    {"action": "turn", "direction": "left", "amount": "half", "while": "clap"},
    {"action": "sneak", "while": "point", "side": "right"},
    {"action": "seated", "while": "drink", "side": "right"},
    {"action": "seated", "while": "phone", "side": "left"},
    {"action": "walk", "direction": "forward", "speed": "normal", "while": "carry"},
    {"action": "walk", "direction": "forward", "speed": "fast", "while": "salute", "side": "left"},
]
CYCLIC: list[Attributes] = [{"action": name, "ends": "cycle", "speed": "normal"} for name in CYCLES]


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return list(Synthetic(160, seed=5, workers=1, actions="all").clips(10))


def test_the_clips_of_the_core_do_not_change():
    few = list(Synthetic(12, seed=3, workers=1).clips(FPS))
    said = json.dumps(
        [[clip.id, clip.captions, clip.split, clip.action, clip.attributes] for clip in few]
    )
    assert hashlib.sha256(said.encode()).hexdigest()[:16] == "4e369d3d06ae3afc"
    sums = [float(np.abs(clip.motion.astype(np.float64)).sum()) for clip in few[:6]]
    np.testing.assert_allclose(
        sums, [1945.7566, 1129.1888, 2575.2707, 2527.4028, 1032.7145, 2779.1908], rtol=1e-6
    )
    assert Synthetic.actions == tuple(CORE)
    assert Synthetic(1).options == {"clips": 1, "seed": 0}
    assert len(Synthetic.verbs) < len(Synthetic(1, actions="all").verbs)


@pytest.mark.parametrize("source", [Synthetic, SyntheticSequences])
def test_a_share_of_the_clips_shows_the_actions_that_are_drawn_often(source):
    often = ("nod", "spin")
    more: dict[str, Any] = {} if source is SyntheticSequences else {"actions": "all"}
    data = source(300, often=often, often_share=0.6, **more)
    rng = np.random.default_rng(0)
    drawn = [data.attributes(rng)["action"] for _ in range(1000)]
    shares = [drawn.count(name) / len(drawn) for name in often]
    assert shares == pytest.approx([0.31, 0.31], abs=0.05)
    assert data.options["often"] == ["nod", "spin"]
    assert data.options["often_share"] == 0.6
    assert "often" not in source(1).options


def test_an_action_outside_the_core_cannot_be_drawn_often_from_the_core():
    with pytest.raises(UserError, match="often=idle: this action requires actions=all"):
        Synthetic(1, often=["idle"], often_share=0.3)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            {"often": ["spinn"], "often_share": 0.3},
            "often=spinn: unknown action. Did you mean spin",
        ),
        ({"often": ["spin"]}, "often_share=0.0: expected names of actions, and a number above 0"),
        ({"often": ["spin"], "often_share": 1.5}, "often_share=1.5"),
        ({"often_share": 0.3}, r"often=\[\], often_share=0.3"),
    ],
)
def test_wrong_options_of_actions_drawn_often_are_refused(options, message):
    with pytest.raises(UserError, match=message):
        Synthetic(1, actions="all", **options)


SUMS = """
walk 694.9474; run 2182.9832; turn 294.2088; jump 330.4702; wave 315.4375;
raise 364.6921; kick 298.6419; punch 297.8807; squat 284.5109; bow 294.3306;
stand 307.9865; sit 63.7301; rise 465.4892; dance 309.1385; leap 676.3503; pick 251.8870;
throw 375.6851; crawl 585.9189; lie -216.0183; clap 288.8193; salute 300.7209;
nod 287.5747; idle 309.0147; look around 302.0157; stretch 339.7485;
stretch sideways 296.2981; lean 299.7373; point 311.9223; beckon 323.0090;
shrug 298.6464; celebrate 336.4035; pray 333.7008; cry 348.2612; laugh 304.7646;
drink 315.1783; phone 332.9912; type 235.9698; wipe 335.0915; knock 289.8237;
guitar 319.4168; cross arms 314.9105; hands on hips 270.5160; touch head 312.1845;
touch face 313.3460; talk 298.9330; seated 240.3100; lift 247.7773; kneel 149.6109;
jumping jacks 299.0084; push-ups 109.9745; hop 303.9326; sneak 686.6454;
crouch walk 920.1135; limp 719.8525; stagger 735.4091; march 935.1229;
march in place 311.5594; run in place 315.9729; carry 969.5341; push 700.2988;
pull -38.2968; climb ladder 692.4225; climb stairs 972.7562; stumble 1163.2157;
strafe -130.4843; skip 1301.5856; spin 307.0643; waltz 292.9597; dodge 136.7342;
fighting stance 303.7076; duck 287.7922; hit 243.2389; block 252.2706; slash 339.4636;
fall -226.4744; get up 398.7616
"""
"""Weighted sum of the joints of an example of each action. Models were trained on these motions."""


def weighted(motion: np.ndarray) -> float:
    values = np.asarray(motion, np.float64).ravel()
    return float(values @ np.linspace(-1, 2, len(values)))


def test_the_motion_of_each_action_does_not_change(subtests):
    sums: dict[str, float] = {}
    for line in SUMS.split(";"):
        name, _, number = line.strip().rpartition(" ")
        sums[name] = float(number)
    assert sums.keys() == ACTIONS.keys()
    for number, (name, expected) in enumerate(sums.items()):
        with subtests.test(action=name):
            rng = np.random.default_rng((1, number))
            attributes = ACTIONS[name].draw(rng, name)
            motion = _joints(rng, np.arange(29) / 10, attributes)
            assert weighted(motion) == pytest.approx(expected, abs=3e-4)


def test_the_clips_of_all_actions_do_not_change():
    source = Synthetic(1, seed=3, workers=1, actions="all")
    few = [source.clip(number, 10) for number in range(12)]
    said = json.dumps(
        [[clip.id, clip.captions, clip.split, clip.action, clip.attributes] for clip in few]
    )
    assert hashlib.sha256(said.encode()).hexdigest()[:16] == "68eae1c562ecb599"
    expected = [716.0245, 294.9818, 426.0702, 916.7584, 222.7227, 1464.9527]
    expected += [-29.8436, 259.8482, 262.5928, 368.0685, 260.4666, 268.8342]
    np.testing.assert_allclose([weighted(clip.motion) for clip in few], expected, atol=3e-4)


def test_a_share_of_the_clips_shows_actions_of_the_core():
    few = Synthetic(400, workers=1, actions="all", core_share=0.5)
    without = Synthetic(400, workers=1, actions="all")

    def share(source: Synthetic) -> float:
        rng = np.random.default_rng(0)
        return sum(source.attributes(rng)["action"] in CORE for _ in range(1000)) / 1000

    assert share(few) == pytest.approx(0.5 + 0.5 * share(without), abs=0.05)
    assert few.options["core_share"] == 0.5
    assert "core_share" not in without.options
    with pytest.raises(
        UserError, match=r"core_share=0.5: expected a number from 0 to 1. Values above 0"
    ):
        Synthetic(1, core_share=0.5)


@pytest.mark.parametrize(
    "attributes",
    [*({"action": name} for name in MORE), *SIMULTANEOUS, *CYCLIC],
    ids=lambda row: " ".join(map(str, row.values())),
)
def test_bones_are_constant_and_feet_on_the_floor_do_not_move(attributes: Attributes, subtests):
    motion = example(attributes, FPS).astype(np.float64)
    bones = np.linalg.norm(motion[:, 1:] - motion[:, PARENTS[1:]], axis=-1)
    standing = example({"action": "stand"}, FPS).astype(np.float64)[0]
    body = np.linalg.norm(standing[1:] - standing[PARENTS[1:]], axis=-1)
    np.testing.assert_allclose(bones, np.tile(body, (len(bones), 1)), atol=5e-6)
    assert motion[..., 1].min() > -0.01
    np.testing.assert_allclose(motion[0, 0, [0, 2]], 0, atol=1e-6)
    across = motion[0, 16] - motion[0, 17]
    assert across[0] > 0.9 * np.linalg.norm(across), "it does not face +z"

    # Toes that neither rise nor sink for three frames stand on something.
    toes = motion[:, [10, 11]]
    level = np.abs(np.diff(toes[..., 1], axis=0)) < 1e-5
    stance = level[1:-1] & level[2:] & level[:-2]
    moved = np.linalg.norm(np.diff(toes[..., [0, 2]], axis=0), axis=-1)[1:-1]
    assert (moved[stance] < 1e-3).all()
    assert stance.sum() > 1

    ahead = motion[:, 1] - motion[:, 2]
    for side in (0, 1):
        with subtests.test(side=side):
            hip, knee, ankle = (motion[:, joint + side] for joint in (1, 4, 7))
            assert (
                ((knee - (hip + ankle) / 2) * np.cross(ankle - hip, ahead)).sum(-1) > 0
            ).all(), "a knee bends backward"
    assert np.linalg.norm(np.diff(motion, axis=0), axis=-1).max() * FPS < 13


@pytest.mark.parametrize("attributes", CYCLIC, ids=lambda row: row["action"])
def test_a_cycle_begins_and_ends_in_motion(attributes: Attributes):
    """Ankles move at both ends of a part of a cycle, and not at the end of a clip of the same action."""
    speeds = []
    for requested in (attributes, {"action": attributes["action"]}):
        ankles = example(requested, FPS)[:, [7, 8]]
        speeds.append(np.linalg.norm(np.diff(ankles, axis=0), axis=-1).max(1) * FPS)
    cycle, clip = speeds
    assert min(cycle[:2].max(), cycle[-2:].max()) > 0.5
    assert clip[-2:].max() < 0.4


def test_two_actions_at_once_move_legs_like_one_and_an_arm_like_the_other():
    both = example(
        {
            "action": "walk",
            "direction": "forward",
            "speed": "slow",
            "while": "wave",
            "side": "left",
        },
        FPS,
    )
    assert (both[:, 20, 1] > both[:, 16, 1] + 0.1).sum() > FPS
    assert (both[:, 21, 1] < both[:, 17, 1]).all()
    assert both[-1, 0, 2] > 0.8
    seated = example({"action": "seated", "while": "wave", "side": "right"}, FPS)
    assert np.ptp(seated[:, 0, 1]) < 0.02


def test_who_sits_stays_seated_and_who_picks_up_ends_upright(subtests):
    assert example({"action": "seated"}, FPS)[:, 0, 1].max() < 0.6
    assert example({"action": "sit"}, FPS)[-5:, 0, 1].max() < 0.6
    assert MORE["seated"].share == CORE["sit"].share
    for action in ("pick", "lift"):
        with subtests.test(action=action):
            assert example({"action": action}, FPS)[-1, 0, 1] > 0.9


WORDS = {
    1: "once|one|1|a|an|single", 2: "twice|two|2", 3: "thrice|three|3", "slow": "slow|slowly",
    "fast": "fast|quick|quickly|brisk|briskly", "half": "around|round|half|halfway|180", "left": "left",
    "right": "right", "both": "both|hands|arms", "forward": "forward|forwards|ahead|straight|front",
    "backward": "back|backward|backwards|reverse", "cycle": "cycle|loop",
    "clockwise": "clockwise|right", "counterclockwise": "counterclockwise|counter|anticlockwise|anti|left",
}  # fmt: skip


def test_captions_state_the_attributes_and_contradict_none():
    rng, source = np.random.default_rng(0), Synthetic(1, actions="all")
    requested = [MORE[name].draw(rng, name) for name in MORE for _ in range(6)]
    requested += [source.attributes(rng) for _ in range(40)]
    requested = [
        attributes
        for number, attributes in enumerate(requested)
        if attributes not in requested[:number]
    ]
    meaning: dict[str, Attributes] = {}
    for attributes in requested:
        captions, stated = draw_captions(rng, attributes, 14)
        assert stated == attributes
        for caption in captions:
            assert meaning.setdefault(caption, attributes) == attributes, caption
            assert not set(caption) & set("[]{}<>|="), caption
            said = set(words(caption))
            for name, value in attributes.items():
                if name not in ("action", "while") and value not in ("normal", "quarter"):
                    assert said & set(WORDS[value].split("|")), f"{caption}: {name}={value}"
            sides = {attributes.get("side"), attributes.get("direction")} & {"left", "right"}
            assert not sides or not ({"left", "right"} - sides) & said, caption


def test_every_action_has_six_captions_and_known_verbs(subtests):
    grammar = content()
    for name in MORE:
        with subtests.test(name=name):
            templates = next(
                grammar["captions"][key]
                for key in (name, f"{name} left")
                if key in grammar["captions"]
            )
            assert len(templates) >= 6, name
    assert {key for key in grammar["captions"] if key.endswith(" cycle")} == {
        f"{name} cycle" for name in CYCLES
    }
    assert grammar["gestures"].keys() == GESTURES.keys()
    assert {key.split()[0] for key in grammar["mains"]} == BASES.keys()
    text = json.dumps(
        [grammar[name] for name in ("captions", "mains", "gestures", "simultaneous", "phrases")]
    )
    used = {
        verb for group in text.split("<")[1:] for verb in group.split(">")[0].lstrip("-").split("/")
    }
    assert used <= grammar["verbs"].keys()


def test_all_has_both_groups_two_actions_at_once_and_cycles(clips: list[Clip]):
    source = Synthetic(160, seed=5, actions="all")
    assert source.actions == tuple(ACTIONS)
    assert len(ACTIONS) >= 70
    assert source.options["actions"] == "all"
    assert all(source.actions[clip.action or 0] == clip.attributes["action"] for clip in clips)
    shares = {
        name: np.mean([name in clip.attributes for clip in clips]) for name in ("while", "ends")
    }
    assert 0.03 < shares["while"] < 0.14
    assert 0.005 < shares["ends"] < 0.09
    assert len({clip.attributes["action"] for clip in clips}) > 45
    with pytest.raises(UserError, match='actions=\'more\': choose "core" or "all"'):
        Synthetic(1, actions="more")  # pyright: ignore[reportArgumentType]


def drawn(name: str, number: int) -> tuple[np.ndarray, Attributes]:
    attributes = MORE[name].draw(np.random.default_rng((number, len(name))), name)
    return gaussian_filter1d(
        example(attributes, FPS).astype(np.float64), 1.0, axis=0, mode="nearest"
    ), attributes


@pytest.mark.parametrize("name", CHECKED)
def test_checks_read_side_count_and_direction_and_a_mirrored_motion_the_other_side(
    name: str, subtests
):
    other = {"left": "right", "right": "left"}
    for number in range(3):
        with subtests.test(number=number):
            motion, attributes = drawn(name, number)
            assert check(name, View.of(motion, FPS)) == attributes
            mirrored = motion[:, SWAP] * np.array([-1, 1, 1])
            expected = {key: other.get(str(value), value) for key, value in attributes.items()}
            assert check(name, View.of(mirrored, FPS)) == expected


def test_standing_shows_none_of_the_checked_actions():
    standing = example({"action": "stand"}, FPS).astype(np.float64)
    assert {name for name in CHECKED if check(name, View.of(standing, FPS))} == set()
    assert "checks" not in read_all(np.zeros((40, 22, 3)), FPS)


def test_only_what_rules_decide_is_scored():
    point = example({"action": "point", "side": "left"}, FPS)
    assert right_attributes(read_all(point, FPS), {"action": "point", "side": "left"})["all"]
    assert not right_attributes(read_all(point, FPS), {"action": "point", "side": "right"})["all"]
    seen = read_all(example({"action": "pray"}, FPS), FPS)
    assert {"pray", "idle", "sneak"} <= UNDECIDED
    assert right_attributes(seen, {"action": "pray"}) == {}
    assert right_attributes(seen, {"action": "walk", "while": "wave", "side": "left"}) == {}


def standing_view(frames: int = 20, turned: float = 0.0, **changes: Any) -> View:
    """A body that stands with hanging arms and faces +z, with the paths (F, 3) or (3,) of some joints changed."""
    body = np.zeros((frames, 22, 3))
    heights = {"pelvis": 0.95, "neck": 1.45, "head": 1.6, "ankle": 0.08, "foot": 0.0}
    heights |= {"shoulder": 1.4, "elbow": 1.1, "wrist": 0.85}
    for joint, name in enumerate(SMPL22.joints):
        side, _, part = name.rpartition("_")
        body[:, joint, 0] = {"left": 0.2, "right": -0.2}.get(side, 0.0)
        body[:, joint, 1] = heights.get(part, 1.0)
    for name, path in changes.items():
        body[:, SMPL22.joints.index(name)] = path
    forward, left = np.tile([0.0, 1.0], (frames, 1)), np.tile([1.0, 0.0], (frames, 1))
    return View(body, 20.0, forward, left, turned, 0.0)


def during(frames: int, there: Sequence[float], otherwise: Sequence[float]) -> np.ndarray:
    """A path (20, 3) that is at one point in the first frames and at another point afterwards."""
    return np.where(np.arange(20)[:, None] < frames, there, otherwise)


HANG, AHEAD = (0.2, 0.85, 0.0), (0.2, 1.2, 0.16)
LEFT, RIGHT = {"side": "left"}, {"side": "right"}
TO_LEFT, TO_RIGHT = {"direction": "left"}, {"direction": "right"}


def shifted(x: float, z: float, quick: float = 1.0) -> dict[str, Any]:
    """A pelvis that moves by (x, z) and then rests, within one frame or slower."""
    share = np.clip(np.arange(20) * quick, 0, 1)[:, None]
    return {"pelvis": [0.0, 0.95, 0.0] + share * [x, 0.0, z]}


def level_arm(frames: int) -> dict[str, Any]:
    """An arm that is level in the first frames and hangs afterwards."""
    elbow = during(frames, (0.2, 1.4, 0.3), (0.2, 1.1, 0.0))
    return {"left_elbow": elbow, "left_wrist": during(frames, (0.2, 1.4, 0.6), (0.2, 0.8, 0.0))}


LIMITS: list[tuple[str, dict[str, Any], dict[str, Any]]] = [
    ("touch head", {"left_wrist": during(8, (0.0, 1.6, 0.269), HANG)}, LEFT),
    ("touch head", {"left_wrist": during(8, (0.0, 1.6, 0.271), HANG)}, {}),
    ("touch head", {"left_wrist": during(7, (0.0, 1.6, 0.269), HANG)}, {}),
    ("beckon", {"left_wrist": during(9, AHEAD, HANG)}, LEFT),
    ("beckon", {"left_wrist": during(8, AHEAD, HANG)}, {}),
    ("beckon", {"left_wrist": during(9, (0.2, 1.2, 0.14), HANG)}, {}),
    ("beckon", {"right_wrist": (-0.2, 1.11, 0.2)}, RIGHT),
    ("beckon", {"right_wrist": (-0.2, 1.09, 0.2)}, {}),
    ("point", level_arm(9), LEFT),
    ("point", level_arm(8), {}),
    ("point", {"left_elbow": (0.2, 1.4, 0.3), "left_wrist": (0.2, 1.552, 0.559)}, LEFT),
    ("point", {"left_elbow": (0.45, 1.566, 0.0), "left_wrist": (0.7, 1.735, 0.0)}, LEFT),
    ("point", {"left_elbow": (0.44, 1.58, 0.0), "left_wrist": (0.68, 1.76, 0.0)}, {}),
    ("point", {"left_elbow": (0.2, 1.2, 0.223), "left_wrist": (0.2, 1.4, 0.446)}, {}),
    ("spin", {"turned": 271.0}, TO_LEFT),
    ("spin", {"turned": -271.0}, TO_RIGHT),
    ("spin", {"turned": 269.0}, {}),
    ("lean", {"head": (0.131, 1.6, 0.0)}, TO_LEFT),
    ("lean", {"head": (-0.131, 1.6, 0.0)}, TO_RIGHT),
    ("lean", {"head": (0.129, 1.6, 0.5)}, {}),
    ("stretch sideways", {"head": (0.14, 1.6, 0.0)}, {}),
    ("strafe", shifted(0.34, 0.16), TO_LEFT),
    ("strafe", shifted(-0.34, 0.16), TO_RIGHT),
    ("strafe", shifted(0.32, 0.0), {}),
    ("strafe", shifted(0.34, 0.18), {}),
    ("dodge", shifted(0.26, 0.1), TO_LEFT),
    ("dodge", shifted(0.0, -0.26), {"direction": "backward"}),
    ("dodge", shifted(0.0, 0.26), {}),
    ("dodge", shifted(0.24, 0.0), {}),
    ("dodge", shifted(0.31, 0.0, 0.1), TO_LEFT),
    ("dodge", shifted(0.29, 0.0, 0.1), {}),
    ("hop", {"right_foot": during(8, (0, 0.13, 0), (0, 0, 0))}, {**LEFT, "count": 0}),
    ("hop", {"right_foot": during(7, (0, 0.13, 0), (0, 0, 0))}, {}),
    ("hop", {"right_foot": (0, 0.119, 0)}, {}),
    ("hop", {"right_foot": (0, 0.3, 0), "left_foot": during(9, (0, 0, 0), (0, 0.051, 0))}, {**LEFT, "count": 1}),
    ("hop", {"right_foot": (0, 0.3, 0), "left_foot": during(9, (0, 0, 0), (0, 0.049, 0))}, {**LEFT, "count": 0}),
]  # fmt: skip


@pytest.mark.parametrize(("name", "changes", "shown"), LIMITS)
def test_checks_have_the_limits_that_their_docstrings_state(
    name: str, changes: dict[str, Any], shown: dict[str, Any]
):
    expected = {"action": name, **shown} if shown else {}
    assert check(name, standing_view(**changes)) == expected


@pytest.mark.parametrize(("apart", "high", "count"), [(0.46, 0.11, 1), (0.44, 0.11, 0), (0.46, 0.09, 0)])  # fmt: skip
def test_jumping_jacks_spread_the_feet_while_the_hands_rise(apart: float, high: float, count: int):
    feet: dict[str, Any] = {"left_ankle": during(10, (0.05, 0.08, 0), (apart - 0.05, 0.08, 0))}
    feet |= {"right_ankle": (-0.05, 0.08, 0.0)}
    hands: dict[str, Any] = {f"{side}_wrist": (0.2, 1.4 + high, 0.0) for side in ("left", "right")}
    shown = check("jumping jacks", standing_view(**feet, **hands))
    assert shown.get("count", 0) == count
    for side in ("left", "right"):
        one_hand_hangs = {**feet, **hands, f"{side}_wrist": (0.2, 0.8, 0.0)}
        assert check("jumping jacks", standing_view(**one_hand_hangs)) == {}


@pytest.mark.parametrize(
    ("sinks", "height", "count"), [(0.131, 0.83, 1), (0.129, 0.83, 0), (0.2, 0.85, 0)]
)
def test_push_ups_sink_by_13_centimeters_with_a_level_trunk(
    sinks: float, height: float, count: int
):
    neck = during(12, (0.0, 0.95 + height, 1.0), (0.0, 0.95 + height - sinks, 1.0))
    assert check("push-ups", standing_view(neck=neck)).get("count", 0) == count


@pytest.mark.parametrize(("above", "inward", "frames", "slashes"), [
    (0.21, 0.16, 9, True), (0.19, 0.16, 9, False), (0.21, 0.14, 9, False), (0.21, 0.16, 10, False)
])  # fmt: skip
@pytest.mark.parametrize(("side", "sign"), [("left", 1), ("right", -1)])
def test_a_slash_goes_down_and_inward_within_half_a_second(
    above: float, inward: float, frames: int, slashes: bool, side: str, sign: int
):
    wrist = np.tile([sign * 0.2, 1.5, 0.0], (20, 1))
    wrist[2, 1] = 1.4 + above
    wrist[2 + frames :] = sign * (0.2 - inward), 1.39, 0.0
    expected = {"action": "slash", "side": side} if slashes else {}
    assert check("slash", standing_view(**cast(Any, {f"{side}_wrist": wrist}))) == expected


@pytest.mark.parametrize(
    ("walked", "lifted", "sunk", "shift", "side"),
    [
        (0.34, 0.1, 0.03, 0, "left"),
        (0.34, 0.1, 0.03, 5, "right"),
        (0.34, 0.1, 0.03, 2.5, None),
        (0.32, 0.1, 0.03, 0, None),
        (0.34, 0.019, 0.03, 0, None),
        (0.34, 0.1, 0.019, 0, None),
    ],
)
def test_in_a_limp_the_body_sinks_on_one_leg_while_the_other_foot_is_up(
    walked: float, lifted: float, sunk: float, shift: float, side: str | None
):
    """The right foot is up in every second half of a period of 10 frames."""
    phase = 2 * np.pi * np.arange(41) / 10
    right_up = 0.5 + 0.5 * np.cos(phase)
    low = 0.5 + 0.5 * np.cos(phase - 2 * np.pi * shift / 10)
    ahead = np.linspace(0, walked, 41)
    zero = np.zeros(41)
    view = standing_view(
        41,
        right_ankle=np.stack([zero - 0.2, 0.08 + lifted * right_up, ahead], -1),
        left_ankle=np.stack([zero + 0.2, zero + 0.08, ahead], -1),
        pelvis=np.stack([zero, 0.95 - sunk * low, ahead], -1),
    )
    assert check("limp", view) == ({"action": "limp", "side": side} if side else {})


@pytest.mark.parametrize(
    ("stroke", "back", "count"), [(0.3, 0.2, 3), (0.3, 0.22, 1), (0.24, 0.2, 2)]
)
def test_knocks_are_strokes_near_the_farthest_point_of_the_hand(
    stroke: float, back: float, count: int
):
    """The hand begins at its side and goes to 0.3 m ahead, to `stroke` m and to 0.3 m again."""
    ahead = np.array([0, 0.3, back, stroke, back, 0.3, *[0.2] * 14])
    wrist = np.stack([0 * ahead - 0.2, 0 * ahead + 1.2, ahead], -1)
    expected = {"action": "knock", "side": "right", "count": count}
    assert check("knock", standing_view(right_wrist=wrist)) == expected


@pytest.mark.parametrize(("height", "stretches"), [(1.61, True), (1.59, False)])
def test_a_stretch_sideways_has_both_hands_above_the_head(height: float, stretches: bool):
    hands = {"left_wrist": (0.2, 1.9, 0.0), "right_wrist": (-0.2, height, 0.0)}
    shown = check("stretch sideways", standing_view(head=(-0.14, 1.6, 0.0), **cast(Any, hands)))
    expected = {"action": "stretch sideways", "direction": "right"}
    assert shown == (expected if stretches else {})


def test_a_rise_counts_after_the_signal_was_low():
    assert count_rises(np.array([5.0, 1, 3, 5, 3, 5, 2, 4.1, 0]), 4.0, 2.0) == 1
    assert count_rises(np.array([1.0, 4.0, 1.9, 4.1, 4.2, 1.9, 9]), 4.0, 2.0) == 2


@pytest.mark.parametrize(("speed", "action", "pace"), [
    (0.84, "walk", "slow"), (0.86, "walk", "normal"), (1.39, "walk", "normal"), (1.41, "walk", "fast"),
    (2.09, "walk", "fast"), (2.11, "run", None),
])  # fmt: skip
@pytest.mark.parametrize("fps", [20.0, 30.0])
def test_the_pace_of_a_walk_is_its_speed_in_the_middle(
    speed: float, action: str, pace: str | None, fps: float
):
    view = standing_view(60)
    path = np.arange(60)[:, None, None] * [0.0, 0.0, speed / fps]
    smooth = view.smooth + path
    smooth[:, (7, 8), 1] += 0.05 * (np.arange(60) % 10 < 5)[:, None]
    shown = _locomotion(smooth, view.forward, view.left, 0.0, fps)
    expected = {"action": action, "direction": "forward"} | ({"speed": pace} if pace else {})
    assert shown == expected
    back = _locomotion(smooth, -view.forward, -view.left, 0.0, fps)
    assert back["direction"] == "backward"
    aside = _locomotion(smooth, view.left, -view.forward, 0.0, fps)
    assert aside["direction"] == "right"
    for turned, direction in ((91.0, "counterclockwise"), (-91.0, "clockwise"), (89.0, "forward")):
        shown = _locomotion(smooth, view.forward, view.left, turned, fps)
        assert shown["direction"] == direction


@pytest.mark.parametrize(
    ("lift", "distance", "walks"),
    [(0.041, 0.36, True), (0.039, 0.36, False), (0.041, 0.32, False)],
)
def test_a_walk_lifts_both_feet_and_leaves_its_place(lift: float, distance: float, walks: bool):
    view = standing_view(60)
    smooth = view.smooth + np.clip(np.arange(60) / 20 - 1, 0, 1)[:, None, None] * [0, 0, distance]
    smooth[:, (7, 8), 1] += lift * (np.arange(60) % 10 < 5)[:, None]
    smooth[:, 7, 1] += 0.2 * (np.arange(60) % 10 < 5)
    assert bool(_locomotion(smooth, view.forward, view.left, 0.0, 20.0)) == walks


@pytest.mark.parametrize(("reach", "height", "count"), [(0.36, 0.32, 2), (0.34, 0.32, 0), (0.36, 0.30, 0)])  # fmt: skip
def test_a_kick_is_far_in_front_and_high_and_each_one_counts(
    reach: float, height: float, count: int
):
    ankle = np.tile([-0.2, 0.08, 0.0], (20, 1))
    ankle[[5, 12]] = -0.2, height, reach
    view = standing_view(right_ankle=ankle)
    expected = {"action": "kick", "side": "right", "count": count} if count else {}
    assert _kick(view.smooth, 0.0, view.forward) == expected


@pytest.mark.parametrize(
    ("neck", "toes", "stands"), [(0.26, 0.51, True), (0.24, 0.51, False), (0.26, 0.49, False)]
)
def test_a_body_stands_if_its_neck_and_its_pelvis_are_high(neck: float, toes: float, stands: bool):
    still = np.repeat(example({"action": "stand"}, FPS)[:1].astype(np.float64), 40, axis=0)
    pelvis = still[:, [0], 1]
    still[:, [12], 1], still[:, [10, 11], 1] = pelvis + neck, pelvis - toes
    assert read_attributes(still, FPS) == ({"action": "stand"} if stands else {})


def test_limbs_of_a_body_have_plausible_lengths_and_move_smoothly():
    still = np.repeat(example({"action": "stand"}, FPS)[:1].astype(np.float64), 20, axis=0)
    limbs = [(1, 4), (2, 5), (4, 7), (5, 8), (16, 18), (17, 19), (18, 20), (19, 21)]
    lengths = [np.linalg.norm(still[0, a] - still[0, b]) for a, b in limbs]
    for scale, plausible in (
        (0.149 / min(lengths), False),
        (0.151 / min(lengths), True),
        (0.599 / max(lengths), True),
        (0.601 / max(lengths), False),
    ):
        assert _is_a_body(scale * still, scale * still) == plausible, scale
    shift = np.array([0.0, 0.012, 0.016])  # 2 cm
    assert _is_a_body(still + 0.99 * shift, still)
    assert not _is_a_body(still + 1.01 * shift, still)
    # Each of the 8 limbs is 160 times in the motion with 20 frames: 90 % are 144
    for changed, share, plausible in ((15, 1.26, True), (16, 1.26, False), (19, 1.24, True)):
        longer = still.copy()
        bone = still[:, 20] - still[:, 18]
        longer[:, 20] += (share - 1) * bone * (np.arange(20) < min(changed, 9))[:, None]
        other = still[:, 21] - still[:, 19]
        longer[:, 21] += (share - 1) * other * (np.arange(20) < changed - 9)[:, None]
        assert _is_a_body(longer, longer) == plausible, (changed, share)


UPRIGHT, LEVEL = (0.0, 0.5, 0.1), (0.0, 0.2, 0.4)


@pytest.mark.parametrize(
    ("start", "end", "moved", "shown"),
    [
        ((0.79, UPRIGHT), (0.71, UPRIGHT), 0.0, {"action": "sit"}),
        ((0.79, UPRIGHT), (0.73, UPRIGHT), 0.0, {}),
        ((0.77, UPRIGHT), (0.71, UPRIGHT), 0.0, {}),
        ((0.79, UPRIGHT), (0.36, UPRIGHT), 0.0, {"action": "sit"}),
        ((0.79, UPRIGHT), (0.34, UPRIGHT), 0.0, {}),
        ((0.5, UPRIGHT), (0.9, UPRIGHT), 0.0, {"action": "rise"}),
        ((0.5, UPRIGHT), (0.9, LEVEL), 0.0, {}),
        ((0.5, LEVEL), (0.9, UPRIGHT), 0.0, {}),
        ((0.79, UPRIGHT), (0.34, LEVEL), 0.0, {"action": "lie"}),
        ((0.79, UPRIGHT), (0.36, LEVEL), 0.0, {}),
        ((0.77, UPRIGHT), (0.34, LEVEL), 0.0, {}),
        ((0.5, LEVEL), (0.5, LEVEL), 0.34, {"action": "crawl", "direction": "forward"}),
        ((0.5, LEVEL), (0.5, LEVEL), -0.34, {"action": "crawl", "direction": "backward"}),
        ((0.5, LEVEL), (0.5, LEVEL), 0.32, {}),
        ((0.36, LEVEL), (0.36, LEVEL), 0.5, {"action": "crawl", "direction": "forward"}),
        ((0.64, LEVEL), (0.64, LEVEL), 0.5, {"action": "crawl", "direction": "forward"}),
        ((0.34, LEVEL), (0.34, LEVEL), 0.5, {}),
        ((0.66, LEVEL), (0.66, LEVEL), 0.5, {}),
    ],
)
@pytest.mark.parametrize("floor", [0.0, -0.4])
def test_lowered_bodies_are_told_apart_by_the_heights_of_the_pelvis_and_the_tilt(
    start: tuple[float, tuple], end: tuple[float, tuple], moved: float, shown: dict, floor: float
):
    view = standing_view(40)
    for joint, offset in ((0, (0.0, 0.0, 0.0)), (12, None)):
        for frames, (height, neck) in ((slice(0, 20), start), (slice(20, 40), end)):
            view.smooth[frames, joint] = np.array([0.0, floor + height, 0.0]) + (offset or neck)
    view.smooth[..., 2] += 3.0 + np.linspace(0, moved, 40)[:, None]
    assert _lowered(view.smooth, floor, view.forward, 20.0) == shown


def arm_view(frames: int, fps: float, first: int = 5, **there: Any) -> View:
    """A standing body of which some joints are at a point for `frames` frames, from frame `first` on."""
    rest = standing_view(int(3 * fps))
    for name, path in there.items():
        rest.smooth[first : first + frames, SMPL22.joints.index(name)] = path
    return rest


def up(side: str = "left", height: float = 0.55) -> dict[str, Any]:
    """An arm that is above the shoulder; the arm is 0.55 m long."""
    x = 0.2 if side == "left" else -0.2
    wrist = 1.4 + height
    return {f"{side}_elbow": (x, wrist - 0.25, 0.0), f"{side}_wrist": (x, wrist, 0.0)}


@pytest.mark.parametrize(
    ("frames", "fps", "joints", "sides"),
    [
        (7, 20, up(), "left"),
        (6, 20, up(), None),
        (11, 30, up("right"), "right"),
        (10, 30, up("right"), None),
        (7, 20, up() | up("right"), "both"),
        (7, 20, up(height=0.415), "left"),
        (7, 20, up(height=0.41), None),
    ],
)
def test_a_raised_arm_points_up_for_a_third_of_a_second(
    frames: int, fps: int, joints: dict[str, Any], sides: str | None
):
    view = arm_view(frames, fps, **joints)
    expected = {"action": "raise", "side": sides} if sides else {}
    assert _arms(view.smooth, view.forward, fps) == expected
    # An arm that is up from the start does not rise
    view = arm_view(3 * fps, fps, first=0, **joints)
    assert _arms(view.smooth, view.forward, fps) == {"action": "stand"}


@pytest.mark.parametrize(("swing", "waves"), [(0.5, True), (0.05, False)])
@pytest.mark.parametrize("sides", [("left",), ("right",), ("left", "right")])
@pytest.mark.parametrize("fps", [20, 30])
def test_in_a_wave_the_forearm_swings_about_the_elbow(
    swing: float, waves: bool, sides: tuple[str, ...], fps: int
):
    view = standing_view(3 * fps)
    angle = swing * np.sin(4 * np.pi * np.arange(3 * fps) / fps)  # twice per second
    for name in sides:
        out = 1 if name == "left" else -1
        elbow = np.array([0.5 * out, 1.4, 0.0])
        fore = 0.25 * np.stack([out * np.sin(angle), np.cos(angle), 0 * angle], -1)
        view.smooth[:, SMPL22.joints.index(f"{name}_elbow")] = elbow
        view.smooth[:, SMPL22.joints.index(f"{name}_wrist")] = elbow + fore
    side = sides[0] if len(sides) == 1 else "both"
    expected = {"action": "wave", "side": side} if waves else {"action": "stand"}
    assert _arms(view.smooth, view.forward, fps) == expected


@pytest.mark.parametrize(
    ("reach", "drawn", "count"), [(0.445, 0.32, 2), (0.435, 0.32, 0), (0.445, 0.34, 1)]
)
@pytest.mark.parametrize(("side", "x"), [("left", 0.2), ("right", -0.2)])
def test_punches_stretch_the_arm_and_are_drawn_back(
    reach: float, drawn: float, count: int, side: str, x: float
):
    view = standing_view(60)
    wrist = SMPL22.joints.index(f"{side}_wrist")
    view.smooth[10:14, wrist] = view.smooth[20:24, wrist] = x, 1.4, reach
    view.smooth[14:20, wrist] = x, 1.4, drawn
    expected = {"action": "punch", "side": side, "count": count} if count else {}
    assert _arms(view.smooth, view.forward, 20.0) == expected


@pytest.mark.parametrize(
    ("closed", "opened", "count"), [(0.17, 0.29, 2), (0.18, 0.29, 0), (0.17, 0.27, 1)]
)
def test_claps_bring_the_hands_together_and_apart(closed: float, opened: float, count: int):
    view = standing_view(60)
    wrists = [SMPL22.joints.index(f"{side}_wrist") for side in ("left", "right")]
    for frames, apart in (
        (slice(10, 60), opened),
        (slice(20, 24), closed),
        (slice(30, 34), closed),
    ):
        for wrist, sign in zip(wrists, (1, -1), strict=True):
            view.smooth[frames, wrist] = sign * apart / 2, 1.2, 0.3
    expected = {"action": "clap", "count": count} if count else {}
    assert _arms(view.smooth, view.forward, 20.0) == expected


@pytest.mark.parametrize(
    ("later", "ahead", "throws"), [(9, 0.39, True), (10, 0.39, False), (9, 0.37, False)]
)
def test_a_throw_moves_the_hand_from_above_the_shoulder_to_the_front_in_half_a_second(
    later: int, ahead: float, throws: bool
):
    wrist = np.tile([-0.2, 0.85, 0.0], (60, 1))
    wrist[20] = -0.2, 1.41, 0.09
    wrist[21 : 20 + later] = -0.2, 1.41, 0.11
    wrist[20 + later :] = -0.2, 1.3, ahead
    view = standing_view(60, right_wrist=wrist)
    shown = _arms(view.smooth, view.forward, 20.0)
    assert (shown == {"action": "throw", "side": "right"}) == throws
    turned = _arms(view.smooth, -view.forward, 20.0)  # to the back
    assert turned.get("action") != "throw"


@pytest.mark.parametrize(
    ("frames", "offset", "salutes"),
    [
        (9, (0.22, 0.0, 0.0), True),
        (8, (0.22, 0.0, 0.0), False),
        (9, (0.23, 0.0, 0.0), False),
        (9, (0.2, -0.07, 0.0), True),
        (9, (0.2, -0.09, 0.0), False),
    ],
)
def test_a_salute_holds_a_hand_at_the_head(
    frames: int, offset: tuple[float, float, float], salutes: bool
):
    view = arm_view(
        frames, 20, right_wrist=np.array([0.0, 1.6, 0.0]) - np.array([1, -1, 1]) * offset
    )
    shown = _arms(view.smooth, view.forward, 20.0)
    assert (shown == {"action": "salute", "side": "right"}) == salutes
    # A hand that stays at the head does not salute
    held = arm_view(
        60, 20, 0, right_wrist=np.array([0.0, 1.6, 0.0]) - np.array([1, -1, 1]) * offset
    )
    assert _arms(held.smooth, held.forward, 20.0) == {"action": "stand"}


@pytest.mark.parametrize(
    ("angle", "back", "count"), [(33, 21, 2), (31, 21, 0), (33, 23, 1), (-33, -21, 0)]
)
def test_nods_pitch_the_head_forward_and_back(angle: float, back: float, count: int):
    pitch = np.zeros(60)
    pitch[[*range(10, 14), *range(18, 22)]], pitch[14:18] = np.radians(angle), np.radians(back)
    head = np.array([0.0, 1.45, 0.0]) + 0.15 * np.stack(
        [0 * pitch, np.cos(pitch), np.sin(pitch)], -1
    )
    view = standing_view(60, head=head)
    assert _nods(view.smooth, view.forward) == count


@pytest.mark.parametrize(("degrees", "shown"), [
    (44, {}), (46, {"direction": "left", "amount": "quarter"}),
    (-46, {"direction": "right", "amount": "quarter"}), (134, {"direction": "left", "amount": "quarter"}),
    (136, {"direction": "left", "amount": "half"}),
])  # fmt: skip
def test_a_turn_is_a_quarter_or_a_half(degrees: float, shown: dict[str, Any]):
    still = example({"action": "stand"}, FPS)[:1].astype(np.float64)
    angle = np.radians(degrees) * np.clip((np.arange(80) - 20) / 40, 0, 1)[:, None]
    x, z = np.moveaxis(still[..., [0, 2]] - still[:, :1, [0, 2]], -1, 0)
    turning = np.repeat(still, 80, axis=0)
    turning[..., 0] = np.cos(angle) * x + np.sin(angle) * z
    turning[..., 2] = np.cos(angle) * z - np.sin(angle) * x
    seen = read_attributes(turning, FPS)
    assert {name: seen[name] for name in ("direction", "amount") if name in seen} == shown
    assert (seen.get("action") == "turn") == bool(shown)


@pytest.mark.parametrize(("degrees", "bows"), [(27, False), (29, True)])
def test_a_bow_tilts_the_trunk(degrees: float, bows: bool):
    still = np.repeat(example({"action": "stand"}, FPS)[:1].astype(np.float64), 60, axis=0)
    upper = [3, 6, 9, *range(12, 22)]
    trunk = still[0, 12] - still[0, 0]
    tilt = np.radians(degrees) - np.arctan2(trunk[2], trunk[1])
    y, z = np.moveaxis(still[:, upper][..., 1:] - still[:, :1, 1:], -1, 0)
    bowed = still.copy()
    bowed[:, upper, 1] = still[:, :1, 1] + np.cos(tilt) * y - np.sin(tilt) * z
    bowed[:, upper, 2] = still[:, :1, 2] + np.cos(tilt) * z + np.sin(tilt) * y
    assert (read_attributes(bowed, FPS).get("action") == "bow") == bows


@pytest.mark.parametrize(("height", "jumps"), [(0.075, 2), (0.065, 0)])
def test_jumps_are_counted_from_seven_centimeters_on(height: float, jumps: int):
    up = np.repeat(example({"action": "stand"}, FPS)[:1].astype(np.float64), 80, axis=0)
    up[[*range(20, 32), *range(50, 62)], :, 1] += height
    assert read_attributes(up, FPS).get("count", 0) == jumps


def test_a_clip_shorter_than_a_second_has_no_attributes():
    still = example({"action": "stand"}, FPS)
    assert read_attributes(still[:20], 20.0)["action"] == "stand"
    assert read_attributes(still[:19], 20.0) == {}
    assert "checks" not in read_all(still[:19], 20.0)


@pytest.mark.parametrize(
    "attributes",
    [
        {"action": "nod"},
        {"action": "walk", "direction": "left"},
        {"action": "get up"},
        {"action": "walk", "speed": "normal", "ends": "cycle"},
    ],
    ids=str,
)
def test_an_example_lasts_three_seconds_at_any_rate(attributes: Attributes):
    slow, fast = example(attributes, 10), example(attributes, 30)
    assert (len(slow), len(fast), len(example(attributes))) == (30, 90, 60)
    assert slow.dtype == np.float32


@pytest.mark.parametrize(
    ("name", "changes", "shown"), [row for row in LIMITS if row[0] not in ("dodge", "knock")]
)
def test_checks_need_the_same_seconds_at_twice_the_frame_rate(
    name: str, changes: dict[str, Any], shown: dict[str, Any]
):
    twice: dict[str, Any] = {
        part: np.repeat(path, 2, axis=0) if np.ndim(path) == 2 else path
        for part, path in changes.items()
    }
    view = replace(standing_view(40, **twice), fps=40.0)
    assert check(name, view) == ({"action": name, **shown} if shown else {})


@pytest.mark.parametrize(("path", "dodges"), [(0.31, True), (0.29, False)])
def test_a_dodge_is_faster_than_60_centimeters_per_second_at_any_rate(path: float, dodges: bool):
    for fps in (20.0, 40.0):
        share = np.clip(np.arange(fps) / fps * 2, 0, 1)[:, None]  # within half a second
        view = standing_view(int(fps), pelvis=[0.0, 0.95, 0.0] + share * [path, 0.0, 0.0])
        shown = check("dodge", replace(view, fps=fps))
        assert shown == ({"action": "dodge", "direction": "left"} if dodges else {}), fps


def resting(frames: int) -> np.ndarray:
    """A body of the synthetic set that stands still."""
    return np.repeat(example({"action": "stand"}, FPS)[:1].astype(np.float64), frames, axis=0)


@pytest.mark.parametrize(
    ("distance", "stride", "leaps"),
    [(0.46, 0.0, True), (0.44, 0.0, False), (0.46, 0.27, False), (0.46, 0.23, True)],
)
def test_a_leap_covers_45_centimeters_with_both_feet_side_by_side(
    distance: float, stride: float, leaps: bool
):
    body = resting(80)
    body[30:50, :, 1] += 0.15
    body[..., 2] += distance * np.clip((np.arange(80) - 30) / 20, 0, 1)[:, None]
    body[:, 10, 2] += stride + body[0, 11, 2] - body[0, 10, 2]
    assert (read_attributes(body, FPS) == {"action": "leap"}) == leaps


@pytest.mark.parametrize("fps", [20, 30])
@pytest.mark.parametrize(("sway", "dances"), [(0.039, True), (0.034, False)])
def test_a_dance_sways_by_three_and_a_half_centimeters_to_each_side(
    sway: float, dances: bool, fps: int
):
    body = resting(4 * fps)
    body[..., 0] += sway * np.sin(2 * np.pi * np.arange(4 * fps) / fps)[:, None]
    assert (read_attributes(body, fps) == {"action": "dance"}) == dances
    assert read_attributes(body[: int(1.2 * fps)], fps) != {"action": "dance"}, "it sways once"


@pytest.mark.parametrize(
    ("hanging", "low", "picks"),
    [(0.85, 0.41, True), (0.85, 0.43, False), (0.72, 0.41, True), (0.7, 0.41, False)],
)
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_hand_that_picks_up_comes_within_42_centimeters_of_the_floor(
    hanging: float, low: float, picks: bool, side: str
):
    body = resting(80)
    floor, wrist = body[:, (10, 11), 1].min(), SMPL22.joints.index(f"{side}_wrist")
    body[:, wrist, 1], body[30:42, wrist, 1] = floor + hanging, floor + low
    expected = {"action": "pick", "side": side} if picks else None
    assert (read_attributes(body, FPS) == expected) == picks
    assert picks or read_attributes(body, FPS).get("action") != "pick"


@pytest.mark.parametrize(
    ("down", "between", "squats"),
    [(0.19, 0.0, 2), (0.17, 0.0, 0), (0.19, 0.09, 2), (0.19, 0.11, 1)],
)
def test_squats_lower_the_pelvis_by_18_centimeters_and_raise_it_again(
    down: float, between: float, squats: int
):
    body = resting(100)
    body[30:42, 0, 1] -= down
    body[42:54, 0, 1] -= between
    body[54:66, 0, 1] -= down
    expected = {"action": "squat", "count": squats} if squats else {"action": "stand"}
    assert read_attributes(body, FPS) == expected


@pytest.mark.parametrize(("later", "throws"), [(14, True), (15, False)])
def test_a_throw_takes_half_a_second_at_any_rate(later: int, throws: bool):
    wrist = np.tile([-0.2, 0.85, 0.0], (90, 1))
    wrist[20] = -0.2, 1.41, 0.09
    wrist[21 : 20 + later] = -0.2, 1.41, 0.11
    wrist[20 + later :] = -0.2, 1.3, 0.39
    view = standing_view(90, right_wrist=wrist)
    shown = _arms(view.smooth, view.forward, 30.0)
    assert (shown == {"action": "throw", "side": "right"}) == throws


@pytest.mark.parametrize(("frames", "salutes"), [(13, True), (12, False)])
def test_a_salute_lasts_two_fifths_of_a_second_at_any_rate(frames: int, salutes: bool):
    view = arm_view(frames, 30, left_wrist=np.array([0.2, 1.6, 0.0]))
    shown = _arms(view.smooth, view.forward, 30.0)
    assert (shown == {"action": "salute", "side": "left"}) == salutes


VARIANTS = """
walk 10778.1341; run 5872.2105; turn 2974.0920; jump 2374.5218; wave 2408.1447;
raise 2584.6757; kick 3106.2329; punch 4676.1959; squat 1446.3350; bow 746.6929;
stand 730.0480; sit 179.9105; rise 1169.5234; dance 827.8001; leap 1690.3054;
pick 1364.7221; throw 1961.7646; crawl 1553.9208; lie -541.4124; clap 2336.5787;
salute 1568.7406; nod 2266.2360; idle 756.5110; look around 750.8615; stretch 884.7714;
stretch sideways 1647.6497; lean 1507.5817; point 1578.9790; beckon 1564.2168;
shrug 777.9679; celebrate 803.2100; pray 841.8385; cry 889.3299; laugh 760.7559;
drink 1584.5226; phone 1633.2673; type 648.2723; wipe 1620.5179; knock 4514.8169;
guitar 822.4992; cross arms 801.7220; hands on hips 768.1794; touch head 1563.9014;
touch face 1560.7661; talk 760.1416; seated 587.8148; lift 697.6949; kneel 350.3586;
jumping jacks 2310.5294; push-ups 554.6941; hop 4602.3353; sneak 1799.3604;
crouch walk 2282.9387; limp 4120.9493; stagger 2174.4324; march 2583.7800;
march in place 786.5589; run in place 821.0186; carry 2552.7427; push 1814.7712;
pull -196.2240; climb ladder 2110.3902; climb stairs 2235.3830; stumble 2949.2577;
strafe 1466.4304; skip 3603.6703; spin 1528.3566; waltz 743.3201; dodge 1866.7081;
fighting stance 780.9399; duck 717.1750; hit 607.4964; block 706.6105; slash 1741.7079;
fall -564.4881; get up 1010.2286
"""
"""Weighted sums of examples of each action over all attributes, at two durations."""


def variants(name: str) -> list[Attributes]:
    """All attributes that an action can have. Only walks ahead have a speed."""
    values = ACTIONS[name].values
    rows: list[Attributes] = []
    for row in product(*values.values()):
        rows.append({"action": name, **dict(zip(values, row, strict=True))})
    for row in rows:
        if row.get("direction", "forward") != "forward":
            row.pop("speed", None)
    return [row for number, row in enumerate(rows) if row not in rows[:number]]


def numbers_of(table: str) -> list[tuple[str, float]]:
    rows = (line.strip().rpartition(" ") for line in table.split(";"))
    return [(name, float(number)) for name, _, number in rows]


@pytest.mark.parametrize(("name", "expected"), numbers_of(VARIANTS))
def test_the_motions_of_all_variants_of_an_action_do_not_change(name: str, expected: float):
    number, total = list(ACTIONS).index(name), 0.0
    for variant, attributes in enumerate(variants(name)):
        for seed, frames in ((2, 33), (3, 41)):
            rng = np.random.default_rng((seed, number, variant))
            total += weighted(_joints(rng, np.arange(frames) / 12.5, attributes))
    assert total == pytest.approx(expected, abs=3e-3)


ADDED = """
wave 6061.2448; raise 5769.8184; clap 5160.0547; point 5318.2607; salute 5803.9051;
phone 5238.4970; drink 5624.6969; carry 6078.9952; walk cycle 2299.9571;
run cycle 3386.2477; run in place cycle 395.9350; sneak cycle 865.1895;
crouch walk cycle 1161.0951
"""
"""Weighted sums of gestures during each of the other actions, and of parts of cycles."""


@pytest.mark.parametrize(("name", "expected"), numbers_of(ADDED))
def test_gestures_during_other_actions_and_parts_of_cycles_do_not_change(
    name: str, expected: float
):
    drawn: list[Attributes] = []
    if cycle := name.removesuffix(" cycle") if name.endswith(" cycle") else "":
        number = list(CYCLES).index(cycle)
        draws = [np.random.default_rng((5, number))]
        drawn = [{"action": cycle, "ends": "cycle"} | CYCLES[cycle].draw(draws[0], cycle)]
    else:
        number = list(GESTURES).index(name)
        draws = [np.random.default_rng((4, number, base)) for base in range(len(BASES))]
        for base, rng in zip(BASES, draws, strict=True):
            first, second = BASES[base].draw(rng, base), GESTURES[name].draw(rng, name)
            drawn.append(first | second | {"action": base, "while": name})
    motions = (
        _joints(rng, np.arange(36) / 12.5, attributes)
        for rng, attributes in zip(draws, drawn, strict=True)
    )
    assert sum(weighted(motion) for motion in motions) == pytest.approx(expected, abs=3e-3)


@pytest.mark.parametrize("fps", [12.5, 24, 30, 60])
@pytest.mark.parametrize("number", [0, 3, 8])
def test_clips_have_the_same_duration_at_every_rate(fps: float, number: int):
    source = Synthetic(10, seed=7, actions="all")
    exact, clip = source.clip(number, 1000), source.clip(number, fps)
    assert len(clip.motion) - 1 == pytest.approx((len(exact.motion) - 1) / 1000 * fps, abs=0.6)
    assert (clip.captions, clip.attributes) == (exact.captions, exact.attributes)


@pytest.mark.parametrize("name", ["walk", "sneak", "crouch walk"])
def test_parts_of_cycles_show_the_same_motion_at_every_rate(name: str):
    attributes: Attributes = {"action": name, "ends": "cycle", "speed": "normal"}
    slow, fast = (
        _joints(np.random.default_rng(3), np.arange(2 * fps + 1) / fps, attributes)
        for fps in (20, 60)
    )
    np.testing.assert_allclose(slow, fast[::3], atol=1e-4)
