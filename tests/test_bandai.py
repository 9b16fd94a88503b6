import tarfile
import tempfile
import zipfile
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.fixtures import SHARED, needs_third_party, third_party
from support.stores import BONES, TAKES, synthetic_take

from flame_mdm.data import Clip, archives, bandai
from flame_mdm.data.bandai import (
    CONTENTS_1,
    JOINTS,
    STYLES_1,
    STYLES_2,
    TAKES_2,
    Bandai,
    captions,
    side_of,
    split_of,
)
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.representations.skeleton import SMPL22, SMPL24
from flame_mdm.representations.smpl import ADULT, SMPL

ARCHIVE = SHARED / "data" / "bandai-namco-motiondataset-raw.tar.xz"
HAPPY = "dataset-1_walk_happy_001"


@pytest.fixture(scope="module")
def tiny(tmp_path_factory) -> Path:
    """A few takes in the layout of the original repository, with label files."""
    root = tmp_path_factory.mktemp("bandai") / "Bandai-Namco-Research-Motiondataset"
    for seed, (name, frames) in enumerate(TAKES.items()):
        folder = root / "dataset" / f"Bandai-Namco-Research-Motiondataset-{name[8]}" / "data"
        folder.mkdir(parents=True, exist_ok=True)
        bvh.write(synthetic_take(seed, frames), folder / f"{name}.bvh")
        (folder / f"{name}.json").write_text('{"content": 0, "style": 0}')
    return root


def clips(path: Path, **options) -> list[Clip]:
    return list(Bandai(str(path), **{"workers": 1, **options}).clips(20))


def same(one: list[Clip], other: list[Clip]) -> None:
    assert [clip.id for clip in one] == [clip.id for clip in other]
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a.motion, b.motion)
        assert {**vars(a), "motion": None} == {**vars(b), "motion": None}


def test_clips_of_a_folder(tiny, subtests):
    everything = clips(tiny)
    ids = [clip.id for clip in everything]
    originals = [clip for clip in everything if clip.id[0] != "M"]
    assert Bandai(str(tiny)).count() == len(set(ids)) == len(ids)
    assert [clip.id for clip in originals] == sorted(TAKES)
    for clip in originals:
        with subtests.test(clip=clip.id):
            frames = (TAKES[clip.id] - 1) * 20 // 30 + 1
            assert (clip.motion.shape, clip.motion.dtype, clip.source) == (
                (frames, 22, 3),
                np.float32,
                clip.id,
            )
            assert (f"M{clip.id}" in ids) == (clip.split == "train")
            assert Bandai.actions[clip.action or 0] == clip.attributes["content"]
            assert clip.attributes["dataset"] == int(clip.id[8])
            assert len(set(clip.captions)) == 4
    assert {clip.split for clip in originals} == {"train", "val", "test"}
    assert Bandai(str(tiny), mirror=False).count() == len(TAKES)
    same(clips(tiny, mirror=False), originals)


def test_bones_keep_their_length_and_joints_their_position(tiny, subtests):
    assert tuple(JOINTS) == SMPL22.joints
    by_id = {clip.id: clip.motion for clip in clips(tiny, mirror=False)}
    for seed, id_ in enumerate(TAKES):
        with subtests.test(clip=id_):
            motion, take = by_id[id_], synthetic_take(seed, TAKES[id_])
            lengths = np.linalg.norm(motion[:, 1:] - motion[:, SMPL22.parents[1:]], axis=2)
            np.testing.assert_allclose(lengths, np.tile(lengths[:1], (len(lengths), 1)), atol=1e-6)
            expected = (
                take.positions()[::3, [take.joints.index(name) for name in JOINTS.values()]] / 100
            )
            # The files have no spine1, which lies between pelvis and spine2.
            expected[:, 3] = 0.6 * expected[:, 0] + 0.4 * expected[:, 6]
            np.testing.assert_allclose(motion[::2][: len(expected)], expected, atol=1e-6)


def test_mirrored_copies(tiny, subtests):
    by_id = {clip.id: clip for clip in clips(tiny)}
    mirrored = [clip for clip in by_id.values() if clip.id[0] == "M"]
    assert mirrored
    swapped = {"left": "right", "right": "left"}
    for clip in mirrored:
        with subtests.test(clip=clip.id):
            original = by_id[clip.id[1:]]
            assert (clip.split, clip.source) == ("train", original.id)
            np.testing.assert_array_equal(
                SMPL22.mirror(torch.from_numpy(clip.motion)).numpy(), original.motion
            )
            side = str(original.attributes.get("side", ""))
            assert clip.attributes.get("side", "") == swapped.get(side, side)
            ours, theirs = (
                [c.replace(",", " ,").split() for c in some.captions] for some in (clip, original)
            )
            assert ours == [[swapped.get(word, word) for word in words] for words in theirs]
    wrong_side = (
        "dataset-2_walk-turn-right_masculine_006"  # this take turns to the other side than named
    )
    for name, content, side in (
        ("Mdataset-2_walk-turn-left_normal_001", "walk-turn-right", "right"),
        ("Mdataset-1_bye_giant_001", "bye", "left"),
        (wrong_side, "walk-turn-left", "left"),
    ):
        with subtests.test(name=name):
            clip = by_id[name]
            assert (clip.attributes["content"], clip.attributes["side"]) == (content, side)
            assert Bandai.actions[clip.action or 0] == content
            assert all(
                side in caption and swapped[side] not in caption for caption in clip.captions
            )
    assert by_id[wrong_side].split == "test"  # as the name says


def decoded(motion: np.ndarray, offsets=ADULT) -> np.ndarray:
    body = SMPL(offsets=offsets)
    return body.decode(body.encode(torch.from_numpy(motion))).numpy()


def resting_offsets() -> np.ndarray:
    """Bones (24, 3) of the files in meters, as they lie in the rest pose; spine1 is 40 % of the way to spine2."""
    take = synthetic_take(0, 1)
    offsets = np.zeros((24, 3))
    for joint, name in enumerate(JOINTS.values()):
        if name != "Hips":
            above = take.joints[take.parents[take.joints.index(name)]]
            offsets[joint] = bandai.REST[above] @ BONES[name] / 100
    lower, upper = SMPL22.joints.index("spine1"), SMPL22.joints.index("spine2")
    offsets[lower], offsets[upper] = 0.4 * offsets[upper], 0.6 * offsets[upper]
    return offsets


def test_smpl_rotations_show_the_joints(tiny, subtests):
    """Posed by SMPL's kinematics, the skeleton of the files has its joints where the files have them."""
    by_id = {clip.id: clip for clip in clips(tiny, motion="smpl")}
    for joints in clips(tiny):
        with subtests.test(clip=joints.id):
            rotations = by_id[joints.id]
            assert (rotations.motion.shape, rotations.motion.dtype) == (
                (len(joints.motion), 75),
                np.float32,
            )
            same([Clip(**{**vars(rotations), "motion": joints.motion})], [joints])
            np.testing.assert_allclose(
                decoded(rotations.motion, resting_offsets())[:, :22], joints.motion, atol=1e-5
            )
            assert not rotations.motion[:, -6:].any()
            if joints.id[0] == "M":
                mirrored = SMPL24.mirror(
                    torch.from_numpy(decoded(by_id[joints.id[1:]].motion))
                ).numpy()
                np.testing.assert_allclose(decoded(rotations.motion), mirrored, atol=1e-6)


def test_the_rest_pose_is_that_of_smpl(subtests):
    take = synthetic_take(0, 1)
    turned = [bandai.REST.get(name, np.eye(3)) for name in take.joints]
    local = np.stack(
        [turned[max(parent, 0)].T @ own for parent, own in zip(take.parents, turned, strict=True)]
    )
    motion = bandai.smpl_motion(take, local[None], take.offsets[None])
    np.testing.assert_allclose(motion[0, :3], [0, -0.03, 0.939], atol=1e-6)
    upright = Rotation.from_matrix(bandai.AXES).as_matrix()
    np.testing.assert_allclose(Rotation.from_rotvec(motion[0, 3:6]).as_matrix(), upright, atol=1e-6)
    np.testing.assert_allclose(motion[0, 6:], 0, atol=1e-6)
    offsets = np.stack([resting_offsets(), ADULT])
    bones, expected = offsets / np.maximum(np.linalg.norm(offsets, axis=2, keepdims=True), 1e-9)
    for joint, name in enumerate(SMPL24.joints):
        with subtests.test(joint=name):
            if name.endswith(("shoulder", "elbow", "wrist", "knee", "ankle")):
                assert bones[joint] @ expected[joint] > 1 - 1e-6, name
            if name.endswith("foot"):
                assert np.arctan2(*bones[joint, [0, 2]]) == pytest.approx(
                    np.arctan2(*expected[joint, [0, 2]]), abs=1e-3
                )
    at = dict(zip(SMPL24.joints, decoded(motion)[0] - decoded(motion)[0, 0], strict=True))
    assert at["left_wrist"][0] > 0.6 > -0.6 > at["right_wrist"][0]
    assert at["head"][1] > 0.5 > -0.8 > at["left_ankle"][1]


def published() -> list[tuple[int, str, str, int]]:
    """Data set, content, style and number of all takes whose BVH file was published."""
    counts = {
        (2, c, style): n
        for c, row in TAKES_2.items()
        for style, n in zip(STYLES_2, row, strict=True)
    }
    only_normal = {"call": 2, "punch": 2, "slash": 2, "kick": 1, "respond": 1, "dance-short": 1}
    counts |= {(1, content, "normal"): count for content, count in only_normal.items()}
    for content in set(CONTENTS_1) - set(only_normal) - {"dance-long"}:
        counts |= {(1, content, style): 2 if content == "walk" else 1 for style in STYLES_1}
    return [(*combination, k + 1) for combination, count in counts.items() for k in range(count)]


def test_split_of_the_published_takes(subtests):
    takes = published()
    assert Counter(take[0] for take in takes) == {1: 174, 2: 2902}
    splits = {take: split_of(*take) for take in takes}
    assert Counter(splits.values()) == {"train": 2379, "val": 325, "test": 372}
    for content, style in {take[1:3] for take in takes if take[0] == 2}:
        with subtests.test(content=content, style=style):
            of_combo = {split for take, split in splits.items() if take[:3] == (2, content, style)}
            overlapping = style == "normal" and content.startswith("walk-turn-")
            assert of_combo == ({"train"} if overlapping else {"train", "val", "test"})
    second = {take: split for take, split in splits.items() if take[0] == 2}
    # neighbors in blocks of five
    first = {take: (*take[:3], (take[3] - 1) // 5 * 5 + 1) for take in second}
    assert second == {take: second[first[take]] for take in second}


def test_compositional_split_holds_out_whole_combinations(subtests):
    takes = published()
    splits = {take: split_of(*take, "compositional") for take in takes}
    assert Counter(splits.values()) == {"train": 2324, "val": 279, "test": 473}

    seen = [take for take, split in splits.items() if split != "test"]
    held_out = [take for take, split in splits.items() if split == "test"]
    both = []
    for part in (seen, held_out):  # mirror images included
        named = {
            (name, style)
            for _, content, style, _ in part
            for name in (content, bandai.swap_sides(content))
        }
        both.append(
            {text for name, style in named for text in captions(name, style, side_of(name))}
        )
    assert not both[0] & both[1]
    for part in (1, 2):  # content, style: each is seen, in other combinations
        with subtests.test(part=part):
            assert {take[part] for take in held_out} <= {
                take[part] for take in splits if splits[take] == "train"
            }
    assert {style for dataset, _, style, _ in held_out if dataset == 2} == set(STYLES_2)
    # Other takes stay where they are, except test takes, which are used for training.
    assert all(
        splits[take] == {"test": "train"}.get(split_of(*take), split_of(*take)) for take in seen
    )
    assert splits[1, "walk", "old", 1] == splits[2, "walk", "elderly", 6] == "test"


def test_archives_give_the_same_clips_and_leave_no_files(tiny, tmp_path, monkeypatch, subtests):
    files = sorted(tiny.rglob("*"), reverse=True)  # another order than the clips have
    with zipfile.ZipFile(tmp_path / "set.zip", "w", zipfile.ZIP_DEFLATED) as archive:
        for file in files:
            archive.write(file, file.relative_to(tiny.parent))
        archive.writestr(f"__MACOSX/._{HAPPY}.bvh", b"\0")
    for kind in ("", "gz", "xz"):
        with tarfile.open(tmp_path / f"set.tar{kind and '.'}{kind}", f"w:{kind}") as archive:  # pyright: ignore
            for file in files:
                archive.add(file, f"./{file.relative_to(tiny.parent)}", recursive=False)
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    expected, count = clips(tiny), Bandai(str(tiny)).count()
    packed = sorted(tmp_path.glob("set.*"))
    for path in packed:
        with subtests.test(path=path.name):
            assert Bandai(str(path)).count() == count
            same(clips(path), expected)
    with tarfile.open(tmp_path / "set.evil", "w") as archive:
        archive.add(files[0], f"data/../../{HAPPY}.bvh")
    message = r"set\.evil: the file data/\.\./\.\./.* would be unpacked outside the folder"
    with pytest.raises(UserError, match=message):
        Bandai(str(tmp_path / "set.evil")).count()
    (tmp_path / "set.evil").unlink()
    assert not list(temporary.iterdir())
    assert sorted(tmp_path.iterdir()) == [*packed, temporary]


def test_wrong_input_is_explained(tiny, tmp_path, subtests):
    (tmp_path / "notes.txt").write_text("walk")
    for name in ("swim/dataset-1_swim_happy_001", f"twice/one/{HAPPY}", f"twice/two/{HAPPY}"):
        path = tmp_path / f"{name}.bvh"
        path.parent.mkdir(parents=True)
        path.touch()
    for path, exclude, message in (
        (
            tiny,
            ["dataset-1_walk_hapy_001"],
            "data.source.exclude: .* does not contain dataset-1_walk_hapy_001",
        ),
        (tmp_path / "notes.txt", [], "notes.txt: neither a folder nor a zip or tar archive"),
        (
            tmp_path / "swim",
            [],
            "dataset-1_swim_happy_001.bvh: .* no content swim with style happy",
        ),
        (tmp_path / "twice", [], f"{HAPPY} exists twice, as .*one/.* and .*two/"),
    ):
        with (
            subtests.test(path=path, exclude=exclude, message=message),
            pytest.raises(UserError, match=message),
        ):
            Bandai(str(path), exclude=exclude).count()


CASES = [key.split("/")[0] for key in third_party("hml263_bandai") if key.endswith("/joints_in")]


@pytest.fixture(scope="module")
def originals(tmp_path_factory) -> dict[str, Path]:
    """BVH files of the clips in the fixture, by the name of the case."""
    if not ARCHIVE.exists():
        pytest.skip(f"{ARCHIVE} is not redistributed and not there")
    cases = {f"dataset-{d}_{case.split('_', 1)[1]}": case for case in CASES for d in (1, 2)}
    files: dict[str, Path] = {}
    folder = tmp_path_factory.mktemp("originals")
    for name, data in archives.members(
        ARCHIVE, lambda name: name.endswith(".bvh") and Path(name).stem in cases
    ):
        file = files[cases[Path(name).stem]] = folder / Path(name).name
        file.write_bytes(data)
        if len(files) == len(CASES):
            break
    return files


@needs_third_party
@pytest.mark.golden
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"hml263_bandai-{case}")
def test_real_takes_against_the_joints_of_the_fixture(case, originals):
    expected = third_party("hml263_bandai")[f"{case}/joints_in"]
    motion = bandai.convert(originals[case], 20)
    # The fixture's clips were cut. It takes the rounded frame time for exact, which is 6e-6 s and 6e-5 m of a fast
    # joint at its last frame, and it interpolates linearly between frames, where a fast joint leaves the straight line.
    motion = motion[: len(expected)]
    np.testing.assert_allclose(motion[::2], expected[::2], atol=1e-4)
    np.testing.assert_allclose(motion, expected, atol=0.03)


@needs_third_party
@pytest.mark.golden
@pytest.mark.parametrize("case", CASES, ids=lambda case: f"hml263_bandai-{case}")
def test_limbs_of_real_takes_point_the_same_way_on_smpls_body(case, originals, subtests):
    """Bones of arms and legs keep their directions, elbows bend inwards and knees do not twist."""
    joints, motion = (bandai.convert(originals[case], 20, kind) for kind in ("joints", "smpl"))
    one, other = (x[:, 1:22] - x[:, SMPL22.parents[1:]] for x in (joints, decoded(motion)))
    cosines = (one * other).sum(-1) / np.linalg.norm(one, axis=-1) / np.linalg.norm(other, axis=-1)
    vectors = dict(zip(SMPL24.joints, motion[:, 3:].reshape(-1, 24, 3).swapaxes(0, 1), strict=True))
    for side, sign in (("left", -1), ("right", 1)):
        with subtests.test(side=side, sign=sign):
            for name in ("shoulder", "elbow", "wrist", "knee", "ankle"):
                assert cosines[:, SMPL22.joints.index(f"{side}_{name}") - 1].min() > 1 - 1e-5, (
                    side,
                    name,
                )
            elbow = vectors[f"{side}_elbow"]
            assert sign * elbow[:, 1].mean() > 0.8 * np.linalg.norm(elbow, axis=1).mean()
            assert np.abs(vectors[f"{side}_knee"][:, 1]).max() < 0.2  # the shin does not twist


@pytest.mark.parametrize("content", ["walk-left", "walk-right", "walk", "bye"])
def test_captions_name_the_other_side_where_the_head_turns(content: str):
    side = side_of(content)
    for text in captions(content, "old", side):
        words = text.replace(",", "").split()
        other = {"left": "right", "right": "left"}.get(side, "left")
        assert (other in words) == ("head turned to the" in text)
        if "head turned to the" in text:
            assert text.rstrip(".").endswith(f"head turned to the {other}")


@pytest.mark.parametrize("kind", ["w", "w:gz", "w:bz2", "w:xz", "zip", "zip after other bytes"])
def test_archives_of_all_kinds_are_unpacked_to_the_deepest_common_folder(tmp_path, kind: str):
    files = {
        "a/b/one.bvh": b"1",
        "a/b/c/two.bvh": b"22",
        "a/notes.txt": b"not wanted",
        "__MACOSX/a/b/._one.bvh": b"attributes",
    }
    if kind.startswith("w"):
        del files["__MACOSX/a/b/._one.bvh"]
    for name, content in files.items():
        path = tmp_path / "files" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    packed = tmp_path / "packed"
    if kind.startswith("w"):
        with tarfile.open(packed, kind) as archive:  # pyright: ignore[reportArgumentType, reportCallIssue]
            archive.add(tmp_path / "files", "")
    else:
        packed.write_bytes(b"#!/bin/sh\n" if "after" in kind else b"")
        with zipfile.ZipFile(packed, "a") as archive:
            for name in files:
                archive.write(tmp_path / "files" / name, name)
    owner = Counter[str]()
    folder = archives.as_folder(packed, owner, lambda name: name.endswith(".bvh"))
    unpacked = {path.relative_to(folder).as_posix() for path in folder.rglob("*.bvh")}
    assert unpacked == {"one.bvh", "c/two.bvh"}
    assert (folder / "c" / "two.bvh").read_bytes() == b"22"
    assert archives.as_folder(folder, owner, lambda name: False) == folder


@pytest.mark.parametrize(("size", "is_read"), [(6, True), (7, False)])
def test_members_of_archives_have_at_most_the_maximum_size(tmp_path, monkeypatch, size, is_read):
    monkeypatch.setattr(archives, "MEMBER_LIMIT", 6)
    (tmp_path / "a.bvh").write_bytes(b"x" * size)
    with (
        tarfile.open(tmp_path / "a.tar", "w") as tar,
        zipfile.ZipFile(tmp_path / "a.zip", "w") as z,
    ):
        tar.add(tmp_path / "a.bvh", "a.bvh")
        z.write(tmp_path / "a.bvh", "a.bvh")
    for name in ("a.tar", "a.zip"):
        if is_read:
            members = dict(archives.members(tmp_path / name, lambda name: True))
            assert members == {"a.bvh": b"x" * size}
        else:
            with pytest.raises(UserError, match="7 bytes, which is too large"):
                list(archives.members(tmp_path / name, lambda name: True))
