"""Small data sets in the layouts of the published ones, and a source of any clips."""

import io
import json
import pickle
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.data import Clip, MotionSource, Split
from flame_mdm.data.bandai import REST
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.data.uestc import TRAIN_SUBJECTS
from flame_mdm.data.verify import PUBLISHED
from flame_mdm.formats import bvh
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.safe_io import read_yaml


class OwnClips(MotionSource):
    """A data set of the clips that its constructor gets."""

    name = "own-clips"

    def __init__(self, *clips):
        self.own = clips

    def count(self):
        return len(self.own)

    def clips(self, fps):
        yield from self.own


def clip(name, split: Split = "train", source=None, motion=None, **options):
    joints = next(iter(Synthetic(clips=1).clips(20.0))).motion if motion is None else motion
    return Clip(name, joints, ["a person walks"], split, source or name, **options)


# HumanML3D and KIT-ML as processed by Guo et al. -------------------------------------------------------------------

Texts = Mapping[str, tuple[int, list[str]]]
"""Name -> number of frames, lines of the text file."""


def published(name: str) -> dict:
    """The published figures of a data set."""
    return read_yaml(PUBLISHED)[name]


def line(caption: str, begin: object = 0.0, end: object = 0.0) -> str:
    """A description as in the text files."""
    return f"{caption}#{' '.join(f'{word}/NOUN' for word in caption.replace('#', '').split())}#{begin}#{end}"


def write_folder(
    folder: Path, motions: Texts, splits: Mapping[str, list[str]], width: int, mirror: bool = True
) -> Path:
    """Features count up from 1000 x the number of the motion, so that a frame tells where it comes from."""
    (folder / "new_joint_vecs").mkdir(parents=True)
    (folder / "texts").mkdir()
    for number, (name, (frames, lines)) in enumerate(motions.items()):
        features = np.tile(1000.0 * number + np.arange(frames)[:, None], (1, width)).astype(
            np.float32
        )
        for copy, values in ((name, features), (f"M{name}", -features)):
            if copy == name or mirror:
                np.save(folder / "new_joint_vecs" / f"{copy}.npy", values)
                (folder / "texts" / f"{copy}.txt").write_text("\n".join(lines) + "\n")
    for split, names in splits.items():
        copies = [copy for name in names for copy in ((name, f"M{name}") if mirror else (name,))]
        (folder / f"{split}.txt").write_text("\n".join(copies) + "\n")
    np.save(folder / "Mean.npy", np.linspace(-1, 1, width))
    np.save(folder / "Std.npy", np.linspace(0.5, 2, width))
    return folder


def write_words(folder: Path, words: list[str], vectors: np.ndarray) -> Path:
    """Word vectors (N, 300) under the names that Guo et al. gave their files."""
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "our_vab_data.npy", vectors)
    (folder / "our_vab_idx.pkl").write_bytes(
        pickle.dumps({word: row for row, word in enumerate(words)})
    )
    return folder


# HumanAct12 and UESTC -----------------------------------------------------------------------------------------------


def written(path: Path, content: object, protocol: int = 4) -> Path:
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def poses(frames: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """SMPL poses (F, 72) and joints (F, 24, 3) that wander."""
    rng = np.random.default_rng(seed)
    joints = rng.normal(size=(1, 24, 3)) + 0.02 * rng.normal(size=(frames, 1, 3)).cumsum(0)
    return 0.3 * rng.normal(size=(frames, 72)).astype(np.float32), joints.astype(np.float32)


def write_humanact12(folder: Path, clips: int = 360, **columns) -> Path:
    """The pickle as ACTOR hands it out: lists of arrays of all lengths, labels in no order."""
    made = [poses(20 + 7 * (k % 15), k) for k in range(clips)]
    turns, joints = [pose for pose, _ in made], [positions for _, positions in made]
    data = {
        "poses": turns,
        "oldposes": turns,
        "joints3D": joints,
        "y": [k % 12 for k in range(clips)],
    }
    folder.mkdir()
    return written(folder / "humanact12poses.pkl", data | columns)


VIDEOS = [
    *(
        f"a{k % 40}_d0_p{subject:03d}_c1_color.avi"
        for k, subject in enumerate([*TRAIN_SUBJECTS, 3, 4, 118])
    ),
    "a3_d5_p003_c2_color.avi",
    "a3_d8_p003_c2_color.avi",
    "a3_d8_p004_c1_color.avi",
    "a4_d2_p001_c2_color.avi",
    "a5_d1_p001_c1_color.avi",
    "a5_d1_p005_c1_color.avi",
]


def write_uestc(folder: Path, **changed) -> Path:
    """Files as ACTOR publishes them: one pickle of three lists of float32 arrays, and text files."""
    (folder / "info").mkdir(parents=True)
    lengths = [60 + 3 * k for k in range(len(VIDEOS) - 2)] + [70, 50]
    rng = np.random.default_rng(0)
    data = {
        "pose": [0.5 * rng.normal(size=(n, 72)).astype(np.float32) for n in lengths],
        "shape": [np.zeros((n, 10), np.float32) for n in lengths],
        "joints3d": [rng.normal(size=(n, 49, 3)).astype(np.float32) for n in lengths],
        "orig_cam": [rng.uniform(0.2, 0.9, size=(n, 4)).astype(np.float32) for n in lengths],
    }
    written(folder / "vibe_cache_refined.pkl", data | changed)
    shown = [*lengths[:-2], 44, 44]
    (folder / "info" / "names.txt").write_text("\n".join(VIDEOS) + "\n")
    (folder / "info" / "num_frames_min.txt").write_text("\n".join(map(str, shown)) + "\n")
    (folder / "info" / "action_classes.txt").write_text(
        "".join(f"exercise-{k}\n" for k in range(40))
    )
    return folder


# AMASS, and HumanML3D before it is made from it ---------------------------------------------------------------------


def amass_file(seed: int, frames: int, fps: float, gender: str | bytes) -> dict[str, np.ndarray]:
    """A file of AMASS as its SMPL+H G release has them: somebody wanders and bends every joint."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None] / fps
    waves = np.sin(2 * np.pi * (rng.uniform(0.2, 0.6, 156) * time + rng.random(156)))
    return {
        "poses": 0.3 * waves + np.eye(1, 156, 0) * np.pi / 2,
        "trans": np.stack([0.5 * time[:, 0], 0.1 * np.sin(time[:, 0]), 0.9 + 0 * time[:, 0]], 1),
        "betas": rng.normal(size=16),
        "dmpls": np.zeros((frames, 8)),
        "gender": np.array(gender),
        "mocap_framerate": np.array(fps),
    }


def write_amass(path: Path, frames: int, fps: float, seed: int = 0) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, **amass_file(seed, frames, fps, b"male"))  # type: ignore[arg-type]


RECORDINGS = {
    "KIT/3/kick_high_left02_poses": amass_file(0, 360, 100.0, "male"),
    "BMLrub/rub001/0000_treadmill_norm_poses": amass_file(1, 400, 120.0, "female"),
    "Eyes_Japan_Dataset/hamada/pose-06 hangon_poses": amass_file(2, 360, 59.94, "male"),
    "CMU/80/80_63_poses": amass_file(3, 360, 120.0, "male"),
}
INDEX = """source_path,start_frame,end_frame,new_name
./pose_data/KIT/3/kick_high_left02_poses.npy,0,50,000000.npy
./pose_data/KIT/3/kick_high_left02_poses.npy,20,72,000001.npy
./pose_data/humanact12/humanact12/P11G01R02F1812T1847A0402.npy,0,-1,000002.npy
./pose_data/BioMotionLab_NTroje/rub001/0000_treadmill_norm_poses.npy,5,60,000003.npy
./pose_data/Eyes_Japan_Dataset/hamada/pose-06 hangon_poses.npy,3,60,000004.npy
./pose_data/CMU/80/80_63_poses.npy,1,48,000005.npy
"""
HUMANACT12 = poses(45, 5)[1].astype(np.float64)
"""Joints (45, 24, 3) of the clip of HumanAct12."""


def write_body(path: Path, seed: int) -> None:
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


def write_downloads(root: Path) -> Path:
    """Files of a user before HumanML3D is built: amass/, bodies/ and the repository HumanML3D/."""
    for name, content in RECORDINGS.items():
        path = root / "amass" / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **content)  # type: ignore[arg-type]
    np.savez(root / "amass" / "KIT" / "3" / "shape.npz", betas=np.zeros(16))
    for seed, gender in enumerate(("male", "female")):
        write_body(root / "bodies" / "smplh" / gender / "model.npz", seed)
    motions = {
        f"{n:06d}": (1, [line("a person moves"), line("someone moves", 0.5, 1)]) for n in range(6)
    }
    splits = {
        "train": ["000000", "000001", "000002", "000003"],
        "val": ["000004"],
        "test": ["000005"],
    }
    folder = write_folder(root / "HumanML3D" / "HumanML3D", motions, splits, 263)
    shutil.rmtree(folder / "new_joint_vecs")
    for name in ("Mean", "Std"):
        (folder / f"{name}.npy").unlink()
    (folder.parent / "index.csv").write_text(INDEX)
    (folder.parent / "pose_data").mkdir()
    clip = io.BytesIO()
    np.save(clip, HUMANACT12)
    with zipfile.ZipFile(folder.parent / "pose_data" / "humanact12.zip", "w") as archive:
        archive.writestr("humanact12/P11G01R02F1812T1847A0402.npy", clip.getvalue())
    return root


# KIT-ML as TEMOS reads it -------------------------------------------------------------------------------------------

KIT_FRAMES = {
    **{"00001": 801, "00002": 72, "00003": 73, "00004": 4001},
    **{"00005": 90, "00006": 100, "00007": 9, "00008": 161},
}
"""Name -> frames at 100 a second; the motions of `write_mmm`."""


def kit_walk(frames: int) -> np.ndarray:
    """(F, 21, 3) in KIT's unit at 100 frames a second: a rigid body on a wide circle."""
    body = np.random.default_rng(3).normal([0, 900, 0], 300, (21, 3))
    time = np.arange(frames)[:, None, None] / 100
    turn = 0.4 * time[..., 0]
    x, y, z = np.moveaxis(np.broadcast_to(body, (frames, 21, 3)), -1, 0)
    turned = np.stack(
        [np.cos(turn) * x + np.sin(turn) * z, y, np.cos(turn) * z - np.sin(turn) * x], -1
    )
    return turned + 1000 * np.concatenate([np.sin(time), 0 * time, np.cos(time)], 2)


def write_mmm(root: Path) -> Path:
    """The folders kit-mmm-xyz, which is returned, and kit-splits."""
    folder = root / "kit-mmm-xyz"
    folder.mkdir()
    names = [name.split("_")[-1] for name in KIT21.joints]
    head = ",".join(
        ["", *(f"{number}{name}_{axis}" for number, name in enumerate(names) for axis in "xyz")]
    )
    for name, frames in KIT_FRAMES.items():
        captions = (
            []
            if name == "00005"
            else ["A person walks in a circle.", f"Somebody walks, take {name}."]
        )
        (folder / f"{name}_annotations.json").write_text(json.dumps(captions))
        (folder / f"{name}_meta.json").write_text(
            json.dumps({"nb_annotations": len(captions), "motion": {}})
        )
        rows = np.column_stack([np.arange(frames), kit_walk(frames).reshape(frames, 63)])
        np.savetxt(folder / f"{name}_fke.csv", rows, "%.4f", ",", header=head, comments="")
    (root / "kit-splits").mkdir()
    splits = {
        "train": sorted(KIT_FRAMES)[:5],
        "val": ["00006"],
        "test": ["00007", "00008"],
        "ghosh-test": ["00008"],
    }
    for split, listed in splits.items():
        (root / "kit-splits" / split).write_text("\n".join(listed) + "\n")
    return folder


# BABEL --------------------------------------------------------------------------------------------------------------

BABEL_FILES = ("train", "extra_train", "val", "extra_val")


def sequence(name: str, labels: list[dict] | None, extra: bool) -> dict:
    """One entry of a file of BABEL; `name` is the path of the motion in AMASS."""
    annotation = (
        None
        if labels is None
        else {"babel_lid": "x", "anntr_id": "y", "mul_act": True, "labels": labels}
    )
    whole = {"babel_lid": "z", "labels": [label("walk", ["walk"], None, None)]}
    if extra:
        other = {"babel_lid": "x", "labels": [label("another annotator", ["jump"], 0, 9)]}
        annotations = None if annotation is None else [annotation, other]
        kept = {"seq_anns": [whole], "frame_anns": annotations}
    else:
        kept = {"seq_ann": whole, "frame_ann": annotation}
    return {
        "babel_sid": 0,
        "url": "https://",
        "feat_p": f"{name.split('/')[0]}/{name}",
        "dur": 1.0,
        **kept,
    }


def label(text: str, categories: list[str] | None, start: float | None, end: float | None) -> dict:
    times = {"start_t": start, "end_t": end}
    return {
        "raw_label": text.upper(),
        "proc_label": text,
        "seg_id": "s",
        "act_cat": categories,
        **times,
    }


def write_babel(folder: Path, sequences: dict[str, dict[str, dict]]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name in BABEL_FILES:
        (folder / f"{name}.json").write_text(json.dumps(sequences.get(name, {})))
    return folder


LABELS = [
    label("walk", ["walk", "move"], 0.0, 8.0),
    label("walk", ["walk"], 0.0, 8.0),  # said twice
    label("transition", ["transition"], 0.0, 2.0),
    label("", ["step"], 1.0, 3.0),
    label("wave", None, 2.0, 4.0),
    label("backwards", ["mislabeled"], 4.0, 3.0),
    label("nowhen", None, None, None),
    label("late", None, 12.0, 14.9),
    label("too late", None, 12.0, 16.0),
    label("nothing", None, 3.0, 3.06),
    label("lost", [], 2.0, 4.0),
]


def small_babel(root: Path) -> tuple[Path, Path]:
    """BABEL with a few motions of 15 s in both parts, and one without frame labels."""
    # Motion 27 is the one of the val part that is for testing.
    names = [f"CMU/{k:02d}/{k:02d}_01_poses.npz" for k in [*range(23), 27]]
    for seed, name in enumerate(names):
        write_amass(root / "amass" / name, 900, 60.0, seed)
    sequences = {
        "train": {
            str(k): sequence(name, LABELS if k else None, False)
            for k, name in enumerate(names[:12])
        },
        "extra_train": {
            str(k): sequence(name, LABELS[:1], True) for k, name in enumerate(names[12:14])
        },
        "val": {str(k): sequence(name, LABELS, False) for k, name in enumerate(names[14:])},
    }
    return write_babel(root / "babel", sequences), root / "amass"


# Bandai-Namco -------------------------------------------------------------------------------------------------------

TAKES = {
    "dataset-1_walk_happy_001": 28,
    "dataset-1_walk-left_old_001": 31,
    "dataset-1_bye_giant_001": 25,
    "dataset-2_walk-turn-left_normal_001": 34,
    "dataset-2_walk-turn-right_masculine_006": 22,
    "dataset-2_raise-up-right-hand_youthful_001": 19,
    "dataset-2_run_active_017": 40,
    "dataset-2_wave-both-hands_elderly_003": 23,
}


ROWS = [
    row.split()
    for row in (Path(__file__).parent / "bandai_skeleton.txt").read_text().splitlines()[1:]
]
BONES = {name: np.array(offset, float) for name, _, *offset in ROWS}
"""Joint -> where it is seen from its parent, in cm."""


def synthetic_take(seed: int, frames: int) -> bvh.Bvh:
    """Smooth random turns of all joints of the real skeleton from its rest pose; the hips wander."""
    rng = np.random.default_rng(seed)
    joints, offsets = tuple(BONES), np.stack(list(BONES.values()))
    time = np.arange(frames)[:, None, None] / 30
    phase, size = rng.uniform(0, 6, (2, 22, 3))
    axes = {name: REST.get(name, np.eye(3)) for name in ["-", *joints]}
    local = np.stack([axes[parent].T @ axes[name] for name, parent, *_ in ROWS])
    turns = Rotation.from_euler(
        "ZXY", (4 * size * np.sin(3 * time + phase)).reshape(-1, 3), degrees=True
    )
    posed = Rotation.from_matrix(np.tile(local, (frames, 1, 1))) * turns
    angles = posed.as_euler("ZXY", degrees=True).reshape(frames, -1, 3)
    values = np.concatenate([np.tile(offsets, (frames, 1, 1)), angles], 2)
    values[:, 0] = 0
    values[:, 1, :3] += 30 * np.sin(2 * time[:, 0] + phase[1])
    channels = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    ends = ("Head", "Hand_L", "Hand_R", "Toes_L", "Toes_R")
    return bvh.Bvh(
        (*joints, *(f"{name}.end" for name in ends)),
        (
            *(-1 if parent == "-" else joints.index(parent) for _, parent, *_ in ROWS),
            *map(joints.index, ends),
        ),
        np.concatenate([offsets, np.zeros((5, 3))]),
        (*(channels,) * 22, *[()] * 5),
        values.reshape(frames, -1),
        30.0,
    )
