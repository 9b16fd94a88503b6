"""Single-page view of a prepared data set: `flame-mdm browse data=bandai search="waves left"`"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from markupsafe import Markup

from flame_mdm.data.store import Entry, Store
from flame_mdm.formats.motion import Motion
from flame_mdm.reporting.page import render
from flame_mdm.representations import Representation
from flame_mdm.visualize import write_player
from flame_mdm.visualize.body import Mesh

SECONDS = 15  # seconds shown of a longer clip, to keep the page small


def find(clips: Sequence[Entry], split: str | None, search: str) -> list[list[Entry]]:
    """Returns the clips of a split (None = all) whose id and captions contain all words of `search`, in any case.

    Each clip is grouped with its mirrored copy, original first; a group matches if one of its clips does.
    """
    ids = {clip.id for clip in clips}
    families: dict[str, list[Entry]] = {}
    for clip in clips:
        if split in (None, clip.split):
            original = clip.id[1:] if clip.id[0] == "M" and clip.id[1:] in ids else clip.id
            families.setdefault(original, []).append(clip)
    words = search.lower().split()
    texts = {clip.id: " ".join([clip.id, *clip.captions]).lower() for clip in clips}
    matching = (f for f in families.values() if any(all(word in texts[clip.id] for word in words) for clip in f))
    return [sorted(family, key=lambda clip: len(clip.id)) for family in matching]  # a mirrored id is longer


def choose(families: Sequence[list[Entry]], most: int) -> list[list[Entry]]:
    """Returns evenly spaced families with at most `most` clips in total, but at least one family."""
    for count in range(min(len(families), max(1, most)), 0, -1):
        chosen = [families[k] for k in np.linspace(0, len(families) - 1, count).round().astype(int)]
        if sum(map(len, chosen)) <= most:
            return chosen
    return [families[0]]


def motion(store: Store, representation: Representation, clip: Entry) -> Motion:
    shown = round(SECONDS * representation.fps)
    joints = representation.decode(torch.from_numpy(store.motion(clip)[:shown].copy())).numpy()
    below = joints[..., 1].min()
    if below < -0.3:  # the action data sets use camera coordinates, without a floor: put the lowest joint on it
        joints[..., 1] -= below
    actions = store.info["actions"]
    caption = " · ".join(clip.captions) or ("" if clip.action is None else actions[clip.action])
    if clip.length > shown:
        caption += f" (the first {SECONDS} of {clip.length / representation.fps:.0f} s)"
    return Motion(joints, representation.fps, representation.skeleton, caption, clip.id)


def write_page(
    path: Path, store: Store, representation: Representation, clips: Sequence[Entry], title: str, body: Mesh | None
) -> None:
    write_player(
        path,
        [motion(store, representation, clip) for clip in clips],
        title,
        about=describe(store),
        groups=[clip.split for clip in clips],
        beside=[clip.id[1:] if clip.id.startswith("M") else "" for clip in clips],
        body=body,
    )


def describe(store: Store) -> Markup:
    info, fps = store.info, store.info["fps"]
    splits = {name: [clip for clip in store.clips if clip.split == name] for name, n in info["clips"].items() if n}
    counts = Counter(info["actions"][clip.action] for clip in store.clips if clip.action is not None)
    rows = []
    for name, clips in splits.items():
        lengths = np.array([clip.length for clip in clips])
        captions = [caption for clip in clips for caption in clip.captions]
        words = f"{np.mean([len(caption.split()) for caption in captions]):.1f}" if captions else ""
        cells = [len(clips), f"{lengths.sum() / fps / 60:.1f}", lengths.min(), f"{np.median(lengths):g}", lengths.max()]
        rows.append([name, *cells, len(captions), len(set(captions)), words])
    return render("browse.html", info=info, actions=counts.most_common(), rows=rows)
