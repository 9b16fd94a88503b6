"""The synthetic set: repeatable clips of a body that keeps its bones, its feet on the floor, and its captions true."""

from collections import Counter

import numpy as np
import pytest

from flame_mdm.conditions.vocabulary import words
from flame_mdm.data import Clip
from flame_mdm.data.grammar import draw_captions
from flame_mdm.data.synthetic import Synthetic, prompts
from flame_mdm.representations.skeleton import SMPL22

PARENTS = list(SMPL22.parents)
FPS = 20


@pytest.fixture(scope="module")
def clips() -> list[Clip]:
    return list(Synthetic(400, seed=3).clips(FPS))


def test_a_clip_depends_on_seed_and_number_alone(clips: list[Clip]):
    for clip, same in zip(Synthetic(3, seed=3).clips(FPS), clips, strict=False):
        assert (clip.id, clip.captions) == (same.id, same.captions)
        np.testing.assert_array_equal(clip.motion, same.motion)
    other = Synthetic(1, seed=4).clip(0, FPS)
    assert other.id != clips[0].id
    assert other.motion.shape != clips[0].motion.shape or not np.allclose(other.motion, clips[0].motion)


def test_frame_rates_sample_the_same_motion():
    slow, fast = Synthetic(1).clip(0, 10), Synthetic(1).clip(0, 20)
    both = min(len(slow.motion), len(fast.motion[::2]))
    np.testing.assert_allclose(slow.motion[:both], fast.motion[::2][:both], atol=1e-6)


def test_one_body_above_the_floor(clips: list[Clip]):
    bones = [np.linalg.norm(clip.motion[:, 1:] - clip.motion[:, PARENTS[1:]], axis=-1) for clip in clips]
    first = bones[0][0]
    for clip, lengths in zip(clips, bones, strict=True):
        if clip.attributes["action"] == "crawl":  # a shin may be 3 cm too long, and a foot below the floor
            continue
        np.testing.assert_allclose(lengths, np.tile(first, (len(lengths), 1)), atol=2e-6, err_msg=clip.id)
        assert clip.motion[..., 1].min() > -1e-6, clip.id
        low = {"rise": (1.0, 1.2)}
        least, most = low.get(str(clip.attributes["action"]), (1.3, 1.7))
        assert least < clip.motion[0, 15, 1] < most, clip.id
    assert first[PARENTS.index(9) - 1 :].min() > 0.05
    np.testing.assert_allclose(first[[0, 3, 6, 9]], first[[1, 4, 7, 10]], atol=1e-6)


def test_starts_at_the_origin_facing_z(clips: list[Clip]):
    for clip in clips:
        start = clip.motion[0]
        np.testing.assert_allclose(start[0, [0, 2]], 0, atol=1e-6)
        across = start[16] - start[17]
        assert across[0] > 0.9 * np.linalg.norm(across), f"{clip.id}: the left shoulder is not at +x"
        assert (start[10, 2] > start[7, 2]) == (clip.attributes["action"] != "crawl"), (
            f"{clip.id}: wrong way of the toes"
        )


def test_feet_on_the_floor_do_not_move(clips: list[Clip]):
    """A toe joint at rest height in two adjacent frames of a stance stays within a millimeter."""
    planted = 0
    for clip in clips:
        toes = clip.motion[:, [10, 11]]
        resting = toes[..., 1] < 1e-5
        stance = resting[1:-2] & resting[2:-1] & resting[:-3] & resting[3:]
        moved = np.linalg.norm(np.diff(toes[..., [0, 2]], axis=0), axis=-1)[1:-1]
        assert (moved[stance] < 1e-3).all(), f"{clip.id} {clip.attributes}: {moved[stance].max():.4f} m"
        planted += stance.sum()
    assert planted > 400 * FPS  # the check saw feet: more than half a second of each clip


def test_knees_bend_forward_elbows_do_not_bend_back_and_nothing_jumps(clips: list[Clip]):
    for clip in clips:
        motion = clip.motion.astype(np.float64)
        left = motion[:, 1] - motion[:, 2]
        for side in (0, 1):
            hip, knee, ankle = motion[:, 1 + side], motion[:, 4 + side], motion[:, 7 + side]
            forward = np.cross(ankle - hip, left)
            assert (((knee - (hip + ankle) / 2) * forward).sum(-1) > 0).all(), clip.id
            upper, fore = motion[:, 18 + side] - motion[:, 16 + side], motion[:, 20 + side] - motion[:, 18 + side]
            chest_forward = np.cross(motion[:, 16] - motion[:, 17], motion[:, 12] - motion[:, 0])
            lowered = (upper[:, 1] < -0.2) & (np.abs(chest_forward[:, 1]) < 0.1)
            bend = fore - upper * (fore * upper).sum(-1, keepdims=True) / (upper * upper).sum(-1, keepdims=True)
            assert ((bend * chest_forward).sum(-1)[lowered] > -1e-3).all(), clip.id
        speed = np.linalg.norm(np.diff(motion, axis=0), axis=-1).max() * FPS
        assert speed < 13, clip.id  # meters a second; a kick's toes, as in motion capture


def test_every_action_side_count_direction_and_speed_occurs(clips: list[Clip]):
    seen = Counter((name, value) for clip in clips for name, value in clip.attributes.items())
    for name, values in {
        "action": Synthetic.actions,
        "side": ("left", "right", "both"),
        "count": (1, 2, 3),
        "direction": ("forward", "backward", "left", "right", "clockwise", "counterclockwise"),
        "speed": ("slow", "normal", "fast"),
        "amount": ("quarter", "half"),
    }.items():
        for value in values:
            assert seen[name, value] > 2, f"{name}={value}"
    assert all(Synthetic.actions[clip.action or 0] == clip.attributes["action"] for clip in clips)


WORDS = {
    1: "once|one|1|a|an|single", 2: "twice|two|2", 3: "thrice|three|3", "slow": "slow|slowly",
    "fast": "fast|quick|quickly|brisk|briskly", "half": "around|round|half|halfway|180", "left": "left",
    "right": "right", "both": "both|hands|arms", "forward": "forward|forwards|ahead|straight|front",
    "backward": "back|backward|backwards|reverse", "clockwise": "clockwise|right",
    "counterclockwise": "counterclockwise|counter|anticlockwise|anti|left",
}  # fmt: skip


def test_captions_state_the_attributes_and_contradict_none(clips: list[Clip]):
    meaning: dict[str, dict] = {}
    for clip in clips:
        assert len(clip.captions) == len(set(clip.captions)) == 8
        for caption in clip.captions:
            assert meaning.setdefault(caption, dict(clip.attributes)) == dict(clip.attributes), caption
            said = set(words(caption))
            stated = {value: said & set(names.split("|")) for value, names in WORDS.items()}
            for name, value in clip.attributes.items():
                assert name == "action" or value in ("normal", "quarter") or stated[value], f"{caption}: {name}={value}"
            for side, other in (("left", "right"), ("right", "left")):
                if side in (clip.attributes.get("side"), clip.attributes.get("direction")):
                    assert other not in said, caption


def test_a_quarter_of_the_training_clips_leaves_something_out_and_no_other_clip(clips: list[Clip]):
    strikes = [clip for clip in clips if clip.attributes["action"] in ("kick", "punch")]
    less = {split: [len(clip.attributes) < 3 for clip in strikes if clip.split == split] for split in ("train", "test")}
    assert 0.1 < np.mean(less["train"]) < 0.45
    assert less["test"]
    assert not any(less["test"])


def test_verbs_agree_with_their_subjects():
    rng = np.random.default_rng(0)
    sentences = [caption.split() for _ in range(40) for caption in draw_captions(rng, {"action": "sit"}, 30)[0]]
    for subjects, verbs in (("he she someone", "sits takes lowers is"), ("they you people", "sit take lower are")):
        said = {sentence[1] for sentence in sentences if sentence[0] in subjects.split()}
        assert said == {*verbs.split(), *["sat", "took", "lowered", "will"]}
    bare = {sentence[0] for sentence in sentences if sentence[0].startswith(("sit", "tak"))}
    assert bare == {"sit", "take", "sitting", "taking"}


def test_speed_words_are_true(clips: list[Clip]):
    speeds: dict[str, list[float]] = {"slow": [], "normal": [], "fast": []}
    for clip in clips:
        if "speed" in clip.attributes:
            steps = np.linalg.norm(np.diff(clip.motion[:, 0, [0, 2]], axis=0), axis=-1) * FPS
            speeds[str(clip.attributes["speed"])].append(float(np.percentile(steps, 90)))
    assert max(speeds["slow"]) < 0.85 < min(speeds["normal"])
    assert max(speeds["normal"]) < 1.4 < min(speeds["fast"])


def test_prompts_cover_actions_and_sides():
    texts = [text for text, _ in prompts()]
    assert len(set(texts)) == len(texts) >= 20
    assert {attributes["action"] for _, attributes in prompts()} == set(Synthetic.actions)
    assert {attributes.get("side") for _, attributes in prompts()} == {None, "left", "right", "both"}
    assert ("a person waves with the left hand", {"action": "wave", "side": "left"}) in prompts()
