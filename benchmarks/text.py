"""Compares encoding captions with a language model and reading them from the cache: `python benchmarks/text.py`.

The language model is sentence-BERT from the extra `offline`, which needs no download. It returns
one feature vector per token.
"""

import itertools
import tempfile
from pathlib import Path

import torch
from sections import Section, Settings, ratios, section, show, take_turns

from flame_mdm.batch import MotionBatch
from flame_mdm.config import compose, instantiate

ROUNDS = 15
PARTS = [
    ("a person", "someone", "a man", "the woman"),
    ("walks", "runs", "turns", "waves"),
    ("slowly", "quickly", "to the left", "to the right", "in a circle"),
    ("", "and stops", "before sitting down on a chair"),
]


def measure(settings: Settings) -> Section:
    """Times a text encoder with and without cached embeddings, and returns the page section."""
    size, rounds = (2, 1) if settings.quick else (64, ROUNDS)
    condition = compose("quickstart", ["condition=minilm_offline"])["condition"]
    live, cached = (instantiate(condition | {"tokens": True}) for _ in range(2))

    captions = [" ".join(words) for words in itertools.product(*PARTS)]
    x, mask = torch.zeros(size, 1, 1), torch.ones(size, 1, dtype=torch.bool)
    batch = MotionBatch(
        x, mask, [""] * size, list(itertools.islice(itertools.cycle(captions), size))
    )
    with tempfile.TemporaryDirectory() as folder:
        cached.precompute(batch.text, Path(folder))
        cached.load_cache(batch.text, Path(folder))
        times = take_turns(
            {"encoded": lambda: live(batch), "cached": lambda: cached(batch)}, rounds
        )

    return section(
        "Text encoding",
        f"""A batch of {size} captions is encoded by sentence-BERT (MiniLM, with tokens), or read from the cache of
        frozen encoders. Values are medians over {rounds} rounds.""",
        f"Reading a batch of cached captions is {times['encoded'] / times['cached']:.0f} times as fast as encoding it.",
        {"captions": ratios(times, "cached", "captions", "ms")},
    )


if __name__ == "__main__":
    show(measure(Settings()))
