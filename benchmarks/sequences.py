"""Sequences, targets and candidates: `python benchmarks/sequences.py OUT.json PART MODEL CLIP SEED [clips=6]`.

PART is transitions, targets or candidates. MODEL generates the motions, and the motion-CLIP in the checkpoint CLIP
measures how well they fit their texts. For candidates, CLIP selects motions, and `judge=` is a second motion-CLIP that
measures the selected ones. For targets, `steps=` is the number of sampling steps. Texts and targets come from test
clips of the data set that MODEL was trained on, in the folder $FLAME_MDM_DATA. `python benchmarks/sequences.py table
OUT*.json` prints the means over the seeds and their 95 % intervals by Student's t. `differences` instead of `table`
compares each row with the motions without targets.
"""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from quality import shown
from sections import table

import flame_mdm
from evaluators.metrics.attributes import ATTRIBUTES, read_attributes, right_attributes
from evaluators.metrics.physics import FootSkating, Jitter
from evaluators.metrics.published_physics import peak_and_area, transition_jerk
from evaluators.selection import text_fit
from flame_mdm.batch import Edit
from flame_mdm.data.store import Store
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.sampling import targets
from flame_mdm.sampling.generation import best

PARTS, PART_FRAMES, WINDOW = 4, 50, 30
Rows = dict[str, dict[str, float]]


class Bench:
    """A model, test clips of its data set, and what is measured of motions."""

    def __init__(self, model: str, clip: str, seed: int, clips: int):
        self.model, self.seed = flame_mdm.load(model), seed
        self.fit = text_fit(clip, self.model)
        known, name = self.model.representation, self.model.facts["dataset"]
        store = Store(Path(os.environ.get("FLAME_MDM_DATA", "data")) / f"{name}-{known.name}")
        found = [clip for clip in store.clips if clip.split == "test"]
        chosen = np.random.default_rng(seed).permutation(len(found))
        self.real, self.wanted = [], []
        for clip_ in (found[index] for index in chosen):
            features = np.array(store.motion(clip_))[: self.model.facts["max_frames"]]
            if len(features) >= 2 * known.fps and len(self.real) < clips:
                joints = known.decode(torch.from_numpy(features)).numpy()
                text = clip_.captions[0]
                self.real.append(Motion(joints, known.fps, known.skeleton, text, features=features))
                self.wanted.append({k: v for k, v in clip_.attributes.items() if k in ATTRIBUTES})

    def generate(self, texts: str | Sequence[str], **options: Any) -> list[Motion]:
        return flame_mdm.generate(self.model, texts, seed=self.seed, **options)

    def values(self, motions: Sequence[Motion]) -> dict[str, float]:
        """Returns text fit and physics of motions that are generated for the texts of the clips."""
        fps = motions[0].fps
        skating, jitter = FootSkating(fps), Jitter(fps)
        for number, motion in enumerate(motions):
            joints, mask = torch.from_numpy(motion.joints)[None], torch.ones(1, len(motion.joints), dtype=torch.bool)
            skating.update(joints, mask)
            jitter.update(joints, mask, torch.tensor([number]))
        found = {
            "text fit": float(np.mean(self.fit(motions))),
            "foot skating": skating.compute() or 0.0,
            "jitter, m/s³": jitter.compute() or 0.0,
            "with faults": float(np.mean([bool(find_faults(motion)) for motion in motions])),
        }
        single = all(len(motion.parts) < 2 for motion in motions) and len(motions) == len(self.wanted)
        if single and all("action" in each for each in self.wanted):
            pairs = zip(motions, self.wanted, strict=True)
            right = [right_attributes(read_attributes(m.joints, fps), each)["all"] for m, each in pairs]
            found = {"attributes right": float(np.mean(right))} | found
        return found


def transitions(bench: Bench) -> Rows:
    """Compares sequences with plain concatenation, and with real motion. Then: 60 seconds, and loops."""
    texts = [motion.text for motion in bench.real]
    rng = np.random.default_rng(bench.seed)
    sequences = [rng.permutation(texts)[:PARTS].tolist() for _ in range(len(texts))]
    known, fps = bench.model.representation, bench.model.representation.fps
    spans = [(PART_FRAMES * part, PART_FRAMES * (part + 1)) for part in range(PARTS)]
    made = bench.generate([text for each in sequences for text in each], frames=PART_FRAMES)
    features = [np.concatenate([m.features for m in made[n : n + PARTS]]) for n in range(0, len(made), PARTS)]
    joined = [Motion(known.decode(torch.from_numpy(x)).numpy(), fps, known.skeleton, features=x) for x in features]
    for motion, each in zip(joined, sequences, strict=True):
        motion.parts = tuple((text, *span) for text, span in zip(each, spans, strict=True))
    blended = bench.generate([" | ".join(each) for each in sequences], frames=PART_FRAMES)

    def curve(motions: Sequence[Motion], seams: Callable[[Motion], Sequence[int]]) -> torch.Tensor:
        joints = [torch.from_numpy(motion.joints) for motion in motions for _ in seams(motion)]
        starts = [seam - WINDOW // 2 for motion in motions for seam in seams(motion)]
        return torch.stack([transition_jerk(x[s : s + WINDOW]) for x, s in zip(joints, starts, strict=True)]).mean(0)

    real = curve(bench.real, lambda motion: [len(motion.joints) // 2])
    level, rows = float(real.mean()), {}
    for name, motions in (("concatenation", joined), ("blended windows", blended)):
        peak, area = peak_and_area(curve(motions, lambda _: [begin for begin, _ in spans[1:]]), level)
        rows[name] = {"peak jerk": peak, "area under jerk": area or 0.0} | bench.values(motions)
    rows["real motion"] = dict(zip(("peak jerk", "area under jerk"), peak_and_area(real, level), strict=True))
    rows["real motion"] |= bench.values(bench.real)
    (long,) = bench.generate(f"{texts[0]} @60")
    for name, begin in (("60 s: first 10 s", 0), ("60 s: last 10 s", 1000)):
        part = long.joints[begin : begin + 200]
        rows[name] = bench.values([Motion(part, fps, text=texts[0], features=long.features[begin : begin + 200])])
    for name, loop in (("loop, seam", True), ("single clip played again, seam", False)):
        motions = bench.generate(texts, frames=44, loop=loop)
        twice = [known.decode(torch.from_numpy(np.concatenate([m.features] * 2))).numpy() for m in motions]
        peak, area = peak_and_area(curve([Motion(x, fps) for x in twice], lambda _: [44]), level)
        rows[name] = {"peak jerk": peak, "area under jerk": area or 0.0} | bench.values(motions)
    return rows


def wanted(kind: str, real: Motion) -> dict[str, Any]:
    """Returns targets from a real motion: its path every half second, its hands and feet twice, or two poses."""
    frames, names = len(real.joints), real.skeleton.joints
    if kind == "path":
        chosen = range(10, frames, 10)
        return {"root": [{"time": f / 20, "position": real.joints[f, 0, ::2].tolist()} for f in chosen]}
    some = [(f, n) for f in (frames // 3, 2 * frames // 3) for n in names if "wrist" in n or "ankle" in n]
    if kind == "poses":
        some = [(f, n) for f in (frames // 2, frames - 2) for n in names]
    place = real.joints[:, [names.index(name) for name in names]]
    return {
        "joints": [
            {"time": f / 20, "joint": n, "position": [float(v) for v in place[f, names.index(n)]]} for f, n in some
        ]
    }


def reaching(bench: Bench, steps: int | None) -> Rows:
    """Compares ways to reach targets from real motions, in centimeters as Kimodo."""
    known, steer, reach = bench.model.representation, targets.steer, targets.reach
    skip = lambda clean, x_t, *_: x_t  # noqa: E731
    rows: Rows = {}
    for kind in ("path", "hands and feet", "poses"):
        for method in ("none", "imputation", "correction", "steering", "steering and correction"):
            targets.steer = steer if "steering" in method else skip
            targets.reach = reach if "correction" in method else lambda x, *_: x
            motions = []
            for real in bench.real:
                options: dict[str, Any] = {"frames": len(real.joints), "num_inference_steps": steps}
                if method == "imputation":
                    x = known.normalize(torch.from_numpy(real.features))[None]
                    keep = torch.zeros_like(x, dtype=torch.bool)
                    at = [round(each["time"] * 20) for each in next(iter(wanted(kind, real).values()))]
                    joints = {"path": [0], "hands and feet": [7, 8, 20, 21], "poses": range(22)}[kind]
                    keep[:, slice(None) if kind == "path" else at] = known.joint_features(joints)
                    options["edit"] = Edit(x, keep)
                elif method != "none":
                    options["targets"] = wanted(kind, real)
                motions += bench.generate(real.text, **options)
            errors = []
            for motion, real in zip(motions, bench.real, strict=True):
                aim = targets.read_targets(known, wanted(kind, real))
                errors.append(100 * float(targets.errors(motion, aim).mean()))
            rows[f"{kind}: {method}"] = {"error, cm": float(np.mean(errors))} | bench.values(motions)
    targets.steer, targets.reach = steer, reach
    return rows | {"real motion": {"error, cm": 0.0} | bench.values(bench.real)}


def candidates(bench: Bench, judge: str, count: int = 5) -> Rows:
    """Compares the best of N motions of 10 steps with one motion of 10 N steps."""
    texts = [motion.text for motion in bench.real]
    select, bench.fit = bench.fit, text_fit(judge, bench.model)
    few = bench.generate(texts, frames=PART_FRAMES, num_inference_steps=10, samples=count)
    groups = [few[n : n + count] for n in range(0, len(few), count)]
    rows = {
        "one, 10 steps": [group[0] for group in groups],
        f"one, {10 * count} steps": bench.generate(texts, frames=PART_FRAMES, num_inference_steps=10 * count),
        f"best of {count}, 10 steps: physics": [best(group) for group in groups],
        f"best of {count}, 10 steps: motion-CLIP and physics": [best(group, select) for group in groups],
    }
    if all("action" in each for each in bench.wanted):
        right = [
            [right_attributes(read_attributes(m.joints, m.fps), each)["all"] for m in group]
            for group, each in zip(groups, bench.wanted, strict=True)
        ]
        rows[f"best of {count}, 10 steps: attributes"] = [
            g[int(np.argmax(r))] for g, r in zip(groups, right, strict=True)
        ]
    return {name: bench.values(motions) for name, motions in rows.items()}


def combined(files: Sequence[str], paired: bool = False) -> str:
    """Returns a Markdown table of the means over the seeds.

    If `paired`, those of the differences from the row "KIND: none" of the same seed.
    """
    seeds = [json.loads(Path(file).read_text()) for file in files]
    columns = list(dict.fromkeys(name for row in seeds[0].values() for name in row))
    rows = []
    for name, values in seeds[0].items():
        base = f"{name.split(':')[0]}: none"
        if paired and (base == name or base not in seeds[0]):
            continue
        found = {
            c: [seed[name][c] - (seed[base][c] if paired else 0) for seed in seeds] for c in columns if c in values
        }
        sign = "+" if paired else ""
        cells = {c: shown([round(v, 3) for v in found[c]], sign) if c in found else "" for c in columns}
        rows.append({"": name, **cells})
    return table(rows)


def main(out: str, *words: str) -> None:
    """Measures a part for one seed, or prints the table of several."""
    if out in ("table", "differences"):
        print(combined(words, out == "differences"))
        return
    part, model, clip, seed, *rest = words
    options = dict(word.split("=", 1) for word in rest)
    bench = Bench(model, clip, int(seed), int(options.get("clips", 6)))
    if part == "targets":
        rows = reaching(bench, int(options["steps"]) if "steps" in options else None)
    else:
        rows = transitions(bench) if part == "transitions" else candidates(bench, options["judge"])
    Path(out).write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(*sys.argv[1:])
