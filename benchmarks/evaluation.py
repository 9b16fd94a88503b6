"""Time of an evaluation of the size of HumanML3D, without networks: `python benchmarks/evaluation.py`.

A protocol measures random motions with the lengths of HumanML3D (40 to 196 frames at 20 fps, 22 joints). The extractor
returns numbers of the motion and random text features, 512 each, and the source returns other windows of the same
clips. What is left is the cost of the evaluation itself: reading and decoding motions, and metrics.
"""

import argparse
import cProfile
import pstats
import sys
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from sections import Section, section, show
from torch import Tensor

from evaluators.evaluation import Evaluation
from evaluators.extractors import Extractor
from evaluators.protocol import DrawnClip, load_protocol
from evaluators.sources import Baseline, Generator, Samples
from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Entry
from flame_mdm.representations.humanml import HumanML

WIDTH, CAPTIONS = 512, 3


class Stub(Extractor):
    """The first numbers of a motion as its features, and random features of captions."""

    sha256 = "stub"

    def __init__(self, captions: Sequence[str]):
        self.rows = {caption: row for row, caption in enumerate(captions)}
        self.table = torch.randn(len(captions), WIDTH)

    def check(self, representation: Any, dataset: str) -> None:
        pass

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        return {"features": features[:, :2].flatten(1)[:, :WIDTH]}

    def texts(self, captions: Sequence[str], tokens: Any) -> Tensor:
        return self.table[[self.rows[caption] for caption in captions]]


class Windows(Generator):
    """Another window of each clip, as if a model had generated it."""

    def __init__(self, clips: Clips):
        self.real = Baseline("real", clips, "text", 0)

    def __call__(self, name: str, rows: list[DrawnClip], replication: int) -> Samples:
        return Samples(rows, self.real._real(rows, replication))


def random_clips(count: int) -> Clips:
    """Returns clips of random features; a third of them have the maximum length, as in HumanML3D."""
    generator = np.random.default_rng(0)
    lengths = np.minimum(generator.integers(40, 275, count), 199)
    ends = np.cumsum(lengths)
    representation = HumanML(variant="legacy")
    features = 0.02 * generator.standard_normal((int(ends[-1]), representation.features), np.float32)
    features[:, 3] += 0.9
    entries = [
        Entry(f"{i:06d}", int(end - length), int(length), "test", f"{i}", [f"{i} {j}" for j in range(CAPTIONS)], None)
        for i, (end, length) in enumerate(zip(ends, lengths, strict=True))
    ]
    zeros = np.zeros(representation.features, np.float32)
    store: Any = SimpleNamespace(
        clips=entries,
        mean=zeros,
        std=zeros + 1,
        motion=lambda clip: features[clip.start : clip.start + clip.length],
        references=lambda ids: None,
        info={"dataset": "random", "clips": {"test": count}},
    )
    return Clips(store, "test", representation=representation, crop=Units(), seed=0)


def measure(*words: str) -> Section:
    """Measures seconds per replication, and estimates those of the whole protocol."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clips", type=int, default=4600)
    parser.add_argument("--protocol", default="text_to_motion_t2m")
    parser.add_argument("--profile", action="store_true")
    args = parser.parse_args(words)
    torch.manual_seed(0)
    clips = random_clips(args.clips)
    extractor = Stub([caption for clip in clips.clips for caption in clip.captions])

    def seconds(multimodality: bool, **size: Any) -> float:
        protocol = load_protocol(args.protocol, clips.representation)
        protocol, _ = protocol.resized(args.clips, multimodality=multimodality, **size)
        start = time.perf_counter()
        Evaluation(protocol, clips, extractor, clips.representation).run(Windows(clips))
        return time.perf_counter() - start

    seconds(True, replications=1, samples=64)  # warms up
    profile = cProfile.Profile()
    if args.profile:
        profile.enable()
    once = seconds(False, replications=1)
    profile.disable()
    several = seconds(True, replications=1) - once
    protocol = load_protocol(args.protocol, clips.representation)
    again = protocol.multimodality.replications if protocol.multimodality else 0
    total = once * protocol.replications + several * again
    if args.profile:
        pstats.Stats(profile).sort_stats("tottime").print_stats(40)
    rows = {"replication": once, "replication of multimodality": several, "whole protocol, estimated": total}
    return section(
        "Evaluation",
        f"`{args.protocol}` with {args.clips:,} motions of HumanML3D's lengths, {protocol.replications} replications "
        f"and {again} of multimodality, without networks: reading and decoding of motions, and metrics. "
        f"{torch.get_num_threads()} threads.",
        f"An evaluation of the size of HumanML3D takes {total / 60:.1f} minutes plus the networks.",
        protocol=[{"part": k, "seconds": v, "ratio": v / once} for k, v in rows.items()],
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
