"""CMU's motions with the captions of HumanML3D and KIT-ML: conversions, rates, splits, bad files, the real files."""

import gc
import json
import re
import tarfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.asf import write_amc, write_asf
from support.fixtures import SHARED, needs_third_party

from flame_mdm.__main__ import main
from flame_mdm.data import archives, cmu, hashed_split
from flame_mdm.data.humanml3d import IndexedClip
from flame_mdm.data.store import Store, write_store
from flame_mdm.data.t2m import Description
from flame_mdm.errors import UserError
from flame_mdm.formats import asf, bvh
from flame_mdm.formats.layouts import tree_layout
from flame_mdm.formats.recordings import AT_60, is_at_60, known_rate
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import SMPL

ARCHIVE = SHARED / "data" / "cmu-part.tar.xz"


def motionbuilder(tree: bvh.Bvh) -> bvh.Bvh:
    """The recording as the public conversion has it: T-pose first, without the vectors of thorax and wrist bones."""
    names = {bone: name for name, bone in cmu.FACTS["motionbuilder"].items()}
    lost = ("lowerneck", "lclavicle", "rclavicle", "lhand", "rhand")
    offsets = np.where(np.isin(tree.joints, lost)[:, None], 0, tree.offsets)
    pose = np.concatenate([tree.frames[:1, :3], np.zeros((1, tree.frames.shape[1] - 3))], 1)
    frames = np.concatenate([pose, tree.frames])
    return replace(
        tree,
        joints=tuple(names.get(name, name) for name in tree.joints),
        offsets=offsets,
        frames=frames,
    )


def mapped(tree: bvh.Bvh, fields: dict) -> np.ndarray:
    """The 22 joints of SMPL in a recording."""
    layout, names = tree_layout(tree, fields)
    return layout.apply(tree.positions(), names)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Motions in `motions` and a clone of HumanML3D in `clone`."""
    motions, clone = tmp_path / "motions", tmp_path / "clone"
    for path in (motions / "02", motions / "60", clone / "HumanML3D" / "texts"):
        path.mkdir(parents=True)
    write_asf(motions / "02" / "02.asf")
    for seed, name in enumerate(("02_01", "02_02", "02_03")):
        write_amc(motions / "02" / f"{name}.amc", 400, seed)
    bvh.write(
        motionbuilder(asf.read(motions / "02" / "02_02.amc", 120)), motions / "60" / "60_01.bvh"
    )
    rows = ["CMU/02/02_01_poses.npy,0,60,000001.npy", "CMU/02/02_02_poses.npy,6,66,000002.npy"]
    rows += ["CMU/9/9_1_poses.npy,0,60,000003.npy", "CMU/60/60_01_poses.npy,20,130,000004.npy"]
    table = [
        "source_path,start_frame,end_frame,new_name",
        *rows,
        "KIT/3/x_poses.npy,0,99,000009.npy",
    ]
    (clone / "index.csv").write_text("\n".join(table) + "\n")
    for name in ("000001", "000002", "000003", "000004"):
        for mirrored, side in (("", "left"), ("M", "right")):
            part = f"the {side} arm swings#the/DET arm/NOUN#0.5#2.75\n" * (name == "000002")
            text = f"a person walks to the {side}#a/DET person/NOUN#0.0#0.0\n{part}"
            (clone / "HumanML3D" / "texts" / f"{mirrored}{name}.txt").write_text(text)
    for split, names in {
        "train": ("000001", "000003", "000004"),
        "val": (),
        "test": ("000002",),
    }.items():
        listed = [mark + name for name in names for mark in ("", "M")]
        (clone / "HumanML3D" / f"{split}.txt").write_text("\n".join(listed))
    sentence = {"duration": 400 / 120, "annotations": [{"text": "Somebody moves."}]}
    sentences = {f"0000{k}": sentence | {"path": f"CMU/02/02_0{k + 1}_poses"} for k in (1, 2)}
    (clone / "kitml.json").write_text(json.dumps(sentences))
    return tmp_path


def source(folder: Path, **options) -> cmu.CMU:
    return cmu.CMU(str(folder / "motions"), str(folder / "clone"), **options)


@pytest.mark.slow
def test_clips_have_their_motion_captions_and_splits(folder, subtests):
    humanml = HumanML("smpl22", "legacy")
    data = source(folder)
    store = write_store(folder / "store", data, humanml)
    clips = {clip.id: clip for clip in store.clips}
    assert (store.info["clips"], data.count()) == ({"train": 4, "val": 1, "test": 5}, 10)
    assert {name for name, clip in clips.items() if clip.split == "test"} == {
        *("000002", "M000002", "000002@0.5-2.75", "M000002@0.5-2.75", "kit00001"),
    }
    assert clips["M000002@0.5-2.75"].captions == ["the right arm swings"]
    assert clips["kit00001"].source != clips["000002"].source
    assert store.info["excluded"] == {"HumanML3D clips whose recording is missing": 1}
    assert store.info["counts"]["clips of HumanML3D"] == 3
    recording = asf.read(folder / "motions/02/02_02.amc", 120)
    tree, fields = cmu.standardize(recording)
    joints = mapped(replace(tree, frames=tree.frames[::6]), fields)[6:66]
    for name, motion in (
        ("000002", joints),
        ("M000002", SMPL22.mirror(torch.from_numpy(joints)).numpy()),
    ):
        with subtests.test(name=name):
            expected = humanml.encode(torch.from_numpy(motion))
            np.testing.assert_allclose(store.motion(clips[name]), expected, atol=1e-5)
    assert clips["000004"].length == 109, "60 frames per second: 401 frames are 6.7 s"
    with tarfile.open(folder / "motions.tar.xz", "w:xz") as archive:
        archive.add(folder / "motions", "cmu/motions")
    packed = cmu.CMU(str(folder / "motions.tar.xz"), str(folder / "clone"), workers=2)
    assert write_store(folder / "again", packed, humanml).fingerprint == store.fingerprint
    unpacked = packed.path
    del packed
    gc.collect()
    assert not unpacked.exists()


def test_conversions_have_the_joints_of_the_original(folder):
    original, _ = cmu.standardize(asf.read(folder / "motions/02/02_02.amc", 120))
    converted, fields = cmu.standardize(bvh.read(folder / "motions/60/60_01.bvh"))
    assert len(converted.frames) == len(original.frames) == 400
    both = [mapped(tree, fields) for tree in (original, converted)]
    np.testing.assert_allclose(both[0], both[1], atol=1e-5)
    hips = both[0][:, [1, 2]].mean(1) - both[0][:, 0]
    scale = 0.82 / cmu.ADULT_LEG
    assert np.linalg.norm(hips, axis=1) == pytest.approx(0.085 * scale, rel=1e-4), (
        "SMPL's pelvis is above the hips"
    )


DAZ = {"hip": "", "abdomen": "hip", "chest": "abdomen", "neck": "chest", "head": "neck"}
for mark in "lr":
    legs = ("Buttock", "Thigh", "Shin", "Foot", "Foot.end")
    arms = ("Collar", "Shldr", "ForeArm", "Hand")
    DAZ |= {
        mark + name: mark + above if above else "hip"
        for name, above in zip(legs, ("", *legs), strict=False)
    }
    DAZ |= {
        mark + name: mark + above if above else "chest"
        for name, above in zip(arms, ("", *arms), strict=False)
    }


@pytest.mark.parametrize("kind", ["original", "conversion", "daz"])
def test_the_bone_of_the_head_keeps_its_length_while_neck_and_head_turn(folder, kind: str):
    if kind == "daz":
        parents = tuple([*DAZ].index(above) if above else -1 for above in DAZ.values())
        tree = bvh.Bvh(tuple(DAZ), parents, np.ones((len(DAZ), 3)), (), np.zeros((0, 0)), 120)
    elif kind == "original":
        tree = asf.read(folder / "motions/02/02_02.amc", 120)
    else:
        tree = bvh.read(folder / "motions/60/60_01.bvh")
    turning = ("Xrotation", "Yrotation", "Zrotation")
    angles = np.random.default_rng(0).normal(0, 20, (50, 3 * len(tree.joints)))
    moving = replace(tree, channels=(turning,) * len(tree.joints), frames=angles)
    joints = mapped(*cmu.standardize(moving))
    neck, head = (joints[:, SMPL22.joints.index(name)] for name in ("neck", "head"))
    assert np.ptp(np.linalg.norm(head - neck, axis=1)) < 1e-5


def test_rotations_are_those_of_the_positions(folder):
    store = write_store(folder / "store", source(folder, motion="smpl"), SMPL())
    clip = next(clip for clip in store.clips if clip.id == "000001")
    joints = SMPL().decode(torch.from_numpy(np.array(store.motion(clip)))).numpy()[:, :22]
    assert joints[..., 1].min() == pytest.approx(0, abs=0.06), "the adult body stands on the floor"
    speed = np.linalg.norm(np.diff(joints[:, 0], axis=0), axis=1) * 20
    assert speed.mean() == pytest.approx(1.2 * cmu.ADULT_LEG / 0.82, rel=0.05), (
        "and walks as it does, to its scale"
    )


def test_rates_of_1200_frames(subtests):
    """KIT-ML's duration decides, then HumanML3D's last frame, then CMU's list, then the file."""
    cases = [
        (120.0, 10.0, None, True, 120),
        (120.0, 20.0, None, False, 60),
        (120.0, None, 201, False, 120),
    ]
    cases += [
        (120.0, None, 202, False, 60),
        (120.0, None, None, True, 60),
        (60.0, None, 390, False, 60),
    ]
    for *evidence, rate in [*cases, (None, None, None, False, 120)]:
        with subtests.test(rate=rate):
            assert cmu.decide_rate(1200, *evidence) == rate, evidence


def test_bad_recordings_are_listed_and_the_good_ones_prepared(folder, capsys):
    motions = folder / "motions"
    files = {
        "02/02_01.amc": "version https://git-lfs.github.com/spec/v1\noid sha256:0\n",
        "18_01.bvh": "known as bad",
    }
    files["02/02_03.amc"] = (motions / "02/02_03.amc").read_text().replace("ltibia", "lshin", 1)
    files["02/02_02.bvh"] = "not read, the original is there"
    for name, text in files.items():
        (motions / name).write_text(text)
    words = ["data=cmu", f"source={motions}", f"data_root={folder}", "data.source.workers=1"]
    assert main(["prepare", *words, f"data.source.captions={folder / 'clone'}"]) == 0
    output = capsys.readouterr().out
    assert re.search(r"left out: \S*/02_01\.amc", output)
    assert "lshin is not a moving bone of the skeleton" in output
    assert "excluded: 1 recordings known to be bad" in output
    assert Store(folder / "cmu-humanml-legacy-smpl22").info["clips"] == {
        "train": 2,
        "val": 0,
        "test": 5,
    }


TABLE = """id,begin,end,text,action,split
02_01,,,a person walks,walk,train
02_01,,,somebody goes,walk,train
02_02,0.5,2.75,"an arm, the left one, swings",swing,test
02_02,0.5,2.75,the arm moves,swing,test
60_01,,,a salsa,dance,val
99_01,,,not there,walk,train
"""


def test_captions_of_ones_own(folder, capsys):
    """In the folder of the motions or another one, without a clone of HumanML3D."""
    (folder / "mine").mkdir()
    (folder / "mine" / "captions.csv").write_text(TABLE)
    words = [
        "data=cmu",
        f"source={folder / 'motions'}",
        f"data_root={folder}",
        "data.source.workers=1",
    ]
    assert main(["prepare", *words, f"data.source.captions={folder / 'mine'}"]) == 0, (
        capsys.readouterr().err
    )
    store = Store(folder / "cmu-humanml-legacy-smpl22")
    clips = {clip.id: clip for clip in store.clips}
    assert clips.keys() == {"02_01", "02_02@0.5-2.75", "60_01"}
    assert clips["02_01"].captions == ["a person walks", "somebody goes"]
    assert (clips["02_02@0.5-2.75"].split, clips["60_01"].split) == ("test", "val")
    assert [store.info["actions"][clips[name].action] for name in sorted(clips)] == [
        "walk",
        "swing",
        "dance",
    ]
    assert store.info["excluded"]["parts in captions.csv whose recording is missing"] == 1
    assert clips["02_01"].split == "train"
    assert clips["60_01"].length > 100, "60 frames per second, without the T-pose"
    tree, fields = cmu.standardize(asf.read(folder / "motions/02/02_02.amc", 120))
    joints = mapped(replace(tree, frames=tree.frames[::6]), fields)[10:55]
    read = {
        clip.id: clip
        for clip in cmu.CMU(str(folder / "motions"), str(folder / "mine"), workers=1).clips(20.0)
    }
    np.testing.assert_allclose(read["02_02@0.5-2.75"].motion, joints, atol=1e-5)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (
            "walk,,,a,b,",
            "captions.csv, line 2: id 'walk' is not the name of a recording, such as 02_01",
        ),
        (
            "02_01,3,1,a,b,",
            "captions.csv, line 2: begin '3', end '1': expected times in seconds, with 0 <= begin < end",
        ),
        ("02_01,x,1,a,b,", "begin 'x', end '1': not times in seconds"),
        ("02_01,nan,1,a,b,", "begin 'nan', end '1': not times in seconds"),
        ("02_01,,,a,b,tset", "captions.csv, line 2: unknown split 'tset'"),
        ("02_01,,,,b,\n02_02,,,a,b,", "1 of 2 parts have no text (for example, 02_01)"),
        (
            "02_01,,,a,b,\n02_01,,,a,c,",
            "captions.csv, line 3: 02_01 has conflicting values for split, source or action",
        ),
        ("99_01,,,a,b,", "no captions for the recordings in"),
    ],
)
def test_faults_in_captions_of_ones_own_are_named(row: str, message: str, folder):
    (folder / "motions" / "captions.csv").write_text(f"id,begin,end,text,action,split\n{row}\n")
    with pytest.raises(UserError, match=re.escape(message)):
        _ = cmu.CMU(str(folder / "motions")).items


def test_wrong_folders_get_one_line(folder, subtests):
    for path, captions, message in [
        ("none", "clone", "contains no recording such as 02_01.bvh or 02_01.amc; clone https"),
        ("motions", "none", "none: not found; it is the folder with the captions"),
        ("motions", "motions", "index.csv"),
    ]:
        with (
            subtests.test(path=path, captions=captions, message=message),
            pytest.raises(FileNotFoundError, match=message),
        ):
            cmu.CMU(str(folder / path), str(folder / captions)).count()
    for name in ("texts/000002.txt", "train.txt"):
        (folder / "clone/HumanML3D" / name).unlink()
    with pytest.raises(FileNotFoundError, match=r"train\.txt: not found; clone https"):
        source(folder).count()
    with pytest.raises(UserError, match=r"data\.source\.exclude: .* does not contain 99_99"):
        _ = source(folder, exclude=["99_99"]).files
    (folder / "clone/kitml.json").write_text("[1]")
    with pytest.raises(UserError, match=r"kitml\.json: not KIT-ML's captions for AMASS"):
        _ = source(folder).kit


@pytest.fixture(scope="module")
def real(tmp_path_factory):
    """Some files of the archive, unpacked into a folder that lives as long as the factory."""
    wanted = ("asf_amc/01.", "asf_amc/02", "daz_bvh/02_0", ".json", ".csv")
    return archives.as_folder(
        ARCHIVE, tmp_path_factory, lambda name: any(part in name for part in wanted)
    )


@needs_third_party
@pytest.mark.slow
def test_angles_are_those_of_the_public_conversion(real, subtests):
    """The first frame of 02_03.bvh in https://github.com/una-dinosauria/cmu-mocap: Euler angles z, y, x."""
    motion = asf.read(real / "asf_amc/02_03.amc", 120)
    expected: dict[str, tuple[float, ...]] = {
        "root": (9.2872, 16.95, -34.2762, 1.1618, 3.3939, 8.2094)
    }
    expected |= {"rtoes": (-1.1835, 6.9042, -19.4319), "lradius": (128.0347, -53.758, -92.2485)}
    expected |= {"lowerneck": (-2.7887, 3.2343, -15.4607)}
    columns = dict(zip(motion.joints, motion.columns(), strict=True))
    for name, angles in expected.items():
        with subtests.test(name=name):
            np.testing.assert_allclose(
                motion.frames[0, columns[name]], angles, atol=1.1e-4, err_msg=name
            )


@needs_third_party
@pytest.mark.slow
def test_the_archive(real, subtests):
    """Rates as CMU lists them; Daz-friendly files agree with the original ones at the same bone lengths."""
    listed = json.loads((real / "cmu_fps.json").read_text())
    assert {t for t, entry in listed.items() if entry["fps"] == 60} == {
        t for t in listed if is_at_60(t)
    }
    names = ["02_04", "02_05", "02_07", "02_08", "02_09"]
    for name in names:
        with subtests.test(name=name):
            whole = cmu.Item("a", "test", "a", [])
            files = (real / "asf_amc" / f"{name}.amc", real / "daz_bvh" / f"{name}.bvh")
            both = [
                cmu._read("joints", ([file], (None, None, False), [whole]))[0] for file in files
            ]
            bones = [SMPL22.bones(torch.from_numpy(joints).double()) for joints in both]
            lengths = torch.linalg.vector_norm(bones[0], dim=-1, keepdim=True)
            same = [torch.nn.functional.normalize(bone, dim=-1) * lengths for bone in bones]
            joints = [SMPL22.assemble(bone, torch.zeros(len(bone), 3).double()) for bone in same]
            assert float(torch.linalg.vector_norm(joints[0] - joints[1], dim=-1).mean()) < 0.02, (
                name
            )
    clips = {clip.id: clip for clip in cmu.CMU(str(real), workers=1).clips(20)}
    assert {"000327", "M000327", "kit02278"} & clips.keys() == {"000327", "M000327"}, (
        "02_06 takes 18 seconds"
    )
    assert clips["kit02279"].captions == [
        "A person is doing sidewards punches like with paddle at ping-pong."
    ]


@pytest.mark.parametrize(
    ("trial", "is_slow"),
    [
        *((f"{subject}_01", True) for subject in (33, 34, 42, 60, 61, 62, 74, 75, 77, 79, 80)),
        *((f"{subject}_01", True) for subject in (87, 88, 89)),
        *(("136_19", True), ("136_18", False), ("02_01", False), ("133_01", False)),
        *(("60_15", True), ("35_01", False), ("76_60", False)),
    ],
)
def test_recordings_at_60_frames_per_second(trial: str, is_slow: bool):
    assert len(AT_60) == 15
    assert is_at_60(trial) == is_slow
    assert known_rate(f"{trial}_poses", "CMU", 120.0) == (60.0 if is_slow else None)


@pytest.mark.parametrize(
    ("name", "skeleton", "fps", "rate"),
    [
        ("60_01", "CMU ASF", 120.0, 60.0),
        ("60_01", "Daz without toes", 119.6, 60.0),
        ("60_01", "Mixamo", 120.0, None),
        ("60_01", "CMU", 60.0, None),
        ("60_01", "CMU", 100.0, None),
        ("60_01", "CMU", 30.0, None),
        ("160_01", "CMU", 120.0, None),
        ("walk", "CMU", 120.0, None),
    ],
)
def test_a_rate_is_corrected_only_for_a_cmu_recording_that_states_120(name, skeleton, fps, rate):
    assert known_rate(name, skeleton, fps) == rate


@pytest.mark.parametrize(
    ("begin", "end", "frames"),
    [("0.53", "2.68", (11, 54)), ("", "2.52", (0, 50)), ("", "", (0, None))],
)
def test_times_of_a_part_are_rounded_to_frames(begin: str, end: str, frames: tuple):
    part = cmu._part_in_table({"id": "02_01", "begin": begin, "end": end})
    assert (part.start, part.end) == frames


def test_the_pose_in_front_of_a_daz_file_and_the_frames_blended_with_it_are_removed():
    parents = tuple([*DAZ].index(above) if above else -1 for above in DAZ.values())
    turning = ("Zrotation", "Xrotation", "Yrotation")
    channels = (("Xposition", "Yposition", "Zposition", *turning), *[turning] * (len(DAZ) - 1))
    numbers = np.arange(10)[:, None] * np.ones(6 + 3 * (len(DAZ) - 1))
    tree = bvh.Bvh(tuple(DAZ), parents, np.ones((len(DAZ), 3)), channels, numbers, 120)
    standard, _ = cmu.standardize(tree)
    assert standard.frames[:, 0].tolist() == [*range(1, 10)], "the path stays as it is"
    assert standard.frames[:, 3].tolist() == [*range(1, 10)]
    assert (standard.frames[:, 6:] == [[4]] * 4 + [[k] for k in range(5, 10)]).all()
    moving = replace(tree, frames=numbers + 1)
    assert len(cmu.standardize(moving)[0].frames) == 10


def test_original_files_come_first_and_daz_conversions_last():
    names = ("daz/02_01.bvh", "02_01.bvh", "02_01.AMC", "Daz-friendly/a/02_01.bvh")
    assert [cmu._rank(Path(name)) for name in names] == [2, 1, 0, 2]


def test_bad_recordings_are_whole_subjects_or_single_ones():
    names = ("18_01", "19_15", "106_03", "143_21", "143_20", "118_01", "02_18")
    bad = [cmu._is_in("bad", name) for name in names]
    assert bad == [True, True, True, True, False, False, False]


@pytest.mark.parametrize(
    ("rows", "count", "count_of_others"),
    [(39, 0, 0), (40, 1, 1), (199, 1, 1), (200, 1, 0), (900, 1, 0)],
)
def test_parts_of_ones_own_have_no_maximum_length(rows, count, count_of_others):
    text = [Description("walks", [])]
    mine = cmu.Item("a", "train", "a", text, is_own=True)
    assert [(cut.start, cut.length) for cut in mine.cuts(rows)] == [(0, rows)] * count
    assert len(cmu.Item("a", "train", "a", text).cuts(rows)) == count_of_others


def captioned(splits: dict[str, str], seconds: float = 3.0, end: int = 60) -> cmu.CMU:
    """A recording with a clip in each of these splits, and with a caption of KIT-ML."""
    data = cmu.CMU("there")
    data.table = None
    data.files = {"02_01": [Path("02_01.amc")], "07_01": [Path("07_01.amc")]}
    rows = [IndexedClip(name, "CMU/02/02_01_poses", 0, end) for name in splits]
    texts = {name: [Description("walks", [])] for name in splits}
    data.humanml3d = rows, texts, splits  # type: ignore[assignment]
    data.kit = [("kit1", "02_01", "Somebody walks.", seconds)]
    return data


@pytest.mark.parametrize(
    ("splits", "split"),
    [
        *((("train",), "train"), (("val",), "val"), (("train", "val"), "val")),
        *((("test", "train"), "test"), (("test", "val", "train"), "test")),
        ((), hashed_split("CMU subject 02", val=5, test=10)),
    ],
)
def test_a_recording_is_in_the_strictest_split_of_its_clips(splits, split):
    data = captioned({f"{number}": split for number, split in enumerate(splits)})
    assert [item.split for item in data.items["02_01"] if item.id == "kit1"] == [split]
    assert data.excluded["recordings without a caption"] == 1


@pytest.mark.parametrize(
    ("seconds", "end", "count"), [(2.05, 41, 2), (2.05, 40, 1), (2.0, 41, 1), (10.05, 201, 0)]
)
def test_clips_are_counted_by_the_times_of_their_captions(seconds, end, count):
    """A clip has one row of features less than it has frames, from 40 to 199 rows."""
    assert captioned({"a": "train"}, seconds, end).count() == count


@pytest.mark.parametrize(
    ("header", "seconds", "is_sixty", "rate"),
    [
        *((120.0, 20.04, False, 60), (120.0, 20.06, False, 120), (60.0, 10.04, False, 120)),
        *((60.0, 10.06, False, 60), (100.0, 10.0, False, 120), (100.0, None, False, 100)),
        *((100.0, 12.0, True, 100), (100.0, 13.0, True, 60), (None, 12.0, True, 60)),
    ],
)
def test_a_duration_fits_a_rate_within_one_frame_at_20_per_second(header, seconds, is_sixty, rate):
    assert cmu.decide_rate(1200, header, seconds, None, is_sixty) == rate


def test_a_rate_is_decided_by_the_last_clip_and_the_duration_of_the_recording(monkeypatch):
    data = cmu.CMU("there", workers=1)
    data.table = None
    data.files = {name: [Path(f"{name}.amc")] for name in ("02_01", "60_01")}
    ends = {"a": 50, "b": 90, "c": 70}
    rows = [IndexedClip(name, "CMU/02/02_01_poses", 5, end) for name, end in ends.items()]
    rows.append(IndexedClip("d", "CMU/60/60_01_poses", 20, 30))
    texts = {row.name: [Description("walks", [])] for row in rows}
    data.humanml3d = rows, texts, dict.fromkeys(texts, "train")  # type: ignore[assignment]
    data.kit = [("kit1", "02_01", "Somebody walks.", 4.5)]
    evidence = {}

    def in_order(_, tasks, workers):
        evidence.update({files[0].stem: facts for files, facts, _ in tasks})
        return ["it is damaged"] * len(tasks)

    monkeypatch.setattr(cmu, "in_order", in_order)
    with pytest.raises(UserError, match=r"The first error is: it is damaged"):
        list(data.clips(20.0))
    assert evidence == {"02_01": (4.5, 90, False), "60_01": (None, 30, True)}
    assert data.findings() == ["left out: it is damaged"] * 2
