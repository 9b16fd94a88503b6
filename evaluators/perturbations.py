# pyright: standard
"""Graded perturbations of real motions for audits: changes that a metric should detect or ignore.

Each function takes joint positions (F, J, 3) in meters, with y up, and keeps the number of frames
unless its docstring states otherwise. Random draws come from a generator that is passed as an
argument, so that all grades of a perturbation can use the same draws.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from evaluators.encoding import Joints, encode
from evaluators.protocol import DrawnClip
from evaluators.scene import NEAR, RANDOM, Scene, Text
from evaluators.sources import real_motions
from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.formats.resampling import resample
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SKELETONS
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.seeds import key

Draws = np.random.Generator
GROUND = np.array([1.0, 0.0, 1.0])
# Frequency of the wobble, in Hz
WOBBLE = 1.0
# Seconds over which a motion is blended into another motion
BLEND = 0.4
# Grades of perturbations that replace motions: the percentage of the motions
SHARES = (5, 10, 20, 50, 100)


def jitter(joints: Joints, millimeters: float, draws: Draws) -> Joints:
    """Adds Gaussian noise to all coordinates, independently in each frame."""
    return joints + millimeters / 1000 * draws.standard_normal(joints.shape)


def wobble(joints: Joints, millimeters: float, draws: Draws, fps: float) -> Joints:
    """Moves each joint back and forth in a random direction.

    The movement is a 1 Hz sine with the given amplitude.
    """
    along = draws.standard_normal(joints.shape[1:])
    phase = draws.uniform(0, 2 * np.pi, (1, joints.shape[1]))
    sine = np.sin(2 * np.pi * WOBBLE / fps * np.arange(len(joints))[:, None] + phase)
    return joints + millimeters / 1000 * sine[..., None] * along / np.linalg.norm(
        along, axis=-1, keepdims=True
    )


def skate(joints: Joints, factor: float) -> Joints:
    """Multiplies the horizontal speed of the root but keeps the poses, so that the feet slide."""
    return joints + (factor - 1) * ((joints[:, :1] - joints[:1, :1]) * GROUND)


def lift(joints: Joints, centimeters: float) -> Joints:
    """Raises the body above the floor, or lowers it into the floor."""
    return joints + np.array([0, centimeters / 100, 0])


def resize(joints: Joints, percent: float) -> Joints:
    """Lengthens all bones by a percentage, but keeps the floor and the root's path on it."""
    ground = joints[:, :1] * GROUND
    return ground + (1 + percent / 100) * (joints - ground)


def pop(joints: Joints, centimeters: float, draws: Draws, *, last: bool = False) -> Joints:
    """Displaces the whole body in a random direction in one frame: a random interior frame or the last."""
    frame = int(draws.integers(1, len(joints) - 1))
    direction = draws.standard_normal(3)
    popped = joints.copy()
    popped[-1 if last else frame] += centimeters / 100 * direction / np.linalg.norm(direction)
    return popped


def draw_in(joints: Joints, centimeters: float) -> Joints:
    """Moves the wrists toward (but not past) the axis of the trunk, and the elbows half as far."""
    names = next(
        skeleton.joints for skeleton in SKELETONS.values() if len(skeleton) == joints.shape[1]
    )
    changed, neck = joints.copy(), joints[:, names.index("neck")]
    for side in ("left", "right"):
        elbow, wrist = (names.index(f"{side}_{name}") for name in ("elbow", "wrist"))
        shift = joints[:, 0] + 0.4 * (neck - joints[:, 0]) - joints[:, wrist]
        shift *= np.minimum(1, centimeters / 100 / np.linalg.norm(shift, axis=-1, keepdims=True))
        changed[:, wrist], changed[:, elbow] = (
            joints[:, wrist] + shift,
            joints[:, elbow] + shift / 2,
        )
    return changed


def freeze(joints: Joints, percent: float) -> Joints:
    """Freezes a motion by holding one of its frames until the end.

    `percent` is the share of the duration for which the frame is held.
    """
    moving = max(1, round(len(joints) * (1 - percent / 100)))
    return joints[np.minimum(np.arange(len(joints)), moving - 1)]


def play(joints: Joints, factor: float, fps: float) -> Joints:
    """Plays the motion faster or slower.

    A faster motion is shorter. A slower motion is cut to the original length.
    """
    return resample(joints, fps * factor, fps)[: len(joints)]


def through_rate(joints: Joints, rate: float, fps: float) -> Joints:
    """Resamples a motion linearly to another frame rate and back.

    If the resampled motion is shorter than the original, its last frame is repeated.
    """
    back = resample(resample(joints, fps, rate), rate, fps)
    return back[np.minimum(np.arange(len(joints)), len(back) - 1)]


def crop(joints: Joints, percent: float) -> Joints:
    """Cuts a percentage of the frames off the end of the motion. At least three frames remain."""
    return joints[: max(3, round(len(joints) * (1 - percent / 100)))]


def drop_repetition(joints: Joints, count: int) -> Joints:
    """Shortens a motion by cutting out one of its `count` repetitions.

    Among all pairs of frames that are about one period apart (within 20 %), the cut joins the pair
    with the most similar poses. The second part continues at the position where the first part
    ends.
    """
    poses = joints - joints[:, :1] * GROUND
    change = np.linalg.norm(np.diff(poses, axis=0), axis=-1).mean(1)
    moving = np.flatnonzero(change > 0.2 * change.max())
    first, last = int(moving[0]), int(moving[-1]) + 1
    period = (last - first) / count
    cuts = [
        (float(np.linalg.norm(poses[start + length] - poses[start], axis=-1).mean()), start, length)
        for length in range(max(1, round(0.8 * period)), round(1.2 * period) + 1)
        for start in range(first, last - length + 1)
    ]
    _, start, length = min(cuts)
    rest = joints[start + length :]
    return np.concatenate([joints[:start], rest + (joints[start, 0] - rest[0, 0]) * GROUND])


def continue_with(joints: Joints, other: Joints, fps: float) -> Joints:
    """Replaces the second half with the second half of another motion.

    The new half starts at the position where the first half ends. Poses are blended over `BLEND`
    seconds.
    """
    half = len(joints) // 2
    rest = other[len(other) // 2 :]
    rest = rest[np.minimum(np.arange(len(joints) - half), len(rest) - 1)]
    rest = rest + (joints[half - 1, 0] - rest[0, 0]) * GROUND
    fading = np.maximum(0, 1 - np.arange(1, len(rest) + 1) / (BLEND * fps))[:, None, None]
    return np.concatenate([joints[:half], rest + fading * (joints[half - 1] - rest[0])])


BASE, STORED, REAL = "decoded and encoded", "as stored", "reference"
"""Names of the sets of motions in every audit.

All perturbed motions are compared with `BASE`. `STORED` contains the stored features. `REAL` is a
second draw of real motions, for metrics that compare sets.
"""

Inputs = dict[str, np.ndarray]
"""Metric inputs for N motions, by name: features (N, E), and the readings of the metrics."""

Motions = Callable[[], list[np.ndarray]]
"""A function that computes a set of N motions as features (F, D)."""


@dataclass(frozen=True)
class Perturbation:
    """A graded perturbation of a set of motions."""

    name: str
    group: str  # kind of perturbation: joints, meaning, set or plumbing
    about: str
    # Unit of the grades
    unit: str = ""
    # The grades, from weak to strong
    grades: Sequence[float] = (1,)

    def offered(self, scene: Scene, captioned: bool) -> Sequence[Perturbation]:
        """Returns this perturbation, or one per kind of error, with the grades that are possible.

        Returns [] if no grade is possible.
        """
        return [self]

    def motions(self, scene: Scene) -> dict[str, Motions]:
        """Returns functions that compute the sets of motions for `apply`, keyed by name."""
        return {}

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns the motions and texts for a grade.

        The i-th motion and text replace real motion i and texts[i].
        """
        raise NotImplementedError

    def order(self, scene: Scene) -> np.ndarray:
        """Returns the order in which motions are perturbed, as indices (N,).

        The order is the same at all grades.
        """
        return scene.draws("order", self.name).permutation(len(scene))


@dataclass(frozen=True)
class ChangedJoints(Perturbation):
    """Changes the joints of all motions. The random draws for a motion are the same at all grades.

    Attributes:
        change: function of joints (F, J, 3), the grade, and the options in `takes`.
        takes: names of the options that `change` accepts: "draws" (a generator) and "fps" (frames
            per second).
        sign: factor by which the grade is multiplied, 1 or -1.
    """

    change: Callable[..., Joints] = lambda joints, grade: joints
    takes: Sequence[str] = ()
    sign: int = 1

    def motions(self, scene: Scene) -> dict[str, Motions]:
        """Returns the changed motions for each grade, keyed by the name of the set."""
        return {self._set(grade): partial(self._motions, scene, grade) for grade in self.grades}

    def _set(self, grade: float) -> str:
        return f"{self.name} {grade:g}"

    def _motions(self, scene: Scene, grade: float) -> list[np.ndarray]:
        changed = []
        for row, joints in zip(scene.rows, scene.joints, strict=True):
            options = {"draws": scene.draws(self.name, row.id), "fps": scene.fps}
            changed.append(
                self.change(
                    joints, self.sign * grade, **{name: options[name] for name in self.takes}
                )
            )
        return encode(scene.representation, changed)

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns the changed motions for a grade, and the unchanged texts."""
        return sets[self._set(grade)], texts


@dataclass(frozen=True)
class ChangedSet(Perturbation):
    """Replaces all motions with new ones, which `make` computes from the scene."""

    make: Callable[[Scene], list[np.ndarray]] = lambda scene: scene.features

    def motions(self, scene: Scene) -> dict[str, Motions]:
        """Returns the new motions, keyed by the name of the perturbation."""
        return {self.name: partial(self.make, scene)}

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns the new motions, and the unchanged texts."""
        return sets[self.name], texts


@dataclass(frozen=True)
class ReplacedShare(ChangedSet):
    """Replaces a percentage of the motions."""

    unit: str = "% of motions"
    grades: Sequence[float] = SHARES

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns the motions with this share (in percent) replaced, and the unchanged texts."""
        count = round(len(scene) * grade / 100)
        replaced = np.isin(np.arange(len(scene)), self.order(scene)[:count])
        base, other = sets[BASE], sets[self.name]
        shaped = {name: replaced.reshape(-1, *[1] * (x.ndim - 1)) for name, x in base.items()}
        return {name: np.where(shaped[name], other[name], x) for name, x in base.items()}, texts


@dataclass(frozen=True)
class DroppedRepetition(ReplacedShare):
    """Cuts one repetition out of a share of the motions. Motions without repetitions stay unchanged."""

    def offered(self, scene: Scene, captioned: bool) -> Sequence[Perturbation]:
        """Returns the perturbation if any motion has repetitions."""
        return [self] if any(repetitions(row) > 1 for row in scene.rows) else []


@dataclass(frozen=True)
class ReplacedCaptions(Perturbation):
    """Replaces a percentage of the captions with wrong captions.

    `name` is the kind of wrong caption, a key of `Scene.wrong`.
    """

    unit: str = "% of captions"
    grades: Sequence[float] = (1, 2, 5, 10, 20, 50, 100)

    def offered(self, scene: Scene, captioned: bool) -> Sequence[Perturbation]:
        """Returns a perturbation for each kind of wrong caption.

        At the largest grade, every caption for which there is a wrong caption of this kind is
        replaced.
        """
        offered = []
        for kind in scene.wrong if captioned else ():
            if kind.partition(":")[0] == self.name:
                most = 100 * sum(text is not None for text in scene.wrong[kind]) / len(scene)
                grades = [*(grade for grade in self.grades if grade < most), round(most, 1)]
                offered.append(replace(self, name=kind, grades=grades))
        return offered

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns the unchanged motions, and the texts with this share (in percent) replaced."""
        wrong, replaced = scene.wrong[self.name], list(texts)
        for i in [i for i in self.order(scene) if wrong[i]][: round(len(scene) * grade / 100)]:
            replaced[i] = wrong[i] or texts[i]
        return sets[BASE], replaced


@dataclass(frozen=True)
class DroppedActions(Perturbation):
    """Drops a percentage of the actions.

    Motions that show these actions are replaced with copies of the remaining motions and their
    texts.
    """

    unit: str = "% of actions"

    def offered(self, scene: Scene, captioned: bool) -> Sequence[Perturbation]:
        """Returns the perturbation if there are at least two actions."""
        return [self] if len({row.clip.action for row in scene.rows}) > 1 else []

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns as many motions and texts as before, but only for the remaining actions."""
        actions = sorted(set(scene.actions), key=lambda action: key("missing", scene.seed, action))
        gone = set(actions[: max(1, round(len(actions) * grade / 100))])
        kept = [i for i in self.order(scene) if scene.actions[i] not in gone]
        left = set(kept)
        picked = np.array([i if i in left else kept[i % len(kept)] for i in range(len(scene))])
        return {name: x[picked] for name, x in sets[BASE].items()}, [
            texts[i] for i in picked
        ] if texts else []


@dataclass(frozen=True)
class FewerMotions(Perturbation):
    """Keeps only the first motions. The grade is the number of motions."""

    unit: str = "motions"

    def offered(self, scene: Scene, captioned: bool) -> Sequence[Perturbation]:
        """Returns the perturbation with the grades that are smaller than the number of motions."""
        grades = [grade for grade in self.grades if grade < len(scene)]
        return [replace(self, grades=grades)] if grades else []

    def apply(
        self, scene: Scene, grade: float, sets: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, Sequence[Text]]:
        """Returns the first motions, with their texts."""
        return {name: x[: int(grade)] for name, x in sets[BASE].items()}, texts[: int(grade)]


def base_motions(scene: Scene) -> list[np.ndarray]:
    """Returns the real motions, decoded and encoded in the same way as perturbed motions."""
    return encode(scene.representation, scene.joints)


def _half_precision(scene: Scene) -> list[np.ndarray]:
    return [x.astype(np.float16).astype(np.float32) for x in base_motions(scene)]


def _mirrored(scene: Scene) -> list[np.ndarray]:
    mirror = scene.representation.skeleton.mirror
    return encode(scene.representation, [mirror(torch.from_numpy(x)).numpy() for x in scene.joints])


def _reversed(scene: Scene) -> list[np.ndarray]:
    return encode(scene.representation, [x[::-1].copy() for x in scene.joints])


def repetitions(row: DrawnClip) -> int:
    """Returns the number of repetitions that the data set states for a clip, or 1 if it states none."""
    count = row.clip.attributes.get("count", 1)
    return count if isinstance(count, int) else 1


def _with_a_repetition_less(scene: Scene) -> list[np.ndarray]:
    shorter = [
        drop_repetition(joints, repetitions(row)) if repetitions(row) > 1 else joints
        for row, joints in zip(scene.rows, scene.joints, strict=True)
    ]
    return encode(scene.representation, shorter)


def _other_half(scene: Scene) -> list[np.ndarray]:
    order = scene.draws("other half").permutation(len(scene))
    other = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))
    joined = [
        continue_with(x, scene.joints[other[i]], scene.fps) for i, x in enumerate(scene.joints)
    ]
    return encode(scene.representation, joined)


def _memorized(scene: Scene) -> list[np.ndarray]:
    """Returns, for each motion, a training motion with the same captions or action.

    If there is none, the motion itself is returned.
    """
    training, copies = scene.data.clips("train"), []
    for row in scene.rows:
        same = [clip for clip in training.clips if clip.captions == row.clip.captions]
        same = (
            same
            or [clip for clip in training.clips if clip.action == row.clip.action]
            or [row.clip]
        )
        draws = scene.draws("memorized", row.id)
        clip = same[int(draws.integers(len(same)))]
        copies.append(DrawnClip(row.id, clip, training.crop(clip.length, draws), None, row.id))
    return real_motions(training, copies)


def _through(other: HumanML, scene: Scene) -> list[np.ndarray]:
    decoded = [other.decode(torch.from_numpy(encode(other, [x])[0])).numpy() for x in scene.joints]
    return encode(scene.representation, decoded)


def through_others(representation: HumanML) -> list[Perturbation]:
    """Returns a perturbation for every other representation with this skeleton and frame rate."""
    files = sorted((EXPERIMENTS / "representation").glob("humanml*.yaml"))
    others: list[HumanML] = [instantiate(read_package_yaml(path)) for path in files]
    about, skeleton, fps = (
        "encoded and decoded by another representation",
        representation.skeleton,
        representation.fps,
    )
    return [
        ChangedSet(f"through {other.name}", "plumbing", about, make=partial(_through, other))
        for other in others
        if other.skeleton == skeleton and other.fps == fps and other.name != representation.name
    ]


def perturbations_of(scene: Scene, captioned: bool) -> list[Perturbation]:
    """Returns all perturbations that the motions and captions allow.

    Near misses are also included separately for each attribute.
    """
    listed = [*PERTURBATIONS, *through_others(scene.representation)]
    return [
        offered for perturbation in listed for offered in perturbation.offered(scene, captioned)
    ]


# fmt: off
PERTURBATIONS: list[Perturbation] = [
    ChangedJoints("jitter", "joints", "noise on all joints, std", "mm", (1, 2, 5, 10, 20), jitter, ["draws"]),
    ChangedJoints(
        "wobble", "joints", "joints sway at 1 Hz, amplitude", "mm", (5, 10, 20, 50), wobble, ["draws", "fps"]
    ),
    ChangedJoints("skating", "joints", "root speed", "x", (1.05, 1.1, 1.25, 1.5, 2), skate),
    ChangedJoints("floating", "joints", "above the floor", "cm", (1, 2, 5, 10), lift),
    ChangedJoints("sinking", "joints", "below the floor", "cm", (1, 2, 5, 10), lift, sign=-1),
    ChangedJoints("longer bones", "joints", "all bones longer", "%", (1, 2, 5, 10, 20), resize),
    ChangedJoints("shorter bones", "joints", "all bones shorter", "%", (1, 2, 5, 10, 20), resize, sign=-1),
    ChangedJoints("pop", "joints", "one frame displaced", "cm", (1, 2, 5, 10, 20), pop, ["draws"]),
    ChangedJoints(
        "last-frame pop", "joints", "last frame displaced", "cm", (1, 2, 5, 10, 20), partial(pop, last=True), ["draws"]
    ),
    ChangedJoints("arms inside", "joints", "wrists moved into the trunk", "cm", (10, 20, 30), draw_in),
    ReplacedShare("mirrored", "meaning", "left and right exchanged, captions kept", make=_mirrored),
    ReplacedShare("reversed", "meaning", "played backward", make=_reversed),
    ChangedJoints("slower", "meaning", "played at this speed", "x", (0.9, 0.75, 0.5), play, ["fps"]),
    ChangedJoints("faster", "meaning", "played at this speed", "x", (1.1, 1.25, 1.5, 2), play, ["fps"]),
    ChangedJoints("frozen", "meaning", "held up to the end", "% of time", (10, 25, 50, 75, 100), freeze),
    DroppedRepetition(
        "dropped repetition", "meaning", "one repetition less, of those with several", make=_with_a_repetition_less
    ),
    ReplacedShare("other half", "meaning", "second half of another motion", make=_other_half),
    ReplacedCaptions(RANDOM, "meaning", "captions of random other motions"),
    ReplacedCaptions(NEAR, "meaning", "captions wrong in one attribute"),
    DroppedActions("missing actions", "set", "actions that never appear; others repeat", grades=(10, 25, 50, 75)),
    ReplacedShare("memorized", "set", "training motions with the same captions", make=_memorized),
    FewerMotions("fewer", "set", "only so many motions", grades=(256, 128, 64)),
    ChangedSet(STORED, "plumbing", "features neither decoded nor encoded"),
    ChangedSet("half precision", "plumbing", "features rounded to float16", make=_half_precision),
    ChangedJoints("frame rate", "plumbing", "resampled and back", "fps", (30, 15, 10), through_rate, ["fps"]),
    ChangedJoints("cropped", "plumbing", "end removed", "% of time", (10, 25, 50), crop),
]
# fmt: on
"""All perturbations that do not depend on the data.

Near misses by attribute and other representations depend on the data.
"""
