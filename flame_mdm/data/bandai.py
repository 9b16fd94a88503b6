"""Bandai-Namco-Research-Motiondataset 1 and 2: 3,077 takes by three actors.

The actors perform 25 actions, called contents, in 19 styles. Source: Kobayashi et al., arXiv
2306.08861, 2023; CC BY-NC 4.0. `docs/bandai.md` describes the data set and its preparation.
"""

import re
from collections.abc import Iterator, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from flame_mdm.data import (
    Clip,
    MotionSource,
    Split,
    archives,
    mirrored,
    name_hash,
    required,
    split_blocks,
    swap_sides,
)
from flame_mdm.data.parallel import in_order
from flame_mdm.errors import UserError
from flame_mdm.formats import bvh
from flame_mdm.formats.layouts import LAYOUTS
from flame_mdm.formats.readers import read_recording
from flame_mdm.representations.skeleton import SMPL22, SMPL24
from flame_mdm.safe_io import read_package_yaml

_MAP = LAYOUTS["Bandai-Namco"].map
JOINTS = {
    name: joint if isinstance(joint := _MAP[name], str) else next(iter(joint))
    for name in SMPL22.joints
}
"""For each SMPL joint, the name of the joint in the files. spine1 lies between Hips and Spine.
"""

_LEFT, _UP, _FORWARD = np.eye(3)
_TOES = np.array([np.sin(0.153), 0.0, np.cos(0.153)])  # direction of SMPL's left foot


def _axes(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns a matrix with orthonormal columns.

    The columns are the direction of x, the direction of the component of y that is perpendicular to
    x, and the cross product of these two.
    """
    first = x / np.linalg.norm(x)
    third = np.cross(first, y) / np.linalg.norm(np.cross(first, y))
    return np.stack([first, np.cross(third, first), third], 1)


def _limb(name: str, bone: Sequence[float] | np.ndarray, y: np.ndarray) -> dict[str, np.ndarray]:
    """Returns the axes of a joint in the left limb, and the mirrored axes for the right limb.

    In the right limb, the bone points along -x.
    """
    left = _axes(np.asarray(bone), y)
    return {f"{name}_L": left, f"{name}_R": np.diag([1.0, -1.0, -1.0]) @ left}


def _sloping(degrees: float) -> np.ndarray:
    return np.cos(np.radians(degrees)) * _TOES - np.sin(np.radians(degrees)) * _UP


# Directions of each joint's local axes (columns) when the body is in SMPL's rest pose: standing
# straight with flat feet, with the arms stretched out and the palms down. In this pose, all SMPL
# rotations are the identity. The bones of arms and legs lie on the x axis and have the directions
# of SMPL's rest pose. Knees and elbows bend about y. `docs/bandai.md` explains how the axes were
# measured.
REST = {
    "Hips": _axes(_UP, -_LEFT),
    **dict.fromkeys(("Spine", "Chest", "Neck", "Head"), _axes(_UP, _FORWARD)),
    **_limb("Shoulder", (0.12, 0.045, -0.02), _UP),
    **_limb("UpperArm", (0.26, -0.015, -0.025), _UP),
    **_limb("LowerArm", (0.267, 0.01, 0.0), _UP),
    **_limb("Hand", (0.267, 0.01, 0.0), _UP),
    **_limb("UpperLeg", (0.035, -0.39, 0.0), _LEFT),
    **_limb("LowerLeg", (-0.015, -0.425, -0.04), _LEFT),
    **_limb("Foot", _sloping(39.8), np.cross(_UP, _TOES)),
    **_limb("Toes", _sloping(23.0), np.cross(_UP, _TOES)),
}
# Converts between y up and AMASS's z up: (-x, z, y). The SMPL representation converts back when
# decoding.
AXES = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])

WORDS = read_package_yaml(Path(__file__).with_suffix(".yaml"))  # contents, styles and captions
CONTENTS_1, STYLES_1 = tuple(WORDS["dataset_1"]["contents"]), tuple(WORDS["dataset_1"]["styles"])
STYLES_2 = tuple(WORDS["dataset_2"]["styles"])
TAKES_2: dict[str, list[int]] = WORDS["dataset_2"]["takes"]
"""For each content of data set 2, the number of published takes per style.

The styles are in the order of `STYLES_2`. Splits are drawn from these numbers, so that they do not
depend on which files exist.
"""

WRONG_SIDE, SIDES = WORDS["wrong_side"], WORDS["sides"]
HELD_OUT = frozenset(
    (content, style)
    for group in WORDS["held_out"]
    for content in group["contents"]
    for style in group["styles"]
)
"""Combinations of content and style that never occur in training with the compositional split."""
GET_IT = (
    "the data sets are published at https://github.com/BandaiNamcoResearchInc/Bandai-Namco-Research-Motiondataset (CC "
    "BY-NC 4.0): clone the repository, then run `make prepare` with SOURCE=/path/to/the/clone"
)
FILE = re.compile(r"dataset-([12])_([^_]+)_([^_]+)_(\d+)\.bvh")


class Take(NamedTuple):
    """One BVH file.

    `content` is the action that the actor performs. For the takes in `WRONG_SIDE`, it differs from
    the content in the file name.
    """

    file: Path
    dataset: int
    content: str
    style: str
    split: Split


class Bandai(MotionSource):
    """Both data sets, converted to SMPL's skeleton. The captions state the content and the style.

    Args:
        path: a clone of the original repository, a folder that contains the BVH files at any
            depth, or an archive of such a folder.
        motion: "joints" for representations of joint positions, "smpl" for representations of
            rotations.
        mirror: whether a mirrored copy follows each clip of the training split.
        workers: number of processes; 0 = one per core.
        exclude: file names (without extension) of the takes to leave out.
        split: with "takes", the combinations of content and style in the held-out takes also occur
            in training. With "compositional", the combinations in `HELD_OUT` are held out, so
            training includes their contents and styles only in other combinations.
    """

    name = "bandai"
    license = "CC-BY-NC-4.0"
    captions_may_be_shared = True
    actions = tuple(dict.fromkeys([*CONTENTS_1, *TAKES_2]))

    def __init__(
        self,
        path: str,
        motion: Literal["joints", "smpl"] = "joints",
        mirror: bool = True,
        workers: int = 0,
        exclude: Sequence[str] = (),
        split: Literal["takes", "compositional"] = "takes",
    ):
        self.path, self.workers, self.exclude = Path(path), workers, tuple(exclude)
        self.motion, self.mirror, self.split = motion, mirror, split
        self.options = {
            "motion": motion,
            "mirror": mirror,
            "exclude": list(exclude),
            "split": split,
        }

    def count(self) -> int:
        """Returns the number of clips: takes and mirrored copies."""
        return sum(1 + (self.mirror and take.split == "train") for take in self.takes)

    def counts(self) -> dict[str, int]:
        """Returns the number of takes, in total and per data set."""
        one, two = ([take.dataset for take in self.takes].count(number) for number in (1, 2))
        return {"takes": one + two, "takes of data set 1": one, "takes of data set 2": two}

    def clips(self, fps: float) -> Iterator[Clip]:
        """Yields all takes. With `mirror`, each training take is followed by its mirrored copy.

        The attributes of a clip are `content`, `style` and `dataset`, and also `side` if the
        content has a side.
        """
        convert_one = partial(convert, fps=fps, kind=self.motion)
        motions = in_order(convert_one, [take.file for take in self.takes], self.workers)
        for take, motion in zip(self.takes, motions, strict=True):
            side, name = side_of(take.content), take.file.stem
            attributes = {"content": take.content, "style": take.style, "dataset": take.dataset}
            if side:
                attributes["side"] = side
            texts = captions(take.content, take.style, side)
            action = self.actions.index(take.content)
            clip = Clip(name, motion, texts, take.split, name, action, attributes)
            yield clip
            if self.mirror and take.split == "train":
                yield mirrored(clip, mirror(motion), self.actions)

    @cached_property
    def takes(self) -> list[Take]:
        """The takes that exist and are not excluded, sorted by name."""
        files: dict[str, Path] = {}
        folder = archives.as_folder(
            required(self.path, GET_IT), self, lambda name: name.endswith(".bvh")
        )
        for file in sorted(folder.rglob("dataset-*.bvh")):
            if FILE.fullmatch(file.name) and files.setdefault(file.stem, file) != file:
                raise UserError(
                    f"{self.path}: {file.stem} exists twice, as {files[file.stem]} and {file}. Delete one of them"
                )
        if not files:
            raise FileNotFoundError(
                f"{self.path}: contains no file dataset-1_*.bvh or dataset-2_*.bvh; {GET_IT}"
            )
        return [
            _take(file, self.split)
            for _, file in sorted(self.not_excluded(files, self.path).items())
        ]


def convert(file: Path, fps: float, kind: str = "joints") -> np.ndarray:
    """Converts a BVH file to joint positions or an SMPL motion.

    Joint positions (F, 22, 3) are float32, in meters, with y up.

    Args:
        file: the BVH file.
        fps: frames per second of the result.
        kind: "joints" for joint positions, or "smpl" for the result (F, 75) of `smpl_motion`.

    Raises:
        UserError: If the file does not have the skeleton of the data set, or if a joint jumps.
    """
    recording = read_recording(file, fps, standard=_standard)
    if recording.doubts.jump:
        raise UserError(f"{file}: {recording.doubts.jump}")
    if kind == "smpl" and recording.tree is not None:
        return smpl_motion(recording.tree, *recording.tree.resample(fps))
    return recording.motion.joints


def _standard(tree: bvh.Bvh) -> tuple[bvh.Bvh, dict[str, Any]]:
    if missing := set(JOINTS.values()) - set(tree.joints):
        raise UserError(
            f"this is not the skeleton of the data set: it lacks {', '.join(sorted(missing))}"
        )
    return tree, {"map": _MAP, "unit": LAYOUTS["Bandai-Namco"].unit}


def smpl_motion(skeleton: bvh.Bvh, rotations: np.ndarray, translations: np.ndarray) -> np.ndarray:
    """Converts a take to an SMPL motion (F, 75) float32 in AMASS's axes, with z up.

    Each frame contains the position of the pelvis in meters and the axis-angle vectors of 24
    joints. The hands (joints 22 and 23) do not rotate.

    Args:
        skeleton: skeleton of the file.
        rotations: (F, J, 3, 3), rotation of each joint relative to its parent.
        translations: (F, J, 3), translation of each joint relative to its parent, in centimeters.
    """
    # Each SMPL joint has the same parent as in the file, except spine1, which lies between two
    # joints of the file and rotates with the pelvis. Therefore, with the axes B of the rest pose, a
    # rotation R of the file is converted to the SMPL rotation B_parent R B_joint^-1.
    positions, turned = bvh.forward_kinematics(skeleton.parents, rotations, translations)
    local = np.tile(np.eye(3), (len(rotations), 24, 1, 1))
    hips = skeleton.joints.index("Hips")
    for joint, name in enumerate(JOINTS.values()):
        if name != "Hips":
            index = skeleton.joints.index(name)
            parent = skeleton.joints[skeleton.parents[index]]
            local[:, joint] = REST[parent] @ rotations[:, index] @ REST[name].T
    local[:, 0] = AXES @ turned[:, hips] @ REST["Hips"].T
    vectors = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(len(local), -1)
    return np.concatenate([positions[:, hips] @ AXES / 100, vectors], 1).astype(np.float32)


def mirror(motion: np.ndarray) -> np.ndarray:
    """Returns the mirror image of joint positions (F, 22, 3) or of an SMPL motion (F, 75)."""
    if motion.ndim == 3:
        return SMPL22.mirror(torch.from_numpy(motion)).numpy()
    vectors = motion[:, 3:].reshape(len(motion), 24, 3)[:, list(SMPL24.mirrored)] * np.array(
        [1, -1, -1], motion.dtype
    )
    translation = motion[:, :3] * np.array([-1, 1, 1], motion.dtype)
    return np.concatenate([translation, vectors.reshape(len(motion), -1)], 1)


def side_of(content: str) -> str:
    """Returns "left", "right" or "both": the side that moves or to which the body moves.

    The result is "" if the content has no side.
    """
    named = re.search("left|right|both", content)
    return named[0] if named else SIDES.get(content, "")


def captions(content: str, style: str, side: str) -> list[str]:
    """Returns four captions for a take, in the style of HumanML3D's captions."""
    contents, styles = WORDS["contents"], WORDS["styles"]
    phrases = zip(contents[re.sub("left|right", "{side}", content)], styles[style], strict=True)
    filled = (
        phrase.format(side=side, other=swap_sides(side), how=manner) for phrase, manner in phrases
    )
    return [" ".join(caption.split()).replace(" ,", ",") for caption in filled]


def split_of(dataset: int, content: str, style: str, number: int, rule: str = "takes") -> Split:
    """Returns the split of a take. The split depends only on the take's name.

    In data set 2, neighboring takes are similar, so each block of five takes is kept in one split.
    Data set 1 contains only one take for most combinations, so each combination is kept in one
    split. The takes of walk-turn-left and walk-turn-right in normal style overlap in time, so all
    of them are used for training.

    With the rule "compositional", the combinations in `HELD_OUT` form the test split. Other takes
    that the rule "takes" would assign to the test split are used for training.
    """
    if rule == "compositional":
        if (content, style) in HELD_OUT:
            return "test"
        return "val" if split_of(dataset, content, style, number) == "val" else "train"
    if dataset == 1:
        draw = (name_hash(f"dataset-1_{content}_{style}") >> 128) % 20
        return "test" if draw < 2 else "val" if draw == 2 else "train"
    if style == "normal" and content.startswith("walk-turn-"):
        return "train"
    takes = TAKES_2[content][STYLES_2.index(style)]
    return split_blocks(f"dataset-2_{content}_{style}", takes, 5, val=0.05, test=0.1)[
        (number - 1) // 5
    ]


def _take(file: Path, rule: str) -> Take:
    name, content, style, number = file.stem.split("_")
    dataset = int(name[-1])
    contents, styles = (CONTENTS_1, STYLES_1) if dataset == 1 else (TAKES_2, STYLES_2)
    if content not in contents or style not in styles:
        raise UserError(
            f"{file.name}: data set {dataset} has no content {content} with style {style}"
        )
    split = split_of(dataset, content, style, int(number), rule)
    return Take(
        file, dataset, swap_sides(content) if file.stem in WRONG_SIDE else content, style, split
    )


def prompts() -> list[str]:
    """Returns the prompts of this data set's recipes, in the style of the captions.

    During training, samples are generated for these prompts.
    """
    return WORDS["prompts"]
