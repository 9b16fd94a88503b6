"""One web page of a prepared data set: `python -m flame_mdm.browse data=bandai search="waves left"`"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flame_mdm.config import EXPERIMENTS, Config, UserError, instantiate, run

if TYPE_CHECKING:
    from flame_mdm.data.store import Entry, Store
    from flame_mdm.representations import Representation
    from flame_mdm.visualize import Motion

USAGE = """
usage: python -m flame_mdm.browse data=NAME [split=train] [search="waves left"] [clips=200] [out=FILE.html]
       python -m flame_mdm.browse data=NAME split=test clips=10 motions=FOLDER

Writes one web page that opens from disk: clips of a data set with their captions, mirrored copies beside their
originals, a search, a choice of splits, the distribution of lengths and other statistics. motions= writes the clips of
the page as motion files, too, so that generated motions can be compared with them.
"""

SECONDS = 15
"""Longer clips show their beginning only, so that the page stays small."""
BARS = 30
COLORS = {"train": "var(--left)", "val": "var(--right)", "test": "var(--contact)"}


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    return run(
        browse, sys.argv[1:] if argv is None else argv, usage=USAGE, name="browse", text=("search", "out", "motions")
    )


def browse(config: Config) -> None:
    """Writes the page, after the data set is prepared where that has not been done.

    Raises:
        UserError: no data set named, no clip fits, or other motions in the folder `motions`.
        FileNotFoundError, ValueError: the raw data is absent or damaged.
    """
    if "data" not in config:
        names = sorted(path.stem for path in (EXPERIMENTS / "data").glob("*.yaml"))
        raise UserError(f"which data set? data=NAME, one of: {', '.join(names)}")
    if config["clips"] < 1:
        raise UserError(f"clips={config['clips']}: a page shows at least 1")
    from flame_mdm.visualize import write_player

    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation)
    data.prepare_data()
    store = data.open()
    if config["split"] not in (None, *store.info["clips"]):
        raise UserError(f"no split is called {config['split']}; there are {', '.join(store.info['clips'])}")
    search = "" if config["search"] is None else str(config["search"])
    families = find(store.clips, config["split"], search)
    if not families:
        raise UserError(f"no clip of {data.folder} has '{search}' in its id or its captions")
    fitting = sum(map(len, families))
    clips = [clip for family in choose(families, config["clips"]) for clip in family]
    title = f"{store.info['dataset']}: {len(clips)} of {fitting} clips"
    title += f" in {config['split']}" * (config["split"] is not None) + f" with '{search}'" * bool(search)
    out = Path(config["out"] or Path("runs") / "browse" / f"{data.folder.name}.html")
    write_player(out, [motion(store, representation, clip) for clip in clips], title, about=describe(store))
    print(f"{out}: {len(clips)} of {fitting} clips, {out.stat().st_size / 1e6:.1f} MB")
    if config["motions"] is not None:
        write_clips(Path(config["motions"]), store, representation, clips, data.crop.longest())
        print(f"{config['motions']}: {len(clips)} motions")


def find(clips: Sequence[Entry], split: str | None, search: str) -> list[list[Entry]]:
    """Clips of a split that have all words of `search` in id and captions; an original and its mirror go together."""
    ids = {clip.id for clip in clips}
    families: dict[str, list[Entry]] = {}
    for clip in clips:
        if split in (None, clip.split):
            original = clip.id[1:] if clip.id[0] == "M" and clip.id[1:] in ids else clip.id
            families.setdefault(original, []).append(clip)
    words = search.lower().split()
    texts = {clip.id: " ".join([clip.id, *clip.captions]).lower() for clip in clips}
    fitting = (f for f in families.values() if any(all(word in texts[clip.id] for word in words) for clip in f))
    return [sorted(family, key=lambda clip: len(clip.id)) for family in fitting]  # the original stands first


def choose(families: Sequence[list[Entry]], most: int) -> list[list[Entry]]:
    """Families spread evenly over all of them, with `most` clips together at most, and one family at least."""
    for count in range(min(len(families), max(1, most)), 0, -1):
        chosen = [families[k] for k in np.linspace(0, len(families) - 1, count).round().astype(int)]
        if sum(map(len, chosen)) <= most:
            return chosen
    return [families[0]]


def motion(store: Store, representation: Representation, clip: Entry) -> Motion:
    """A clip as the player shows it, cut after `SECONDS`."""
    import torch

    from flame_mdm.visualize import Motion

    shown = round(SECONDS * representation.fps)
    joints = representation.decode(torch.from_numpy(store.motion(clip)[:shown].copy())).numpy()
    below = joints[..., 1].min()
    if below < -0.3:  # the camera's coordinates of the action sets have no floor: the lowest joint stands on it
        joints[..., 1] -= below
    actions = store.info["actions"]
    caption = " · ".join(clip.captions) or ("" if clip.action is None else actions[clip.action])
    if clip.length > shown:
        caption += f" (the first {SECONDS} of {clip.length / representation.fps:.0f} s)"
    original = clip.id[1:] if clip.id.startswith("M") else ""
    return Motion(
        joints, representation.fps, representation.skeleton, caption, clip.id, group=clip.split, beside=original
    )


def write_clips(
    folder: Path, store: Store, representation: Representation, clips: Sequence[Entry], longest: int
) -> None:
    """Writes clips as `motion_000.npz` ..., in the form of generated motions, each with one caption.

    A clip of several captions gets the first that no clip before it has, so that a caption names a motion where it can.

    Args:
        longest: frames after which clips are cut, as they are for training and evaluation.

    Raises:
        UserError: the folder holds other motions, which would be taken for motions of this choice.
    """
    import torch

    from flame_mdm.generation import Generated, write_motion

    paths = [folder / f"motion_{number:03d}.npz" for number in range(len(clips))]
    if others := sorted(set(folder.glob("*.npz")) - set(paths)):
        raise UserError(f"motions={folder}: holds other motions, such as {others[0].name}; delete it, or name another")
    given: set[str] = set()
    for path, clip in zip(paths, clips, strict=True):
        names = clip.captions or ([] if clip.action is None else [store.info["actions"][clip.action]])
        caption = next((name for name in names if name not in given), names[0] if names else "")
        given.add(caption)
        features = representation.rebase(store.motion(clip)[:longest])
        joints = representation.decode(torch.from_numpy(features.copy())).numpy()
        facts = {"clip": clip.id, "split": clip.split, "data": store.fingerprint}
        write_motion(
            path, Generated(clip.id, joints, features, representation.fps, caption), representation.name, facts
        )


def describe(store: Store) -> str:
    """HTML: what the whole store holds."""
    info, fps = store.info, store.info["fps"]
    splits = {name: [clip for clip in store.clips if clip.split == name] for name, n in info["clips"].items() if n}
    facts = [
        f"{escape(info['dataset'])} as {escape(info['representation'])} at {fps:g} frames a second, "
        f"{info['hours']:g} hours, fingerprint {escape(info['fingerprint'])}"
    ]
    if info["published_split"]:
        facts.append("The published split: clips are tested on that training has seen, or none are left to validate on")
    if info["excluded"]:
        facts.append(
            "Left out: " + ", ".join(f"{count} {escape(reason)}" for reason, count in info["excluded"].items())
        )
    counts = Counter(info["actions"][clip.action] for clip in store.clips if clip.action is not None)
    if counts:
        facts.append("Actions: " + ", ".join(f"{escape(name)} {count}" for name, count in counts.most_common()))
    heads = ("split", "clips", "minutes", "frames: least", "median", "most", "captions", "distinct", "words a caption")
    rows = ["".join(f"<th style='padding:0 12px 0 0;text-align:left'>{head}</th>" for head in heads)]
    rows += ["".join(f"<td>{cell}</td>" for cell in (name, *_row(clips, fps))) for name, clips in splits.items()]
    table = "<table>" + "".join(f"<tr>{row}</tr>" for row in rows) + "</table>"
    return "".join(f"<p>{fact}</p>" for fact in facts) + table + _lengths(splits, fps)


def _row(clips: Sequence[Entry], fps: float) -> list[str]:
    lengths = np.array([clip.length for clip in clips])
    captions = [caption for clip in clips for caption in clip.captions]
    words = f"{np.mean([len(caption.split()) for caption in captions]):.1f}" if captions else ""
    cells = [len(clips), f"{lengths.sum() / fps / 60:.1f}", lengths.min(), f"{np.median(lengths):g}", lengths.max()]
    return [f"{cell}" for cell in (*cells, len(captions), len(set(captions)), words)]


def _lengths(splits: dict[str, list[Entry]], fps: float) -> str:
    """The distribution of lengths, as in Kim et al. 2023 (FLAME), figure 7: bars of clips by seconds, stacked by split.

    The last bar holds all clips beyond the 99th percentile, as a few very long ones would squeeze the others.
    """
    seconds = {name: np.array([clip.length for clip in clips]) / fps for name, clips in splits.items()}
    last = float(np.percentile(np.concatenate(list(seconds.values())), 99)) or 1
    bins = {
        n: np.bincount(np.minimum(BARS * s / last, BARS - 1).astype(int), minlength=BARS) for n, s in seconds.items()
    }
    most = max(1, int(np.sum(list(bins.values()), 0).max()))
    wide, high, bar = 600, 120, 600 / BARS
    parts = []
    base = np.zeros(BARS)
    for name, counts in bins.items():
        for k, count in enumerate(counts):
            top, tall = high * (1 - (base[k] + count) / most), high * count / most
            note = (
                f"{k * last / BARS:.1f} to {(k + 1) * last / BARS:.1f} s{' and more' * (k == BARS - 1)}: {count} {name}"
            )
            parts.append(
                f"<rect x='{k * bar:.1f}' y='{top:.1f}' width='{bar - 1:.1f}' height='{tall:.1f}' "
                f"style='fill:{COLORS[name]}'><title>{note}</title></rect>"
            )
        base += counts
    parts.append("<g style='fill:var(--faint);font-size:11px'>")
    for k in range(0, BARS + 1, 5):
        anchor = "start" if k == 0 else "end" if k == BARS else "middle"
        parts.append(f"<text x='{k * bar:.0f}' y='{high + 14}' text-anchor='{anchor}'>{k * last / BARS:.1f} s</text>")
    parts.append("</g>")
    names = ", ".join(f"<span style='color:{COLORS[name]}'>{name}</span>" for name in bins)
    chart = f"<svg viewBox='0 0 {wide} {high + 18}' style='width:100%;max-width:{wide}px'>{''.join(parts)}</svg>"
    return f"<p>Length of clips ({names}), up to {most} a bar</p>{chart}"


if __name__ == "__main__":
    sys.exit(main())
