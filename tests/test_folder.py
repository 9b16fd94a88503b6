"""Own motions and captions, in every kind of file that the documentation names."""

import csv
import json
import os
import re
import shlex
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import ROOT

from flame_mdm.__main__ import main
from flame_mdm.data import hashed_split, store
from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.layouts import LAYOUTS, read_skeleton
from flame_mdm.formats.readers import read
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.representations.smpl import ADULT, SMPL
from flame_mdm.sampling.reading import read_motion

WALK = next(c for c in Synthetic(clips=30).clips(30.0) if c.attributes["action"] == "walk").motion.astype(float)
"""(F, 22, 3) metres, y up, 30 frames a second."""
AT_20 = np.floor((len(WALK) - 1) * 20 / 30 + 1e-6) + 1


def only(folder: Path, fps: float = 30.0, **options) -> np.ndarray:
    (clip,) = Folder(str(folder), **options).clips(fps)
    return clip.motion


def skeleton(folder: Path, text: str) -> None:
    (folder / "skeleton.yaml").write_text(text)


@pytest.fixture
def arrays(tmp_path: Path) -> Path:
    """Three motions in the three kinds of arrays, with captions in text files."""
    np.save(tmp_path / "one.npy", WALK)
    (tmp_path / "deep").mkdir()
    np.savez(tmp_path / "deep" / "two.npz", joints=WALK[:50].astype(np.float32), fps=30)
    rest = [(0.0, 0.0, 0.0)] * 51
    poses = np.tile(np.array([(np.pi / 2, 0, 0), *rest]).reshape(1, 156), (60, 1))
    np.savez(tmp_path / "three.npz", poses=poses, trans=np.linspace((0, 0, 1), (1, 0, 1), 60), mocap_framerate=60.0)
    skeleton(tmp_path, "fps: 30\n")
    for name in ("one", "deep/two", "three"):
        (tmp_path / f"{name}.txt").write_text("a person walks\nsomeone goes ahead#someone/NOUN#0.0#0.0\n\n")
    return tmp_path


def test_arrays_and_text_files(arrays: Path):
    source = Folder(str(arrays))
    clips = {clip.id: clip for clip in source.clips(20.0)}
    assert list(clips) == ["deep_two", "one", "three"]
    assert source.count() == 3
    assert all(clip.captions == ["a person walks", "someone goes ahead"] for clip in clips.values())
    assert len(clips["one"].motion) == AT_20
    np.testing.assert_allclose(clips["one"].motion[::2], WALK[::3][: len(clips["one"].motion[::2])], atol=1e-6)
    amass = clips["three"].motion
    assert amass.shape == (20, 22, 3)
    at = dict(zip(SMPL22.joints, amass[-1], strict=True))
    assert at["head"][1] > at["pelvis"][1] > at["left_foot"][1]
    np.testing.assert_allclose(at["pelvis"], [-57 / 59 - ADULT[0][0], 1, 0], atol=1e-5)


def test_smpl_rotations_are_kept(tmp_path: Path):
    rng = np.random.default_rng(0)
    turns = np.cumsum(0.1 * rng.normal(size=(31, 52, 3)), 0)
    np.savez(tmp_path / "x.npz", poses=turns.reshape(31, 156), trans=rng.normal(size=(31, 3)), mocap_framerate=120)
    motion = only(tmp_path, 60.0, motion="smpl")
    assert motion.shape == (16, 75)
    expected = SMPL().encode(torch.from_numpy(motion))
    with np.load(tmp_path / "x.npz") as file:
        same = SMPL().encode(torch.from_numpy(np.concatenate([file["trans"], file["poses"]], 1)[::2]))
    np.testing.assert_allclose(expected.numpy(), same.numpy(), atol=1e-5)


def bvh_of(names: tuple[str, ...], positions: np.ndarray, parents: tuple[int, ...], fps: float) -> bvh.Bvh:
    """A file in which every joint has position channels, so that it shows these positions."""
    local = positions.copy()
    for joint, parent in enumerate(parents):
        if parent >= 0:
            local[:, joint] -= positions[:, parent]
    channels = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    frames = np.concatenate([local, np.zeros_like(local)], 2).reshape(len(local), -1)
    size = len(names)
    return bvh.Bvh(names, parents, np.zeros((size, 3)), (channels,) * size, (), np.zeros((0, 3)), frames, fps)


@pytest.mark.parametrize("name", LAYOUTS)
@pytest.mark.parametrize("prefix", ["", "mixamorig:", "mixamorig_", "mixamorig1_"])
def test_known_skeletons_are_recognized(name: str, prefix: str, tmp_path: Path):
    """Joints that a skeleton has itself come out where they are; the blended ones lie between them."""
    layout = LAYOUTS[name]
    own = {place: joint for joint, place in layout.map.items() if isinstance(place, str)}
    own |= {next(iter(p)): j for j, p in layout.map.items() if not isinstance(p, str) and len(p) == 1}
    blended = {j for j, p in layout.map.items() if not isinstance(p, str) and len(p) > 1}
    extra = {n for p in layout.map.values() if not isinstance(p, str) for n in p} - set(own)
    names = [*own, *sorted(extra)]
    number = {joint: k for k, joint in enumerate(SMPL22.joints)}
    place = [number[own[n]] if n in own else number["spine3"] for n in names]
    unit = 0.01 if name in ("SMPL", "SOMA") else layout.unit
    positions = WALK[:, place] / unit * [-1 if layout.mirrored else 1, 1, 1]
    names = tuple(prefix + n for n in names)
    bvh.write(bvh_of(names, positions, (-1, *(0 for _ in names[1:])), 30.0), tmp_path / "take.bvh")
    (tmp_path / "captions.csv").write_text("id,text\ntake,a person walks\n")
    found = only(tmp_path)
    exact = [k for joint, k in number.items() if joint not in blended]
    np.testing.assert_allclose(found[:, exact], WALK[:, exact], atol=1e-4)
    for joint in blended:
        assert np.abs(found[:, number[joint]] - WALK[:, number[joint]]).max() < 0.25, joint


def turning(path: Path) -> Path:
    """A stiff body that turns fast, so that straight lines between positions would shorten its bones."""
    offsets = WALK[0].copy() * 100
    for joint, parent in enumerate(SMPL22.parents):
        if parent >= 0:
            offsets[joint] -= WALK[0, parent] * 100
    names = dict(LAYOUTS["Mixamo"].map)
    joints = tuple(n if isinstance(n, str) else next(iter(n)) for n in (names[j] for j in SMPL22.joints))
    root = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    frames = np.zeros((40, 6 + 3 * 21))
    frames[:, :3] = WALK[0, 0] * 100
    frames[:, 5] = np.arange(40) * 40.0
    channels = (root, *[root[3:]] * 21)
    bvh.write(bvh.Bvh(joints, SMPL22.parents, offsets, channels, (), np.zeros((0, 3)), frames, 30.0), path)
    return path


def test_a_skeleton_file_maps_any_joints(tmp_path: Path):
    """Centimetres, z up, joints in another order with names of their own."""
    order = np.random.default_rng(0).permutation(22)
    turned = WALK[:, order][..., [0, 2, 1]] * [100, -100, 100]  # y up -> z up
    np.save(tmp_path / "x.npy", turned)
    names = [f"bone {SMPL22.joints[k]}" for k in order]
    places = {joint: f"bone {joint}" for joint in SMPL22.joints}
    lines = ["fps: 30", "unit: 0.01", "up: z", f"joints: {json.dumps(names)}", f"map: {json.dumps(places)}"]
    skeleton(tmp_path, "\n".join(lines))
    np.testing.assert_allclose(only(tmp_path), WALK, atol=1e-5)


def write_table(folder: Path, rows: list[dict], kind: str) -> None:
    if kind == "csv":
        with (folder / "captions.csv").open("w", newline="") as file:
            writer = csv.DictWriter(file, ["id", "text", "action", "split", "source"])
            writer.writeheader()
            writer.writerows(rows)
        return
    content: dict[str, dict] = {}
    for row in rows:
        entry = content.setdefault(row["id"], {**row, "text": []})
        entry.pop("id", None)
        entry["text"].append(row["text"])
    (folder / "captions.json").write_text(json.dumps(content))


@pytest.mark.parametrize("kind", ["csv", "json"])
def test_tables_give_captions_actions_splits_and_sources(kind: str, tmp_path: Path):
    rows = []
    for k in range(12):
        np.savez(tmp_path / f"{k:02d}.npz", joints=WALK + 0.01 * k, fps=30)
        where = {"action": ("turn left", "turn right", "walk")[k % 3], "split": "val" if k == 11 else "train"}
        rows += [{"id": f"{k:02d}", "text": text, **where, "source": f"take {k // 2 if k < 10 else k}"}
                 for text in ("turns Left, clockwise", "is bright")]  # fmt: skip
    write_table(tmp_path, rows, kind)
    data = MotionDataModule(
        Folder(str(tmp_path), mirror=True),
        HumanML(),
        root=str(tmp_path / "stores"),
        name="mine",
        batch_size=4,
        crop=Units(24, 60, 4),
    )
    data.prepare_data()
    data.setup("fit")
    assert data.store.info["actions"] == ["turn left", "turn right", "walk"]
    assert data.store.info["clips"] == {"train": 22, "val": 1, "test": 0}
    clips = {clip.id: clip for clip in data.store.clips}
    assert data.source.count() == len(clips)
    assert clips["00"].captions == ["turns Left, clockwise", "is bright"]
    assert clips["M00"].captions == ["turns Right, counterclockwise", "is bright"]
    assert [clips[i].action for i in ("00", "M00", "02", "M02")] == [0, 1, 2, 2]
    assert clips["00"].source == clips["M00"].source == clips["01"].source == "take 0"
    batch = next(iter(data.train_dataloader()))
    assert batch.x.shape[0::2] == (4, 263)
    assert batch.action is not None
    assert batch.text is not None


MAP = json.dumps({joint: f"{joint}?" for joint in SMPL22.joints})
BAD = {
    "no motion": (lambda f: [p.unlink() for p in f.rglob("*.np*")], "no motion in it; give a folder"),
    "twice": (lambda f: np.savez(f / "one.npz", joints=WALK, fps=30), r"one\.npz: has the same name as one\.npy"),
    "no caption": (lambda f: (f / "one.txt").unlink(), "1 of 3 motions have no caption, such as one"),
    "unknown id": (lambda f: (f / "captions.csv").write_text("id,text\nonce,a\n"), r"captions\.csv, line 2: .*'once'"),
    "cells": (lambda f: (f / "captions.csv").write_text("id,text\none,a, b\n"), r"line 2: not one cell per column"),
    "json": (lambda f: (f / "captions.json").write_text("{"), r"captions\.json: not a JSON file"),
    "two splits": (
        lambda f: (f / "captions.csv").write_text("id,split\none,val\none,test\n"),
        "line 3: one has two values of split: val and test",
    ),
    "no rate": (lambda f: (f / "skeleton.yaml").unlink(), r"one\.npy: no frame rate in the file"),
    "cut": (lambda f: (f / "one.npy").write_bytes((f / "one.npy").read_bytes()[:900]), r"one\.npy: damaged"),
    "23 joints": (lambda f: np.save(f / "one.npy", np.zeros((9, 23, 3))), r"one\.npy: 23 joints, not the 22, 24 or 52"),
    "nan": (lambda f: np.save(f / "one.npy", WALK * np.nan), r"one\.npy: numbers of joints in frame 0 are not finite"),
    "unit": (
        lambda f: np.save(f / "one.npy", WALK * 100),
        r"one\.npy: the legs are 8\d.* m long .* be 0\.01 \(cent",
    ),
    "sides": (lambda f: np.save(f / "one.npy", WALK * [-1, 1, 1]), r"one\.npy: the toes point backwards"),
    "up": (
        lambda f: np.savez(f / "deep/two.npz", joints=WALK[..., [0, 2, 1]] * [1, -1, 1], fps=9),
        "the body is lying down",
    ),
    "yaml key": (lambda f: skeleton(f, "rate: 30"), r"skeleton\.yaml: unknown key rate; use map, joints"),
    "yaml map": (lambda f: skeleton(f, "map: {pelvis: Hips}"), r"skeleton\.yaml: map: no joint given for head"),
    "other map": (
        lambda f: skeleton(f, f"fps: 30\nmap: {MAP}"),
        r"two\.npz: the map in skeleton\.yaml uses .* head\?",
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_every_fault_is_named_in_a_line(case: str, arrays: Path):
    damage, message = BAD[case]
    if case == "up":
        for name in ("one.npy", "three.npz"):
            (arrays / name).unlink()
    damage(arrays)
    with pytest.raises((ValueError, UserError, FileNotFoundError), match=message) as error:
        list(Folder(str(arrays)).clips(30.0))
    assert "\n" not in str(error.value)
    assert str(arrays) in str(error.value)


def test_missing_joints_are_named_first(tmp_path: Path):
    file = turning(tmp_path / "a.bvh")
    file.write_text(file.read_text().replace("Spine2", "Back"))
    with pytest.raises(
        ValueError, match=r"a\.bvh: unknown skeleton\. Mixamo is the nearest known one; missing: Spine2\."
    ):
        only(tmp_path)


def test_motions_are_excluded_by_name(arrays: Path):
    (arrays / "one.npy").write_bytes(b"")
    source = Folder(str(arrays), exclude=["one"])
    assert [clip.id for clip in source.clips(20.0)] == ["deep_two", "three"]
    assert source.excluded == {"motions by data.source.exclude": 1}
    with pytest.raises(ValueError, match="has no won"):
        Folder(str(arrays), exclude=["won"]).count()
    with pytest.raises(ValueError, match=r"one\.npy: damaged"):
        write_store(arrays / "store", Folder(str(arrays)), HumanML())
    with pytest.raises(ValueError, match=r"deep/two\.npz: contains no SMPL rotations"):
        list(Folder(str(arrays), motion="smpl").clips(20.0))


def mixamo(path: Path, scale: float = 1.0, prefix: str = "", toes: float = 1.0) -> Path:
    """Writes the stiff body of `turning` in another unit, with end sites below the feet in place of toes if wanted."""
    path.parent.mkdir(parents=True, exist_ok=True)
    body = bvh.read(turning(path))
    names = [prefix + name for name in body.joints]
    keep = [k for k, name in enumerate(names) if toes == 1 or "Toe" not in name]
    ends = [k for k in range(len(names)) if k not in keep]
    columns = np.r_[tuple(body.columns()[k] for k in keep)]
    frames = body.frames[:, columns] * np.r_[np.full(3, scale), np.ones(len(columns) - 3)]
    made = bvh.Bvh(
        tuple(names[k] for k in keep),
        tuple(keep.index(body.parents[k]) if k else -1 for k in keep),
        body.offsets[keep] * scale,
        tuple(body.channels[k] for k in keep),
        tuple(keep.index(body.parents[k]) for k in ends),
        body.offsets[ends].reshape(-1, 3) * scale * toes,
        frames,
        30.0,
    )
    bvh.write(made, path)
    return path


INCH = 1 / 2.54


def test_wrong_units_are_refused_with_the_unit_that_fits(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    mixamo(tmp_path / "mine" / "a.bvh", INCH)
    message = r"a\.bvh: the legs are 0\.3\d+ m long .*The unit may be 0\.0254 \(inches\): set `unit: 0\.0254`"
    with pytest.raises(ValueError, match=message):
        only(tmp_path / "mine")
    assert main(["convert", "mine/a.bvh", "out=a.glb"]) == 1
    assert re.search(message, capsys.readouterr().err)
    assert main(["convert", "mine/a.bvh", "out=a.bvh"]) == 0, "a copy keeps its proportions"
    assert "adults have legs of 0.6 to 1.2 m" in capsys.readouterr().out
    assert main(["convert", "mine/a.bvh", "out=a.glb", "unit=0.0254"]) == 0
    skeleton(tmp_path / "mine", "children: true\n")
    assert only(tmp_path / "mine").shape[1:] == (22, 3)
    skeleton(tmp_path / "mine", "unit: 0.0254\n")
    assert only(tmp_path / "mine").shape[1:] == (22, 3)


def test_convert_and_edit_read_files_as_prepare_does(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    mixamo(tmp_path / "mine" / "deep" / "a.bvh", INCH)
    skeleton(tmp_path / "mine", "unit: 0.0254\nup: z\n")
    assert main(["convert", "mine/deep/a.bvh", "out=a.npy"]) == 0
    np.testing.assert_allclose(np.load("a.npy"), next(Folder("mine").clips(30.0)).motion, atol=1e-5)
    assert main(["convert", "mine/deep/a.bvh", "out=b.npy", "up=y"]) == 0
    np.testing.assert_allclose(np.load("b.npy")[..., 2], np.load("a.npy")[..., 1], atol=1e-5)
    skeleton(tmp_path / "mine", "unit: 0.0254\n")
    edited = read_motion(HumanML(), "mine/deep/a.bvh").joints
    np.testing.assert_allclose(np.ptp(edited[0, :, 1]), np.ptp(np.load("b.npy")[0, :, 1]), atol=1e-3)
    assert np.ptp(read_motion(HumanML(), "mine/deep/a.bvh", up="z").joints[0, :, 1]) < 0.6, "it lies"

    np.savez("mine/made.npz", joints=WALK, fps=30, text="a person walks")
    assert main(["convert", "mine/made.npz", "out=made.npy"]) == 0, "motions made by this project are in meters, y up"
    np.testing.assert_allclose(np.load("made.npy"), WALK, atol=1e-6)


def test_the_nearest_skeleton_file_applies(tmp_path: Path):
    mixamo(tmp_path / "a" / "x.bvh")
    mixamo(tmp_path / "b" / "deep" / "y.bvh", INCH, "theirs_")
    places = {
        joint: f"theirs_{next(iter(p)) if isinstance(p, dict) else p}" for joint, p in LAYOUTS["Mixamo"].map.items()
    }
    skeleton(tmp_path / "b", f"unit: 0.0254\nmap: {json.dumps(places)}\n")
    source = Folder(str(tmp_path))
    one, two = source.clips(30.0)
    np.testing.assert_allclose(one.motion, two.motion, atol=1e-4)
    assert len(source.findings()) == 2
    assert "own map, unit 0.0254, 30 fps (" in source.findings()[1]


def test_feet_without_toes_end_at_the_end_sites(tmp_path: Path):
    mixamo(tmp_path / "a.bvh", toes=1.0)
    mixamo(tmp_path / "b.bvh", toes=0.999)
    places = {j: next(iter(p)) if isinstance(p, dict) else p for j, p in LAYOUTS["Mixamo"].map.items()}
    whole, ends = (clip.motion for clip in Folder(str(tmp_path)).clips(30.0))
    np.testing.assert_allclose(whole, ends, atol=1e-3)
    places |= {"left_foot": "LeftFoot.end", "right_foot": "RightFoot.end"}
    (tmp_path / "a.bvh").unlink()
    skeleton(tmp_path, f"unit: 0.01\nmap: {json.dumps(places)}\n")
    np.testing.assert_allclose(only(tmp_path), ends, atol=1e-6)
    places |= {"left_foot": "LeftFoot"}
    skeleton(tmp_path, f"unit: 0.01\nmap: {json.dumps(places)}\n")
    with pytest.raises(ValueError, match=r"b\.bvh: the left foot has no length"):
        only(tmp_path)


def test_arrays_of_kimodo_are_known(tmp_path: Path):
    layout = LAYOUTS["SOMA"]
    joints = np.zeros((len(WALK), 77, 3))
    for joint, place in layout.map.items():
        (name,) = [place] if isinstance(place, str) else place
        joints[:, LAYOUTS["SOMA"].joints.index(name)] = WALK[:, SMPL22.joints.index(joint)]
    np.savez(tmp_path / "a.npz", posed_joints=joints, root_positions=joints[:, 0])
    np.testing.assert_allclose(only(tmp_path), WALK, atol=1e-5)
    np.testing.assert_allclose(read(tmp_path / "a.npz").joints, WALK, atol=1e-5)


def test_check_lists_skeletons_and_all_failures(tmp_path: Path):
    mixamo(tmp_path / "a.bvh")
    mixamo(tmp_path / "b.bvh", INCH)
    mixamo(tmp_path / "c.bvh", INCH)
    (tmp_path / "d.bvh").write_text("HIERARCHY\n")
    lines = Folder(str(tmp_path)).check()
    assert re.fullmatch(
        r"Mixamo, unit 0\.01, 30 fps: 1 motion, 40 frames, 1\.3 s, legs 0\.8\d m, head joint at 1\.\d\d m", lines[0]
    )
    assert re.match(r"error: .*b\.bvh and 1 more: the legs are", lines[1])
    assert re.match(r"error: .*d\.bvh, line 1: ", lines[2])
    assert re.fullmatch(r"error: 3 of 4 motions of .* cannot be prepared", lines[3])


def write_amass(path: Path, frames: int = 90, width: int = 156) -> None:
    poses, trans = np.zeros((frames, width)), np.tile([0.0, 0.0, 0.9], (frames, 1))
    poses[:, 0] = np.pi / 2
    np.savez_compressed(path, poses=poses, trans=trans, betas=np.zeros(16), gender="male", mocap_framerate=60.0)


def test_check_reads_headers_only(tmp_path: Path):
    long = mixamo(tmp_path / "long.bvh")
    body = bvh.read(long)
    bvh.write(replace(body, frames=np.tile(body.frames, (50, 1))), long)
    text = long.read_text().splitlines()
    assert len("\n".join(text)) > 2 * bvh.HEADER
    long.write_text("\n".join([*text[:-1], "not a number"]) + "\n")
    write_amass(tmp_path / "amass.npz")
    np.savez_compressed(
        tmp_path / "walk.npz", joints=np.where(np.arange(len(WALK))[:, None, None], np.nan, WALK), fps=30
    )
    torn = tmp_path / "torn.npz"
    np.savez_compressed(torn, joints=WALK + 1e-3 * np.random.default_rng(0).normal(size=WALK.shape), fps=30)
    content = bytearray(torn.read_bytes())
    content[len(content) // 2] ^= 255
    torn.write_bytes(content)
    lines = Folder(str(tmp_path)).check()
    assert lines[0] == "AMASS, SMPL+H, 60 fps: 1 motion, 90 frames, 1.5 s"
    assert lines[1].startswith("Mixamo, unit 0.01, 30 fps: 1 motion, 2,000 frames, 66.7 s, legs 0.8")
    assert lines[2].startswith(f"SMPL, unit 1, 30 fps: 2 motions, {2 * len(WALK)} frames, ")
    assert len(lines) == 4, lines
    with pytest.raises(ValueError, match=r"long\.bvh, line \d+: could not convert"):
        only(tmp_path, exclude=["amass", "torn", "walk"])
    with pytest.raises(ValueError, match=r"torn\.npz: damaged"):
        only(tmp_path, exclude=["amass", "long", "walk"])
    with pytest.raises(ValueError, match=r"walk\.npz: numbers of joints in frame 1 are not finite"):
        only(tmp_path, exclude=["amass", "long", "torn"])
    long.write_text("\n".join(text[:-1200]) + "\n")
    assert re.match(
        r"error: .*long\.bvh, line \d+: the file ends after 800 frames, but must", Folder(str(tmp_path)).check()[2]
    )


def test_a_first_frame_in_an_unusual_pose_is_not_an_error(tmp_path: Path):
    motion = WALK.copy()
    for side in ("left", "right"):  # as when kneeling
        ankle, foot = (SMPL22.joints.index(f"{side}_{name}") for name in ("ankle", "foot"))
        motion[0, foot] = 2 * motion[0, ankle] - motion[0, foot]
    np.savez(tmp_path / "a.npz", joints=motion, fps=30)
    assert Folder(str(tmp_path)).check()[0].startswith("SMPL, unit 1, 30 fps: 1 motion, ")
    np.savez(tmp_path / "a.npz", joints=np.tile(motion[:1], (30, 1, 1)), fps=30)
    assert "the toes point backwards" in Folder(str(tmp_path)).check()[0]


def test_the_store_does_not_depend_on_the_number_of_workers(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    place = tmp_path / "mine"
    for number, inch in enumerate((1, INCH, 1)):
        mixamo(place / f"{number}" / "a.bvh", inch)
    skeleton(place / "1", "unit: 0.0254\n")
    write_amass(place / "b.npz")
    monkeypatch.setattr(store, "CHUNK", 60)
    first, second = (
        write_store(tmp_path / f"{workers}", Folder(str(place), mirror=True, workers=workers), HumanML()).folder
        for workers in (1, 2)
    )
    assert [path.read_bytes() for path in sorted(first.iterdir())] == [
        path.read_bytes() for path in sorted(second.iterdir())
    ]
    (place / "2" / "a.bvh").write_text("HIERARCHY\n")
    with pytest.raises(ValueError, match=r"2/a\.bvh, line 1: "):
        write_store(tmp_path / "none", Folder(str(place), workers=2), HumanML())


@pytest.mark.parametrize("motions", [10, 12, 15, 20])
def test_from_ten_motions_on_each_split_has_some(motions: int, tmp_path: Path):
    for begin in range(6):
        folder = tmp_path / str(begin)
        folder.mkdir()
        for number in range(motions):
            np.savez(folder / f"walk_{begin}_{number}.npz", joints=WALK[:30], fps=30)
        splits = Folder(str(folder)).splits
        hashed = {name: hashed_split(name, val=5, test=10) for name in splits}
        assert set(splits.values()) == {"train", "val", "test"}
        if set(hashed.values()) == {"train", "val", "test"}:
            assert splits == hashed
        assert sum(splits[name] != hashed[name] for name in splits) <= 2
        rows = [{"id": name, "text": "a", "source": f"take {number % 4}"} for number, name in enumerate(splits)]
        write_table(folder, rows, "json")
        taken = Folder(str(folder))
        of_source = {(taken.notes[name].source, split) for name, split in taken.splits.items()}
        assert len(of_source) == 4, "a source stays in one split"
        assert len({split for _, split in of_source}) == 3


def test_what_a_folder_lacks_is_said(tmp_path: Path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for number in range(10):
        np.savez(f"mine/{number}.npz", joints=WALK[:20], fps=20)
    words = ["prepare", "data=folder", "data.name=mine", "data_root=data", "source=mine"]
    assert main(words) == 0
    said = capsys.readouterr().out
    assert Store(tmp_path / "data" / "mine-humanml-clean-smpl22").info["dataset"] == "mine"
    assert "all train clips are too short: lower data.crop.min_frames" in said
    assert "no captions: add captions.csv and prepare again with force=true" in said
    assert main(words) == 0
    assert "changed since" not in capsys.readouterr().out
    write_table(tmp_path / "mine", [{"id": str(n), "text": "walks"} for n in range(10)], "csv")
    future = time.time() + 10
    os.utime(tmp_path / "mine" / "captions.csv", (future, future))
    assert main(words) == 0
    assert "mine: captions.csv changed since: prepare with force=true to read them" in capsys.readouterr().out
    assert main([*words, "force=true"]) == 0
    said = capsys.readouterr().out
    assert "changed since" not in said
    assert "no captions" not in said


QUICK = [
    "trainer.max_steps=3",
    "trainer.val_check_interval=3",
    "trainer.enable_progress_bar=false",
    "trainer.accelerator=cpu",
    "data.num_workers=0",
    "callbacks.samples.every_n_steps=100",
    "denoiser.num_layers=1",
    "task.num_inference_steps=2",
]
"""What makes the training of the tutorial short."""
MODEL = QUICK.index("callbacks.samples.every_n_steps=100")
"""Index of the first key that a feature extractor does not have."""


def make(line: str, environment: pytest.MonkeyPatch) -> int:
    """Runs a make command as make does: variables are handed down in MAKEFLAGS, latest first."""
    _, target, *variables = shlex.split(line)
    model = target == "train" and not variables[0].startswith("EXP=motion_clip")
    variables += QUICK[:MODEL] if target == "train" and not model else QUICK if model else []
    variables += ["quick=true"] if target == "evaluate" else []
    escaped = (re.sub(r"([\\ ])", r"\\\1", word).replace("$", "$$") for word in reversed(variables))
    environment.setenv("MAKEFLAGS", f" -- {' '.join(escaped)}")
    return main([target, "--from-make"])


@pytest.mark.slow
def test_the_tutorial_works_as_it_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Runs the code blocks of the documentation in their order, in an empty folder."""
    text = (ROOT / "docs" / "own-data.md").read_text()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("FLAME_MDM_DATA", str(tmp_path / "data"))
    ran = 0
    for language, block in re.findall(r"```(\w+)\n(.*?)```", text, re.DOTALL):
        if language == "python":
            exec(block, {})
        elif language == "yaml":
            Path(re.findall(r"# (\S+\.yaml)", block)[0]).write_text(block)
        else:
            for line in block.splitlines():
                assert make(line, monkeypatch) == 0, capsys.readouterr()
                ran += 1
    assert ran == 6
    output = capsys.readouterr().out
    assert "40 clips can be prepared (motions: " in output
    assert "not computed: " in output
    assert output.count("\nclips: ") == 3, "of preparation and two trainings"
    assert "mine as humanml-clean-smpl22 at 20 fps" in output
    assert list(tmp_path.glob("samples/mine/*/*/*.html"))
    assert set(read_skeleton(tmp_path / "mine" / "skeleton.yaml")["map"]) == set(SMPL22.joints)
