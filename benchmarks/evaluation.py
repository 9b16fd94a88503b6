"""Times an evaluation of HumanML3D's size without networks: `python benchmarks/evaluation.py`.

A protocol evaluates random motions with HumanML3D's lengths (40 to 196 frames at 20 frames per
second, 22 joints). No network is called: the extractor returns 512 numbers from the motion and 512
random numbers for the text, and the source of generated motions returns other windows of the same
clips. The measured time is therefore the cost of the evaluation itself: reading and decoding
motions, and computing metrics. The framework's FID is also compared with torchmetrics'
implementation on the same features.
"""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from sections import Row, Section, Settings, ratios, section, show, take_turns
from torch import Tensor, nn
from torchmetrics.image.fid import FrechetInceptionDistance

from evaluators.evaluation import Evaluation
from evaluators.extractors import Extractor
from evaluators.metrics.distribution import frechet_distance
from evaluators.protocol import DrawnClip, load_protocol
from evaluators.sources import Samples, real_motions
from flame_mdm.data.crops import Units
from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Entry
from flame_mdm.representations.humanml import HumanML

PROTOCOL = "text_to_motion_t2m"
WIDTH, CAPTIONS, BATCH = 512, 3, 64
TORCHMETRICS, FRAMEWORK = "torchmetrics' FrechetInceptionDistance", "framework"


class Stub(Extractor):
    """An extractor without a network. It returns the first numbers of a motion, and random features for captions."""

    sha256 = "stub"

    def __init__(self, captions: Sequence[str]):
        self.rows = {caption: row for row, caption in enumerate(captions)}
        self.table = torch.randn(len(captions), WIDTH)

    def check(self, representation: Any, dataset: str) -> None:
        """Accepts all motions."""

    def motions(self, features: Tensor, joints: Tensor, mask: Tensor) -> dict[str, Tensor]:
        """Returns the first `WIDTH` numbers of two frames as features."""
        return {"features": features[:, :2].flatten(1)[:, :WIDTH]}

    def texts(self, captions: Sequence[str], tokens: Any) -> Tensor:
        """Returns one row of random numbers for each caption."""
        return self.table[[self.rows[caption] for caption in captions]]


class Windows:
    """A source that returns the requested clips themselves, as if a model had generated them."""

    def __init__(self, clips: Clips):
        self.clips = clips

    def __call__(self, name: str, rows: list[DrawnClip], replication: int) -> Samples:
        return Samples(rows, real_motions(self.clips, rows))


def random_clips(count: int) -> Clips:
    """Returns clips with random features. A third of the clips have the maximum length, as in HumanML3D."""
    generator = np.random.default_rng(0)
    lengths = np.minimum(generator.integers(40, 275, count), 199)
    ends = np.cumsum(lengths)
    representation = HumanML(variant="legacy")
    features = 0.02 * generator.standard_normal(
        (int(ends[-1]), representation.features), np.float32
    )
    features[:, 3] += 0.9  # the height of the root, in meters

    entries = []
    for number, (end, length) in enumerate(zip(ends, lengths, strict=True)):
        captions = [f"{number} {caption}" for caption in range(CAPTIONS)]
        entries.append(
            Entry(
                f"{number:06d}", int(end - length), int(length), "test", f"{number}", captions, None
            )
        )

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


class Identity(nn.Module):
    """A feature extractor for torchmetrics that returns its inputs, because they are already features."""

    num_features = WIDTH

    def forward(self, features: Tensor) -> Tensor:
        """Returns the features unchanged."""
        return features


def fid(motions: int, rounds: int) -> list[Row]:
    """Times the FID of two sets of random features, computed by the framework and by torchmetrics.

    Args:
        motions: number of features per set.
        rounds: number of timed rounds.
    """
    generated, real = torch.randn(motions, WIDTH), torch.randn(motions, WIDTH) + 0.1

    def torchmetrics() -> Tensor:
        metric = FrechetInceptionDistance(feature=Identity())
        for batch in real.split(BATCH):
            metric.update(batch, real=True)
        for batch in generated.split(BATCH):
            metric.update(batch, real=False)
        return metric.compute()

    def ours() -> Tensor:
        sets = [
            torch.cat([batch.double() for batch in features.split(BATCH)])
            for features in (generated, real)
        ]
        return frechet_distance(*sets)

    if motions > WIDTH:  # otherwise, covariances are singular, and torchmetrics loses digits
        torch.testing.assert_close(ours().float(), torchmetrics().float(), rtol=1e-3, atol=1e-3)
    return ratios(
        take_turns({TORCHMETRICS: torchmetrics, FRAMEWORK: ours}, rounds), FRAMEWORK, "FID", "ms"
    )


def measure(settings: Settings) -> Section:
    """Times an evaluation without networks and returns the page section."""
    motions, rounds = (40, 1) if settings.quick else (4600, 2)
    torch.manual_seed(0)
    clips = random_clips(motions)
    extractor = Stub([caption for clip in clips.clips for caption in clip.captions])

    def run(multimodality: bool) -> None:
        protocol = load_protocol(PROTOCOL, clips.representation)
        protocol, _ = protocol.resized(motions, multimodality=multimodality, replications=1)
        Evaluation(protocol, clips, extractor, clips.representation).run(Windows(clips))

    once, several = "replication", "replication with multimodality"
    times = take_turns({once: lambda: run(False), several: lambda: run(True)}, rounds)
    protocol = load_protocol(PROTOCOL, clips.representation)
    repeated = protocol.multimodality.replications if protocol.multimodality else 0
    total = times[once] * (protocol.replications - repeated) + times[several] * repeated
    times["whole protocol, estimated"] = total
    table: list[Row] = [
        {"part": name, "seconds": taken, "ratio": taken / times[once]}
        for name, taken in times.items()
    ]

    distances = fid(motions, 1 if settings.quick else 10)
    return section(
        "Evaluation",
        f"""`{PROTOCOL}` runs without networks on {motions:,} motions with HumanML3D's lengths, in
        {protocol.replications} replications, {repeated} of which measure multimodality. The time is spent on
        reading and decoding motions, and on metrics. The process has {torch.get_num_threads()} threads, and values
        are medians over {rounds} rounds. To time FID alone, {motions:,} features of width {WIDTH} are passed
        to the metric in batches of {BATCH}, and values are medians over 10 rounds.""",
        f"An evaluation of HumanML3D's size takes {total / 60:.1f} minutes, not counting the networks. torchmetrics "
        f"takes {distances[0]['ratio']:.1f} times as long as the framework to compute FID.",
        {"protocol": table, "FID alone": distances},
    )


if __name__ == "__main__":
    show(measure(Settings()))
