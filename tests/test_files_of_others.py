"""Motion files of other programs: what is read, refused with a way out, left out or said, at every entrance."""

import json
import re
import shutil
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from inspect import signature
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.asf import write_amc, write_asf
from support.fixtures import SHARED
from support.glb import changed
from support.motions import posed, synthetic
from support.others import POINTER, TURNED, amass, swapped, walk, write_bvh

from flame_mdm.__main__ import main
from flame_mdm.data.adaptation import check_clips
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Store
from flame_mdm.errors import UserError
from flame_mdm.formats import ENDINGS, SCENES, checks, glb, motions_in
from flame_mdm.formats.layouts import UP, Layout, head_height
from flame_mdm.formats.motion import AMASS_AXES, Motion, amass_parameters, motion_of_poses
from flame_mdm.formats.readers import PELVIS, read, read_recording
from flame_mdm.representations import rotation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.sampling.reading import read_motion


def test_arrays_that_are_not_needed_are_never_opened(tmp_path: Path):
    parts = amass(walk())
    np.savez(tmp_path / "plain.npz", **parts)
    np.savez(
        tmp_path / "a_stageii.npz", **parts, markers_latent_vids=np.array({"a": 1}, dtype=object)
    )
    np.testing.assert_array_equal(
        read(tmp_path / "a_stageii.npz").joints, read(tmp_path / "plain.npz").joints
    )
    np.testing.assert_allclose(read(tmp_path / "plain.npz").joints, walk().joints, atol=1e-5)
    parts["poses"] = np.array([{}])
    np.savez(tmp_path / "b.npz", **parts)
    with pytest.raises(UserError, match="an array of Python objects"):
        read(tmp_path / "b.npz")


def test_shapes_are_read_by_their_layout_and_rates_of_one_element_are_rates(
    tmp_path: Path, subtests
):
    path, expected = tmp_path / "a.npz", walk().joints
    for numbers in (66, 72, 156, 165):
        with subtests.test(numbers=numbers):
            parts = amass(walk(), numbers=numbers)
            np.savez(path, **parts)
            np.testing.assert_allclose(read(path).joints, expected, atol=1e-5)
            np.savez(path, **(parts | {"poses": parts["poses"].reshape(len(expected), -1, 3)}))
            np.testing.assert_allclose(read(path).joints, expected, atol=1e-5)
    poses = parts.pop("poses")
    np.savez(path, root_orient=poses[:, :3], pose_body=poses[:, 3:66], **parts)
    np.testing.assert_allclose(read(path).joints, expected, atol=1e-5)
    for numbers, advice in (
        (216, "rotation matrices"),
        (144, "6D rotations"),
        (69, "expected 66, 72, 156, 165"),
    ):
        with subtests.test(numbers=numbers, advice=advice):
            np.savez(path, poses=np.zeros((40, numbers)), **parts)
            with pytest.raises(UserError, match=advice):
                read(path)
    np.savez(path, poses=poses, trans=parts["trans"], mocap_framerate=np.array([60.0]))
    assert read(path).fps == 60
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        halves: dict[str, Any] = {
            name: np.asarray(values, np.float16) for name, values in amass(walk()).items()
        }
        np.savez(path, **halves)
        np.testing.assert_allclose(read(path).joints, expected, atol=0.02)


KEYS: dict[str, Any] = {
    "unit": 0.02,
    "up": "z",
    "mirrored": True,
    "children": True,
    "joints": list(SMPL22.joints[::-1]),
    "map": {joint: joint for joint in SMPL22.joints} | {"spine2": "spine1"},
    "fps": 7.0,
}
KINDS = ("bvh", "npy", "json", "amc", "glb", "npz", "kimodo", "amass")
WITHOUT_RATE = ("npy", "amc")


def write_kind(kind: str, folder: Path) -> Path:
    """A file of a kind; it contains its frame rate, except `.npy` and `.amc`."""
    joints, path = walk().joints, folder / f"a.{kind if kind in KINDS[:5] else 'npz'}"
    if kind == "bvh":
        write_bvh(path, walk())
    elif kind == "amc":
        write_asf(folder / "a.asf")
        write_amc(path, 40)
    elif kind == "glb":
        walk().save(path, rig="mixamo")
    elif kind == "npz":
        np.savez(path, joints=joints, fps=20)
    elif kind == "npy":
        np.save(path, joints)
    elif kind == "json":
        path.write_text(json.dumps({"joints": joints.tolist(), "fps": 20}))
    elif kind == "kimodo":
        np.savez(path, posed_joints=joints)
    else:
        np.savez(path, **amass(walk()))
    return path


def outcome(path: Path, **keys: Any) -> tuple[str, Motion | None]:
    """The error's message, or the motion."""
    try:
        return "", read(path, **keys)
    except UserError as error:
        return str(error), None


@pytest.mark.parametrize(("key", "kind"), product(KEYS, KINDS))
def test_a_key_acts_or_is_refused(key: str, kind: str, tmp_path: Path):
    path = write_kind(kind, tmp_path)
    rate: dict[str, Any] = {"fps": 20} if kind in WITHOUT_RATE else {}
    before = read(path, **rate)
    skeleton = {key: KEYS[key]}
    if key == "map" and kind not in ("bvh", "amass", "amc", "glb"):
        skeleton["joints"] = list(SMPL22.joints)
    (tmp_path / "skeleton.yaml").write_text(json.dumps(skeleton))
    if key == "children":  # a permission, which acts on children
        small = 0.5 * walk().joints
        if kind == "npz":
            np.savez(path, joints=small, fps=20)
            assert head_height(read(path).joints) < 0.9
            return
        if kind != "amass":
            return
    if key == "fps" and kind in WITHOUT_RATE:
        assert read(path).fps == 7
        return
    if key == "fps":  # of files without a rate
        assert read(path).fps == before.fps
        return
    if (key, kind) == ("up", "amass"):  # z is up in AMASS
        (tmp_path / "skeleton.yaml").write_text("up: y")
    message, after = outcome(path, **rate)
    if after is None:
        assert any(word in message for word in (key, "unit", "toes", "legs")), message
    else:
        assert (
            after.joints.shape != before.joints.shape
            or np.abs(after.joints - before.joints).max() > 0.01
        )


GIVEN: dict[str, Any] = {"fps": 7.0, "unit": 0.02, "up": "z", "animation": "Walk"}


@pytest.mark.parametrize(("key", "kind"), product(GIVEN, KINDS))
def test_a_key_of_a_command_acts_or_is_refused(key: str, kind: str, tmp_path: Path):
    path = write_kind(kind, tmp_path)
    rate: dict[str, Any] = {"fps": 20} if kind in WITHOUT_RATE else {}
    before = read(path, **rate)
    value = "y" if (key, kind) == ("up", "amass") else GIVEN[key]  # z is up in AMASS
    message, after = outcome(path, **rate | {key: value})
    if after is None:
        assert any(word in message for word in (key, "unit", "legs")), message
    elif key == "fps":
        assert after.fps == 7
    else:
        assert key != "animation"
        assert np.abs(after.joints - before.joints).max() > 0.01


@pytest.mark.parametrize("key", sorted(GIVEN.keys() - {"fps"}))
def test_a_key_has_no_effect_on_files_of_this_project(key: str, tmp_path: Path):
    walk().save(tmp_path / "a.npz")
    with pytest.raises(UserError, match=f"{key}={GIVEN[key]} has no effect"):
        read(tmp_path / "a.npz", **{key: GIVEN[key]})
    (tmp_path / "skeleton.yaml").write_text(json.dumps({"up": "z"}))
    assert "skeleton.yaml does not apply" in read(tmp_path / "a.npz").notes[0]


def test_all_keys_and_all_kinds_of_files_are_tried():
    assert KEYS.keys() == Layout.model_fields.keys()
    assert GIVEN.keys() == signature(read).parameters.keys() - {"path", "resample_to"}
    assert {f".{kind}" for kind in KINDS} | set(SCENES) >= set(ENDINGS)


def test_up_of_commands_and_of_json_files_acts(tmp_path: Path, subtests):
    motion = walk()
    np.savez(tmp_path / "a.npz", **amass(motion, "y"))
    assert any("lying down" in note and "up=y" in note for note in read(tmp_path / "a.npz").notes)
    upright = read(tmp_path / "a.npz", up="y")
    assert not upright.notes
    assert head_height(upright.joints) == pytest.approx(head_height(motion.joints), abs=1e-4)
    assert np.median(upright.joints[..., 1].min(1)) == pytest.approx(0, abs=0.02), (
        "feet on the floor"
    )
    np.savez(tmp_path / "z.npz", **amass(motion, "z"))
    same = [
        read_recording(tmp_path / f"{name}.npz", up=up, as_smpl=True).smpl
        for name, up in (("a", "y"), ("z", None))
    ]
    for turned, usual in zip(*same, strict=True):  # type: ignore[arg-type]
        np.testing.assert_allclose(turned, usual, atol=1e-5)
    turned = motion.joints @ np.array(TURNED["z"], float).T
    content = {
        "joints": turned.tolist(),
        "fps": 20,
        "caption": "",
        "names": SMPL22.joints,
        "unit": "metre",
    }
    for stated, key in (({"up": "z"}, None), ({}, "z"), ({"up": "z"}, "z")):
        with subtests.test(stated=stated, key=key):
            (tmp_path / "a.json").write_text(json.dumps(content | stated))
            np.testing.assert_allclose(
                read(tmp_path / "a.json", up=key).joints, motion.joints, atol=1e-4
            )
    (tmp_path / "a.json").write_text(json.dumps(content | {"up": "down"}))
    with pytest.raises(UserError, match="up: down"):
        read(tmp_path / "a.json")
    motion.save(tmp_path / "ours.npz")
    with pytest.raises(UserError, match="up=z has no effect: the file was written by this package"):
        read(tmp_path / "ours.npz", up="z")


def test_every_entrance_checks_sides_size_and_orientation(tmp_path: Path, capsys, subtests):
    folder = tmp_path / "in"
    folder.mkdir()
    path = folder / "a.bvh"
    entrances = {
        "convert": lambda: main(["convert", str(path), str(tmp_path / "o.npy")]),
        "inspect": lambda: main(["inspect", str(path), str(tmp_path / "o.html")]),
        "edit, after": lambda: read_motion(HumanML(), path).notes,
        "prepare": lambda: main(
            ["prepare", "folder", f"source={folder}", f"data_root={tmp_path}", "check=true"]
        ),
        "adapt": lambda: check_clips(folder, 20.0),
    }

    def said(enter: Callable[[], Any]) -> str:
        try:
            return f"{enter()} {''.join(capsys.readouterr())}"
        except UserError as error:
            return str(error)

    mirrored, small = (
        replace(walk(), joints=swapped(walk())),
        replace(walk(), joints=0.4 * walk().joints),
    )
    for motion, words in ((mirrored, "the toes point backwards"), (small, "human legs are")):
        write_bvh(path, motion)
        for name, enter in entrances.items():
            with subtests.test(words=words, entrance=name):
                assert words in said(enter), name
    write_bvh(path, walk(), turn="z")
    for name, enter in entrances.items():
        with subtests.test(name=name, enter=enter):
            assert re.search("lying down.*up", said(enter), re.DOTALL), name


def test_a_rest_pose_in_front_is_left_out_and_said(tmp_path: Path, capsys, subtests):
    motion, rest = walk(30), posed(1).joints[0]
    write_bvh(tmp_path / "a.bvh", motion, first=rest)
    np.savez(tmp_path / "b.npz", joints=np.concatenate([rest[None], motion.joints]), fps=20)
    parts = amass(motion)
    still: dict[str, Any] = {
        name: np.concatenate([parts[name][:1] * (name == "trans"), parts[name]])
        for name in ("poses", "trans")
    }
    still["poses"][0, 0] = np.pi / 2
    np.savez(tmp_path / "c.npz", **(parts | still))
    motion.save(tmp_path / "d.bvh", rest_pose=True, rig="lafan1")
    for name in ("a.bvh", "b.npz", "c.npz", "d.bvh"):
        with subtests.test(name=name):
            again = read(tmp_path / name)
            assert any("the first frame is a rest pose" in note for note in again.notes), name
            np.testing.assert_allclose(again.joints, motion.joints, atol=0.01)
    check_clips(tmp_path, 20.0)
    assert "4 motions: the first frame is a rest pose and is left out" in capsys.readouterr().out, (
        "adapt says it"
    )
    source = Folder(str(tmp_path), workers=1)
    assert [len(clip.motion) for clip in source.clips(20.0)] == [30] * 4
    assert "4 motions: the first frame is a rest pose and is left out" in source.findings()
    smooth = posed(
        30, left_shoulder=np.linspace([0, 0, 0], [0, 0, -70], 30), right_shoulder=[0, 0, 0]
    )
    smooth.save(tmp_path / "e.json")
    kept = json.loads((tmp_path / "e.json").read_text())
    (tmp_path / "e.json").write_text(json.dumps({"joints": kept["joints"], "fps": 20}))
    assert len(read(tmp_path / "e.json").joints) == 30, (
        "a motion that begins in a rest pose is kept"
    )


def test_a_rest_pose_in_front_of_an_animation_is_left_out(tmp_path: Path):
    motion = walk(30)
    joints = np.concatenate([posed(1).joints, motion.joints])
    Motion(joints, motion.fps).save(tmp_path / "a.glb", rig="mixamo")
    again = read(tmp_path / "a.glb")
    assert again.notes == ("the first frame is a rest pose and is left out",)
    actual, expected = (moved.joints - moved.joints[:, :1] for moved in (again, motion))
    np.testing.assert_allclose(actual, expected, atol=0.01)


def test_legs_that_flip_are_noticed(tmp_path: Path):
    motion = walk(40)
    angles = np.zeros((40, 3))
    angles[20:] = [170, 0, 0]
    flipped = posed(40, left_hip=angles)
    flipped = replace(flipped, fps=60.0)
    np.savez(tmp_path / "a.npz", joints=flipped.joints, fps=60)
    np.savez(tmp_path / "b.npz", joints=motion.joints, fps=60)
    assert any("a leg flips: it moves at" in note for note in read(tmp_path / "a.npz").notes)
    source = Folder(str(tmp_path), workers=1)
    assert [clip.id for clip in source.clips(20.0)] == ["b"]
    assert "a leg flips" in source.failures[0]


def test_check_and_preparation_agree_and_one_bad_file_stops_nothing(
    tmp_path: Path, monkeypatch, capsys, subtests
):
    monkeypatch.chdir(tmp_path)
    Path("mine").mkdir()
    np.savez("mine/a.npz", joints=walk(60).joints, fps=20)
    np.savez("mine/c.npz", joints=walk(50).joints, fps=20)
    np.savez("mine/one.npz", joints=walk(1).joints, fps=20)
    Path("mine/b.bvh").write_text("HIERARCHY\n")
    words = [
        "prepare",
        "folder",
        "source=mine",
        "data.name=ours",
        "data_root=data",
        "data.source.workers=1",
    ]
    assert main([*words, "check=true"]) == 1
    checked = capsys.readouterr().out
    assert main(words) == 1
    prepared = capsys.readouterr().out
    for said in (checked, prepared):
        with subtests.test(said=said):
            assert "mine/b.bvh, line 1" in said
            assert "mine/one.npz: only 1 frames at 20 fps, but a motion requires at least 3" in said
            assert "error: 2 of 4 motions in mine cannot be prepared" in said
    store = Store(Path("data/ours-humanml-clean-smpl22"))
    assert [clip.id for clip in store.clips] == ["a", "c"]
    assert store.info["excluded"] == {"motions that cannot be read": 2}
    assert store.info["version"] == 2

    assert main(["inspect", "ours", "data_root=data"]) in (0, 3), (
        "a data set prepared under its name"
    )
    assert "of 2 motions" in capsys.readouterr().out
    Path("mine/one.npz").unlink()
    assert main(["inspect", "mine/", "page.html"]) == 1
    printed = capsys.readouterr()
    assert "of 2 motions" in printed.out
    assert "error: 1 of 3 motions could not be read" in printed.err
    assert main(["convert", "mine", "out", "format=npy"]) == 1
    assert sorted(path.name for path in Path("out").iterdir()) == ["a.npy", "c.npy"]
    assert "error: mine/b.bvh, line 1" in capsys.readouterr().err


def test_files_that_are_no_motions_are_left_out_of_folders(tmp_path: Path):
    np.savez(tmp_path / "a.npz", joints=walk().joints, fps=20)
    (tmp_path / "meta.json").write_text('{"joints": ["Hips"], "license": "CC0"}')
    (tmp_path / "b.json").write_text(
        json.dumps({"fps": 20, "joints": walk().joints.tolist()}, indent=1)
    )
    (tmp_path / "__MACOSX").mkdir()
    for name in (
        "._a.bvh",
        "__MACOSX/._a.bvh",
        "__MACOSX/a.bvh",
        "shape.npz",
        "neutral_stagei.npz",
    ):
        (tmp_path / name).write_bytes(b"\0\5\26\7")
    assert list(Folder(str(tmp_path), workers=1).files) == ["a", "b"]
    assert main(["convert", str(tmp_path), str(tmp_path / "out"), "format=npy"]) == 0


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("a.blend", "export BVH"),
        ("a.c3d", "markers"),
        ("a.trc", "export BVH"),
        ("a.gltf", "Save it as .glb"),
        ("a.pkl", "numpy.savez"),
        ("a.pt", "numpy.savez"),
        ("a.csv", "numpy.savez"),
        ("a.xyz", "neither a motion file (.npz"),
    ],
)
def test_files_of_other_kinds_are_refused_with_a_way_out(
    name: str, says: str, tmp_path: Path, capsys
):
    (tmp_path / name).write_bytes(b"x")
    assert main(["convert", str(tmp_path / name), str(tmp_path / "o.npy")]) == 1
    assert says in capsys.readouterr().err


def test_pointers_of_git_lfs_are_named(tmp_path: Path, subtests):
    for name in ("a.bvh", "a.npz", "a.json", "a.npy", "a.amc", "a.glb"):
        with subtests.test(name=name):
            (tmp_path / name).write_text(POINTER)
            with pytest.raises(UserError, match=r"a Git LFS pointer.*git lfs pull"):
                (glb.read if name.endswith("glb") else read)(tmp_path / name)


def test_extensions_that_compress_a_character_are_named(tmp_path: Path, subtests):
    synthetic("kick").save(tmp_path / "a.glb", rig="mixamo")
    for name, is_read in (("EXT_meshopt_compression", False), ("KHR_materials_unlit", True)):
        with subtests.test(name=name, is_read=is_read):
            shutil.copy(tmp_path / "a.glb", tmp_path / "b.glb")
            changed(tmp_path / "b.glb", partial(dict.update, extensionsRequired=[name]))
            if is_read:
                glb.read(tmp_path / "b.glb")
                continue
            with pytest.raises(
                UserError, match=rf"b\.glb: it requires {name}, .* without this compression\Z"
            ):
                glb.read(tmp_path / "b.glb")


def test_two_people_and_rates_of_cmu_are_said(tmp_path: Path):
    write_bvh(tmp_path / "a.bvh", walk())
    head, table = (tmp_path / "a.bvh").read_text().split("MOTION")
    second = head.replace("HIERARCHY\n", "").replace("ROOT pelvis", "ROOT other")
    rows = table.splitlines()
    numbered = [*rows[:3], *(f"{row} {row}" for row in rows[3:])]
    (tmp_path / "two.bvh").write_text(head + second + "MOTION" + "\n".join(numbered) + "\n")
    two = read(tmp_path / "two.bvh")
    assert two.notes == ("the file contains 2 people (ROOT), but only the first one is read",)
    np.testing.assert_allclose(two.joints, walk().joints, atol=1e-5)
    motion = replace(walk(), fps=120.0)
    motion.save(tmp_path / "60_01.bvh", rig="cmu")
    motion.save(tmp_path / "02_01.bvh", rig="cmu")
    assert (read(tmp_path / "60_01.bvh").fps, read(tmp_path / "02_01.bvh").fps) == (60, 120)
    assert (
        "CMU recorded this motion at 60 frames per second, not 120"
        in read(tmp_path / "60_01.bvh").notes[0]
    )
    assert read(tmp_path / "60_01.bvh", fps=120).fps == 120


def test_the_pelvis_of_smpls_template_is_added_in_the_axes_of_the_file(tmp_path: Path):
    """It is about (0, -0.223, 0.028) m in SMPL+H's model file, for any rotation of the root."""
    turns = np.zeros((3, 72))
    turns[:, 1] = [0.0, 0.5, 1.0]
    np.savez(tmp_path / "a.npz", poses=turns, trans=np.full((3, 3), 0.5), mocap_framerate=20)
    pelvis = read(tmp_path / "a.npz", up="y").joints[:, 0]
    np.testing.assert_allclose(pelvis, [[0.5, 0.277, 0.528]] * 3, atol=0.005)


def test_a_smaller_body_is_said_and_cubic_splines_resample_own_files_everywhere(tmp_path: Path):
    parts = amass(walk())
    np.savez(tmp_path / "a.npz", **(parts | {"trans": parts["trans"] - [0, 0, 0.09]}))
    assert "the feet are 9 cm below the floor" in read(tmp_path / "a.npz").notes[0]
    joints = synthetic("kick", 30.0).joints
    np.savez(tmp_path / "a.npz", joints=joints, fps=30)
    (clip,) = Folder(str(tmp_path), workers=1).clips(20.0)
    np.testing.assert_array_equal(clip.motion, read(tmp_path / "a.npz", resample_to=20).joints)


FILES = SHARED / "data" / "files-of-others"


@pytest.mark.skipif(
    not FILES.exists(), reason="the files of other programs are outside of the repository"
)
@pytest.mark.parametrize(
    ("name", "keys", "head", "note"),
    [
        ("f01_stageii.npz", {}, 1.57, ""),
        ("f02_y_up.npz", {"up": "y"}, 1.57, ""),
        ("f02_y_up.npz", {}, 0.23, "up=y"),
        ("f03_z_up.bvh", {}, 0.25, "up=z"),
        ("f03_z_up.bvh", {"up": "z"}, 1.54, ""),
        ("f05_json_z_up.json", {}, 1.54, ""),
        ("f05_json_z_up.json", {"up": "z"}, 1.54, ""),
        ("f06_tpose_first.bvh", {}, 1.54, "rest pose"),
        ("f12_body_only_66.npz", {}, 1.57, ""),
        ("f12_rate_of_one_element.npz", {}, 1.57, ""),
        ("f13_shorter_person.npz", {}, 1.57, "smaller"),
        ("f14_two_people.bvh", {}, 1.54, "2 people"),
        ("f15_half.npz", {}, 1.57, ""),
    ],
)
def test_the_collected_files_have_their_heights(name: str, keys: dict, head: float, note: str):
    motion = read(FILES / name, **keys)
    assert head_height(motion.joints) == pytest.approx(head, abs=0.02)
    assert note in " ".join(motion.notes)
    if name == "f02_y_up.npz" and keys:
        lowest = float(np.median(motion.joints[..., 1].min(1)))
        assert lowest == pytest.approx(0, abs=0.02), "feet on the floor"


def test_a_command_comes_before_the_file_and_the_file_before_the_folder(tmp_path: Path):
    motion = walk()
    turned = 100 * motion.joints @ np.array(TURNED["z"], float).T
    content = {"joints": turned.tolist(), "fps": 20, "up": "z", "unit": "cm"}
    (tmp_path / "a.json").write_text(json.dumps(content))
    (tmp_path / "skeleton.yaml").write_text("up: -y\nunit: 0.0254\nfps: 50\n")
    motion_read = read(tmp_path / "a.json")
    np.testing.assert_allclose(motion_read.joints, motion.joints, atol=1e-4)
    assert motion_read.fps == 20
    assert read(tmp_path / "a.json", fps=25).fps == 25

    (tmp_path / "a.json").write_text(json.dumps(content | {"up": "-y", "unit": "m"}))
    again = read(tmp_path / "a.json", up="z", unit=0.01)
    np.testing.assert_allclose(again.joints, motion.joints, atol=1e-4)


@pytest.mark.parametrize(
    ("unit", "meters"),
    [
        *(("m", 1), ("meter", 1), ("metre", 1), ("cm", 0.01), ("centimeter", 0.01)),
        *(("Centimetre", 0.01), ("mm", 0.001), (0.0254, 0.0254)),
    ],
)
def test_names_of_units_in_json_files(tmp_path: Path, unit: Any, meters: float):
    joints = walk(4).joints / meters
    content = {"joints": joints.tolist(), "fps": 20, "unit": unit}
    (tmp_path / "a.json").write_text(json.dumps(content))
    np.testing.assert_allclose(read(tmp_path / "a.json").joints, walk(4).joints, atol=1e-5)


@pytest.mark.parametrize("up", TURNED)
def test_each_axis_that_points_up_is_turned_to_y(tmp_path: Path, up: str):
    joints = walk(4).joints.astype(float)
    np.savez(tmp_path / "a.npz", joints=joints @ np.array(TURNED[up], float).T, fps=20)
    np.testing.assert_allclose(read(tmp_path / "a.npz", up=up).joints, joints, atol=1e-5)
    np.savez(tmp_path / "b.npz", **amass(walk(4), up))
    np.testing.assert_allclose(
        read(tmp_path / "b.npz", up=up).joints[:, 1:]
        - read(tmp_path / "b.npz", up=up).joints[:, :1],
        joints[:, 1:] - joints[:, :1],
        atol=1e-5,
    )


@pytest.mark.parametrize(
    ("up", "pelvis"),
    [("z", (0, 0.028, -0.223)), ("y", (0, -0.223, 0.028)), ("-y", (0, 0.223, -0.028))],
)
def test_a_body_without_translation_has_its_pelvis_where_smpls_template_has_it(
    tmp_path: Path, up: str, pelvis: tuple
):
    parts: dict[str, Any] = amass(walk(4), up) | {"trans": np.zeros((4, 3))}
    np.savez(tmp_path / "a.npz", **parts)
    np.testing.assert_allclose(
        read(tmp_path / "a.npz", up=up).joints[:, 0], np.tile(pelvis, (4, 1)), atol=1e-6
    )


@pytest.mark.parametrize("fps", [20.0, 30.0, 120.0])
def test_speeds_that_no_person_has_are_noticed_at_any_rate(fps: float):
    def moving(joint: str, speed: float) -> str:
        joints = np.zeros((40, 22, 3))
        moved = range(22) if joint == "pelvis" else [SMPL22.joints.index(joint)]
        joints[:, moved, 0] = np.arange(40)[:, None] * speed / fps
        return checks.jump(joints, fps)

    assert moving("pelvis", 14.5) == ""
    assert moving("pelvis", 15.6).startswith("the body jumps: it moves at 16 m/s")
    assert moving("right_ankle", 29.5) == ""
    assert moving("right_ankle", 30.6).startswith("a leg flips: it moves at 31 m/s")


def test_a_pelvis_that_shakes_for_one_frame_does_not_jump():
    joints = np.zeros((40, 22, 3))
    joints[20, :, 0] = 0.2
    assert checks.jump(joints, 60.0) == ""
    joints[20:, :, 0] = 0.8
    assert "the body jumps" in checks.jump(joints, 60.0)
    joints = np.zeros((40, 22, 3))
    joints[20:, SMPL22.joints.index("left_ankle"), 2] = 0.5
    assert checks.jump(joints, 120.0).startswith("a leg flips: it moves at 60 m/s in frame 19")


@pytest.mark.parametrize(("fps", "blended", "left_out"), [(60, 1, 2), (20, 0, 1), (60, 0, 1)])
def test_frames_that_lead_from_a_rest_pose_to_the_motion_are_counted(fps, blended, left_out):
    rest, stand = posed(1).joints[0], walk(1).joints[0]
    steps = [rest + share * (stand - rest) for share in np.linspace(0, 1, blended + 2)]
    joints = np.concatenate([steps, np.tile(stand, (12, 1, 1))])
    assert checks.rest_frames(joints, fps) == left_out
    assert checks.rest_frames(joints[left_out:], fps) == 0


def test_files_of_kimodo_have_30_frames_per_second(tmp_path: Path):
    np.savez(tmp_path / "a.npz", posed_joints=walk(4).joints)
    assert read(tmp_path / "a.npz").fps == 30
    np.savez(tmp_path / "a.npz", posed_joints=walk(4).joints, fps=25)
    assert read(tmp_path / "a.npz").fps == 25


@pytest.mark.parametrize(
    ("up", "trunk", "words"),
    [
        ("y", (0.95, 0.31, 0), ""),
        ("y", (0.96, 0.29, 0), "the body is lying down"),
        ("y", (0, 0.1, 0.99), "set up=z,"),
        ("y", (0.7, 0.2, 0.69), "the body is lying down"),
        ("y", (0.7, 0.1, 0.71), "set up=z,"),
        ("y", (0, -1, 0), "set up=-y,"),
        ("z", (0, 0, -1), "set up=y,"),
        ("z", (0, 0, 1), "set up=-y,"),
    ],
)
def test_a_body_that_lies_would_stand_with_the_axis_that_is_named(
    up: str, trunk: tuple, words: str
):
    """The directions of the trunk have y up."""
    joints = np.zeros((3, 22, 3))
    joints[:, SMPL22.joints.index("neck")] = 0.5 * np.array(trunk)
    message = checks.lying(joints, up, np.array(UP[up], float))
    assert words in message
    assert bool(message) == bool(words)
    assert ("set up=" in message) == ("set up=" in words)


def test_a_body_two_centimeters_below_the_floor_is_reported():
    joints = np.ones((9, 22, 3))
    joints[:, 10, 1] = -0.019
    joints[:4, 10, 1] = -0.5  # a stumble
    assert checks.below_floor(joints) == ""
    joints[:5, 10, 1] = [-0.5] * 4 + [-0.026]
    assert checks.below_floor(joints).startswith("the feet are 3 cm below the floor")


@pytest.mark.parametrize(
    ("turns", "is_rest"),
    [
        ({}, True),
        ({"left_elbow": (0, -15, 0)}, True),
        ({"left_elbow": (0, -40, 0)}, False),
        ({"right_knee": (15, 0, 0)}, True),
        ({"right_knee": (40, 0, 0)}, False),
        ({"left_shoulder": (0, 0, -50), "right_shoulder": (0, 0, 50)}, True),
        ({"left_shoulder": (0, 0, -75), "right_shoulder": (0, 0, 75)}, False),  # the arms hang
        ({"right_shoulder": (0, 0, 8)}, True),
        ({"right_shoulder": (0, 0, 20)}, False),  # lower than the left arm
        ({"left_hip": (0, 0, 15)}, True),
        ({"left_hip": (0, 0, 40)}, False),
    ],
)
def test_a_rest_pose_has_straight_limbs_and_both_arms_at_one_height(turns: dict, is_rest: bool):
    pose = posed(1, **turns).joints[0].astype(float)
    assert checks._is_rest_pose(pose) == is_rest


@pytest.mark.parametrize(
    ("fps", "jumps", "calm", "left_out"),
    [
        (20, [0.16], [0.0] * 9, 1),
        (20, [0.14], [0.0] * 9, 0),  # 15 cm
        (20, [0.3], [0.09] * 9, 1),
        (20, [0.3], [0.11] * 9, 0),  # three times the steps after it
        (20, [0.3], [*[0.0] * 8, 0.2], 1),  # of eight frames
        (20, [0.3], [*[0.0] * 7, 0.2], 0),
        (60, [0.05, 0.11], [0.0] * 9, 2),
        (60, [0.07, 0.07], [0.0] * 9, 0),
        (60, [0.16, 0.16, 0.05], [0.0] * 9, 2),  # at most 0.04 s
    ],
)
def test_a_jump_from_a_rest_pose_is_long_and_longer_than_the_following_steps(
    fps: float, jumps: list[float], calm: list[float], left_out: int
):
    joints = np.tile(posed(1).joints.astype(float), (1 + len(jumps) + len(calm), 1, 1))
    wrist = SMPL22.joints.index("left_wrist")
    joints[:, wrist, 2] += np.cumsum([0, *jumps, *calm])
    joints += np.arange(len(joints))[:, None, None] * [0, 0, 0.3]  # the whole body moves on
    assert checks.rest_frames(joints, fps) == left_out


@pytest.mark.parametrize("padding", [0, 2**20 - 23, 2**20 - 18, 2**20 - 13, 2**20])
def test_joints_of_a_json_file_are_noticed_wherever_they_begin(tmp_path: Path, padding: int):
    """Files are searched in blocks of a mebibyte."""
    text = json.dumps({"fps": 20, "joints": [[[0, 0, 0]]]})
    (tmp_path / "a.json").write_text(" " * padding + text)
    (tmp_path / "b.json").write_text(" " * padding + text.replace("joints", "points"))
    assert [path.name for path in motions_in(tmp_path)] == ["a.json"]


@pytest.mark.parametrize(
    "name", ["ours.npz", "joints.npz", "amass.npz", "a.json", "a.bvh", "a.glb", "a.fbx", "a.vrma"]
)
def test_an_accelerated_path_is_kept_between_the_frames_of_every_kind_of_file(
    name: str, tmp_path: Path
):
    times, later = np.arange(11)[:, None] / 20, np.arange(26)[:, None] / 50
    way = np.array([1.0, 0.4, -2.0])
    headings = 2 * np.pi / 6 * np.arange(11)  # 60 degrees per frame
    motion = posed(11, root=[0.1, 0.9, 0.3] + times**2 * way, heading=headings)
    if name == "amass.npz":
        np.savez(tmp_path / name, **amass(motion))
    elif name == "joints.npz":
        np.savez(tmp_path / name, joints=motion.joints, fps=20)
    else:
        motion.save(tmp_path / name)
    again = read(tmp_path / name, resample_to=50)
    assert (again.fps, len(again.joints)) == (50, 26)
    np.testing.assert_allclose(again.joints[:, 0] - again.joints[0, 0], later**2 * way, atol=1e-4)
    if name in ("amass.npz", "a.bvh"):  # rotations turn at a constant rate
        left = again.joints[:, SMPL22.joints.index("left_hip")] - again.joints[:, 0]
        angles = np.unwrap(np.arctan2(-left[:, 2], left[:, 0]))
        np.testing.assert_allclose(angles - angles[0], 20 * np.pi / 3 * later[:, 0], atol=1e-3)


@pytest.mark.parametrize("up", TURNED)
def test_rotations_of_a_file_with_any_up_axis_are_converted_to_the_axes_of_amass(
    tmp_path: Path, up: str
):
    """The file contains the same body, turned about the origin."""
    motion = posed(4, heading=[0.0, 0.5, 1.0, 1.5], left_elbow=(0, -70, 0))
    motion = motion_of_poses(
        replace(motion.posed(), root=motion.posed().root + torch.tensor([0.3, 0, -0.8])), 20
    )
    poses = motion.posed()
    np.savez(tmp_path / "a.npz", **amass(motion, up))
    recording = read_recording(tmp_path / "a.npz", up=up)
    assert recording.smpl is not None
    translation, turns = recording.smpl
    matrices = rotation.quaternion_to_matrix(turns[:, :22])
    np.testing.assert_allclose(matrices[:, 0], AMASS_AXES @ poses.rotations[:, 0], atol=1e-6)
    np.testing.assert_allclose(matrices[:, 1:], poses.rotations[:, 1:], atol=1e-6)
    pelvis = translation + torch.tensor(PELVIS, dtype=torch.float64)
    np.testing.assert_allclose(pelvis, amass_parameters(poses)[1], atol=1e-6)
    np.testing.assert_allclose(recording.motion.joints[:, 0], pelvis @ AMASS_AXES, atol=1e-6)


def test_hidden_folders_are_skipped_but_a_folder_may_be_below_a_hidden_one(tmp_path: Path):
    root = tmp_path / ".cache" / "mine"
    names = (
        *("a.npz", "deep/b.BVH", ".git/c.bvh", "deep/.cache/er/d.npy", ".e.npz", "F_STAGEII.NPZ"),
        *("f_stagei.npz", "G_STAGEI.NPZ", "male/Shape.npz", "deep/__MACOSX/h.npz", "notes.txt"),
    )
    for name in names:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).touch()
    (root / "i.npy").mkdir()
    listed = [path.relative_to(root).as_posix() for path in motions_in(root)]
    assert listed == sorted(["F_STAGEII.NPZ", "a.npz", "deep/b.BVH"])
