"""Compares systems with the referee and R-precision, for docs/benchmarks/referee_systems.json.

    python tools/referee_table.py [data/bandai-humanml-clean-smpl22 ... runs/bandai/mdm_small/default ...]

These systems are compared on clips from the synthetic test split: motions from the shipped models,
real motions, their mirror images, and real motions with captions of other motions. R-precision is
`MotionsForText` with the package's motion-CLIP. The arguments add prepared data sets with SMPL's 22
joints, without R-precision, and models that were trained on them.
"""

import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.stats import spearmanr

import flame_mdm
from evaluators.extractors import MotionCLIPExtractor
from evaluators.metrics.alignment import MotionsForText
from evaluators.metrics.claims import ClaimAccuracy
from flame_mdm.batch import length_mask
from flame_mdm.config import EXPERIMENTS, instantiate
from flame_mdm.data.store import Store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.safe_io import read_yaml, write_json
from flame_mdm.seeds import key

OUT = Path(__file__).resolve().parents[1] / "docs" / "benchmarks" / "referee_systems.json"
FPS = 20.0
COUNT = 128  # motions per row
CLIPS = 1600  # number of synthetic clips, of which the test split is used
SHIPPED = ("quickstart", "package", "package_dip")
LONGEST = 3.0  # duration in seconds of the longest motion from the package's model
REAL, MIRRORED, SHUFFLED = "real motions", "mirrored real motions", "captions of other motions"

Joints = Sequence[np.ndarray]


def main(folders: Sequence[Path]) -> None:
    ids, joints, captions = synthetic()
    seconds = [min(LONGEST, len(motion) / FPS) for motion in joints]
    sets = {}
    for name in SHIPPED:
        model = flame_mdm.load(name)
        generated = flame_mdm.generate(model, captions, seconds=seconds, seed=0, split=False)
        sets[name] = ([motion.joints for motion in generated], captions)
    sets |= baselines(joints, captions)

    extractor = MotionCLIPExtractor("motion_clip_synthetic", "cpu")
    rows = [
        {"data": "synthetic", "system": name, **measured(ids, *motions, extractor)}
        for name, motions in sets.items()
    ]
    runs = [folder for folder in folders if not (folder / "store.json").exists()]
    for folder in folders:
        if folder in runs:
            continue
        ids, joints, captions = stored(folder)
        name = folder.name.partition("-")[0]
        sets = {
            label(run): (sampled(run, joints, captions), captions) for run in runs_of(name, runs)
        }
        sets |= baselines(joints, captions)
        rows += [
            {"data": name, "system": system, **measured(ids, *motions, None)}
            for system, motions in sets.items()
        ]
    both = [row for row in rows if row["top3"] is not None]
    pairs = [(row["claims"]["all"], row["top3"]) for row in both]
    correlation = float(spearmanr(*zip(*pairs, strict=True)).statistic)
    write_json(OUT, {"format": 1, "motions": COUNT, "rank_correlation": correlation, "rows": rows})
    for row in rows:
        print(row["data"], row["system"], row["claims"], row["top3"])
    print("rank correlation", correlation)


def synthetic() -> tuple[list[str], list[np.ndarray], list[str]]:
    """Returns ids, joints (F, 22, 3) and captions from the test split of the synthetic set."""
    clips = [clip for clip in Synthetic(clips=CLIPS, seed=0).clips(FPS) if clip.split == "test"]
    clips = clips[:COUNT]
    return (
        [clip.id for clip in clips],
        [np.asarray(clip.motion, np.float32) for clip in clips],
        [clip.captions[0] for clip in clips],
    )


def stored(folder: Path) -> tuple[list[str], list[np.ndarray], list[str]]:
    """Returns ids, joints and first captions of test clips from a prepared data set."""
    store = Store(folder)
    representation = instantiate(read_yaml(EXPERIMENTS / "representation" / "humanml_clean.yaml"))
    clips = [clip for clip in store.clips if clip.split == "test" and clip.id[0] != "M"]
    clips = sorted(clips, key=lambda clip: key("referee table", clip.id))[:COUNT]
    motions = [
        representation.decode(torch.from_numpy(store.motion(clip).copy())).numpy() for clip in clips
    ]
    return [clip.id for clip in clips], motions, [clip.captions[0] for clip in clips]


def runs_of(name: str, runs: Sequence[Path]) -> list[Path]:
    """Returns the runs that were trained on a data set."""
    return [run for run in runs if read_yaml(run / "config.yaml")["data"]["name"] == name]


def label(run: Path) -> str:
    """Returns the recipe of a run, and its number of steps."""
    config = read_yaml(run / "config.yaml")
    return f"{config['experiment']}, {config['trainer']['max_steps']} steps"


def sampled(run: Path, joints: Joints, captions: Sequence[str]) -> list[np.ndarray]:
    """Returns motions (F, 22, 3) that a run generates for captions, each as long as a real motion.

    They are at most `LONGEST` seconds long.
    """
    seconds = [min(LONGEST, len(motion) / FPS) for motion in joints]
    model = flame_mdm.load(run)
    motions = flame_mdm.generate(model, captions, seconds=seconds, seed=0, split=False)
    return [motion.joints for motion in motions]


def baselines(joints: Joints, captions: list[str]) -> Mapping[str, tuple[Joints, list[str]]]:
    """Returns, by name, real motions, mirrored motions, and real motions with captions of other motions."""
    mirrored = [SMPL22.mirror(torch.from_numpy(motion)).numpy() for motion in joints]
    order = np.random.default_rng(0).permutation(len(captions))
    shuffled = list(captions)
    for one, other in zip(order, np.roll(order, 1), strict=True):
        shuffled[one] = captions[other]
    return {
        REAL: (joints, captions),
        MIRRORED: (mirrored, captions),
        SHUFFLED: (joints, shuffled),
    }


def measured(
    ids: Sequence[str],
    motions: Joints,
    captions: Sequence[str],
    extractor: MotionCLIPExtractor | None,
) -> dict[str, Any]:
    """Returns the claim accuracy by group, and the R-precision, which is None without an extractor."""
    keys = torch.tensor([key(name) for name in ids])
    lengths = torch.tensor([len(motion) for motion in motions])
    joints = torch.zeros(len(motions), int(lengths.max()), 22, 3)
    for row, motion in enumerate(motions):
        joints[row, : len(motion)] = torch.as_tensor(motion)
    mask = length_mask(lengths, joints.shape[1])
    claims = ClaimAccuracy(FPS)
    claims.update(joints, mask, captions, keys)

    top3 = None
    if extractor is not None:
        representation = HumanML(variant="clean")
        features = [representation.encode(torch.as_tensor(motion).float()) for motion in motions]
        padded = torch.zeros(len(features), joints.shape[1], features[0].shape[-1])
        for row, motion in enumerate(features):
            padded[row, : len(motion)] = motion
        frames = torch.tensor([len(motion) for motion in features])
        with torch.no_grad():
            encoded = extractor.motions(padded, joints, length_mask(frames, padded.shape[1]))
            text = extractor.texts(list(captions), [None] * len(captions))
        metric = MotionsForText(normalize=True)
        text_keys = torch.tensor([key(caption) for caption in captions])
        assert text is not None
        metric.update(generated=encoded["features"], text=text, text_keys=text_keys, keys=keys)
        top3 = metric.compute()["top3"]
    return {"motions": len(motions), "claims": claims.compute(), "top3": top3}


if __name__ == "__main__":
    main([Path(word) for word in sys.argv[1:]])
