"""Graded perturbations of real motions, to audit evaluators with: what a metric should see, or should ignore.

Each function of joints (F, J, 3) in meters, y up, returns as many frames unless it says otherwise. Random draws come
from a generator alone, so that the grades of a perturbation share theirs.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from evaluators.protocol import DrawnClip
from evaluators.sources import real_motions
from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.store import Entry
from flame_mdm.formats.resampling import resample
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SKELETONS
from flame_mdm.safe_io import read_yaml
from flame_mdm.seeds import key

Joints = np.ndarray
Draws = np.random.Generator
GROUND = np.array([1.0, 0.0, 1.0])
WOBBLE = 1.0  # frequency of the wobble, in Hz
BLEND = 0.4  # seconds over which the poses of another motion are blended in


def jitter(joints: Joints, millimeters: float, draws: Draws) -> Joints:
    """Adds Gaussian noise to all coordinates, independently per frame."""
    return joints + millimeters / 1000 * draws.standard_normal(joints.shape)


def wobble(joints: Joints, millimeters: float, draws: Draws, fps: float) -> Joints:
    """Moves each joint along a line of its own, as a sine of 1 Hz with this amplitude."""
    along = draws.standard_normal(joints.shape[1:])
    phase = draws.uniform(0, 2 * np.pi, (1, joints.shape[1]))
    sine = np.sin(2 * np.pi * WOBBLE / fps * np.arange(len(joints))[:, None] + phase)
    return joints + millimeters / 1000 * sine[..., None] * along / np.linalg.norm(along, axis=-1, keepdims=True)


def skate(joints: Joints, factor: float) -> Joints:
    """Multiplies the horizontal speed of the root and keeps the poses, so that the feet slide."""
    return joints + (factor - 1) * ((joints[:, :1] - joints[:1, :1]) * GROUND)


def lift(joints: Joints, centimeters: float) -> Joints:
    """Raises the body above the floor, or lowers it into the floor."""
    return joints + np.array([0, centimeters / 100, 0])


def resize(joints: Joints, percent: float) -> Joints:
    """Makes all bones longer by this share; the root's track on the floor stays the same, and so does the floor."""
    ground = joints[:, :1] * GROUND
    return ground + (1 + percent / 100) * (joints - ground)


def pop(joints: Joints, centimeters: float, draws: Draws, *, last: bool = False) -> Joints:
    """Displaces the whole body in one random inner frame, or in the last frame, in a random direction."""
    frame = int(draws.integers(1, len(joints) - 1))
    way = draws.standard_normal(3)
    popped = joints.copy()
    popped[-1 if last else frame] += centimeters / 100 * way / np.linalg.norm(way)
    return popped


def draw_in(joints: Joints, centimeters: float) -> Joints:
    """Moves the wrists toward the axis of the trunk, as far as it at most, and the elbows half as far."""
    names = next(skeleton.joints for skeleton in SKELETONS.values() if len(skeleton) == joints.shape[1])
    changed, neck = joints.copy(), joints[:, names.index("neck")]
    for side in ("left", "right"):
        elbow, wrist = (names.index(f"{side}_{name}") for name in ("elbow", "wrist"))
        way = joints[:, 0] + 0.4 * (neck - joints[:, 0]) - joints[:, wrist]
        way *= np.minimum(1, centimeters / 100 / np.linalg.norm(way, axis=-1, keepdims=True))
        changed[:, wrist], changed[:, elbow] = joints[:, wrist] + way, joints[:, elbow] + way / 2
    return changed


def freeze(joints: Joints, percent: float) -> Joints:
    """Repeats one frame until the end of the motion, for this share of its duration."""
    moving = max(1, round(len(joints) * (1 - percent / 100)))
    return joints[np.minimum(np.arange(len(joints)), moving - 1)]


def play(joints: Joints, factor: float, fps: float) -> Joints:
    """Plays faster, which shortens the motion, or slower, and cuts what exceeds its length."""
    return resample(joints, fps * factor, fps)[: len(joints)]


def through_rate(joints: Joints, rate: float, fps: float) -> Joints:
    """Resamples to another frame rate and back, linearly; frames past the last new one repeat the last."""
    back = resample(resample(joints, fps, rate), rate, fps)
    return back[np.minimum(np.arange(len(joints)), len(back) - 1)]


def crop(joints: Joints, percent: float) -> Joints:
    return joints[: max(3, round(len(joints) * (1 - percent / 100)))]


def continue_with(joints: Joints, other: Joints, fps: float) -> Joints:
    """Replaces the second half by that of another motion, from the same place; poses are blended over 0.4 seconds."""
    half = len(joints) // 2
    rest = other[len(other) // 2 :]
    rest = rest[np.minimum(np.arange(len(joints) - half), len(rest) - 1)]
    rest = rest + (joints[half - 1, 0] - rest[0, 0]) * GROUND
    fading = np.maximum(0, 1 - np.arange(1, len(rest) + 1) / (BLEND * fps))[:, None, None]
    return np.concatenate([joints[:half], rest + fading * (joints[half - 1] - rest[0])])


def encode(representation: HumanML, motions: Sequence[Joints]) -> list[np.ndarray]:
    """Encodes motions as features (F, D) float32, with as many rows as frames, and at their own height.

    The encoder needs one more frame, and puts the lowest joint on the floor, which would hide floating and sinking.
    """
    longer = [torch.from_numpy(np.concatenate([x, 2 * x[-1:] - x[-2:-1]])) for x in motions]
    encoded = []
    for joints, features in zip(motions, representation.encode_many(longer), strict=True):
        height, positions = representation.slices["root_height"], representation.slices["positions"]
        rise = float(joints[0, 0, 1]) * representation.units_per_metre - features[0, height]
        features[:, height] += rise
        features[:, positions.start + 1 : positions.stop : 3] += rise
        encoded.append(features.numpy())
    return encoded


@dataclass(frozen=True)
class Perturbation:
    """A perturbation of a set of motions, and its grades.

    `change` computes joints from joints, grade, generator and frames per second; None = `Scene` replaces features,
    captions or the set.
    """

    name: str
    group: str  # joints, meaning, set or plumbing
    about: str
    unit: str = ""  # of the grades; "% of motions", "% of captions" and "% of actions" say how many are replaced
    grades: Sequence[float] = (1,)  # from weak to strong
    change: Callable[[Joints, float, Draws, float], Joints] | None = None


_P = Perturbation
_CM, _PERCENT, _SHARES, _FEW = (1, 2, 5, 10), (1, 2, 5, 10, 20), (5, 10, 20, 50, 100), (1, 2, 5, 10, 20, 50, 100)
PERTURBATIONS = [
    _P("jitter", "joints", "noise on all joints, std", "mm", (1, 2, 5, 10, 20), lambda x, g, r, _: jitter(x, g, r)),
    _P("wobble", "joints", "joints sway at 1 Hz, amplitude", "mm", (5, 10, 20, 50), wobble),
    _P("skating", "joints", "root speed", "x", (1.05, 1.1, 1.25, 1.5, 2), lambda x, g, *_: skate(x, g)),
    _P("floating", "joints", "above the floor", "cm", _CM, lambda x, g, *_: lift(x, g)),
    _P("sinking", "joints", "below the floor", "cm", _CM, lambda x, g, *_: lift(x, -g)),
    _P("longer bones", "joints", "all bones longer", "%", _PERCENT, lambda x, g, *_: resize(x, g)),
    _P("shorter bones", "joints", "all bones shorter", "%", _PERCENT, lambda x, g, *_: resize(x, -g)),
    _P("pop", "joints", "one frame displaced", "cm", _PERCENT, lambda x, g, r, _: pop(x, g, r)),
    _P("last-frame pop", "joints", "last frame displaced", "cm", _PERCENT, lambda x, g, r, _: pop(x, g, r, last=True)),
    _P("arms inside", "joints", "wrists moved into the trunk", "cm", (10, 20, 30), lambda x, g, *_: draw_in(x, g)),
    _P("mirrored", "meaning", "left and right exchanged, captions kept", "% of motions", _SHARES),
    _P("reversed", "meaning", "played backward", "% of motions", _SHARES),
    _P("slower", "meaning", "played at this speed", "x", (0.9, 0.75, 0.5), lambda x, g, _, fps: play(x, g, fps)),
    _P("faster", "meaning", "played at this speed", "x", (1.1, 1.25, 1.5, 2), lambda x, g, _, fps: play(x, g, fps)),
    _P("frozen", "meaning", "held up to the end", "% of time", (10, 25, 50, 75, 100), lambda x, g, *_: freeze(x, g)),
    _P("other half", "meaning", "second half of another motion", "% of motions", _SHARES),
    _P("wrong captions", "meaning", "captions of random other motions", "% of captions", _FEW),
    _P("near misses", "meaning", "captions wrong in one attribute", "% of captions", _FEW),
    _P("missing actions", "set", "actions that never appear; others repeat", "% of actions", (10, 25, 50, 75)),
    _P("memorized", "set", "training motions with the same captions", "% of motions", _SHARES),
    _P("fewer", "set", "only so many motions", "motions", (256, 128, 64)),
    _P("as stored", "plumbing", "features neither decoded nor encoded"),
    _P("half precision", "plumbing", "features rounded to float16"),
    _P("frame rate", "plumbing", "resampled and back", "fps", (30, 15, 10), lambda x, g, _, f: through_rate(x, g, f)),
    _P("cropped", "plumbing", "end removed", "% of time", (10, 25, 50), lambda x, g, *_: crop(x, g)),
]
"""All perturbations, apart from those that depend on the data: near misses by attribute, other representations."""


ACTION = ("action", "content")  # names of the attribute that says what is done; clips without it have no near misses
UNSAID = "normal"  # value that captions do not mention: such captions are less exact, but not wrong

_Stated = frozenset[tuple[str, str | int | float]]


def near_misses(clips: Sequence[Entry]) -> list[dict[str, list[str]]]:
    """Returns the near misses of each clip among the captions of the others, sorted, by the attribute that differs.

    A caption of another clip is a near miss if both clips show the same action, and of the attributes that both have
    (side, style, count, ...), exactly one differs: "walks backward" is a near miss of a slow walk forward.
    """
    stated = [_stated(clip) for clip in clips]
    captions: dict[_Stated, set[str]] = {}
    for own, clip in zip(stated, clips, strict=True):
        captions.setdefault(own, set()).update(clip.captions)
    contradicting = {own: _contradicting(own, captions) for own in captions}
    return [contradicting[own] for own in stated]


def _stated(clip: Entry) -> _Stated:
    """Returns the attributes of a clip; in its action, they are slots: "wave-left-hand" is "wave-{side}-hand"."""
    stated = {name: value for name, value in clip.attributes.items() if isinstance(value, str | int | float)}
    action = next((str(stated.pop(name)) for name in ACTION if name in stated), "")
    names = {str(value): f"{{{name}}}" for name, value in stated.items()}
    if action:
        stated["action"] = "-".join(names.get(word, word.removesuffix("s")) for word in action.split("-"))
    return frozenset(stated.items())


def _contradicting(own: _Stated, captions: dict[_Stated, set[str]]) -> dict[str, list[str]]:
    mine = dict(own)
    wrong: dict[str, set[str]] = {}
    for attributes, texts in captions.items():
        other = dict(attributes)
        if "action" not in mine or mine["action"] != other.get("action"):
            continue
        differing = [name for name in mine.keys() & other.keys() if mine[name] != other[name]]
        if len(differing) == 1 and other[differing[0]] != UNSAID:
            wrong.setdefault(differing[0], set()).update(texts - captions[own])
    return {name: sorted(texts) for name, texts in sorted(wrong.items()) if texts}


BASE, REAL = "decoded and encoded", "reference"
"""Sets of motions that all others are compared with: those of grade 0, and the real ones of set metrics."""

Inputs = dict[str, np.ndarray]
"""Metric inputs of N motions: "features" (N, E), "seen" (N,) attributes as JSON, and totals (N, 2) by metric."""


class Text(NamedTuple):
    """A caption, its tagged words, and the attributes that it requests."""

    caption: str
    tokens: Sequence[str] | None
    requested: Mapping[str, Any]


@dataclass
class Scene:
    """Real motions of a split, and how to perturb them."""

    data: MotionDataModule
    rows: list[DrawnClip]
    features: list[np.ndarray]
    representation: HumanML
    seed: int

    def __post_init__(self) -> None:
        self.joints = [self.representation.decode(torch.from_numpy(x)).double().numpy() for x in self.features]
        self.wrong = self._wrong()

    def draws(self, *parts: str | int) -> np.random.Generator:
        return np.random.default_rng(key("audit", self.seed, *parts))

    def motions(self) -> dict[str, Callable[[], list[np.ndarray]]]:
        """Returns how to make each set of N motions, as features, by the name of the perturbation and the grade."""
        fps, mirror = self.representation.fps, self.representation.skeleton.mirror
        order = self.draws("other half").permutation(len(self.rows))
        other = dict(zip(order.tolist(), np.roll(order, 1).tolist(), strict=True))

        def changed(change: Callable[[int, Joints], Joints]) -> Callable[[], list[np.ndarray]]:
            return lambda: encode(self.representation, [change(i, x) for i, x in enumerate(self.joints)])

        def graded(perturbation: Perturbation, grade: float) -> Callable[[int, Joints], Joints]:
            change = perturbation.change
            assert change is not None
            # The draws are the same at all grades.
            return lambda i, x: change(x, grade, self.draws(perturbation.name, self.rows[i].id), fps)

        sets = {
            BASE: changed(lambda _, x: x),
            "as stored": lambda: self.features,
            "half precision": lambda: [x.astype(np.float16).astype(np.float32) for x in sets[BASE]()],
            "mirrored": changed(lambda _, x: mirror(torch.from_numpy(x)).numpy()),
            "reversed": changed(lambda _, x: x[::-1].copy()),
            "other half": changed(lambda i, x: continue_with(x, self.joints[other[i]], fps)),
            "memorized": self._memorized,
        }
        sets |= {f"{p.name} {g:g}": changed(graded(p, g)) for p in PERTURBATIONS if p.change for g in p.grades}
        for through in self._representations():
            sets[f"through {through.name}"] = changed(
                lambda _, x, r=through: r.decode(torch.from_numpy(encode(r, [x])[0])).numpy()
            )
        return sets

    def _memorized(self) -> list[np.ndarray]:
        """Returns for each motion a training motion with the same captions or the same action, or the motion itself."""
        training, copies = self.data.clips("train"), []
        for row in self.rows:
            same = [clip for clip in training.clips if clip.captions == row.clip.captions]
            same = same or [clip for clip in training.clips if clip.action == row.clip.action] or [row.clip]
            draws = self.draws("memorized", row.id)
            clip = same[int(draws.integers(len(same)))]
            copies.append(DrawnClip(row.id, clip, training.crop(clip.length, draws), None, row.id))
        return real_motions(training, copies)

    def _representations(self) -> list[HumanML]:
        files = sorted((EXPERIMENTS / "representation").glob("humanml*.yaml"))
        others: list[HumanML] = [instantiate(read_yaml(path)) for path in files]
        own = self.representation
        return [r for r in others if r.skeleton == own.skeleton and r.fps == own.fps and r.name != own.name]

    def _wrong(self) -> dict[str, list[Text | None]]:
        """Returns a wrong text for each motion, by the name of the perturbation; None if there is none."""
        texts = {caption: text_of(row, caption) for row in self.rows for caption in row.clip.captions}
        contradicting = near_misses([row.clip for row in self.rows])
        names = sorted({name for misses in contradicting for name in misses})
        wrong: dict[str, list[Text | None]] = {}
        for kind in ("wrong captions", "near misses", *(f"near misses: {name}" for name in names if len(names) > 1)):
            wrong[kind] = []
            for row, misses in zip(self.rows, contradicting, strict=True):
                draws, options = self.draws(kind, row.id), misses.get(kind.partition(": ")[2], [])
                if kind == "near misses" and misses:
                    options = misses[sorted(misses)[draws.integers(len(misses))]]
                elif kind == "wrong captions":
                    options = [caption for caption in texts if caption not in row.clip.captions]
                wrong[kind].append(texts[options[draws.integers(len(options))]] if options else None)
        return {kind: chosen for kind, chosen in wrong.items() if any(chosen)}

    def perturbations(self, captioned: bool) -> list[Perturbation]:
        listed = []
        for perturbation in PERTURBATIONS:
            if perturbation.unit == "% of captions":
                names = [name for name in self.wrong if captioned and name.partition(":")[0] == perturbation.name]
                for kind in names:
                    most = 100 * sum(text is not None for text in self.wrong[kind]) / len(self.rows)
                    grades = [*(grade for grade in perturbation.grades if grade < most), round(most, 1)]
                    listed.append(replace(perturbation, name=kind, grades=grades))
            elif perturbation.unit == "motions":
                grades = [grade for grade in perturbation.grades if grade < len(self.rows)]
                listed.append(replace(perturbation, grades=grades))
            elif perturbation.unit != "% of actions" or len({row.clip.action for row in self.rows}) > 1:
                listed.append(perturbation)
        about = "encoded and decoded by another representation"
        listed += [Perturbation(f"through {other.name}", "plumbing", about) for other in self._representations()]
        return [perturbation for perturbation in listed if perturbation.grades]

    def condition(
        self, perturbation: Perturbation, grade: float, inputs: Mapping[str, Inputs], texts: Sequence[Text]
    ) -> tuple[Inputs, list[Text]]:
        """Returns the motions and texts of a perturbation at a grade; pair i belongs to real motion i."""
        base, texts, count = inputs[BASE], list(texts), len(self.rows)
        order, share = self.draws("order", perturbation.name).permutation(count), round(count * grade / 100)
        if perturbation.unit == "% of captions":
            for i in [i for i in order if self.wrong[perturbation.name][i]][:share]:
                texts[i] = self.wrong[perturbation.name][i] or texts[i]
        elif perturbation.unit == "% of motions":
            chosen = np.isin(np.arange(count), order[:share])
            shaped = {name: chosen.reshape(-1, *[1] * (x.ndim - 1)) for name, x in base.items()}
            base = {name: np.where(shaped[name], inputs[perturbation.name][name], x) for name, x in base.items()}
        elif perturbation.unit == "% of actions":
            actions = sorted({row.clip.action or 0 for row in self.rows}, key=lambda a: key("missing", self.seed, a))
            gone = actions[: max(1, round(len(actions) * grade / 100))]
            kept = [i for i in order if (self.rows[i].clip.action or 0) not in gone]
            picked = np.array([i if i in kept else kept[i % len(kept)] for i in range(count)])
            return {name: x[picked] for name, x in base.items()}, [texts[i] for i in picked] if texts else []
        elif perturbation.unit == "motions":
            return {name: x[: int(grade)] for name, x in base.items()}, texts[: int(grade)]
        else:
            base = inputs[f"{perturbation.name} {grade:g}" if perturbation.change else perturbation.name]
        return base, texts


def text_of(row: DrawnClip, caption: str) -> Text:
    return Text(caption, row.tokens(caption), row.requested)
