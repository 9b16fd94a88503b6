"""Sets of perturbed motions and texts that an audit measures."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch

from evaluators.metrics.attributes import ATTRIBUTES
from evaluators.near_misses import near_misses
from evaluators.perturbations import PERTURBATIONS, Joints, Perturbation, continue_with, encode
from evaluators.protocol import DrawnClip
from evaluators.sources import real_motions
from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.representations.humanml import HumanML
from flame_mdm.safe_io import read_yaml
from flame_mdm.seeds import key

BASE, REAL = "decoded and encoded", "reference"
"""Sets of motions that all others are compared with: those of grade 0, and the real ones of set metrics."""

Inputs = dict[str, np.ndarray]
"""Metric inputs of N motions: "features" (N, E), "seen" (N,) attributes as JSON, and totals (N, 2) by metric."""


class Text(NamedTuple):
    """A caption, its tagged words, and the attributes that it requests."""

    caption: str
    tokens: Sequence[str] | None
    requested: Mapping[str, Any]


class Scene:
    """Real motions of a split, and how to perturb them."""

    def __init__(
        self,
        data: MotionDataModule,
        rows: list[DrawnClip],
        features: list[np.ndarray],
        representation: HumanML,
        seed: int,
    ):
        self.data, self.rows, self.features, self.representation, self.seed = data, rows, features, representation, seed
        self.joints = [representation.decode(torch.from_numpy(x)).double().numpy() for x in features]
        self.wrong = self._wrong()

    def draws(self, *parts: str | int) -> np.random.Generator:
        """Returns the generator for a purpose."""
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
        """Returns the perturbations of this data."""
        listed = []
        for perturbation in PERTURBATIONS:
            if perturbation.unit == "% of captions":
                kinds = (
                    [kind for kind in self.wrong if kind.partition(":")[0] == perturbation.name] if captioned else []
                )
                for kind in kinds:
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
    """Returns a caption of the clip of a row with its attributes."""
    tagged = row.clip.attributes.get("tokens")
    requested = {name: value for name, value in row.clip.attributes.items() if name in ATTRIBUTES}
    return Text(caption, tagged[row.clip.captions.index(caption)] if tagged else None, requested)
