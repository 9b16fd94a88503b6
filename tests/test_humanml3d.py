"""HumanML3D: the published rules, processed folders, and the set made from AMASS."""

import math
import shutil
import tarfile
import zipfile
from functools import partial
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from support.fixtures import golden, golden_case, groups, load
from support.stores import (
    HUMANACT12,
    RECORDINGS,
    line,
    published,
    write_downloads,
    write_folder,
    written,
)

from flame_mdm.__main__ import main
from flame_mdm.data import amass, humanml3d, t2m
from flame_mdm.data.amass import Recording, key_of
from flame_mdm.data.crops import Units
from flame_mdm.data.humanml3d import HumanML3D, HumanML3DSMPL, IndexedClip
from flame_mdm.data.store import write_store
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import SMPL

# In the order of the fixture's numbers
FIXTURE_SUBSETS = (
    *sorted([*amass.SUBSETS][:18]),
    "humanact12",
)
SHORTEST = {"t2m": HumanML3D.shortest, "kit": 24}


def published_items(group):
    """The cuts of the fixture's files in the order of the published list: by length, else as they come."""
    rules = golden("rules")
    rows = rules[f"{group}/text_rows"]
    items = []
    for number, frames in enumerate(rules[f"{group}/file_len"]):
        mine = [
            t2m.Description(
                f"{number} {row}", [f"word{i}/NOUN" for i in range(int(tokens))], begin, end
            )
            for _, row, begin, end, tokens in np.nan_to_num(rows[rows[:, 0] == number])
        ]
        items += [
            (number, cut) for cut in t2m.cuts(str(number), int(frames), mine, SHORTEST[group])
        ]
    return sorted(items, key=lambda item: item[1].length)


class Scripted:
    """Draws what the fixture drew, and notes the upper bounds that it was called with."""

    def __init__(self, *draws):
        self.draws, self.bounds = list(draws), []

    def integers(self, bound):
        self.bounds.append(bound)
        return self.draws.pop(0)


@golden_case("rules")
def test_items_and_their_crops_and_words_are_the_published_ones(stem, subtests):
    rules = golden(stem)
    for group in groups(rules, "entries"):
        with subtests.test(group=group):
            items = published_items(group)
            entries = [
                (n, cut.start, cut.length, len(cut.descriptions), int(cut.id != str(n)))
                for n, cut in items
            ]
            np.testing.assert_array_equal(entries, rules[f"{group}/entries"])
            assert len({cut.id for _, cut in items}) == len(items) == rules[f"{group}/n_items"]
            crop = Units(SHORTEST[group], 196, 4)
            for (
                item,
                file,
                caption,
                double,
                bound,
                drawn,
                length,
                first,
                padded,
                spoken,
                kept,
                slots,
            ) in rules[f"{group}/items"]:
                number, cut = items[item]
                assert number == file
                generator = Scripted(0 if double else 1, drawn)
                frames = crop(cut.length, generator)  # type: ignore[arg-type]
                assert generator.bounds == [3, bound + 1]
                assert (len(frames), cut.start + frames[0], crop.longest()) == (
                    length,
                    first,
                    padded,
                )
                [description] = [
                    d for d in cut.descriptions if float(d.caption.split()[1]) == caption
                ]
                tokens, count = t2m.frame_tokens(description.tokens)
                assert (count, sum(t.startswith("word") for t in tokens), len(tokens)) == (
                    spoken,
                    kept,
                    slots,
                )
                assert (tokens[0], tokens[count - 1]) == ("sos/OTHER", "eos/OTHER")
                assert set(tokens[count:]) <= {"unk/OTHER"}


@golden_case("rules")
def test_clips_lose_the_published_frames_and_mirrored_joints_are_the_published_ones(stem, subtests):
    for subset, count, start, end, first, kept, sign in golden(stem)["crop_table"]:
        with subtests.test(subset=subset, start=start, end=end):
            name = FIXTURE_SUBSETS[subset]
            row = IndexedClip(
                "000000", "P01" if name == "humanact12" else f"{name}/a_poses", start, end
            )
            frames = range(int(count))[row.frames(int(count))]
            assert (frames[0], len(frames), frames.step) == (first, kept, 1)
            assert row.humanact12 == (sign == 1)
    cases = [
        key.removesuffix("in")
        for key in golden(stem)
        if key.startswith("crop_mirror") and key.endswith("in")
    ]
    for key in cases:
        with subtests.test(key=key):
            joints, mirrored = (
                torch.from_numpy(golden(stem)[key + end][:, :22]) for end in ("in", "out")
            )
            assert torch.equal(SMPL22.mirror(joints), mirrored)
    assert cases


@golden_case("smpl147")
def test_parameters_of_a_clip_make_flames_features(stem):
    poses, translation, expected = (
        golden(stem)[f"prep/{key}"] for key in ("poses156", "trans", "feats147")
    )
    recording = Recording(
        np.repeat(poses, 5, 0), np.repeat(translation, 5, 0), np.zeros(16), "female", 100.0
    )
    [motion] = humanml3d._parameters([IndexedClip("a", "CMU/a", 0, len(poses))], recording)
    np.testing.assert_allclose(SMPL().encode(torch.from_numpy(motion)), expected, atol=2e-6)


MOTIONS = {
    "000000": (
        120,
        [line("a person walks"), line("he waves his hand", 1.0, 3.5), line("he waves", 1.0, 3.5)],
    ),
    "000001": (60, [line("a man jumps", "nan", "nan"), line("he lands", 0.0, 1.0)]),
    "000002": (39, [line("too short")]),
    "000003": (200, [line("too long"), line("a part that would fit", 0.0, 4.0)]),
    "000004": (44, []),
    "000005": (44, [line("#3 is a caption with a hash")]),
    "000006": (80, [line("a part only", 0.5, 9.0)]),
    "000007": (80, [line("an unfit part only", 0.5, 1.0)]),
}
TRAIN = ["000000", "000002", "000003", "000004", "000006", "000007"]
LEGACY = HumanML("smpl22", "legacy")


@pytest.fixture
def folder(tmp_path):
    splits = {"train": TRAIN, "val": ["000001"], "test": ["000005"]}
    return write_folder(tmp_path / "HumanML3D", MOTIONS, splits, 263)


def test_a_processed_folder_becomes_a_store_and_says_what_was_left_out(folder, tmp_path):
    (folder / "texts" / "000099.txt").write_text(line("a caption without a clip"))
    source = HumanML3D(str(folder))
    store = write_store(tmp_path / "store", source, LEGACY)
    clips = {clip.id: clip for clip in store.clips}
    originals = ["000000@1-3.5", "000000@1-3.5#2", "000000", "000001", "000005", "000006@0.5-9"]
    assert set(clips) == {*originals, *(f"M{name}" for name in originals)}
    assert source.count() == len(clips)
    np.testing.assert_array_equal(store.motion(clips["000000@1-3.5"])[:, 0], np.arange(20, 70))
    np.testing.assert_array_equal(store.motion(clips["M000000"])[:, 5], -np.arange(120.0))
    np.testing.assert_array_equal(
        store.motion(clips["000006@0.5-9"])[:, 262], 6000 + np.arange(10, 80)
    )
    assert len(store.features) == 2 * (120 + 60 + 44 + 80), "cuts share the frames of their motion"
    captions = {
        "000000@1-3.5#2": "he waves",
        "000001": "a man jumps",
        "000005": "#3 is a caption with a hash",
    }
    assert {name: clips[name].captions for name in captions} == {
        name: [text] for name, text in captions.items()
    }
    assert clips["000001"].attributes == {"tokens": [["a/NOUN", "man/NOUN", "jumps/NOUN"]]}
    splits = {"000000": "train", "000001": "val", "000005": "test", "000006": "train"}
    assert {(clip.source, clip.split) for clip in store.clips} == {*splits.items()}
    np.testing.assert_allclose(store.mean, np.linspace(-1, 1, 263), rtol=1e-6)
    np.testing.assert_allclose(store.std, np.linspace(0.5, 2, 263), rtol=1e-6)

    assert store.info["excluded"] == {
        "texts without a motion (000099)": 1,
        "captions of parts that are too short or too long": 2,
        "names in train shorter than 40 frames": 2,
        "names in train with 200 frames or more": 2,
        "names in train without a caption": 2,
        "names in train whose captions all describe parts that are too short or too long": 2,
    }
    counts = {
        "motions": 8,
        "texts": 12,
        "vocabulary": 27,
        "words per caption": 3.5,
        "train": 12,
        "val": 2,
        "test": 2,
    }
    assert source.counts() == counts | {
        "train share, %": 75,
        "val share, %": 12.5,
        "test share, %": 12.5,
    }
    assert source.counts().keys() == published("humanml3d").keys()
    with pytest.raises(ValueError, match=r"humanml3d has 20 frames per second, not 12\.5"):
        next(iter(source.clips(12.5)))


def test_texts_may_stay_packed(folder):
    unpacked = [(c.id, c.captions) for c in HumanML3D(str(folder)).clips(20.0)]
    with zipfile.ZipFile(folder / "texts.zip", "w") as archive:
        for file in (folder / "texts").iterdir():
            archive.write(file, f"texts/{file.name}")
            archive.writestr(f"__MACOSX/texts/._{file.name}", b"\x00\xff")
    shutil.rmtree(folder / "texts")
    assert [(c.id, c.captions) for c in HumanML3D(str(folder)).clips(20.0)] == unpacked
    (folder / "texts.zip").unlink()
    with pytest.raises(
        FileNotFoundError,
        match=r"texts\.zip: not found; and there is no folder texts either; clone",
    ):
        HumanML3D(str(folder)).count()


def motion(folder, name="000001"):
    return folder / "new_joint_vecs" / f"{name}.npy"


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (
            lambda f: motion(f).unlink(),
            r"new_joint_vecs/\*\.npy lacks 1 of the names .* 000001\. .*exclude=\[000001\]",
        ),
        (
            lambda f: np.save(motion(f), np.full((60, 263), math.nan)),
            "clip 000001: .* frame 0 contain NaN or infinite values. Exclude",
        ),
        (lambda f: motion(f).write_bytes(motion(f).read_bytes()[:-999]), r"000001\.npy: damaged"),
        (
            lambda f: np.save(motion(f), np.zeros((3, 4, 5))),
            r"000001\.npy: expected .*, but found shape \(3, 4, 5\)",
        ),
        (lambda f: np.save(f / "Std.npy", np.zeros(263)), "a positive standard deviation"),
        (
            lambda f: (f / "test.txt").write_text("000000\n"),
            r"test\.txt: 000000 is also in train\.txt",
        ),
        (
            lambda f: (f / "texts/000001.txt").write_text("ok#a/DET#0#0\nno tags\n"),
            r"000001\.txt, line 2: not caption",
        ),
        (shutil.rmtree, r"HumanML3D: not found; clone"),
    ],
)
def test_a_damaged_folder_is_named(folder, tmp_path, damage, message):
    damage(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        write_store(tmp_path / "store", HumanML3D(str(folder)), LEGACY)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "store").exists()


def test_damaged_motions_can_be_excluded(folder, tmp_path):
    motion(folder, "000005").unlink()
    (folder / "texts" / "000005.txt").unlink()
    store = write_store(
        tmp_path / "store", HumanML3D(str(folder), exclude=["M000000", "000005"]), LEGACY
    )
    assert not {"M000000", "000005"} & {clip.id for clip in store.clips}
    assert store.info["excluded"]["motions by data.source.exclude"] == 2
    with pytest.raises(ValueError, match=r"data\.source\.exclude: .* does not contain 7"):
        HumanML3D(str(folder), exclude=["7"]).count()


def test_keys_do_not_depend_on_how_a_subset_is_called(subtests):
    key = "BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses"
    for path in (
        f"./pose_data/{key}.npy",
        f"BMLrub/{key}.npz",
        "some/BMLrub/rub001/0000 treadmill_norm_poses.npz",
    ):
        with subtests.test(path=path):
            assert key_of(path) == key
    assert key_of("./pose_data/Transitions_mocap/a/b_poses.npy") == key_of(
        "Transitionsmocap/a/b_poses.npz"
    )
    assert key_of("elsewhere/rub001/0000_poses.npz") is None
    plain = [
        amass._plain(name) for subset, others in amass.SUBSETS.items() for name in (subset, *others)
    ]
    assert len(set(plain)) == len(plain)


@pytest.fixture(scope="module")
def downloads(tmp_path_factory):
    return write_downloads(tmp_path_factory.mktemp("downloads"))


@pytest.fixture
def mine(downloads, tmp_path):
    """A copy of the downloads to make things in."""
    return shutil.copytree(downloads, tmp_path / "downloads")


BONES = [0.0, *np.linspace(0.1, 0.5, 21).tolist()]
Y_UP = np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])


def raw(root, **options):
    options = {"workers": 1, "bone_lengths": BONES, **options}
    folder = str(root / "HumanML3D" / "HumanML3D")
    return HumanML3D(folder, amass=str(root / "amass"), body_models=str(root / "bodies"), **options)


def slow_joints(root, recording):
    """Joints (F, 22, 3) of SMPL+H, one frame and joint after the other, y up."""
    model = load(root / "bodies" / "smplh" / str(recording["gender"]) / "model.npz")
    rest = model["J_regressor"] @ (
        model["v_template"] + model["shapedirs"][..., :10] @ recording["betas"][:10]
    )
    out = np.zeros((len(recording["poses"]), 52, 3))
    for frame, (pose, translation) in enumerate(
        zip(recording["poses"], recording["trans"], strict=True)
    ):
        turned = Rotation.from_rotvec(pose.reshape(52, 3)).as_matrix()
        out[frame, 0] = translation + rest[0]
        for joint, parent in enumerate(model["kintree_table"][0][1:], 1):
            out[frame, joint] = out[frame, parent] + turned[parent] @ (rest[joint] - rest[parent])
            turned[joint] = turned[parent] @ turned[joint]
    return out[:, :22] @ Y_UP


def expected_features(root):
    """The features of the index, computed apart from the pipeline."""
    kept = {
        "000000": (0, 5, 0, 50),
        "000001": (0, 5, 20, 72),
        "000003": (1, 6, 5, 60),
        "000004": (2, 2, 63, 120),
    }
    motions = {"000002": HUMANACT12[:, :22]}
    for name, (number, step, start, end) in (kept | {"000005": (3, 6, 1, 48)}).items():
        content = [*RECORDINGS.values()][number]
        motions[name] = slow_joints(
            root, content | {k: content[k][::step][start:end] for k in ("poses", "trans")}
        )
    encoder = HumanML("smpl22", "legacy", bone_lengths=BONES)
    motions = {name: torch.from_numpy(joints) for name, joints in motions.items()}
    motions |= {f"M{name}": SMPL22.mirror(joints) for name, joints in motions.items()}
    return {name: encoder.encode(joints).numpy() for name, joints in motions.items()}


def made(root):
    return {
        path.stem: np.load(path)
        for path in (root / "HumanML3D" / "HumanML3D" / "new_joint_vecs").iterdir()
    }


def test_the_set_is_made_from_amass_and_an_interrupted_run_is_taken_up(mine):
    source = raw(mine)
    assert source.check(20) == ["0 of 6 motions and their mirrored copies are created"]
    assert source.count() == 2 * 6
    expected, result = expected_features(mine), made(mine)
    assert result.keys() == expected.keys()
    for name, features in expected.items():
        np.testing.assert_allclose(result[name], features, atol=1e-5, err_msg=name)
    statistics = LEGACY.statistics(torch.from_numpy(np.concatenate(list(expected.values()))))
    for ours, theirs in zip(source.statistics(), statistics, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-5)

    folder = mine / "HumanML3D" / "HumanML3D" / "new_joint_vecs"
    (folder / "M000003.npy").unlink()
    np.save(folder / "000005.npy", np.zeros((44, 263), np.float32))
    again = raw(mine)
    assert again.check(20) == ["5 of 6 motions and their mirrored copies are created"]
    again.count()
    np.testing.assert_array_equal(made(mine)["M000003"], result["M000003"])
    assert not made(mine)["000005"].any(), "what is there is not made again"


def pack(root, subset, name, inner):
    """Puts an unpacked subset back into an archive."""
    with tarfile.open(root / "amass" / name, "w:bz2") as archive:
        archive.add(root / "amass" / subset, inner)
    shutil.rmtree(root / "amass" / subset)


@pytest.mark.slow
def test_archives_are_read_in_place_by_several_processes(downloads, mine, tmp_path):
    raw(mine).count()
    packed = shutil.copytree(downloads, tmp_path / "packed")
    pack(packed, "BMLrub", "BMLrub.tar.bz2", "BioMotionLab_NTroje")
    pack(packed, "KIT", "KIT.tar.bz2", "KIT")
    shutil.move(packed / "amass" / "CMU", packed / "amass" / "nested" / "CMU")
    raw(packed, workers=2).count()
    one, two = made(mine), made(packed)
    assert one.keys() == two.keys()
    for name, features in one.items():
        np.testing.assert_array_equal(features, two[name])
    stores = [
        write_store(tmp_path / f"{k}", smpl(root), SMPL())
        for k, root in enumerate((downloads, packed))
    ]
    assert stores[0].fingerprint == stores[1].fingerprint, (
        "order depends on how the subsets are packed"
    )


def truncate_archive(root):
    pack(root, "KIT", "KIT.tar.bz2", "KIT")
    path = root / "amass" / "KIT.tar.bz2"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def archive_without_recording(root):
    shutil.rmtree(root / "amass" / "BMLrub" / "rub001")
    pack(root, "BMLrub", "BMLrub.tar.bz2", "BioMotionLab_NTroje")


def set_in_file(root, **values):
    np.savez(
        root / "amass/CMU/80/80_63_poses.npz", **{**RECORDINGS["CMU/80/80_63_poses"], **values}
    )


def body_of_55_joints(root):
    path = root / "bodies/smplh/male/model.npz"
    np.savez(path, **load(path) | {"J_regressor": np.ones((55, 80))})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate_archive, r"KIT\.tar\.bz2: damaged archive, download it again: "),
        (
            archive_without_recording,
            r"BMLrub\.tar\.bz2: 1 recordings are missing from the archive, such as BioMotionLab",
        ),
        (
            lambda r: set_in_file(r, trans=np.full((360, 3), np.nan)),
            r"80_63_poses\.npz: contains non-finite numbers",
        ),
        (
            lambda r: set_in_file(r, mocap_framerate=np.array(15.0)),
            r"80_63_poses\.npz: recorded at 15 frames per",
        ),
        (
            lambda r: shutil.rmtree(r / "amass/BMLrub"),
            r"cannot be created. .* 1 of 1 recordings .* or BMLrub",
        ),
        (lambda r: shutil.rmtree(r / "amass"), r"amass: not found; register at https://amass"),
        (
            body_of_55_joints,
            r"male/model\.npz: not an SMPL\+H model with 52 joints: J_regressor has shape \(55, 80\)",
        ),
        (lambda r: (r / "HumanML3D/index.csv").unlink(), r"index\.csv: not found"),
        (
            lambda r: shutil.rmtree(r / "HumanML3D/pose_data"),
            r"1 clips of HumanAct12, such as P11G01R02",
        ),
    ],
)
def test_damaged_downloads_are_named(mine, damage, message):
    damage(mine)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        raw(mine).count()
    assert "\n" not in str(error.value)


def test_the_dry_run_lists_all_that_is_missing(mine, capsys):
    shutil.rmtree(mine / "amass" / "BMLrub")
    (mine / "amass" / "CMU" / "80" / "80_63_poses.npz").unlink()
    shutil.rmtree(mine / "bodies")
    words = [f"source={mine / 'HumanML3D/HumanML3D'}", f"data.source.amass={mine / 'amass'}"]
    assert (
        main(
            [
                "prepare",
                "data=humanml3d",
                "check=true",
                *words,
                f"data.source.body_models={mine / 'bodies'}",
            ]
        )
        == 0
    )
    missing = [
        line.split(": ")[1]
        for line in capsys.readouterr().out.splitlines()
        if line.startswith("missing: ")
    ]
    assert missing == ["BioMotionLab_NTroje", "CMU", f"{mine}/bodies"]
    assert not (mine / "HumanML3D" / "HumanML3D" / "new_joint_vecs").exists()


def smpl(root, **options):
    return HumanML3DSMPL(
        str(root / "HumanML3D" / "HumanML3D"), str(root / "amass"), workers=1, **options
    )


def test_each_caption_is_a_clip_of_smpl_parameters(mine, tmp_path, subtests):
    poses = np.random.default_rng(0).normal(0, 0.2, (45, 72))
    entry = {"poses": poses, "joints3D": HUMANACT12, "motion_length": 45}
    file = written(mine / "humanact12_processed.pkl", {"P11G01R02F1812T1847A0402.npy": entry})
    source = smpl(mine, humanact12=str(file))
    store = write_store(tmp_path / "store", source, SMPL())
    clips = {clip.id: clip for clip in store.clips}
    assert source.count() == len(clips) == 2 * 6
    assert [clips[f"000000#{k}"].captions for k in (0, 1)] == [
        ["a person moves."],
        ["someone moves."],
    ]
    assert (clips["000000#1"].length, clips["000000#1"].start) == (50, clips["000000#0"].start), (
        "frames are shared"
    )
    content = RECORDINGS["Eyes_Japan_Dataset/hamada/pose-06 hangon_poses"]
    recorded = np.concatenate([content["trans"], content["poses"]], 1)[::2][63:120]
    for name, parameters in (
        ("000004#0", recorded),
        ("000002#1", np.concatenate([HUMANACT12[:, 0], poses], 1)),
    ):
        with subtests.test(name=name):
            expected = SMPL().encode(torch.from_numpy(parameters)).numpy()
            np.testing.assert_allclose(store.motion(clips[name]), expected, atol=1e-6)
    assert store.info["excluded"] == {}
    assert {c.split for c in store.clips if c.source == "000004"} == {"val"}


def test_splits_and_motions_left_out_of_the_smpl_form(mine, tmp_path):
    info = write_store(tmp_path / "final", smpl(mine, published_split=True), SMPL()).info
    assert (info["clips"], info["published_split"]) == ({"train": 8, "val": 0, "test": 2}, True)
    left_out = {"motions of HumanAct12, as data.source.humanact12 is not given": 1}
    assert info["excluded"] == left_out
    index = mine / "HumanML3D" / "index.csv"
    index.write_text(
        "".join(row for row in index.read_text().splitlines(True) if "000003" not in row)
    )
    store = write_store(tmp_path / "store", smpl(mine, exclude=["000001", "M000004"]), SMPL())
    assert {clip.source for clip in store.clips} == {"000000", "000004", "000005"}
    left_out |= {"motions by data.source.exclude": 1, "motions that index.csv lacks": 1}
    assert store.info["excluded"] == left_out
    (mine / "HumanML3D" / "HumanML3D" / "texts" / "000000.txt").unlink()
    with pytest.raises(FileNotFoundError, match="1 clips have no text, such as 000000"):
        smpl(mine).count()


@pytest.mark.parametrize(
    ("rate", "step"), [(20, 1), (39.9, 1), (59.94, 2), (60, 3), (120, 6), (100, 5), (250, 12)]
)
def test_the_step_between_frames_is_rounded_down(rate, step):
    poses, path = np.arange(50)[:, None] * np.ones(156), np.arange(50)[:, None] * np.ones(3)
    recording = Recording(poses, path, np.zeros(16), "male", rate).every(20)
    assert recording.translation[:, 0].tolist() == list(range(0, 50, step))
    np.testing.assert_array_equal(recording.poses[:, 155], recording.translation[:, 2])


def test_a_recording_with_too_few_frames_per_second_is_refused():
    recording = Recording(np.zeros((9, 156)), np.zeros((9, 3)), np.zeros(16), "male", 19.9)
    with pytest.raises(UserError, match=r"19\.9 frames per second, but at least 20 are required"):
        recording.every(20)


@pytest.mark.parametrize(("frames", "kept"), [(39, 0), (40, 1), (199, 1), (200, 0)])
def test_motions_of_40_to_199_frames_are_kept(frames, kept):
    whole = t2m.Description("a", [])
    assert len(t2m.cuts("x", frames, [whole], 40)) == kept


@pytest.mark.parametrize(
    ("begin", "end", "cut"),
    [
        (0.29, 2.29, (5, 40)),
        (0.3, 2.29, None),
        (1.0, 99.0, (20, 130)),
        (0.0, 2.0, (0, 40)),
        (0.0, 1.99, None),
    ],
)
def test_times_of_parts_are_rounded_down_and_end_with_the_motion(begin, end, cut):
    part = t2m.Description("a", [], begin, end)
    items = t2m.cuts("x", 150, [part], 40)
    assert [(item.start, item.length) for item in items] == ([] if cut is None else [cut])
    assert all(item.id == f"x@{begin:g}-{end:g}" for item in items)


@pytest.mark.parametrize(
    ("gender", "body"),
    [("male", "male"), ("female", "female"), ("neutral", "female"), ("unknown", "female")],
)
def test_recordings_of_neither_gender_show_the_female_body(gender, body):
    bodies: Any = {
        name: SimpleNamespace(joints=lambda recording, name=name: (name, recording.translation))
        for name in ("male", "female")
    }
    path = np.arange(180)[:, None] * np.ones(3)
    recording = Recording(np.zeros((180, 156)), path, np.zeros(16), gender, 60.0)
    rows = [IndexedClip("a", "CMU/x", 0, 10), IndexedClip("b", "CMU/x", 5, 30)]
    written = {}

    def write(row, joints):
        written[row.name] = joints

    assert humanml3d._from_amass(partial(write), bodies, rows, recording) == 2
    assert {name: shown for name, (shown, _) in written.items()} == {"a": body, "b": body}
    assert written["a"][1][:, 0].tolist() == list(range(0, 30, 3))
    assert written["b"][1][:, 0].tolist() == list(range(15, 90, 3))


def test_captions_of_the_smpl_form_end_with_one_point():
    source = HumanML3DSMPL("a", "b")
    texts = [t2m.Description(text, []) for text in ("walks.", "sits")]
    source.folder = cast(HumanML3D, SimpleNamespace(names={"x": "val"}, texts={"x": texts}))
    row, motion = IndexedClip("x", "CMU/x", 0, 5), np.zeros((5, 75))
    clips = list(source._clips(row, motion))
    assert [(clip.id, clip.captions) for clip in clips] == [("x#0", ["walks."]), ("x#1", ["sits."])]
    assert {(clip.split, clip.source) for clip in clips} == {("val", "x")}
    assert not list(source._clips(row, motion[:0]))
    assert source.excluded == {"motions without a frame": 1}


def test_words_are_kept_if_every_description_of_a_part_has_them():
    tagged, bare = t2m.Description("sits", ["sit/VERB"]), t2m.Description("walks", [])
    motion = np.zeros((9, 3))
    clips = [
        t2m.Cut("x", 2, 5, list(descriptions)).clip(motion, "val", "take", recording="r")
        for descriptions in ((tagged, tagged), (tagged, bare), (bare, bare))
    ]
    assert [clip.attributes for clip in clips] == [
        {"recording": "r", "tokens": [["sit/VERB"]] * 2},
        {"recording": "r"},
        {"recording": "r"},
    ]
    assert clips[1].captions == ["sits", "walks"]
    assert {(clip.window, clip.source, clip.split) for clip in clips} == {((2, 5), "take", "val")}
