import math
import pickle
import shutil
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import golden, groups
from support.stores import line, published, write_folder

from flame_mdm.commands.prepare import main as prepare
from flame_mdm.data import amass, humanml3d, t2m
from flame_mdm.data.amass import Amass, Recording, key_of, load_bodies
from flame_mdm.data.crops import Units
from flame_mdm.data.humanml3d import HumanML3D, HumanML3DSMPL, Row
from flame_mdm.data.store import write_store
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import SMPL

# The order of the subsets' numbers in the fixture.
FIXTURE_SUBSETS = (
    *("ACCAD", "BMLhandball", "BMLmovi", "BioMotionLab_NTroje", "CMU", "DFaust_67", "EKUT", "Eyes_Japan_Dataset"),
    *("HumanEva", "KIT", "MPI_HDM05", "MPI_Limits", "MPI_mosh", "SFU", "SSM_synced", "TCD_handMocap", "TotalCapture"),
    *("Transitions_mocap", "humanact12"),
)
SHORTEST = {"t2m": HumanML3D.shortest, "kit": 24}


# The published rules --------------------------------------------------------------------------------------------------


def published_items(group):
    """The cuts of the fixture's files in the order of the published list: by length, else as found."""
    rules = golden("rules")
    rows = rules[f"{group}/text_rows"]
    found = []
    for number, frames in enumerate(rules[f"{group}/file_len"]):
        mine = [
            t2m.Description(f"{number} {row}", [f"word{i}/NOUN" for i in range(int(tokens))], begin, end)
            for _, row, begin, end, tokens in np.nan_to_num(rows[rows[:, 0] == number])
        ]
        found += [(number, cut) for cut in t2m.cuts(str(number), int(frames), mine, SHORTEST[group])]
    return sorted(found, key=lambda item: item[1].length)


RULES = [pytest.param(group, id=f"rules-{group}") for group in groups(golden("rules"), "entries")]


@pytest.mark.golden
@pytest.mark.parametrize("group", RULES)
def test_items_are_the_published_ones_in_the_published_order(group):
    ours = [
        (number, cut.start, cut.length, len(cut.descriptions), int(cut.id != str(number)))
        for number, cut in published_items(group)
    ]
    np.testing.assert_array_equal(ours, golden("rules")[f"{group}/entries"])
    assert len(ours) == golden("rules")[f"{group}/n_items"]
    assert len({cut.id for _, cut in published_items(group)}) == len(ours)


class Scripted:
    """Draws what the fixture drew, and notes the upper bounds it was asked for."""

    def __init__(self, *draws):
        self.draws, self.bounds = list(draws), []

    def integers(self, bound):
        self.bounds.append(bound)
        return self.draws.pop(0)


@pytest.mark.golden
@pytest.mark.parametrize("group", RULES)
def test_samples_are_cropped_and_worded_as_published(group):
    items = published_items(group)
    crop = Units(SHORTEST[group], 196, 4)
    for item, file, caption, double, bound, drawn, length, first, padded, said, kept, slots in golden("rules")[
        f"{group}/items"
    ]:
        number, cut = items[item]
        assert number == file
        generator = Scripted(0 if double else 1, drawn)
        frames = crop(cut.length, generator)  # type: ignore[arg-type]
        assert generator.bounds == [3, bound + 1]
        assert (len(frames), cut.start + frames[0], crop.longest()) == (length, first, padded)
        [description] = [d for d in cut.descriptions if float(d.caption.split()[1]) == caption]
        tokens, count = t2m.frame_tokens(description.tokens)
        assert (count, sum(t.startswith("word") for t in tokens), len(tokens)) == (said, kept, slots)
        assert tokens[0] == "sos/OTHER"
        assert tokens[count - 1] == "eos/OTHER"
        assert set(tokens[count:]) <= {"unk/OTHER"}


@pytest.mark.golden
@pytest.mark.parametrize("stem", [pytest.param("rules", id="rules-crop_table")])
def test_clips_lose_the_published_frames_of_their_recordings(stem):
    for subset, count, start, end, first, kept, sign in golden(stem)["crop_table"]:
        name = FIXTURE_SUBSETS[subset]
        row = Row("000000", "P01" if name == "humanact12" else f"{name}/a_poses", start, end)
        frames = row.frames(count)
        assert (frames[0], len(frames), frames.step) == (first, kept, 1)
        assert row.humanact12 == (sign == 1)


@pytest.mark.golden
@pytest.mark.parametrize(
    "key",
    [pytest.param(k, id=f"rules-{k}") for k in golden("rules") if k.startswith("crop_mirror") and k.endswith("in")],
)
def test_mirrored_joints_are_the_published_ones(key):
    given, expected = (torch.from_numpy(golden("rules")[k][:, :22]) for k in (key, key.removesuffix("in") + "out"))
    assert torch.equal(SMPL22.mirror(given), expected)


@pytest.mark.golden
@pytest.mark.parametrize("stem", [pytest.param("smpl147", id="smpl147-prep")])
def test_parameters_of_a_clip_make_flames_features(stem):
    poses, translation, expected = (golden(stem)[f"prep/{key}"] for key in ("poses156", "trans", "feats147"))
    recording = Recording(np.repeat(poses, 5, 0), np.repeat(translation, 5, 0), np.zeros(16), "female", 100.0)
    [motion] = humanml3d._parameters([Row("a", "CMU/a", 0, len(poses))], recording)
    np.testing.assert_allclose(SMPL().encode(torch.from_numpy(motion)), expected, atol=2e-6)


# A processed folder ---------------------------------------------------------------------------------------------------

MOTIONS = {
    "000000": (120, [line("a person walks"), line("he waves his hand", 1.0, 3.5), line("he waves", 1.0, 3.5)]),
    "000001": (60, [line("a man jumps", "nan", "nan"), line("he lands", 0.0, 1.0)]),
    "000002": (39, [line("too short")]),
    "000003": (200, [line("too long"), line("a part that would fit", 0.0, 4.0)]),
    "000004": (44, []),
    "000005": (44, [line("#3 is a caption with a hash")]),
    "000006": (80, [line("a part only", 0.5, 9.0)]),
    "000007": (80, [line("an unfit part only", 0.5, 1.0)]),
}
SPLITS = {
    "train": ["000000", "000002", "000003", "000004", "000006", "000007"],
    "val": ["000001"],
    "test": ["000005"],
}


@pytest.fixture
def folder(tmp_path):
    return write_folder(tmp_path / "HumanML3D", MOTIONS, SPLITS, 263)


def legacy():
    return HumanML("smpl22", "legacy")


def test_a_processed_folder_becomes_a_store(folder, tmp_path):
    source = HumanML3D(str(folder))
    store = write_store(tmp_path / "store", source, legacy())
    clips = {clip.id: clip for clip in store.clips}
    originals = ["000000@1-3.5", "000000@1-3.5#2", "000000", "000001", "000005", "000006@0.5-9"]
    assert set(clips) == {*originals, *(f"M{name}" for name in originals)}
    assert source.count() == len(clips)
    np.testing.assert_array_equal(store.motion(clips["000000@1-3.5"])[:, 0], np.arange(20, 70))
    np.testing.assert_array_equal(store.motion(clips["M000000"])[:, 5], -np.arange(120.0))
    np.testing.assert_array_equal(store.motion(clips["000006@0.5-9"])[:, 262], 6000 + np.arange(10, 80))
    assert len(store.features) == 2 * (120 + 60 + 44 + 80), "cuts share the frames of their motion"
    assert clips["000000@1-3.5#2"].captions == ["he waves"]
    assert clips["000001"].captions == ["a man jumps"]
    assert clips["000005"].captions == ["#3 is a caption with a hash"]
    assert clips["000001"].attributes == {"tokens": [["a/NOUN", "man/NOUN", "jumps/NOUN"]]}
    assert {c.source for c in store.clips} == {"000000", "000001", "000005", "000006"}
    assert {c.split for c in store.clips if c.source == "000001"} == {"val"}
    np.testing.assert_allclose(store.mean, np.linspace(-1, 1, 263), rtol=1e-6)
    np.testing.assert_allclose(store.std, np.linspace(0.5, 2, 263), rtol=1e-6)


def test_what_was_left_out_is_counted_and_counts_agree_with_the_folder(folder, tmp_path):
    (folder / "texts" / "000099.txt").write_text(line("a caption without a clip"))
    source = HumanML3D(str(folder))
    store = write_store(tmp_path / "store", source, legacy())
    assert store.info["excluded"] == {
        "texts without a motion (000099)": 1,
        "captions of parts that are too short or too long": 2,
        "names of train shorter than 40 frames": 2,
        "names of train of 200 frames or more": 2,
        "names of train without a caption": 2,
        "names of train with captions of unfit parts only": 2,
    }
    counts = {"motions": 8, "texts": 12, "train": 12, "val": 2, "test": 2}
    counts |= {"train share, %": 75, "val share, %": 12.5, "test share, %": 12.5}
    assert source.counts() == counts | {"vocabulary": 27, "words per caption": 3.5}
    assert source.counts().keys() == published("humanml3d").keys()


def test_texts_may_stay_packed(folder, tmp_path):
    wanted = list(HumanML3D(str(folder)).clips(20.0))
    with zipfile.ZipFile(folder / "texts.zip", "w") as archive:
        for file in (folder / "texts").iterdir():
            archive.write(file, f"texts/{file.name}")
            archive.writestr(f"__MACOSX/texts/._{file.name}", b"\x00\xff")
    shutil.rmtree(folder / "texts")
    packed = list(HumanML3D(str(folder)).clips(20.0))
    assert [(c.id, c.captions) for c in packed] == [(c.id, c.captions) for c in wanted]
    (folder / "texts.zip").write_bytes((folder / "texts.zip").read_bytes()[:-30])
    with pytest.raises(ValueError, match=r"texts\.zip: damaged archive"):
        HumanML3D(str(folder)).count()


def motion(folder, name="000001"):
    return folder / "new_joint_vecs" / f"{name}.npy"


def set_nan(folder):
    for name in ("000001", "M000000"):
        values = np.load(motion(folder, name))
        values[7, 5] = math.nan
        np.save(motion(folder, name), values)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: motion(f).unlink(), r"new_joint_vecs/\*\.npy lacks 1 of the names .* 000001; .*exclude=\[000001\]"),
        (set_nan, r"2 motions contain non-finite numbers: 000001, M000000; .*exclude=\["),
        (lambda f: motion(f).write_bytes(motion(f).read_bytes()[:-999]), r"000001\.npy: damaged"),
        (lambda f: np.save(motion(f), np.zeros((3, 4, 5))), r"000001\.npy: shape \(3, 4, 5\)"),
        (lambda f: (f / "Mean.npy").unlink(), r"Mean\.npy: not found; clone"),
        (lambda f: np.save(f / "Std.npy", np.zeros(263)), "is not a mean or positive std"),
        (lambda f: (f / "test.txt").write_text("000000\n"), r"test\.txt: 000000 is also in train\.txt"),
        (lambda f: (f / "texts/000001.txt").write_text("ok#a/DET#0#0\nno tags\n"), r"000001\.txt, line 2: not caption"),
        (shutil.rmtree, r"HumanML3D: not found; clone"),
    ],
)
def test_a_damaged_folder_is_named(folder, tmp_path, damage, message):
    damage(folder)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        write_store(tmp_path / "store", HumanML3D(str(folder)), legacy())
    assert "\n" not in str(error.value)
    assert not (tmp_path / "store").exists()


def test_damaged_motions_can_be_excluded(folder, tmp_path):
    set_nan(folder)
    motion(folder, "000005").unlink()
    (folder / "texts" / "000005.txt").unlink()
    source = HumanML3D(str(folder), exclude=["000001", "M000000", "000005"])
    store = write_store(tmp_path / "store", source, legacy())
    assert not {"000001", "M000000", "000005"} & {clip.id for clip in store.clips}
    assert store.info["excluded"]["names by data.source.exclude"] == 3
    with pytest.raises(ValueError, match=r"data\.source\.exclude: .* has no 7"):
        HumanML3D(str(folder), exclude=["7"]).count()


def test_another_frame_rate_is_refused(folder):
    with pytest.raises(ValueError, match=r"humanml3d has 20 frames per second, but representation\.fps is 12\.5"):
        next(iter(HumanML3D(str(folder)).clips(12.5)))


# From AMASS -----------------------------------------------------------------------------------------------------------


def test_keys_do_not_depend_on_how_a_subset_is_called():
    key = "BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses"
    for path in (
        "./pose_data/BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses.npy",
        "BMLrub/rub001/0000_treadmill_norm_poses.npz",
        "BMLrub/BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses.npz",
        "somewhere/BMLrub/rub001/0000 treadmill_norm_poses.npz",
    ):
        assert key_of(path) == key
    assert key_of("./pose_data/Transitions_mocap/a/b_poses.npy") == key_of("Transitionsmocap/a/b_poses.npz")
    assert key_of("elsewhere/rub001/0000_poses.npz") is None
    plain = [amass._plain(name) for subset, others in amass.SUBSETS.items() for name in (subset, *others)]
    assert len(set(plain)) == len(plain)


def parameters(seed, frames, fps, gender="male"):
    """A file of AMASS as its SMPL+H G release has them: somebody wanders and bends every joint."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None] / fps
    waves = np.sin(2 * np.pi * (rng.uniform(0.2, 0.6, 156) * time + rng.random(156)))
    walk = np.stack([0.5 * time[:, 0], 0.1 * np.sin(time[:, 0]), 0.9 + 0 * time[:, 0]], 1)
    return {
        "poses": 0.3 * waves + np.eye(1, 156, 0) * np.pi / 2,
        "trans": walk,
        "betas": rng.normal(size=16),
        "dmpls": np.zeros((frames, 8)),
        "gender": np.array(gender),
        "mocap_framerate": np.array(fps),
    }


FILES = {
    "KIT/3/kick_high_left02_poses": parameters(0, 360, 100.0),
    "BMLrub/rub001/0000_treadmill_norm_poses": parameters(1, 400, 120.0, "female"),
    "Eyes_Japan_Dataset/hamada/pose-06 hangon_poses": parameters(2, 360, 59.94),
    "CMU/80/80_63_poses": parameters(3, 360, 120.0),
}
INDEX = """source_path,start_frame,end_frame,new_name
./pose_data/KIT/3/kick_high_left02_poses.npy,0,50,000000.npy
./pose_data/KIT/3/kick_high_left02_poses.npy,20,72,000001.npy
./pose_data/humanact12/humanact12/P11G01R02F1812T1847A0402.npy,0,-1,000002.npy
./pose_data/BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses.npy,5,60,000003.npy
./pose_data/Eyes_Japan_Dataset/hamada/pose-06 hangon_poses.npy,3,60,000004.npy
./pose_data/CMU/80/80_63_poses.npy,1,48,000005.npy
"""
RAW_SPLITS = {"train": ["000000", "000001", "000002", "000003"], "val": ["000004"], "test": ["000005"]}
HUMANACT12 = np.cumsum(np.random.default_rng(5).normal(0, 0.01, (45, 24, 3)), 0) + np.random.default_rng(6).normal(
    0, 0.5, (1, 24, 3)
)


def write_body(path, seed):
    """A model file with the keys of the extended SMPL+H model and few vertices."""
    rng = np.random.default_rng(seed)
    parents = [*SMPL22.parents, *(20 if finger < 15 else 21 for finger in range(30))]
    path.parent.mkdir(parents=True)
    regressor = rng.random((52, 80))
    np.savez(
        path,
        J_regressor=regressor / regressor.sum(1, keepdims=True),
        v_template=rng.normal(size=(80, 3)),
        shapedirs=rng.normal(0, 0.02, (80, 3, 16)),
        kintree_table=np.array([[2**32 - 1, *parents[1:]], range(52)]),
    )


@pytest.fixture(scope="module")
def downloads(tmp_path_factory):
    """What a user has before anything is made."""
    root = tmp_path_factory.mktemp("downloads")
    for name, content in FILES.items():
        path = root / "amass" / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **content)
    np.savez(root / "amass" / "KIT" / "3" / "shape.npz", betas=np.zeros(16))
    for seed, gender in enumerate(("male", "female")):
        write_body(root / "bodies" / "smplh" / gender / "model.npz", seed)
    motions = {f"{n:06d}": (1, [line("a person moves"), line("someone moves", 0.5, 1)]) for n in range(6)}
    folder = write_folder(root / "HumanML3D" / "HumanML3D", motions, RAW_SPLITS, 263)
    shutil.rmtree(folder / "new_joint_vecs")
    for name in ("Mean", "Std"):
        (folder / f"{name}.npy").unlink()
    (folder.parent / "index.csv").write_text(INDEX)
    with (
        zipfile.ZipFile(root / "humanact12.zip", "w") as archive,
        archive.open("humanact12/P11G01R02F1812T1847A0402.npy", "w") as file,
    ):
        np.save(file, HUMANACT12)
    (folder.parent / "pose_data").mkdir()
    shutil.move(root / "humanact12.zip", folder.parent / "pose_data" / "humanact12.zip")
    return root


@pytest.fixture
def mine(downloads, tmp_path):
    """A copy of the downloads to make things in."""
    return shutil.copytree(downloads, tmp_path / "downloads")


BONES = [0.0, *np.linspace(0.1, 0.5, 21).tolist()]


def raw(root, **options):
    options = {"workers": 1, "bone_lengths": BONES, **options}
    folder = str(root / "HumanML3D" / "HumanML3D")
    return HumanML3D(folder, amass=str(root / "amass"), body_models=str(root / "bodies"), **options)


def slow_joints(model_path, recording):
    """Joints (F, 22, 3) of SMPL+H, one frame and joint after the other, z up."""
    with np.load(model_path) as file:
        model = dict(file)
    rest = model["J_regressor"] @ (model["v_template"] + model["shapedirs"][..., :10] @ recording["betas"][:10])
    out = np.zeros((len(recording["poses"]), 52, 3))
    for frame, (pose, translation) in enumerate(zip(recording["poses"], recording["trans"], strict=True)):
        turned = {}
        for joint, parent in enumerate(model["kintree_table"][0]):
            angle = np.linalg.norm(pose[3 * joint : 3 * joint + 3])
            x, y, z = pose[3 * joint : 3 * joint + 3] / angle
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            own = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
            if joint == 0:
                out[frame, 0], turned[0] = translation + rest[0], own
            else:
                out[frame, joint] = out[frame, parent] + turned[parent] @ (rest[joint] - rest[parent])
                turned[joint] = turned[parent] @ own
    return out[:, :22]


@pytest.mark.parametrize("gender", ["male", "female"])
def test_joints_are_smpls(downloads, gender):
    content = parameters(7, 12, 20.0)
    recording = Recording(content["poses"], content["trans"], content["betas"], gender, 20.0)
    joints = load_bodies(downloads / "bodies")[gender].joints(recording)
    expected = slow_joints(downloads / "bodies" / "smplh" / gender / "model.npz", content)
    np.testing.assert_allclose(joints, np.stack([-expected[..., 0], expected[..., 2], expected[..., 1]], -1), atol=1e-9)


def expected_features(root):
    """The features of the index, computed apart from the pipeline."""
    kept = {"000000": (0, 5, 0, 50), "000001": (0, 5, 20, 72), "000003": (1, 6, 5, 60), "000004": (2, 2, 63, 120)}
    features = {}
    for name, (number, step, start, end) in (kept | {"000005": (3, 6, 1, 48)}).items():
        content = dict(list(FILES.values())[number])
        for key in ("poses", "trans"):
            content[key] = content[key][::step][start:end]
        path = root / "bodies" / "smplh" / str(content["gender"]) / "model.npz"
        joints = slow_joints(path, content) @ np.array([[-1.0, 0, 0], [0, 0, 1], [0, 1, 0]])
        features[name] = joints
    features["000002"] = HUMANACT12[:, :22]
    encoder = HumanML("smpl22", "legacy", bone_lengths=BONES)
    for name, joints in list(features.items()):
        features[name] = encoder.encode(torch.from_numpy(joints)).numpy()
        features[f"M{name}"] = encoder.encode(SMPL22.mirror(torch.from_numpy(joints))).numpy()
    return features


def made(root):
    return {path.stem: np.load(path) for path in (root / "HumanML3D" / "HumanML3D" / "new_joint_vecs").iterdir()}


def test_the_set_is_made_from_amass_and_an_interrupted_run_is_taken_up(mine):
    source = raw(mine)
    assert source.check() == ["0 of 6 motions and their mirrored copies are created"]
    assert source.count() == 2 * 6
    expected = expected_features(mine)
    result = made(mine)
    assert result.keys() == expected.keys()
    for name, features in expected.items():
        np.testing.assert_allclose(result[name], features, atol=1e-5, err_msg=name)
    mean, std = HumanML("smpl22", "legacy").statistics(torch.from_numpy(np.concatenate(list(expected.values()))))
    for ours, wanted in zip(source.statistics(), (mean, std), strict=True):
        np.testing.assert_allclose(ours, wanted, atol=1e-5)

    folder = mine / "HumanML3D" / "HumanML3D" / "new_joint_vecs"
    (folder / "M000003.npy").unlink()
    kept = np.zeros((44, 263), np.float32)
    np.save(folder / "000005.npy", kept)
    again = raw(mine)
    assert again.check() == ["5 of 6 motions and their mirrored copies are created"]
    again.count()
    np.testing.assert_array_equal(made(mine)["M000003"], result["M000003"])
    np.testing.assert_array_equal(made(mine)["000005"], kept, err_msg="what is there is not made again")


def pack(root, subset, name, inner):
    """Puts an unpacked subset back into an archive."""
    with tarfile.open(root / "amass" / name, "w:bz2") as archive:
        archive.add(root / "amass" / subset, inner)
    shutil.rmtree(root / "amass" / subset)


@pytest.mark.slow
def test_archives_are_read_in_place_by_several_processes(downloads, mine):
    raw(mine).count()
    packed = shutil.copytree(downloads, mine.parent / "packed")
    pack(packed, "BMLrub", "BMLrub.tar.bz2", "BioMotionLab_NTroje")
    pack(packed, "KIT", "KIT.tar.bz2", "KIT")
    shutil.move(packed / "amass" / "CMU", packed / "amass" / "nested" / "CMU")
    raw(packed, workers=2).count()
    one, two = made(mine), made(packed)
    assert one.keys() == two.keys()
    for name, features in one.items():
        np.testing.assert_array_equal(features, two[name])


def truncate(path: Path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def truncate_archive(root):
    pack(root, "KIT", "KIT.tar.bz2", "KIT")
    truncate(root / "amass" / "KIT.tar.bz2")


def archive_without_recording(root):
    (root / "amass" / "BMLrub" / "rub001" / "0000_treadmill_norm_poses.npz").rename(root / "amass" / "BMLrub" / "o.npz")
    pack(root, "BMLrub", "BMLrub.tar.bz2", "BioMotionLab_NTroje")


def set_in_file(root, **values):
    np.savez(root / "amass" / "CMU" / "80" / "80_63_poses.npz", **{**FILES["CMU/80/80_63_poses"], **values})


def body_of_55_joints(root):
    path = root / "bodies" / "smplh" / "male" / "model.npz"
    with np.load(path) as file:
        content = dict(file)
    np.savez(path, **{**content, "J_regressor": np.ones((55, 80))})


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (truncate_archive, r"KIT\.tar\.bz2: damaged archive, download it again: "),
        (
            archive_without_recording,
            r"BMLrub\.tar\.bz2: 1 recordings are missing in the archive, such as BioMotionLab",
        ),
        (
            lambda r: truncate(r / "amass/CMU/80/80_63_poses.npz"),
            r"80_63_poses\.npz: damaged, or not a file of plain arrays",
        ),
        (lambda r: set_in_file(r, trans=np.full((360, 3), np.nan)), r"80_63_poses\.npz: contains non-finite numbers"),
        (
            lambda r: set_in_file(r, mocap_framerate=np.array(15.0)),
            r"80_63_poses\.npz: recorded at 15 frames per second",
        ),
        (
            lambda r: shutil.rmtree(r / "amass" / "BMLrub"),
            r"cannot be created: BioMotionLab_NTroje: missing \(1 recordings\); .* BioMotionLab_NTroje or BMLrub",
        ),
        (lambda r: shutil.rmtree(r / "amass"), r"amass: not found; register at https://amass"),
        (body_of_55_joints, r"male/model\.npz: a model with 55 joints, not SMPL\+H with 52"),
        (lambda r: (r / "HumanML3D/index.csv").unlink(), r"index\.csv: not found"),
        (lambda r: shutil.rmtree(r / "HumanML3D/pose_data"), r"1 clips of HumanAct12 are missing, such as P11G01R02"),
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
    first, *missing = raw(mine).check()
    assert first == "0 of 6 motions and their mirrored copies are created"
    assert [line.split(":")[1] for line in missing] == [f" {mine}/bodies", " BioMotionLab_NTroje", " CMU"]
    options = [f"data.source.{key}={mine / key}" for key in ("amass",)]
    assert prepare(["data=humanml3d", f"source={mine / 'HumanML3D/HumanML3D'}", "check=true", *options]) == 0
    assert "missing: BioMotionLab_NTroje: missing" in capsys.readouterr().out
    assert not (mine / "HumanML3D" / "HumanML3D" / "new_joint_vecs").exists()


# As FLAME reads it ----------------------------------------------------------------------------------------------------


def smpl(root, **options):
    return HumanML3DSMPL(str(root / "HumanML3D" / "HumanML3D"), str(root / "amass"), workers=1, **options)


def test_each_caption_is_a_clip_of_smpl_parameters(mine, tmp_path):
    poses = np.random.default_rng(0).normal(0, 0.2, (45, 72))
    entry = {"poses": poses, "joints3D": HUMANACT12, "motion_length": 45}
    (mine / "humanact12_processed.pkl").write_bytes(pickle.dumps({"P11G01R02F1812T1847A0402.npy": entry}))
    source = smpl(mine, humanact12=str(mine / "humanact12_processed.pkl"))
    store = write_store(tmp_path / "store", source, SMPL())
    clips = {clip.id: clip for clip in store.clips}
    assert source.count() == len(clips) == 2 * 6
    assert clips["000000#0"].captions == ["a person moves."]
    assert clips["000000#1"].captions == ["someone moves."]
    assert (clips["000000#1"].length, clips["000004#0"].length) == (50, 57)
    assert clips["000000#1"].start == clips["000000#0"].start, "captions share the frames"
    content = FILES["Eyes_Japan_Dataset/hamada/pose-06 hangon_poses"]
    raw_motion = np.concatenate([content["trans"], content["poses"]], 1)[::2][63:120]
    wanted = SMPL().encode(torch.from_numpy(raw_motion)).numpy()
    np.testing.assert_allclose(store.motion(clips["000004#0"]), wanted, atol=1e-6)
    wanted = SMPL().encode(torch.from_numpy(np.concatenate([HUMANACT12[:, 0], poses], 1))).numpy()
    np.testing.assert_allclose(store.motion(clips["000002#1"]), wanted, atol=1e-6)
    assert store.info["excluded"] == {}
    assert {c.split for c in store.clips if c.source == "000004"} == {"val"}


def test_flames_final_split_trains_on_the_validation_clips(mine, tmp_path):
    store = write_store(tmp_path / "store", smpl(mine, published_split=True), SMPL())
    assert store.info["clips"] == {"train": 8, "val": 0, "test": 2}
    assert store.info["published_split"] is True
    assert store.info["excluded"] == {"motions of HumanAct12, as data.source.humanact12 is not given": 1}


def test_motions_left_out_of_the_smpl_form_are_counted(mine, tmp_path):
    index = mine / "HumanML3D" / "index.csv"
    index.write_text("".join(row for row in index.read_text().splitlines(True) if "000003" not in row))
    store = write_store(tmp_path / "store", smpl(mine, exclude=["000001", "M000004"]), SMPL())
    assert {clip.source for clip in store.clips} == {"000000", "000004", "000005"}
    assert store.info["excluded"] == {
        "motions by data.source.exclude": 1,
        "motions that index.csv lacks": 1,
        "motions of HumanAct12, as data.source.humanact12 is not given": 1,
    }


def test_order_and_fingerprint_do_not_depend_on_how_the_subsets_are_packed(downloads, mine, tmp_path):
    unpacked = write_store(tmp_path / "a", smpl(downloads), SMPL())
    pack(mine, "BMLrub", "BMLrub.tar.bz2", "BioMotionLab_NTroje")
    pack(mine, "KIT", "KIT.tar.bz2", "KIT")
    packed = write_store(tmp_path / "b", smpl(mine), SMPL())
    assert packed.fingerprint == unpacked.fingerprint


def test_captions_of_the_smpl_form_must_be_there(mine):
    (mine / "HumanML3D" / "HumanML3D" / "texts" / "000003.txt").unlink()
    with pytest.raises(FileNotFoundError, match="1 clips have no text, such as 000003"):
        smpl(mine).count()
    shutil.rmtree(mine / "amass" / "CMU")
    with pytest.raises(FileNotFoundError, match="CMU: missing"):
        smpl(mine, exclude=["000003"]).count()
    assert Amass(mine / "amass").missing(["CMU/80/80_63_poses"])
