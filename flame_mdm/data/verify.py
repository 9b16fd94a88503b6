"""Verification report for a prepared data set: contents, published figures and anomalies."""

import json
from collections import Counter, defaultdict
from hashlib import sha1
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml

from flame_mdm.data import SPLITS, some
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.store import Entry, Store, training_statistics
from flame_mdm.data.t2m import words_of
from flame_mdm.errors import UserError
from flame_mdm.progress import ProgressBar
from flame_mdm.representations import Representation
from flame_mdm.safe_io import read_package_yaml, write_text

PUBLISHED = Path(__file__).with_name("published.yaml")
# Distance in meters. A clip counts as still if no joint moves farther than this from its first
# position.
STILL_DISTANCE = 0.01


def report(data: MotionDataModule) -> dict[str, Any]:
    """Checks the hashes and the content of a prepared data set, and writes a report.

    The report is saved as `verify.json` in the folder of the store.

    Returns:
        The content of the report: the data set, the hashes of its `files`, its `figures` next to
        the published figures, the number of captions, the number of clips per action, the lengths
        of the clips, clips that are `still` or `duplicates`, deviations of the stored statistics,
        and `excluded` clips.

    Raises:
        FileNotFoundError: If the data set is not prepared.
        UserError: If a hash does not match, or if the features contain NaN or infinite values.
    """
    store = data.open()
    store.verify()
    needed = data.crop.min_frames
    lengths = [clip.length for clip in store.clips]
    captions = [caption for clip in store.clips for caption in clip.captions]
    still, duplicates = _anomalies(store, data.representation)
    mean, std = training_statistics(
        store.folder, store.clips, len(store.features), data.representation
    )
    content = {
        "dataset": store.info["dataset"],
        "representation": store.info["representation"],
        "fps": store.info["fps"],
        "fingerprint": store.info["fingerprint"],
        "published_split": store.info["published_split"],
        "files": store.info["sha256"],
        "figures": _figures(store),
        "captions": {
            "captions": len(captions),
            "different captions": len(set(captions)),
            "different words": len({word for text in set(captions) for word in words_of(text)}),
            "clips without a caption": sum(not clip.captions for clip in store.clips),
        },
        "actions": {
            name: {
                split: sum(c.action == number and c.split == split for c in store.clips)
                for split in SPLITS
            }
            for number, name in enumerate(store.info["actions"])
        },
        "frames": {
            "frames": store.info["shape"][0],
            "features": store.info["shape"][1],
            "shortest clip": min(lengths),
            "median clip": float(np.median(lengths)),
            "longest clip": max(lengths),
            f"clips below the {needed} frames that cropping needs": sum(
                length < needed for length in lengths
            ),
        },
        "still": [clip.id for clip in still],
        "duplicates": [[clip.id for clip in group] for group in duplicates],
        "duplicates_across_splits": sum(
            len({clip.split for clip in group}) > 1 for group in duplicates
        ),
        # Mean and std in the store may be published values. Therefore, they are compared with
        # values computed from the training clips.
        "statistics": {
            "largest difference of a mean, in std": float((np.abs(store.mean - mean) / std).max()),
            "largest relative difference of a std": float(np.abs(store.std / std - 1).max()),
        },
        "excluded": store.info["excluded"],
    }
    write_text(
        store.folder / "verify.json", json.dumps(content, indent=2, ensure_ascii=False) + "\n"
    )
    return content


def lines(content: dict[str, Any]) -> list[str]:
    """Returns a report as lines of YAML. Long lists of clips are shortened."""
    groups = [" = ".join(group) for group in content["duplicates"]]
    shown = content | {
        "still": some(content["still"]) or "none",
        "duplicates": some(groups) or "none",
    }
    return yaml.safe_dump(
        shown, sort_keys=False, allow_unicode=True, default_flow_style=None, width=120
    ).splitlines()


def deviations(content: dict[str, Any]) -> list[str]:
    """Returns one line for each figure that differs from the published figure."""
    differing = [
        (name, f["found"], f["published"])
        for name, f in content["figures"].items()
        if f["state"] == "differs"
    ]
    return [
        f"{name}: {count:,} found, {published:,} published ({count - published:+,g}, {count / published - 1:+.2%})"
        for name, count, published in differing
    ]


def _figures(store: Store) -> dict[str, dict[str, Any]]:
    """Returns the figures for the store and its raw data, together with the published figures.

    A figure that exists for both the store and the raw data is listed twice. The figure for the
    store is called `NAME of the store`.
    """
    labeled = [clip for clip in store.clips if clip.action is not None]
    counted: dict[str, float] = {"clips": len(store.clips), **store.info["clips"]}
    if labeled:
        counted["actions"] = len({clip.action for clip in labeled})
    for kind, splits in (("clips", SPLITS), ("training clips", ("train", "val"))):
        if counts := Counter(clip.action for clip in labeled if clip.split in splits):
            counted[f"fewest {kind} per action"] = min(counts.values())
            counted[f"most {kind} per action"] = max(counts.values())
    raw: dict[str, float] = store.info.get("counts", {})
    counted = {
        f"{name} of the store" if name in raw else name: number for name, number in counted.items()
    } | raw
    published = read_package_yaml(PUBLISHED).get(store.info["dataset"], {})
    figures = {}
    for name in published | counted:
        figure, number = published.get(name), counted.get(name)
        expected, tolerance = figure if isinstance(figure, list) else (figure, 0)
        if expected is None:
            state = "not published"
        elif not isinstance(number, int | float):
            state = "not counted"
        else:
            state = "ok" if abs(number - expected) <= tolerance else "differs"
        figures[name] = {"found": number, "published": expected, "state": state}
    return figures


def _anomalies(
    store: Store, representation: Representation
) -> tuple[list[Entry], list[list[Entry]]]:
    """Returns the clips without movement, and groups of clips with bit-identical motions.

    Clips that share all their frames count as one motion, because they differ only in their
    captions.

    Raises:
        UserError: If a frame contains NaN or infinite values.
    """
    sharing: defaultdict[tuple[int, int], list[Entry]] = defaultdict(list)
    for clip in store.clips:
        sharing[clip.start, clip.length].append(clip)
    still: list[Entry] = []
    identical: defaultdict[bytes, list[Entry]] = defaultdict(list)
    for clips in ProgressBar(sharing.values(), "looking for movement", unit=" motions"):
        clip, motion = clips[0], np.array(store.motion(clips[0]))
        finite = np.isfinite(motion).all(1)
        if not finite.all():
            frame = int(np.argmin(finite))
            raise UserError(
                f"{store.folder} is damaged: frame {frame} of clip {clip.id} contains NaN or "
                "infinite values. Prepare the data set again"
            )
        joints = representation.decode(torch.from_numpy(motion))
        if float((joints - joints[:1]).norm(dim=-1).max()) < STILL_DISTANCE:
            still += clips
        identical[sha1(motion.tobytes()).digest()].append(clip)
    return still, [group for group in identical.values() if len(group) > 1]
