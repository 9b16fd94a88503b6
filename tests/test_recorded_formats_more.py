"""Motions in files, and names of their joints, as recorded."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from support.asf import write_amc, write_asf
from support.motions import bvh_text, posed, sway
from support.others import COLLECTED, amass
from support.outcomes import temporary_folder
from support.recorded import Case, cases_of, check, combinations, outcome, record
from support.recorded_files import motions, without_paths
from support.traits import nested_traits, text_traits, traits

from flame_mdm import formats
from flame_mdm.formats import (
    arrays,
    asf,
    bones,
    bvh,
    layouts,
    motion,
    names,
    readers,
    recordings,
    rig,
)
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.skeleton import KIT21, SKELETONS, SMPL22

NAME = "formats_more"
RIGS = (None, "mixamo", "unreal", "unity", "rigify", "lafan1", "soma", "cmu", "100style")


def read_traits(recording: Any) -> Any:
    """Summary of the motion that a reader returns, or its error message."""
    if isinstance(recording, str):
        return recording
    read = recording.motion
    return [
        len(read.joints),
        read.fps,
        read.skeleton.name,
        read.text,
        read.id,
        traits(read.joints, 3),
        read.notes,
        recording.layout,
        recording.doubts.lines,
        recording.doubts.upright,
        read.bones.reason,
        read.representation,
        [
            traits(part, 3)
            for source in (read.poses, read.bones.poses)
            if source
            for part in vars(source).values()
        ],
        [traits(part, 3) for part in recording.smpl or ()],
        recording.tree and len(recording.tree.frames),
        read.features.shape,
    ]


def tree_traits(tree: bvh.Bvh) -> Any:
    return [
        tree.joints,
        tree.parents,
        tree.channels,
        traits(tree.offsets),
        traits(tree.frames),
        tree.fps,
        traits(tree.positions()),
        traits(tree.translations()),
        *(
            traits(part, 3)
            for fps in (30.0, 12.5)
            for cubic in (False, True)
            for part in tree.resample(fps, cubic)
        ),
    ]


def bvh_files_of_rigs() -> Any:
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        for number, name in enumerate(RIGS):
            path = folder / f"{number}.bvh"
            source = motions()[number % 6]
            line = source.save(path, rest_pose=number % 2 == 0, rig=name)
            tree = bvh.read(path)
            results[str(name)] = [
                without_paths(folder, line),
                tree.joints,
                [len(channels) for channels in tree.channels],
                traits(tree.offsets),
                traits(tree.frames),
                traits(tree.positions()),
                tree.fps,
                without_paths(
                    folder,
                    read_traits(
                        outcome(readers.read_recording, path, 30.0 if number % 3 else None)
                    ),
                ),
            ]
            if number < 2:
                results[f"{name} text"] = text_traits(path.read_text())
                results[f"{name} tree"] = tree_traits(tree)
    return results


def damaged_bvh_files() -> Any:
    text = bvh_text()
    changes = {
        "no hierarchy": ("HIERARCHY", "HIER"),
        "lower": ("HIERARCHY", "hierarchy"),
        "frames": ("Frames: 3", "Frames: 4"),
        "word": ("Frames: 3", "Frames: x"),
        "channel": ("Xposition", "Wposition"),
        "twice": ("Xposition", "Yposition"),
        "offset": ("OFFSET", "OFFSETS"),
        "no offset": ("OFFSET 0.0 0.0 0.0", ""),
        "brace": ("{", "["),
        "site": ("End Site", "End Sit"),
        "large": ("OFFSET 0.0", "OFFSET 1e10"),
        "nan": ("OFFSET 0.0", "OFFSET nan"),
        "motion": ("MOTION", "MOTION 1"),
        "time": ("Frame Time: 0.05", "Frame Time: 20"),
        "rate 30": ("Frame Time: 0.05", "Frame Time: 0.0333333"),
        "rate 59.94": ("Frame Time: 0.05", "Frame Time: .016683"),
        "rate": ("Frame Time: 0.05", "Frame Time: 0.03"),
        "slowest": ("Frame Time: 0.05", "Frame Time: 10"),
        "fastest": ("Frame Time: 0.05", "Frame Time: 0.001"),
        "rough": ("Frame Time: 0.05", "Frame Time: 0.02"),
        "exponent": ("Frame Time: 0.05", "Frame Time: 4.1e-2"),
        "comment": ("MOTION", "# a comment\n\nMOTION"),
        "short": ("ROOT pelvis", "ROOT pelvis of a person"),
        "less": ("CHANNELS 6", "CHANNELS 5"),
    }
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        for name, change in changes.items():
            path = folder / f"{name}.bvh"
            path.write_text(text.replace(*change))
            tree = outcome(bvh.read, path)
            results[name] = (
                without_paths(folder, tree)
                if isinstance(tree, str)
                else [tree.fps, tree.joints[0], len(tree.frames)]
            )
        for name, content in (
            ("bytes", b"HIERARCHY\n\n\xff"),
            ("empty", b""),
            ("end", text[:300].encode()),
            ("row", text.rsplit("\n", 2)[0].encode() + b" 7\n"),
        ):
            path = folder / f"{name}.bvh"
            path.write_bytes(content)
            results[name] = without_paths(folder, outcome(bvh.read, path))
    rng = np.random.default_rng(5)
    orders = (
        ("Xrotation", "Zposition", "Yrotation"),
        ("Zrotation", "Yrotation", "Xrotation", "Xposition"),
        (),
        ("Yrotation",),
    )
    tree = bvh.Bvh(
        ("a", "b", "b.end", "c"),
        (-1, 0, 1, 0),
        rng.normal(size=(4, 3)),
        (*orders[:3], orders[3]),
        rng.normal(0, 70, (7, 8)),
        29.97,
    )
    results["odd channels"] = tree_traits(tree)
    return results


def read_files() -> Any:
    """Files of many kinds, with many options."""
    results: dict[str, Any] = {}
    skeletons = {
        "none": "",
        "unit": "unit: 0.01\n",
        "up": "up: z\nfps: 25\n",
        "mirrored": "mirrored: true\n",
        "children": "children: true\n",
        "wrong": "up: x\n",
        "key": "units: 3\n",
        "map": "map: {pelvis: a}\n",
    }
    options = combinations(
        3,
        8,
        fps=(None, 30.0),
        up=(None, "z", "-y"),
        unit=(None, 0.01, 1.0),
        resample_to=(None, 12.5, 20.0),
    )
    with temporary_folder() as folder:
        for number, (skeleton, text) in enumerate(skeletons.items()):
            inner = folder / skeleton
            inner.mkdir()
            if text:
                (inner / "skeleton.yaml").write_text(text)
            source = motions()[number % 6]
            scale = (1.0, 100.0, 1.0, 1.0, 0.5, 1.0, 1.0, 1.0)[number]
            joints = scale * source.joints
            paths = [
                inner / name
                for name in (
                    "ours.npz",
                    "ours.json",
                    "plain.npy",
                    "other.npz",
                    "amass.npz",
                    "tree.bvh",
                    "other.json",
                    "kimodo.npz",
                    "ours.glb",
                    "ours.fbx",
                    "ours.vrma",
                    "none.xyz",
                )
            ]
            (
                ours,
                ours_json,
                plain,
                other,
                smpl,
                tree,
                other_json,
                kimodo,
                glb_path,
                fbx_path,
                vrma_path,
                _,
            ) = paths
            for path in (ours, ours_json, tree, glb_path, fbx_path, vrma_path):
                if path.suffix in (".npz", ".json", ".bvh") or number < 2:
                    facts: dict[str, Any] = {"seed": 3} if path == ours else {}
                    source.save(path, **facts)
            np.save(plain, joints)
            np.savez(
                other, joints=joints @ np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]), fps=source.fps
            )
            np.savez(smpl, **amass(source, ("z", "y", "-y")[number % 3], (156, 72, 66)[number % 3]))
            other_json.write_text(
                json.dumps(
                    {
                        "joints": joints.tolist(),
                        "fps": 24,
                        "up": "y",
                        "unit": "cm",
                        "names": SMPL22.joints,
                    }
                )
            )
            np.savez(kimodo, posed_joints=np.concatenate([joints, joints[:, 20:]], 1))
            for k, path in enumerate(paths):
                if not path.exists() and path.suffix != ".xyz":
                    continue
                for chosen in (
                    options[(number + k) % 8],
                    {"resample_to": 30.0},
                    {"fps": 15.0, "as_smpl": True},
                ):
                    label = f"{skeleton} {path.name} {chosen}"
                    results[label] = without_paths(
                        folder, read_traits(outcome(readers.read_recording, path, **chosen))
                    )
    # The many refusals are the same in all folders.
    return {
        label: value[-150:] if isinstance(value, str) else value for label, value in results.items()
    }


def files_of_other_programs() -> Any:
    results: dict[str, Any] = {}
    with temporary_folder() as folder:
        for number, (name, write) in enumerate(COLLECTED.items()):
            path = folder / name
            write(path)
            rate = {"resample_to": 30.0} if number % 2 else {}
            results[name] = without_paths(
                folder, read_traits(outcome(readers.read_recording, path, **rate))
            )
        (folder / "02.asf").unlink(missing_ok=True)
        write_asf(folder / "02.asf")
        for frames, name in ((30, "02_01"), (5, "60_02")):
            write_amc(folder / f"{name}.amc", frames, frames)
            for fps in (None, 120.0, 59.94):
                read = outcome(readers.read_recording, folder / f"{name}.amc", 30.0, fps=fps)
                results[f"{name} {fps}"] = without_paths(folder, read_traits(read))
        results["tree"] = tree_traits(asf.read(folder / "02_01.amc", 60.0))
    return results


def damaged_asf_files() -> Any:
    results: dict[str, Any] = {}
    changes = (
        ("asf", "angle deg", "angle rad"),
        ("asf", "axis XYZ", "axis XYX"),
        ("asf", "axis 0 0 20 XYZ", "axis 10 5 20 ZXY"),
        ("asf", "axis 0 0 20 XYZ", "axis 0 x 20 XYZ"),
        ("asf", "dof rx", "dof rz"),
        ("asf", "dof rx", "dof tx"),
        ("asf", "dof rx ry rz", "dof rz rx ry"),
        ("asf", ":root\n", ":root\nposition 0 1 0\n"),
        ("asf", ":root\n", ":root\norientation 0 0 0\n"),
        ("asf", ":hierarchy", ":x"),
        ("asf", "root lhipjoint", "lfoot lhipjoint"),
        ("asf", "length 2.", "size 2."),
        ("asf", "order TX TY TZ RX RY RZ", "order RX RY RZ TX TZ TY"),
        ("amc", ":DEGREES", ":RADIANS"),
        ("amc", "\n3\n", "\nx\n"),
        ("amc", "lfemur", "lfemurs"),
        ("amc", "ltibia 1", "ltibia 1 2"),
        ("amc", "head", "# head"),
        ("amc", "\n2\n", "\n2\nhead 1\n"),
    )
    with temporary_folder() as folder:
        inner = folder
        for number, (ending, old, new) in enumerate(changes):
            inner = folder / str(number)
            inner.mkdir()
            write_asf(inner / "02.asf")
            write_amc(inner / "02_01.amc", 4, number)
            path = next(inner.glob(f"*.{ending}"))
            path.write_text(path.read_text().replace(old, new))
            tree = outcome(asf.read, inner / "02_01.amc", 120.0)
            results[f"{number} {new}"] = (
                without_paths(folder, tree)
                if isinstance(tree, str)
                else [traits(tree.frames), traits(tree.offsets), tree.channels]
            )
        write_asf(inner / "03.asf")
        write_amc(inner / "04_01.amc", 1)
        write_amc(inner / "03_01.amc", 1)
        results["skeletons"] = [
            without_paths(folder, str(outcome(asf.skeleton_of, inner / name)))
            for name in ("03_07.amc", "03.amc", "04_01.amc")
        ]
    return results


def arrays_of_files() -> Any:
    rng = np.random.default_rng(7)
    joints, turns, trans = (
        rng.normal(size=(4, 22, 3)),
        rng.normal(size=(4, 66)),
        rng.normal(size=(4, 3)),
    )
    contents: list[dict[str, Any]] = [
        {"joints": joints, "fps": 20, "text": "a text"},
        {"joints": joints.astype(complex)},
        {"joints": joints[:0]},
        {"x": joints},
        {"joints": joints * 1e6},
        {"joints": np.where(joints > 1, np.nan, joints), "mocap_framerate": 0},
        {"joints": 3.0},
        {"joints": joints, "features": joints},
        {"joints": joints, "features": joints[:, 0], "fps": [20.0], "mocap_frame_rate": 30},
        {
            "root_orient": turns[:, :3],
            "pose_body": turns[:, 3:],
            "trans": trans,
            "mocap_frame_rate": 25.0,
        },
        {"root_orient": turns[:3, :3], "pose_body": turns[:, 3:], "trans": trans},
        {"poses": turns, "trans": trans[:2]},
        *(
            {"poses": rng.normal(size=shape), "trans": trans, "mocap_framerate": 120}
            for shape in (
                (4, 72),
                (4, 156),
                (4, 165),
                (4, 24, 3),
                (4, 24, 2),
                (4, 216),
                (4, 144),
                (4, 3, 3, 24),
                (4, 71),
            )
        ),
    ]
    results: list[Any] = []
    with temporary_folder() as folder:
        for content in contents:
            np.savez(folder / "a.npz", **content)
            data = outcome(arrays.read_arrays, folder / "a.npz")
            results.append(without_paths(folder, nested_traits(data)))
            if not isinstance(data, str) and "poses" in data:
                results += [
                    [traits(part) for part in arrays.smpl_motion(data, fps)] for fps in (None, 30.0)
                ]
        texts = (
            "[]",
            "{}",
            '{"joints": [[[1, 2, 3]]], "unit": "MM", "up": "z", "names": ["a"]}',
            '{"joints": 3}',
            '{"joints": [[[1, 2, 3]]], "caption": "c", "unit": "metre", "up": "y", "fps": 12.5}',
            '{"joints": [[[1, 2, 3]]], "caption": "c", "unit": "inch"}',
            '{"joints": [[1, 2], [3]]}',
        )
        for text in texts:
            (folder / "a.json").write_text(text)
            results.append(
                without_paths(folder, nested_traits(outcome(arrays.read_arrays, folder / "a.json")))
            )
    for kind in ("i4", "f2", "u8", "c8", "f8", "?", "U3"):
        results.append(arrays.is_real(np.zeros(2, kind)))
    for value in (
        joints,
        joints[:, :21],
        sway(3, skeleton=SKELETONS["smpl24"]).joints,
        joints[0],
        "text",
        torch.ones(2, 22, 3),
    ):
        read = outcome(readers.from_array, value, 30.0)
        results.append(read if isinstance(read, str) else [repr(read), traits(read.joints)])
    results.append(outcome(readers.from_array, joints, None))
    return results


def features_in_files() -> Any:
    rng = np.random.default_rng(8)
    results: dict[str, Any] = {}
    source = motions()[2]
    with temporary_folder() as folder:
        for name, width in (*readers.ROTATED.items(), ("hml263", 263), ("smpl147", 150)):
            features = rng.normal(size=(24, width))
            np.savez(
                folder / "a.npz",
                joints=source.joints,
                fps=20,
                text="t",
                features=features,
                representation=name,
            )
            for chosen in ({}, {"resample_to": 30.0}, {"unit": 2.0}):
                read = outcome(readers.read_recording, folder / "a.npz", **chosen)
                results[f"{name} {width} {chosen}"] = without_paths(folder, read_traits(read))
        source.save(folder / "b.npz")
        np.savez(
            folder / "c.npz",
            **{
                **np.load(folder / "b.npz"),
                "poses": np.ones((24, 156)),
                "trans": source.joints[:, 0],
            },
        )
        np.savez(
            folder / "d.npz",
            **{**np.load(folder / "b.npz"), "poses": np.ones((3, 156)), "trans": np.ones((3, 3))},
        )
        for name in "bcd":
            results[name] = without_paths(
                folder, read_traits(outcome(readers.read_recording, folder / f"{name}.npz"))
            )
    return results


def saved_motions() -> Any:
    """Messages and refusals of all options of `Motion.save`, and arrays in files."""
    results: dict[str, Any] = {}
    known = posed(5, 1.1, heading=np.linspace(2, 4, 5), left_elbow=[0, 40.0, 10], neck=[20.0, 0, 5])
    known.text, known.id = "a text", "an id"
    with temporary_folder() as folder:
        for ending in (".bvh", ".glb", ".fbx", ".npz", ".json", ".npy", ".xyz", ".vrma", ".gif"):
            for chosen in combinations(
                9,
                12,
                rig=(None, "unreal", "cmu", "x"),
                rest_pose=(False, True),
                root_motion=(False, True),
                character=(None, "missing.glb"),
            ):
                if ending in (".npz", ".json", ".npy", ".gif") and not any(chosen.values()):
                    continue
                message = outcome(motions()[1].save, folder / f"a{ending}", **chosen)
                results[f"{ending} {chosen}"] = without_paths(folder, message)
        for number, source in enumerate(
            (known, motions()[3], sway(4, skeleton=KIT21), sway(4, skeleton=SKELETONS["smpl24"]))
        ):
            for ending in (".npz", ".json", ".npy", ".bvh", ".glb", ".vrma"):
                path = folder / f"{number}{ending}"
                message = outcome(source.save, path, **({"seed": 7} if ending == ".npz" else {}))
                if number:
                    results[path.name] = [without_paths(folder, message)]
                else:
                    results[path.name] = [
                        message.partition("mean joint error")[0].replace(str(folder), "")
                    ]
                if ending == ".npz":
                    results[path.name] += [nested_traits(dict(np.load(path)))]
                elif ending == ".json":
                    results[path.name] += [nested_traits(json.loads(path.read_text()))]
    return results


def motions_in_memory() -> Any:
    results: dict[str, Any] = {}
    known = posed(9, 1.1, heading=np.linspace(2, 4, 9), left_elbow=[0, 40.0, 10])
    whole = Motion(
        known.joints,
        20,
        text="t",
        id="i",
        contacts=np.arange(36).reshape(9, 4) % 3 == 0,
        poses=known.posed(),
        cleanup=True,
        parts=(("a", 0, 4), ("b", 4, 9)),
        notes=("n",),
        bones=motion.BoneRotations(known.posed()),
    )
    plain = Motion(whole.joints, 20, contacts=whole.contacts, id="x" * 80)
    for source, label in ((whole, "known"), (plain, "plain")):
        for fps in (20.0, 30.0, 12.5, 59.94):
            other = source.resampled(fps)
            results[f"{label} {fps}"] = [
                repr(other),
                traits(other.joints),
                other.parts,
                other.notes,
                other.cleanup,
                traits(other.contacts),
                *(
                    traits(part, 3)
                    for part in (vars(other.bones.poses).values() if other.bones.poses else ())
                ),
                *(traits(part, 3) for part in (vars(other.poses).values() if other.poses else ())),
            ]
    results["amass"] = [traits(part) for part in motion.amass_parameters(known.posed())]
    wrong: list[dict[str, Any]] = [
        {"joints": np.ones((2, 21, 3))},
        {"joints": np.ones((0, 22, 3))},
        {"joints": np.full((2, 22, 3), np.inf)},
        {"fps": 0},
        {"contacts": np.ones((2, 3))},
        {"skeleton": KIT21},
    ]
    for number, change in enumerate(wrong):
        results[f"wrong {number}"] = str(
            outcome(Motion, **{"joints": np.ones((2, 22, 3)), "fps": 20, "id": "i"} | change)
        )
    return results


def rotations_of_bones() -> Any:
    results: dict[str, Any] = {}
    known = posed(
        8,
        1.1,
        heading=np.linspace(2, 4, 8),
        left_elbow=[0, 40.0, 10],
        left_wrist=[30.0, 0, 0],
        neck=[0, 30.0, 0],
        right_knee=[40.0, 0, 0],
    )
    with temporary_folder() as folder:
        for number, name in enumerate(RIGS):
            path = folder / f"{name}.bvh"
            known.save(path, rig=name, rest_pose=number % 2 == 0)
            tree = bvh.read(path)
            layout, listed = layouts.tree_layout(tree, {"mirrored": True} if number == 8 else {})
            positions, worlds = bvh.forward_kinematics(
                tree.parents, tree.rotations(), tree.translations()
            )
            joints = layout.apply(positions, listed)
            for label, turns, front in (
                ("plain", worlds, None),
                ("front", worlds, tree.rotations()[0]),
                ("off", np.roll(worlds, 3, 1), None),
            ):
                read = bones.bone_poses(tree, layout, joints, turns, front)
                results[f"{name} {label}"] = (
                    [read.reason] + [traits(part, 3) for part in vars(read.poses).values()]
                    if read.poses
                    else read.reason
                )
    return results


def files_in_folders() -> Any:
    with temporary_folder() as folder:
        empty = without_paths(folder, str(outcome(formats.motion_files, folder)))
        for name in (
            "b.BVH",
            "a.npz",
            ".hidden.bvh",
            "sub/c.amc",
            "__MACOSX/d.bvh",
            "shape.npz",
            "x_stagei.npz",
            "e.txt",
            ".git/f.bvh",
            "x.json",
            "y.json",
        ):
            path = folder / name
            path.parent.mkdir(exist_ok=True)
            path.write_text('{"posed_joints": [[1' if name == "y.json" else "text")
        (folder / "folder.bvh").mkdir()
        (folder / "sub" / "long.json").write_text(" " * (2**20 - 5) + '"joints" : [ [')
        listed = [str(path.relative_to(folder)) for path in formats.motions_in(folder)]
    errors = [
        str(formats.unread(Path(name))) for name in ("a.gltf", "b", "c.PKL", "d.xyz", "e.trc")
    ]
    return [empty, listed, errors]


def names_of_recordings() -> Any:
    return [
        recordings.known_rate(name, skeleton, fps)
        for name in (
            "60_01",
            "subject 136_19 x",
            "136_18",
            "060_01",
            "1234_01",
            "60_1",
            "89_003",
            "02_33_01",
        )
        for skeleton in ("CMU", "CMU ASF without toes", "Daz", "Mixamo")
        for fps in (120.0, 119.6, 119.4, 60.0)
    ]


def spellings_of_names() -> Any:
    words = (
        "LeftHip",
        "L_Hip",
        "hip.L",
        "mixamorig:LeftUpLeg",
        "Bip01 L Calf",
        "pelvis",
        "lradius",
        "Shoulder_L",
        "LeftLeft",
        "lll",
        "",
    )
    pairs = [(word, word.replace("Left", "Right").replace("L", "R")) for word in words]
    pairs += [("lradius", "rradius"), ("Left_L", "Right_L")]
    return [
        [names.plain(word) for word in words],
        [names.spellings(*pair) for pair in pairs],
        names.spelled({"L_Hip": "R_Hip", "R_Hip": "L_Hip", "HipL": "HipR", "spine": "spine"}),
    ]


def matches_of_layouts() -> Any:
    rng = np.random.default_rng(47)
    results: dict[str, Any] = {}
    for number, (label, layout) in enumerate(layouts.LAYOUTS.items()):
        used = sorted(layout.used)
        results[label] = [
            used,
            layout.name,
            layout.rig,
            layout.bones,
            layout.pairs(),
            layout.ending(foot="ankle"),
            layout.unit,
            layout.up,
            layout.mirrored,
            len(layout.joints),
            [layout.bone(joint) for joint in SMPL22.joints],
        ]
        positions = rng.normal(size=(3, len(used), 3))
        results[label] += [traits(layout.apply(positions, used))]
        spelled = {
            "prefix": [f"Rig{number}:{name}" for name in used],
            "upper": [name.upper() for name in used],
            "more": ["Prop", *used, "Camera"],
            "fewer": used[: 14 + number % 8],
            "joined": [f"mixamorig7{name}" for name in used],
            "spaced": [name.replace("_", " ") for name in used],
            "twice": [*used, used[3].lower() + "_"],
        }
        for kind, listed in spelled.items():
            chosen = outcome(
                layouts.find_layout, listed, {"up": "z"} if number % 2 else {"unit": 0.5}
            )
            results[f"{label} {kind}"] = (
                chosen[:160]
                if isinstance(chosen, str)
                else [
                    chosen.name,
                    chosen.map["left_foot"],
                    chosen.map["spine1"],
                    chosen.bones.get("left_collar"),
                    chosen.up,
                    chosen.unit,
                ]
            )
    for turn in combinations(1, 9, up=("y", "z", "-y"), mirrored=(False, True), unit=(1.0, 0.3)):
        results[str(turn)] = traits(layouts.Layout(**turn).turn(np.arange(12.0).reshape(2, 2, 3)))
    results["opposite"] = [layouts.opposite(joint) for joint in SMPL22.joints]
    for count in (1, 17, 21, 22, 24, 30, 52, 77):
        joints = rng.normal(size=(2, count, 3))
        chosen = outcome(layouts.array_layout, joints, {})
        results[f"array {count}"] = (
            chosen if isinstance(chosen, str) else [chosen[0].name, chosen[1]]
        )
    listed = [f"j{number}" for number in range(22)]
    mapped = {
        "joints": listed,
        "map": dict(zip(SMPL22.joints, listed[::-1], strict=True)),
        "unit": 2.0,
    }
    results["own map"] = [
        outcome(layouts.array_layout, np.ones((2, 22, 3)), fields)
        for fields in (
            mapped,
            mapped | {"joints": listed[:9]},
            {"map": mapped["map"]},
            {"joints": listed},
        )
    ]
    results["shapes"] = [
        outcome(layouts.array_layout, np.ones(shape), {})
        for shape in ((2, 22), (0, 22, 3), (2, 22, 2))
    ]
    results["candidates"] = [
        outcome(rig.matched, "a file", dict(enumerate("abcd")), candidates)
        for candidates in (
            {"pelvis": [0]},
            {"pelvis": [0, 2]},
            {joint: [k] for k, joint in enumerate(SMPL22.joints)},
        )
    ]
    results["recognized"] = rig.recognized(
        {4: "Hips", 7: "Spine", 9: "LeftLeg", 2: "Leg.L"},
        [{"hips": "pelvis"}, {"leftleg": "left_knee", "hips": "pelvis"}],
    )
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
