"""Small data sets in the layouts of the published ones, and a source of any clips."""

import json
import pickle
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from flame_mdm.data import Clip, MotionSource, Split
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.data.uestc import TRAIN_SUBJECTS
from flame_mdm.data.verify import PUBLISHED
from flame_mdm.formats import bvh
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
        features = np.tile(1000.0 * number + np.arange(frames)[:, None], (1, width)).astype(np.float32)
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
    found = [poses(20 + 7 * (k % 15), k) for k in range(clips)]
    data = {
        "poses": [pose for pose, _ in found],
        "oldposes": [pose for pose, _ in found],
        "joints3D": [joints for _, joints in found],
        "y": [k % 12 for k in range(clips)],
    }
    folder.mkdir()
    return written(folder / "humanact12poses.pkl", data | columns)


VIDEOS = [
    *(f"a{k % 40}_d0_p{subject:03d}_c1_color.avi" for k, subject in enumerate([*TRAIN_SUBJECTS, 3, 4, 118])),
    "a3_d5_p003_c2_color.avi",
    "a3_d8_p003_c2_color.avi",
    "a3_d8_p004_c1_color.avi",
    "a4_d2_p001_c2_color.avi",
    "a5_d1_p001_c1_color.avi",
    "a5_d1_p005_c1_color.avi",
]


def write_uestc(folder: Path, **changed) -> Path:
    """What ACTOR hands out: one pickle of three lists of float32 arrays, and text files beside it."""
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
    (folder / "info" / "action_classes.txt").write_text("".join(f"exercise-{k}\n" for k in range(40)))
    return folder


# BABEL on AMASS -----------------------------------------------------------------------------------------------------

BABEL_FILES = ("train", "extra_train", "val", "extra_val")


def write_amass(path: Path, frames: int, fps: float, seed: int = 0) -> None:
    """An AMASS file: SMPL+H's 156 numbers, the gender as bytes, keys that nothing here reads."""
    rng = np.random.default_rng(seed)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(
        path,
        trans=rng.normal(size=(frames, 3)),
        gender=np.array(b"female"),
        mocap_framerate=np.array(fps),
        betas=np.zeros(16),
        dmpls=np.zeros((frames, 8)),
        poses=rng.normal(size=(frames, 156)) * 0.3,
    )


def sequence(name: str, labels: list[dict] | None, extra: bool) -> dict:
    """One entry of a file of BABEL; `name` is the path of the motion in AMASS."""
    annotation = None if labels is None else {"babel_lid": "x", "anntr_id": "y", "mul_act": True, "labels": labels}
    whole = {
        "babel_lid": "z",
        "labels": [{"raw_label": "walk", "proc_label": "walk", "seg_id": "s", "act_cat": ["walk"]}],
    }
    if extra:
        other = {"babel_lid": "x", "labels": [label("another annotator", ["jump"], 0, 9)]}
        annotations = None if annotation is None else [annotation, other]
        kept = {"seq_anns": [whole], "frame_anns": annotations}
    else:
        kept = {"seq_ann": whole, "frame_ann": annotation}
    return {"babel_sid": 0, "url": "https://", "feat_p": f"{name.split('/')[0]}/{name}", "dur": 1.0, **kept}


def label(text: str, categories: list[str] | None, start: float | None, end: float | None) -> dict:
    return {
        "raw_label": text.upper(),
        "proc_label": text,
        "seg_id": "s",
        "act_cat": categories,
        "start_t": start,
        "end_t": end,
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
    names = [f"CMU/{k:02d}/{k:02d}_01_poses.npz" for k in [*range(23), 27]]  # of the val part, 27 is for testing
    for seed, name in enumerate(names):
        write_amass(root / "amass" / name, 900, 60.0, seed)
    sequences = {
        "train": {str(k): sequence(name, LABELS if k else None, False) for k, name in enumerate(names[:12])},
        "extra_train": {str(k): sequence(name, LABELS[:1], True) for k, name in enumerate(names[12:14])},
        "val": {str(k): sequence(name, LABELS, False) for k, name in enumerate(names[14:])},
    }
    return write_babel(root / "babel", sequences), root / "amass"


# Bandai-Namco -------------------------------------------------------------------------------------------------------

HIERARCHY = """
joint_Root - 0 0 0
Hips joint_Root 0 93.9 -3
Spine Hips 15.74 0 0
Chest Spine 8.98 -0.41 0
Neck Chest 16.38 0 0
Head Neck 6.46 0 0
Shoulder_L Chest 12.99 -0.24 4.98
UpperArm_L Shoulder_L 5.35 0 0
LowerArm_L UpperArm_L 24.33 0 0
Hand_L LowerArm_L 22.29 0 0
Shoulder_R Chest 12.99 -0.24 -4.98
UpperArm_R Shoulder_R -5.35 0 0
LowerArm_R UpperArm_R -24.33 0 0
Hand_R LowerArm_R -22.29 0 0
UpperLeg_L Hips -2.19 -6.47 0
LowerLeg_L UpperLeg_L 39.08 0 0
Foot_L LowerLeg_L 40.98 0 0
Toes_L Foot_L 11.75 0 0
UpperLeg_R Hips -2.19 6.47 0
LowerLeg_R UpperLeg_R -39.08 0 0
Foot_R LowerLeg_R -40.98 0 0
Toes_R Foot_R -11.75 0 0
"""


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


def synthetic_take(seed: int, frames: int) -> bvh.Bvh:
    """Smooth random turns of all joints of the real skeleton; the hips wander."""
    rng = np.random.default_rng(seed)
    rows = [line.split() for line in HIERARCHY.split("\n") if line]
    joints = tuple(row[0] for row in rows)
    offsets = np.array([row[2:] for row in rows], float)
    time = np.arange(frames)[:, None, None] / 30
    phase, size = rng.uniform(0, 6, (2, 22, 3))
    values = np.concatenate([np.tile(offsets, (frames, 1, 1)), 20 * size * np.sin(3 * time + phase)], 2)
    values[:, 0] = 0
    values[:, 1, :3] += 30 * np.sin(2 * time[:, 0] + phase[1])
    channels = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    ends = [joints.index(name) for name in ("Head", "Hand_L", "Hand_R", "Toes_L", "Toes_R")]
    return bvh.Bvh(
        joints,
        tuple(-1 if row[1] == "-" else joints.index(row[1]) for row in rows),
        offsets,
        (channels,) * 22,
        tuple(ends),
        np.zeros((5, 3)),
        values.reshape(frames, -1),
        30.0,
    )
