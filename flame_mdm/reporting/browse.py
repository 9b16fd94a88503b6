"""Single-page view of a prepared data set: `flame-mdm browse data=bandai search="waves left"`"""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from markupsafe import Markup

from flame_mdm.data.store import Entry, Store
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.reporting.page import render
from flame_mdm.representations import Representation
from flame_mdm.safe_io import atomic_folder
from flame_mdm.visualize import write_player
from flame_mdm.visualize.body import Mesh

SECONDS = 15  # only the first seconds of a longer clip are shown, to keep the page small


def find(clips: Sequence[Entry], split: str | None, search: str) -> list[list[Entry]]:
    """Returns the clips of a split (None for all splits) that match a search.

    A clip matches if its id and captions contain all words in `search`. The search ignores case.
    Each clip is grouped with its mirrored copy, and the original comes first. A group matches if
    any of its clips matches.
    """
    ids = {clip.id for clip in clips}
    families: dict[str, list[Entry]] = {}
    for clip in clips:
        if split in (None, clip.split):
            original = clip.id[1:] if clip.id[0] == "M" and clip.id[1:] in ids else clip.id
            families.setdefault(original, []).append(clip)
    words = search.lower().split()
    texts = {clip.id: " ".join([clip.id, *clip.captions]).lower() for clip in clips}
    matching = (
        f
        for f in families.values()
        if any(all(word in texts[clip.id] for word in words) for clip in f)
    )
    # The id of a mirrored copy is longer than the original's.
    return [sorted(family, key=lambda clip: len(clip.id)) for family in matching]


def choose(families: Sequence[list[Entry]], most: int) -> list[list[Entry]]:
    """Returns evenly spaced groups with up to `most` clips in total, but at least one group."""
    for count in range(min(len(families), max(1, most)), 0, -1):
        chosen = [families[k] for k in np.linspace(0, len(families) - 1, count).round().astype(int)]
        if sum(map(len, chosen)) <= most:
            return chosen
    return [families[0]]


def motion(store: Store, representation: Representation, clip: Entry) -> Motion:
    """Returns the first `SECONDS` seconds of a clip as a motion placed on the floor."""
    shown = round(SECONDS * representation.fps)
    joints = representation.decode(torch.from_numpy(store.motion(clip)[:shown].copy())).numpy()
    below = joints[..., 1].min()
    # The action data sets use camera coordinates, which have no floor, so the lowest joint is
    # placed at height 0.
    if below < -0.3:
        joints[..., 1] -= below
    actions = store.info["actions"]
    caption = " · ".join(clip.captions) or ("" if clip.action is None else actions[clip.action])
    if clip.length > shown:
        caption += f" (the first {SECONDS} of {clip.length / representation.fps:.0f} s)"
    return Motion(joints, representation.fps, representation.skeleton, caption, clip.id)


def write_page(
    path: Path,
    store: Store,
    representation: Representation,
    clips: Sequence[Entry],
    title: str,
    body: Mesh | None,
) -> None:
    """Writes a page that plays clips, grouped by split, with mirrored copies next to originals."""
    write_player(
        path,
        [motion(store, representation, clip) for clip in clips],
        title,
        about=describe(store),
        groups=[clip.split for clip in clips],
        beside=[clip.id[1:] if clip.id.startswith("M") else "" for clip in clips],
        body=body,
    )


def write_clips(
    folder: Path, store: Store, representation: Representation, clips: Sequence[Entry], longest: int
) -> None:
    """Writes clips as `motion_000_ID.npz` ..., in the layout of generated motions, each with one caption.

    A clip with several captions is written with its first caption that no earlier clip uses, so
    that captions are unique where possible.

    Args:
        folder: the folder to write.
        store: the prepared data set.
        representation: the representation of the data set's features.
        clips: the clips to write.
        longest: maximum number of frames. Longer clips are cut, as in evaluations.

    Raises:
        UserError: If the folder contains other motions, which would be mistaken for these clips.
    """
    ids = [re.sub(r"[^\w.-]+", "_", clip.id)[:100] for clip in clips]
    paths = [folder / f"motion_{number:03d}_{name}.npz" for number, name in enumerate(ids)]
    others = sorted(
        path for path in folder.glob("*.npz") if path not in paths and path.name[0] != "."
    )
    if others:
        raise UserError(
            f"motions={folder}: the folder contains other motions, such as {others[0].name}. "
            f"Delete the folder, or choose another one"
        )

    used: set[str] = set()
    with atomic_folder(folder) as temporary:
        for path, clip in zip(paths, clips, strict=True):
            captions = clip.captions or (
                [] if clip.action is None else [store.info["actions"][clip.action]]
            )
            unused = [caption for caption in captions if caption not in used]
            caption = [*unused, *captions, ""][0]
            used.add(caption)

            features = representation.rebase(store.motion(clip)[:longest])
            joints = representation.decode(torch.from_numpy(features.copy())).numpy()
            written = Motion(joints, representation.fps, representation.skeleton, caption, clip.id)
            written.features, written.representation = features, representation.name
            written.save(
                temporary / path.name, clip=clip.id, split=clip.split, data=store.fingerprint
            )


def describe(store: Store) -> Markup:
    """Returns an HTML table that describes a store."""
    info, fps = store.info, store.info["fps"]
    splits = {
        name: [clip for clip in store.clips if clip.split == name]
        for name, n in info["clips"].items()
        if n
    }
    counts = Counter(
        info["actions"][clip.action] for clip in store.clips if clip.action is not None
    )
    rows = []
    for name, clips in splits.items():
        lengths = np.array([clip.length for clip in clips])
        captions = [caption for clip in clips for caption in clip.captions]
        words = f"{np.mean([len(caption.split()) for caption in captions]):.1f}" if captions else ""
        cells = [
            len(clips),
            f"{lengths.sum() / fps / 60:.1f}",
            lengths.min(),
            f"{np.median(lengths):g}",
            lengths.max(),
        ]
        rows.append([name, *cells, len(captions), len(set(captions)), words])
    return render("browse.html", info=info, actions=counts.most_common(), rows=rows)
