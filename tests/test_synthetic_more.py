"""The actions that `Synthetic(actions="all")` adds: plausible bodies, true captions, checks; an unchanged core."""

import hashlib
import json

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from evaluators.metrics.attributes import UNDECIDED, read_all, right_attributes
from evaluators.metrics.checks import CHECKED, View, check
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
    more = {} if source is SyntheticSequences else {"actions": "all"}
    data = source(300, often=often, often_share=0.6, **more)
    rng = np.random.default_rng(0)
    drawn = [data.attributes(rng)["action"] for _ in range(1000)]
    shares = [drawn.count(name) / len(drawn) for name in often]
    assert shares == pytest.approx([0.31, 0.31], abs=0.05)
    assert data.options["often"] == ["nod", "spin"]
    assert data.options["often_share"] == 0.6
    assert "often" not in source(1).options


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
    actions = [few.actions[few.clip(k, 10).action or 0] for k in range(400)]
    share = sum(action in CORE for action in actions) / 400
    without = Synthetic(400, workers=1, actions="all")
    plain = sum(without.actions[without.clip(k, 10).action or 0] in CORE for k in range(400)) / 400
    assert share == pytest.approx(0.5 + 0.5 * plain, abs=0.06)
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
