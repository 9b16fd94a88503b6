"""Own motions and captions, in every kind of file that the documentation names."""

import json
import os
import re
import time
from itertools import product
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from support.fixtures import ROOT
from support.motions import synthetic
from support.others import amass
from support.refusals import one_error
from support.stores import write_amass

from flame_mdm.__main__ import main
from flame_mdm.config import compose_data, instantiate
from flame_mdm.data import Clip, hashed_split, name_hash
from flame_mdm.data import folder as folder_reader
from flame_mdm.data.captions import drawn_splits
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh, fbx, fbx_scene
from flame_mdm.formats.layouts import LAYOUTS, read_skeleton
from flame_mdm.formats.readers import PELVIS, read
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.representations.smpl import SMPL
from flame_mdm.sampling.reading import read_motion

WALK = next(
    c for c in Synthetic(clips=30).clips(30.0) if c.attributes["action"] == "walk"
).motion.astype(float)
"""(F, 22, 3) meters, y up, 30 frames a second."""


def read_all(folder: Path, **options) -> list[Clip]:
    """The clips of a folder, all of whose motions can be read."""
    source = Folder(str(folder), **options)
    clips = list(source.clips(30.0))
    source.require_all()
    return clips


def only(folder: Path, **options) -> np.ndarray:
    (clip,) = read_all(folder, **options)
    return clip.motion


def skeleton(folder: Path, **content) -> None:
    (folder / "skeleton.yaml").write_text(json.dumps(content))


def write_table(folder: Path, rows: list[dict]) -> None:
    lines = [",".join(rows[0]), *(",".join(f'"{cell}"' for cell in row.values()) for row in rows)]
    (folder / "captions.csv").write_text("\n".join(lines))


INCH = 1 / 2.54
MIXAMO = {
    joint: name if isinstance(name, str) else next(iter(name))
    for joint, name in LAYOUTS["Mixamo"].map.items()
}
CHANNELS = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")


def mixamo(path: Path, scale: float = 1.0, toes: float = 1.0, frames: int = 40) -> None:
    """A stiff body that turns so fast that straight lines between positions would shorten its bones.

    Lengths are in centimeters, times `scale`; if `toes` is not 1, feet end after this share of their length, at sites.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    parents = SMPL22.parents
    offsets = 100 * scale * np.concatenate([WALK[0, :1], WALK[0, 1:] - WALK[0, list(parents[1:])]])
    kept = [k for k, joint in enumerate(SMPL22.joints) if toes == 1 or not joint.endswith("foot")]
    cut = [k for k in range(22) if k not in kept]
    numbers = np.zeros((frames, 6 + 3 * (len(kept) - 1)))
    numbers[:, :3] = 100 * scale * WALK[0, 0]
    numbers[:, 5] = np.arange(frames) * 40.0
    names = [MIXAMO[joint] for joint in SMPL22.joints]
    body = bvh.Bvh(
        (*(names[k] for k in kept), *(f"{names[parents[k]]}.end" for k in cut)),
        tuple(kept.index(parents[k]) if k else -1 for k in kept + cut),
        np.concatenate([offsets[kept], offsets[cut] * toes]),
        (CHANNELS, *[CHANNELS[3:]] * (len(kept) - 1), *[()] * len(cut)),
        numbers,
        30.0,
    )
    bvh.write(body, path)


@pytest.fixture
def arrays(tmp_path: Path) -> Path:
    """Three motions in the three kinds of arrays, with captions in text files."""
    np.save(tmp_path / "one.npy", WALK)
    (tmp_path / "deep").mkdir()
    np.savez(tmp_path / "deep" / "two.npz", joints=WALK[:50].astype(np.float32), fps=30)
    poses = np.tile(np.eye(1, 156) * np.pi / 2, (60, 1))
    np.savez(
        tmp_path / "three.npz",
        poses=poses,
        trans=np.linspace((0, 0, 1), (1, 0, 1), 60),
        mocap_framerate=60.0,
    )
    skeleton(tmp_path, fps=30)
    for name in ("one", "deep/two", "three"):
        (tmp_path / f"{name}.txt").write_text(
            "a person walks\nsomeone goes ahead#someone/NOUN#0.0#0.0\n\n"
        )
    return tmp_path


def test_arrays_and_text_files(arrays: Path):
    clips = {clip.id: clip for clip in Folder(str(arrays)).clips(20.0)}
    assert list(clips) == ["deep_two", "one", "three"]
    assert all(clip.captions == ["a person walks", "someone goes ahead"] for clip in clips.values())
    one, amass = clips["one"].motion, clips["three"].motion
    assert len(one) == (len(WALK) - 1) * 20 // 30 + 1
    np.testing.assert_allclose(one[::2], WALK[::3][: len(one[::2])], atol=1e-6)
    assert len(amass) == 20
    at = dict(zip(SMPL22.joints, amass[-1], strict=True))
    assert at["head"][1] > at["pelvis"][1] > at["left_foot"][1]
    x, y, z = PELVIS  # of the template, at which a body without translation is
    np.testing.assert_allclose(at["pelvis"], [-57 / 59 - x, 1 + z, y], atol=1e-5)


def test_smpl_rotations_are_kept(tmp_path: Path):
    write_amass(tmp_path / "x.npz", 31, 60.0)
    with np.load(tmp_path / "x.npz") as file:
        recorded = np.concatenate([file["trans"], file["poses"]], 1)[::2]
    ours, theirs = (
        SMPL().encode(torch.from_numpy(x)) for x in (only(tmp_path, motion="smpl"), recorded)
    )
    np.testing.assert_allclose(ours.numpy(), theirs.numpy(), atol=1e-5)


@pytest.mark.parametrize("name", LAYOUTS)
def test_skeletons_are_recognized(name: str, tmp_path: Path, subtests):
    """Joints that a skeleton has itself come out where they are; the blended ones lie between them."""
    layout = LAYOUTS[name]
    sources = {joint: [of] if isinstance(of, str) else list(of) for joint, of in layout.map.items()}
    own = {names[0]: joint for joint, names in sources.items() if len(names) == 1}
    extra = sorted({n for names in sources.values() for n in names} - set(own))
    number = {joint: k for k, joint in enumerate(SMPL22.joints)}
    columns = [number[own.get(n, "spine3")] for n in [*own, *extra]]
    unit = layout.unit if "unit" in layout.model_fields_set else 0.01
    # every joint has position channels, so that the file shows these positions
    local = WALK[:, columns] / unit * [-1 if layout.mirrored else 1, 1, 1]
    local[:, 1:] -= local[:, :1]
    size = len(columns)
    frames = np.concatenate([local, np.zeros_like(local)], 2).reshape(len(local), -1)
    parents = (-1, *[0] * (size - 1))
    for prefix in ("", "mixamorig:", "mixamorig1_", "Character1_", "An Actor "):
        with subtests.test(prefix=prefix):
            names = tuple(prefix + n for n in [*own, *extra])
            take = bvh.Bvh(names, parents, np.zeros((size, 3)), (CHANNELS,) * size, frames, 30.0)
            bvh.write(take, tmp_path / "take.bvh")
            motion = only(tmp_path)
            for joint, names in sources.items():
                furthest = np.abs(motion[:, number[joint]] - WALK[:, number[joint]]).max()
                assert furthest < (1e-4 if len(names) == 1 else 0.35), (prefix, joint)


def test_a_skeleton_file_maps_any_joints(tmp_path: Path):
    """Centimeters, z up, joints in another order with names of their own."""
    order = np.random.default_rng(0).permutation(22)
    np.save(tmp_path / "x.npy", WALK[:, order][..., [0, 2, 1]] * [100, -100, 100])  # y up -> z up
    names = [f"bone {SMPL22.joints[k]}" for k in order]
    skeleton(
        tmp_path,
        fps=30,
        unit=0.01,
        up="z",
        joints=names,
        map={j: f"bone {j}" for j in SMPL22.joints},
    )
    np.testing.assert_allclose(only(tmp_path), WALK, atol=1e-5)


def test_the_table_gives_captions_actions_splits_and_sources(tmp_path: Path):
    rows = []
    for k, action in enumerate(("turn left", "turn right", "walk", "walk")):
        np.savez(tmp_path / f"{k}.npz", joints=WALK + 0.01 * k, fps=30)
        facts = {
            "action": action,
            "split": "val" if k == 3 else "train",
            "source": f"take {(k + 1) // 2}",
        }
        rows += [
            {"id": k, "text": text, **facts} for text in ("turns Left, clockwise", "is bright")
        ]
    write_table(tmp_path, rows)
    source = Folder(str(tmp_path), mirror=True)
    store = write_store(tmp_path / "store", source, HumanML())
    assert store.info["actions"] == ["turn left", "turn right", "walk"]
    assert store.info["clips"] == {"train": 6, "val": 1, "test": 0}
    clips = {clip.id: clip for clip in store.clips}
    assert source.count() == len(clips)
    assert clips["0"].captions == ["turns Left, clockwise", "is bright"]
    assert clips["M0"].captions == ["turns Right, counterclockwise", "is bright"]
    assert [clips[i].action for i in ("0", "M0", "2", "M2")] == [0, 1, 2, 2]
    assert [clips[i].source for i in ("0", "M0", "1", "2", "M2")] == [
        "take 0",
        "take 0",
        "take 1",
        "take 1",
        "take 1",
    ]


HEADLESS = {joint: f"{joint} b" for joint in SMPL22.joints}
BAD = {
    "no motion": (
        lambda f: [p.unlink() for p in f.rglob("*.np*")],
        "no motions in this folder. Use a folder",
    ),
    "twice": (
        lambda f: np.savez(f / "one.npz", joints=WALK, fps=30),
        r"one\.npz: has the same name as one\.npy",
    ),
    "no caption": (
        lambda f: (f / "one.txt").unlink(),
        r"1 of 3 motions have no caption \(for example, one\)",
    ),
    "unknown id": (
        lambda f: write_table(f, [{"id": "once", "text": "a"}]),
        r"captions\.csv, line 2: .*'once'",
    ),
    "cells": (
        lambda f: (f / "captions.csv").write_text("id,text\none,a, b\n"),
        r"line 2: the row must have one cell per column",
    ),
    "split": (
        lambda f: write_table(f, [{"id": "one", "split": "dev"}]),
        "line 2: unknown split 'dev'. Use one of train, val",
    ),
    "columns": (
        lambda f: write_table(f, [{"id": "one", "name": "a"}]),
        r"captions\.csv: its columns are \['id', 'na",
    ),
    "two splits": (
        lambda f: write_table(f, [{"id": "one", "split": split} for split in ("val", "test")]),
        "line 3: one has two values for split: val and test",
    ),
    "no rate": (
        lambda f: (f / "skeleton.yaml").unlink(),
        r"one\.npy: the file contains no frame rate",
    ),
    "up": (
        lambda f: np.savez(f / "deep/two.npz", joints=WALK[..., [0, 2, 1]] * [1, -1, 1], fps=9),
        "is lying down",
    ),
    "yaml key": (
        lambda f: skeleton(f, rate=30),
        r"skeleton\.yaml: rate: Extra inputs are .* Valid keys: map, joints",
    ),
    "yaml map": (
        lambda f: skeleton(f, map={"pelvis": "Hips"}),
        r"skeleton\.yaml: the map has no joint for head",
    ),
    "map": (
        lambda f: skeleton(f, fps=30, map=HEADLESS),
        r"two\.npz: the map in skeleton\.yaml uses .* head b",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_every_fault_is_named_in_a_line(case: str, arrays: Path):
    damage, message = BAD[case]
    damage(arrays)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        read_all(arrays)
    assert "\n" not in str(error.value)
    assert str(arrays) in str(error.value)


def test_rotations_are_fitted_to_files_of_joints_and_the_error_is_stated(arrays: Path):
    source = Folder(str(arrays), motion="smpl")
    clips = {clip.id: clip.motion for clip in source.clips(20.0)}
    assert set(clips) == {"deep_two", "one", "three"}
    fitted = SMPL().decode(SMPL().encode(torch.from_numpy(clips["one"]))).numpy()
    traveled = np.linalg.norm(fitted[-1, 0] - fitted[0, 0]) / np.linalg.norm(
        WALK[-1, 0] - WALK[0, 0]
    )
    assert 0.8 < traveled < 1.25
    upright = fitted[:, SMPL22.joints.index("head"), 1] - fitted[:, 0, 1]
    assert (upright > 0.5).all()
    findings = "\n".join(source.findings())
    assert "2 motions: rotations were fitted to joints, with a mean error of at most" in findings


def test_a_clip_has_the_license_of_its_row_or_else_of_the_folder(arrays: Path):
    write_table(arrays, [{"id": "one", "license": "CC0"}, {"id": "deep/two", "license": ""}])
    clips = {clip.id: clip.license for clip in read_all(arrays, license="MIT")}
    assert {"one": "CC0", "deep_two": "MIT"}.items() <= clips.items()
    assert Folder(path=str(arrays), license="MIT").licenses() == {"CC0", "MIT"}
    assert {clip.license for clip in read_all(arrays)} == {"CC0", ""}


def test_motions_are_excluded_by_name(arrays: Path):
    (arrays / "one.npy").write_bytes(b"")
    source = Folder(str(arrays), exclude=["one"])
    assert [clip.id for clip in source.clips(20.0)] == ["deep_two", "three"]
    assert source.excluded == {"motions by data.source.exclude": 1}
    with pytest.raises(ValueError, match="does not contain won"):
        Folder(str(arrays), exclude=["won"]).count()


def test_wrong_units_are_refused_with_the_unit_that_fits(
    tmp_path: Path, monkeypatch, capsys, subtests
):
    monkeypatch.chdir(tmp_path)
    mixamo(tmp_path / "mine" / "a.bvh", INCH)
    message = (
        r"a\.bvh: the legs are 0\.3\d+ m long .*The unit may be 0\.0254 \(inches\)\. Set `unit`"
    )
    with pytest.raises(ValueError, match=message):
        only(tmp_path / "mine")
    assert [
        main(["convert", "mine/a.bvh", "out=a.glb", *words]) for words in ([], ["unit=0.0254"])
    ] == [1, 0]
    assert re.search(message, capsys.readouterr().err)
    for content in ({"children": True}, {"unit": 0.0254}):
        with subtests.test(content=content):
            skeleton(tmp_path / "mine", **content)
            assert only(tmp_path / "mine").shape[1:] == (22, 3)


def test_convert_and_edit_read_files_as_prepare_does(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mixamo(tmp_path / "mine" / "deep" / "a.bvh", INCH)
    skeleton(tmp_path / "mine", unit=0.0254, up="z")
    assert main(["convert", "mine/deep/a.bvh", "out=a.npy"]) == 0
    np.testing.assert_allclose(np.load("a.npy"), next(Folder("mine").clips(30.0)).motion, atol=1e-5)
    assert main(["convert", "mine/deep/a.bvh", "out=b.npy", "up=y"]) == 0
    np.testing.assert_allclose(np.load("b.npy")[..., 2], np.load("a.npy")[..., 1], atol=1e-5)
    skeleton(tmp_path / "mine", unit=0.0254)
    edited = read_motion(HumanML(), "mine/deep/a.bvh").joints
    np.testing.assert_allclose(
        np.ptp(edited[0, :, 1]), np.ptp(np.load("b.npy")[0, :, 1]), atol=1e-3
    )
    assert np.ptp(read_motion(HumanML(), "mine/deep/a.bvh", up="z").joints[0, :, 1]) < 0.6, (
        "it lies"
    )
    np.savez("mine/made.npz", joints=WALK, fps=30, text="a person walks")
    # The file was made here, in meters, y up.
    np.testing.assert_allclose(read("mine/made.npz").joints, WALK, atol=1e-6)


def test_feet_without_toes_end_at_the_end_sites(tmp_path: Path):
    mixamo(tmp_path / "a.bvh")
    mixamo(tmp_path / "b.bvh", toes=0.999)
    whole, ends = (clip.motion for clip in Folder(str(tmp_path)).clips(30.0))
    np.testing.assert_allclose(whole, ends, atol=1e-3)
    (tmp_path / "a.bvh").unlink()
    names = {**MIXAMO, "left_foot": "LeftFoot.end", "right_foot": "RightFoot.end"}
    skeleton(tmp_path, unit=0.01, map=names)
    np.testing.assert_allclose(only(tmp_path), ends, atol=1e-6)
    skeleton(tmp_path, unit=0.01, map={**names, "left_foot": "LeftFoot"})
    with pytest.raises(ValueError, match=r"b\.bvh: the left foot has no length"):
        only(tmp_path)


def test_arrays_of_kimodo_are_known(tmp_path: Path):
    layout = LAYOUTS["SOMA"]
    joints = np.zeros((len(WALK), 77, 3))
    for joint, of in layout.map.items():
        (name,) = [of] if isinstance(of, str) else of
        joints[:, layout.joints.index(name)] = WALK[:, SMPL22.joints.index(joint)]
    np.savez(tmp_path / "a.npz", posed_joints=joints, root_positions=joints[:, 0])
    np.testing.assert_allclose(only(tmp_path), WALK, atol=1e-5)
    np.testing.assert_allclose(read(tmp_path / "a.npz").joints, WALK, atol=1e-5)


def test_check_lists_skeletons_and_all_failures(tmp_path: Path):
    mixamo(tmp_path / "a.bvh")
    mixamo(tmp_path / "b.bvh", INCH)
    (tmp_path / "c.bvh").write_text((tmp_path / "a.bvh").read_text().replace("Spine2", "Back"))
    (tmp_path / "d.bvh").write_text("HIERARCHY\n")
    expected = (
        r"Mixamo, unit 0\.01, 30 fps: 1 motions",
        r"error: .*b\.bvh: the legs are.*",
        r"error: .*c\.bvh: unknown skeleton\. Mixamo is the nearest .*; missing: Spine2\. .*",
        r"error: .*d\.bvh, line 1: .*",
        r"error: 3 of 4 motions in .* cannot be prepared",
    )
    assert re.fullmatch("\n".join(expected), "\n".join(Folder(str(tmp_path)).check(20)))


def test_a_first_frame_in_an_unusual_pose_is_not_an_error(tmp_path: Path):
    motion = WALK.copy()
    for side in ("left", "right"):  # as when kneeling
        ankle, foot = (SMPL22.joints.index(f"{side}_{name}") for name in ("ankle", "foot"))
        motion[0, foot] = 2 * motion[0, ankle] - motion[0, foot]
    np.savez(tmp_path / "a.npz", joints=motion, fps=30)
    assert Folder(str(tmp_path)).check(20)[0] == "SMPL, unit 1, 30 fps: 1 motions"
    np.savez(tmp_path / "a.npz", joints=np.tile(motion[:1], (30, 1, 1)), fps=30)
    assert "the toes point backwards" in Folder(str(tmp_path)).check(20)[0]


def test_from_ten_motions_on_each_split_has_some(tmp_path: Path, subtests):
    for motions, begin in product((10, 20), range(3)):
        with subtests.test(motions=motions, begin=begin):
            folder = tmp_path / f"{motions}-{begin}"
            folder.mkdir()
            for number in range(motions):
                (folder / f"walk_{begin}_{number}.npz").touch()
            splits = Folder(str(folder)).splits
            hashed = {name: hashed_split(name, val=5, test=10) for name in splits}
            assert set(splits.values()) == {"train", "val", "test"}
            if set(hashed.values()) == {"train", "val", "test"}:
                assert splits == hashed
            assert sum(splits[name] != hashed[name] for name in splits) <= 2
            write_table(
                folder,
                [{"id": n, "text": "a", "source": f"take {k % 4}"} for k, n in enumerate(splits)],
            )
            taken = Folder(str(folder))
            of_source = {(taken.notes[name].source, split) for name, split in taken.splits.items()}
            assert len(of_source) == 4, "a source stays in one split"
            assert len({split for _, split in of_source}) == 3


def test_what_a_folder_lacks_is_reported(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for number in range(10):
        np.savez(f"mine/{number}.npz", joints=WALK[:20], fps=20)

    def prepared(*words: str) -> str:
        assert (
            main(
                [
                    "prepare",
                    "data=folder",
                    "data.name=mine",
                    "data_root=data",
                    "source=mine",
                    *words,
                ]
            )
            == 0
        )
        return capsys.readouterr().out

    output = prepared()
    assert Store(tmp_path / "data" / "mine-humanml-clean-smpl22").info["dataset"] == "mine"
    assert "all train clips are too short. Lower data.crop.min_frames" in output
    assert "no captions. Add captions.csv and prepare with force=true" in output
    assert "changed since" not in prepared()
    write_table(tmp_path / "mine", [{"id": str(n), "text": "walks"} for n in range(10)])
    later = time.time() + 10
    os.utime(tmp_path / "mine" / "captions.csv", (later, later))
    assert (
        "mine: captions.csv changed since the data set was prepared. Prepare it again with force=true"
        in prepared()
    )
    assert not re.search("changed since|no captions", prepared("force=true"))


def test_the_skeleton_file_in_the_documentation_is_legal(tmp_path: Path):
    blocks = re.findall(
        r"```yaml\n(.*?)```", (ROOT / "docs" / "own-data.md").read_text(), re.DOTALL
    )
    (block,) = (block for block in blocks if "skeleton.yaml" in block.splitlines()[0])
    (tmp_path / "skeleton.yaml").write_text(block)
    assert set(read_skeleton(tmp_path / "skeleton.yaml")["map"]) == set(SMPL22.joints)


def test_an_empty_folder_and_a_missing_one_are_told_apart(tmp_path, subtests):
    (tmp_path / "empty").mkdir()
    for name, says in (("empty", "no motions in this folder"), ("absent", "no such folder")):
        with (
            subtests.test(name=name, says=says),
            pytest.raises(FileNotFoundError, match=rf"{name}: {says}\. Use a folder of"),
        ):
            Folder(str(tmp_path / name)).count()


BIPED = {  # Mixamo's names without their prefix -> the names of a Biped, as in Rocketbox
    "Hips": "Bip01 Pelvis",
    "Spine": "Bip01 Spine",
    "Spine1": "Bip01 Spine1",
    "Spine2": "Bip01 Spine2",
    "Neck": "Bip01 Neck",
    "Head": "Bip01 Head",
    **{
        f"{side}{name}": f"Bip01 {side[0]} {biped}"
        for side in ("Left", "Right")
        for name, biped in {
            "Shoulder": "Clavicle",
            "Arm": "UpperArm",
            "ForeArm": "Forearm",
            "Hand": "Hand",
            "UpLeg": "Thigh",
            "Leg": "Calf",
            "Foot": "Foot",
            "ToeBase": "Toe0",
        }.items()
    },
}


def rename(path: Path, names: dict[str, str]) -> None:
    """Gives the nodes of an FBX file other names."""
    root = fbx.read(path)
    objects = root.first("Objects")
    assert objects is not None
    for record in objects.children:
        name, separator, kind = str(record.properties[1]).partition("\x00\x01")
        if new := names.get(name.removeprefix("mixamorig:")):
            record.properties[1] = new + separator + kind
    fbx.write(path, root)


def test_fbx_files_with_names_of_mixamo_rocketbox_and_unreal_go_in_and_come_out(
    tmp_path: Path, capsys, subtests
):
    folder, motion = tmp_path / "in", synthetic("kick")
    folder.mkdir()
    for name, rig in (("mixamo", "mixamo"), ("rocketbox", "mixamo"), ("unreal", "unreal")):
        motion.save(folder / f"{name}.fbx", rig=rig)
    rename(folder / "rocketbox.fbx", BIPED)
    assert "Bip01 L Thigh" in fbx_scene.read(folder / "rocketbox.fbx").names

    words = [f"source={folder}", f"data_root={tmp_path}", "data.source.workers=1"]
    assert main(["prepare", "folder", *words]) == 0, capsys.readouterr().err
    (path,) = tmp_path.glob("folder-*/store.json")
    store = Store(path.parent)
    assert sorted(clip.id for clip in store.clips) == ["mixamo", "rocketbox", "unreal"]

    limbs = [SMPL22.joints.index(name) for name in ("left_wrist", "right_ankle", "head")]
    for name in ("mixamo", "rocketbox", "unreal"):
        with subtests.test(name=name):
            out = tmp_path / f"{name}.fbx"
            assert main(["convert", str(folder / f"{name}.fbx"), f"out={out}", "rig=unity"]) == 0
            joints = read(out).joints
            moved = joints[:, limbs] - joints[:, :1]
            expected = motion.joints[:, limbs] - motion.joints[:, :1]
            # Rigs keep the lengths of their bones, so that limbs end a few centimeters elsewhere.
            assert np.linalg.norm(moved - expected, axis=-1).mean() < 0.06


@pytest.mark.parametrize(
    ("name", "motion", "features"),
    [
        *[("smpl", "smpl", 147), ("rot6d", "smpl", 150), ("motion272", "smpl", 272)],
        *[("kit_legacy", "joints", 251), ("rifke", "joints", 64), ("humanml_clean", "joints", 263)],
    ],
)
def test_every_representation_is_prepared_from_every_kind_of_file(
    name, motion, features, tmp_path, capsys, subtests
):
    folder = tmp_path / "in"
    folder.mkdir()
    for ending in ("npz", "bvh", "json", "glb", "fbx"):
        synthetic("walk").save(folder / f"{ending}.{ending}")
    np.savez(folder / "amass.npz", **amass(synthetic("walk")))
    words = [
        "folder",
        f"source={folder}",
        f"data_root={tmp_path}",
        f"representation={name}",
        "data.source.workers=1",
    ]
    assert main(["prepare", *words, f"data.source.motion={motion}"]) == 0, capsys.readouterr().err
    (path,) = tmp_path.glob("folder-*/store.json")
    store = Store(path.parent)
    assert store.info["shape"][1] == features
    assert ("rotations were fitted to joints, with a mean error" in capsys.readouterr().out) == (
        motion == "smpl"
    )
    representation = instantiate(
        compose_data("folder", [f"representation={name}"])["representation"]
    )
    clips = {
        clip.id: representation.decode(torch.from_numpy(np.array(store.motion(clip))))
        for clip in store.clips
    }
    for clip, joints in clips.items():
        with subtests.test(clip=clip):
            head, pelvis = joints[:, representation.skeleton.joints.index("head")], joints[:, 0]
            assert (head - pelvis)[:, 1].mean() > 0.3, "it stands"

    other = "joints" if motion == "smpl" else "smpl"
    for check in ("check=true", "check=false"):
        with subtests.test(check=check):
            root = f"data_root={tmp_path / 'other'}"
            assert (
                main(
                    ["prepare", *words[:2], root, *words[3:], check, f"data.source.motion={other}"]
                )
                == 1
            )
            assert "data.source.motion=smpl" in one_error(capsys)


def test_missing_splits_are_filled_with_the_sources_of_the_highest_hashes():
    names = [f"walk {number}" for number in range(200)]
    training = [name for name in names if hashed_split(name, val=5, test=10) == "train"]
    first, second, *_ = sorted(training[:10], key=name_hash, reverse=True)
    splits = drawn_splits({name: name for name in training[:10]}, dict.fromkeys(training[:10]))
    others = set(training[:10]) - {first, second}
    assert splits == dict.fromkeys(others, "train") | {first: "val", second: "test"}
    splits = drawn_splits({name: name for name in training[:9]}, dict.fromkeys(training[:9]))
    assert set(splits.values()) == {"train"}


def test_motions_of_one_source_are_used_for_training():
    for source in ("walk 1", *(f"take {number}" for number in range(20))):
        motions = [f"{number}" for number in range(12)]
        splits = drawn_splits(dict.fromkeys(motions, source), dict.fromkeys(motions))
        assert set(splits.values()) == {"train"}


def test_a_stated_split_holds_for_all_motions_of_the_source():
    sources = {"a": "one", "b": "one", "c": "two", "d": "three"}
    splits = drawn_splits(sources, {"a": "test", "b": None, "c": "val", "d": None})
    assert splits == {"a": "test", "b": "test", "c": "val", "d": "train"}


def test_the_error_of_fitted_rotations_is_rounded_up_to_centimeters(tmp_path: Path, monkeypatch):
    np.savez(tmp_path / "a.npz", joints=WALK, fps=30)
    motion = torch.ones(30, 75, dtype=torch.float64)
    note = "rotations were fitted to joints, on the body of an adult"
    for error, centimeters in ((0.0301, 4), (0.03, 3), (0.001, 1), (0.25, 25)):
        fitted = SimpleNamespace(values=motion, note=note, error=error)
        monkeypatch.setattr(folder_reader, "raw_motion", lambda *_, fitted=fitted: fitted)
        attempt = folder_reader._read(
            "smpl", SMPL(), 20.0, folder_reader.MotionFile(tmp_path / "a.npz")
        )
        expected = f"rotations were fitted to joints, with a mean error of at most {centimeters} cm"
        assert attempt.notes[-1] == expected
        assert (attempt.motion.dtype, attempt.motion.shape) == (np.float32, (30, 75))


@pytest.mark.parametrize(("frames", "is_read"), [(2, False), (3, True)])
def test_a_motion_has_at_least_three_frames_at_the_rate_of_the_model(
    tmp_path: Path, frames: int, is_read: bool
):
    np.savez(tmp_path / "a.npz", joints=WALK[:frames], fps=30)
    attempt = folder_reader._read(
        "joints", None, 30.0, folder_reader.MotionFile(tmp_path / "a.npz")
    )
    assert (len(attempt.motion) == frames) == is_read
    assert (f"only {frames} frames at 30 fps" in attempt.error) != is_read
    attempt = folder_reader._read(
        "joints", None, 10.0, folder_reader.MotionFile(tmp_path / "a.npz")
    )
    assert "only 1 frames at 10 fps" in attempt.error


def test_files_that_are_newer_than_the_store_have_changed(tmp_path: Path):
    mine, store = tmp_path / "mine", tmp_path / "store.json"
    (mine / "deep").mkdir(parents=True)
    for number, path in enumerate((mine / "b.npz", store, mine / "deep" / "a.txt")):
        path.touch()
        os.utime(path, (1000 + number // 2, 1000 + number // 2))
    source = Folder(str(mine))
    (line,) = source.changed(store)
    assert line.startswith(f"{mine}: deep/a.txt changed since the data set was prepared")
    os.utime(store, (1001, 1001))
    assert source.changed(store) == []


def test_captions_of_the_table_precede_those_of_the_text_file(tmp_path: Path):
    for name in ("a", "b"):
        np.savez(tmp_path / f"{name}.npz", joints=WALK, fps=30)
    rows = [("a", "one "), ("b", "other"), ("a", " two")]
    write_table(tmp_path, [{"id": name, "text": text, "source": " take"} for name, text in rows])
    (tmp_path / "a.txt").write_text(" three # 3 \n#four\n\nfive")
    source = Folder(str(tmp_path))
    assert source.notes["a"].texts == ["one", "two", "three", "five"]
    assert source.notes["b"].texts == ["other"]
    assert [clip.source for clip in source.clips(20.0)] == ["take", "take"]


def test_reading_a_folder_again_reports_each_motion_once(tmp_path: Path):
    for name in "ab":
        np.savez(tmp_path / f"{name}.npz", joints=WALK, fps=30)
    (tmp_path / "c.bvh").write_text("HIERARCHY\n")
    source = Folder(str(tmp_path))
    for _ in range(2):
        assert [clip.id for clip in source.clips(20.0)] == ["a", "b"]
        assert source.findings() == ["SMPL, unit 1, 30 fps: 2 motions"]
        assert len(source.failures) == 1
    assert source.failure_lines()[-1].startswith("error: 1 of 3 motions in ")


def test_mirror_images_have_the_joints_of_the_representation(tmp_path: Path):
    np.savez(tmp_path / "a.npz", joints=WALK, fps=30)
    kit = HumanML("kit21", "legacy", fps=12.5, units_per_metre=640)
    for representation, skeleton in ((kit, KIT21), (HumanML(), SMPL22)):
        source = Folder(str(tmp_path), mirror=True)
        source.suit(representation)
        original, image = source.clips(representation.fps)
        assert (original.id, image.id) == ("a", "Ma")
        expected = skeleton.mirror(torch.from_numpy(original.motion)).numpy()
        assert expected.shape[1:] == (len(skeleton.joints), 3)
        np.testing.assert_array_equal(image.motion, expected)


def test_motions_of_each_split_are_counted_and_the_first_failure_is_named(tmp_path: Path):
    splits = {"a": "train", "b": "train", "c": "test"}
    for name in splits:
        np.savez(tmp_path / f"{name}.npz", joints=WALK, fps=30)
    write_table(tmp_path, [{"id": name, "split": split} for name, split in splits.items()])
    source = Folder(str(tmp_path), mirror=True)
    source.name = "mine"
    *_, line = source.check(20.0)
    assert line == "mine: 5 clips can be prepared (motions: 2 train, 0 val, 1 test)"
    source.failures = ["a.bvh: damaged", "b.bvh: damaged", "c.bvh: damaged"]
    with pytest.raises(UserError, match=r"^a\.bvh: damaged \(and 2 more\)$"):
        source.require_all()
    source.failures = ["a.bvh: damaged"]
    with pytest.raises(UserError, match=r"^a\.bvh: damaged$"):
        source.require_all()


@pytest.mark.parametrize(
    ("values", "is_refused"),
    [([0.9, 0.9, -3.0], False), ([0.9, -0.9, -0.9], True), ([0.9, 0.9, -9.0, 0.9], False)],
)
def test_some_motions_may_show_a_body_that_lies(values: list[float], is_refused: bool):
    if not is_refused:
        folder_reader._check_upright(Path("x"), {"SMPL": values})
        return
    with pytest.raises(UserError, match=r"lying down in most motions \(SMPL\)"):
        folder_reader._check_upright(Path("x"), {"BVH": [0.9] * 9, "SMPL": values})
