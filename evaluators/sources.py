"""Sources of the motions to evaluate: a model, files of another system, or sanity-check baselines."""

from __future__ import annotations

import hashlib
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
import torch
from tqdm import tqdm

from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Entry
from flame_mdm.editing import kept_parts
from flame_mdm.errors import UserError
from flame_mdm.files import atomic_write, read_npz, regular_file
from flame_mdm.motion import Edit, MotionBatch, length_mask, pad_to
from flame_mdm.representations import Representation
from flame_mdm.seeds import key, normal
from flame_mdm.task import MotionGeneration

T = TypeVar("T")

NOISE = 0.5
"""Standard deviation of the noise of noisy baselines, in normalized features."""


@dataclass(frozen=True)
class Row:
    """One motion to generate: its name, the clip it is compared with, the frames and the caption drawn of that.

    `prompt` is the name that it shares with the other motions of the same caption and length.
    """

    id: str
    clip: Entry
    frames: np.ndarray
    caption: int | None
    prompt: str

    @property
    def text(self) -> str:
        """The caption that was drawn."""
        assert self.caption is not None
        return self.clip.captions[self.caption]


@dataclass
class Samples:
    """Motions to measure and what they cost.

    Attributes:
        rows: what was asked for, in order.
        features: (F, D) float32 each, in the data's units.
        cost: calls of the denoiser a motion, and seconds a motion at its batch size; empty where no model was called.
        captions: what the motions were made for, where those are not the captions of the rows.
    """

    rows: list[Row]
    features: list[np.ndarray]
    cost: dict[str, float] = field(default_factory=dict)
    captions: list[str] | None = None


class Source(Protocol):
    """Gives the motions of some rows."""

    def __call__(self, name: str, rows: list[Row], replication: int, rank: int, world: int) -> Samples | None:
        """The motions of the rows, under a name that tells replications and purposes apart.

        All of `world` processes call it together; the first gets the motions, the others None.
        """
        ...


def real_motions(clips: Clips, rows: Sequence[Row]) -> list[np.ndarray]:
    """Features (F, D) of the real motions of the rows, in the data's units."""
    store, rebase = clips.store, clips.representation.rebase
    return [np.ascontiguousarray(rebase(store.motion(row.clip)[row.frames]), np.float32) for row in rows]


class Generator:
    """Motions of a model, kept in a folder so that a killed evaluation goes on and new metrics need no new motions.

    Several processes sample a share of the rows each.

    Args:
        model: the model, on its device.
        folder: of the motions, `rep_0.npz` and so on, as `SampleFolder` reads them; None = not kept.
        options: for `MotionGeneration.generate`: guidance_scale, sampler, num_inference_steps, seed; with `parts`,
            also `edit`, the options of `Edit`.
        clips: the split.
        condition: "text", "action" or "none".
        batch_size: motions at once.
        timed: whether a first batch, which is slower than the others, is sampled once more than it is counted.
        parts: `region` and `joints` as of `flame_mdm.editing.kept_parts`: the motions are edits of the real ones.
        total: motions of the whole evaluation, for the time left.
        progress: whether to show it.
    """

    def __init__(
        self,
        model: MotionGeneration,
        folder: Path | None,
        options: Mapping[str, Any],
        *,
        clips: Clips,
        condition: str,
        batch_size: int,
        timed: bool = False,
        parts: Mapping[str, Any] | None = None,
        total: int = 0,
        progress: bool = True,
    ):
        self.model, self.folder, self.options, self.clips = model, folder, dict(options), clips
        self.condition, self.batch_size, self.timed, self.parts = condition, batch_size, timed, parts
        self.how = self.options.pop("edit", {})
        self.bar = tqdm(total=total, desc="generating", unit=" motions", disable=not progress)

    def __call__(self, name: str, rows: list[Row], replication: int, rank: int = 0, world: int = 1) -> Samples | None:
        """The motions of the rows, from the folder or else from the model; see `Source`.

        Raises:
            UserError: the folder holds other motions, or a damaged file; or the model returns what is not finite.
        """
        path = self.folder / f"{name}.npz" if self.folder else None
        if shared(path is not None and path.exists(), world):
            return self._read(path, rows) if path is not None and not rank else None
        features, counts = self._generate(rows[rank::world], replication)
        if world > 1:
            parts: list[Any] | None = [None] * world if not rank else None
            torch.distributed.gather_object((features, counts), parts)
            if parts is None:
                return None
            features = [np.empty(0)] * len(rows)
            for number, (share, _) in enumerate(parts):
                features[number::world] = share
            counts = np.sum([numbers for _, numbers in parts], axis=0)
        calls, batches, seconds = (float(count) for count in counts)
        cost = {
            "nfe": calls / batches,
            "seconds_per_sample": seconds / len(rows),
            "batch_size": float(min(self.batch_size, len(rows[::world]))),
        }
        if path is not None:
            _write(path, rows, features, cost, self.condition)
        return Samples(rows, features, cost)

    def _read(self, path: Path, rows: list[Row]) -> Samples:
        content = read_samples(path)
        if content["ids"].tolist() != [row.id for row in rows]:
            raise UserError(f"{path}: holds other motions than these; delete it")
        self.bar.update(len(rows))
        cost = {key: float(content[key]) for key in ("nfe", "seconds_per_sample", "batch_size")}
        return Samples(rows, _split(content), cost)

    def _generate(self, rows: Sequence[Row], replication: int) -> tuple[list[np.ndarray], np.ndarray]:
        """Motions in order; and calls of the denoiser, batches and seconds."""
        features: dict[int, np.ndarray] = {}
        calls = 0

        def count(*_: Any) -> None:
            nonlocal calls
            calls += 1

        def sample(some: Sequence[Row]) -> np.ndarray:
            x = self.model.generate(
                self._batch(some),
                replication=replication,
                unconditioned=self.condition == "none",
                edit=None if self.parts is None else self._edit(some),
                **self.options,
            )
            return self.model.representation.denormalize(x.float()).cpu().numpy()

        order = np.argsort([-len(row.frames) for row in rows], kind="stable").tolist()
        if self.timed:
            sample([rows[i] for i in order[: self.batch_size]])
        hook = self.model.denoiser.register_forward_hook(count)
        begin, batches = time.perf_counter(), 0
        try:
            for first in range(0, len(rows), self.batch_size):
                indices = order[first : first + self.batch_size]
                some = [rows[i] for i in indices]
                for i, motion in zip(indices, sample(some), strict=True):
                    features[i] = motion[: len(rows[i].frames)].copy()
                    if not np.isfinite(features[i]).all():
                        raise UserError(f"the model returned a motion that is not finite for {rows[i].id}")
                batches += 1
                self.bar.update(len(indices))
        except BaseException:
            self.bar.close()  # ends its line
            raise
        finally:
            hook.remove()
        seconds = time.perf_counter() - begin
        return [features[i] for i in range(len(rows))], np.array([calls, batches, seconds])

    def _batch(self, rows: Sequence[Row]) -> MotionBatch:
        model = self.model
        mask = length_mask(torch.tensor([len(row.frames) for row in rows], device=model.device))
        labels = [row.clip.action for row in rows] if self.condition == "action" else None
        return MotionBatch(
            x=torch.zeros(*mask.shape, model.representation.features, device=model.device),
            mask=mask,
            ids=[row.id for row in rows],
            text=[row.text for row in rows] if self.condition == "text" else None,
            action=None if labels is None else torch.tensor(labels, device=model.device),
        )

    def _edit(self, rows: Sequence[Row]) -> Edit:
        """The real motions of the rows and what is kept of them; what lies behind the end is kept as zeros."""
        representation, longest = self.model.representation, max(len(row.frames) for row in rows)
        known, keep = [], []
        for motion in real_motions(self.clips, rows):
            x = torch.from_numpy(motion).to(self.model.device)
            known.append(pad_to(representation.normalize(x)[None], longest))
            kept, _ = kept_parts(representation, len(motion), **(self.parts or {}))
            keep.append(~pad_to(~kept[None].to(x.device), longest))
        return Edit(torch.cat(known), torch.cat(keep), **self.how)


def shared(value: T, world: int) -> T:
    """Returns the value of the first of `world` processes, on all of them."""
    box = [value]
    if world > 1:
        torch.distributed.broadcast_object_list(box)
    return box[0]


class SampleFolder:
    """Motions from another system: a folder of .npz files, one per replication, in the order of their names.

    Each holds `ids` (N,), names of clips of the split; `lengths` (N,); `features` (sum of lengths, D) in the data's
    units, or `joints` (sum of lengths, J, 3) in metres, y up, at the data's frame rate; and, where they were not made
    for the captions that the protocol draws, `captions` (N,).

    Raises:
        UserError: no such files.
    """

    def __init__(self, folder: Path, representation: Representation):
        self.representation = representation
        self.files = sorted(folder.glob("*.npz"), key=lambda path: (len(path.name), path.name))
        self.files = [path for path in self.files if not path.name.startswith((".", "multimodality_"))]
        if not self.files:
            raise UserError(f"from_samples={folder}: no .npz file there")
        for path in self.files:
            regular_file(path)

    @property
    def sha256(self) -> str:
        """Of all files."""
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def __call__(self, name: str, rows: list[Row], replication: int, rank: int = 0, world: int = 1) -> Samples | None:
        """The motions of one file, those of the rows' clips, and their captions; see `Source`.

        Raises:
            UserError: it names other clips, or lacks most.
        """
        if rank:
            return None
        path = self.files[replication]
        content = read_samples(path)
        by_id = {row.id: row for row in rows}
        ids = content["ids"].tolist()
        unknown = sorted(set(ids) - by_id.keys())
        if unknown or len(set(ids)) < len(ids):
            what = (
                f"names {len(unknown)} clips that the split lacks, such as {unknown[0]}" if unknown else "repeats ids"
            )
            raise UserError(f"{path}: {what}; give each clip of the split once")
        if "joints" in content:
            joints = [torch.from_numpy(np.ascontiguousarray(x, np.float32)) for x in _split(content, "joints")]
            features = [x.numpy().astype(np.float32) for x in self.representation.encode_many(joints)]
        else:
            features = _split(content)
        if features[0].shape[1] != self.representation.features:
            raise UserError(
                f"{path}: {features[0].shape[1]} features a frame, but {self.representation.name} has "
                f"{self.representation.features}"
            )
        place = {name: index for index, name in enumerate(ids)}
        requested = [row for row in rows if row.id in place]
        captions = content.get("captions")
        texts = None if captions is None else [str(captions[place[row.id]]) for row in requested]
        return Samples(requested, [features[place[row.id]] for row in requested], captions=texts)


class Baseline:
    """Sanity-check baselines: motions without a model, which show what each metric detects.

    | kind | motions | what should be bad |
    |---|---|---|
    | real | real ones, another window of the same clips | nothing |
    | shuffled | real ones of other captions or labels | what reads text or label; not FID |
    | noisy | real ones plus normal noise of `NOISE` in normalized features | FID, jitter, foot skating |
    | static | the first frame, held | FID, diversity, static share |

    Args:
        kind: one of these.
        clips: the split.
        condition: "text", "action" or "none".
        seed: of all draws.

    Raises:
        UserError: an unknown kind, or nothing to shuffle.
    """

    KINDS = ("real", "shuffled", "noisy", "static")

    def __init__(self, kind: str, clips: Clips, condition: str, seed: int):
        if kind not in self.KINDS:
            raise UserError(f"baseline={kind}: there are {', '.join(self.KINDS)}")
        if kind == "shuffled" and condition == "none":
            raise UserError("baseline=shuffled: motions without text or label cannot be given those of others")
        self.kind, self.clips, self.condition, self.seed = kind, clips, condition, seed

    def __call__(self, name: str, rows: list[Row], replication: int, rank: int = 0, world: int = 1) -> Samples | None:
        """The motions of the rows; see `Source`."""
        if rank:
            return None
        make = {"real": self._real, "shuffled": self._shuffled, "noisy": self._noisy, "static": self._static}
        return Samples(rows, make[self.kind](rows, replication))

    def _real(self, rows: Sequence[Row], replication: int) -> list[np.ndarray]:
        """Windows of the rows' lengths, from anywhere in their clips."""
        moved = []
        for row in rows:
            generator = np.random.default_rng(key("baseline", self.seed, replication, row.id))
            spare = row.clip.length - 1 - int(row.frames[-1] - row.frames[0])
            begin = generator.integers(spare + 1) if spare > 0 else row.frames[0]
            moved.append(Row(row.id, row.clip, row.frames - row.frames[0] + begin, row.caption, row.prompt))
        return real_motions(self.clips, moved)

    def _shuffled(self, rows: Sequence[Row], replication: int) -> list[np.ndarray]:
        """Each row gets the motion of a row that asks for something else: no row keeps its own.

        Rows that ask for the same stand together, in an order that is drawn. Moved on by the size of the largest group,
        none stays in its own.
        """
        names = [row.text if self.condition == "text" else str(row.clip.action) for row in rows]
        turn = {name: key("shuffle", self.seed, replication, name) for name in names}
        place = [(turn[name], key(row.id)) for name, row in zip(names, rows, strict=True)]
        order = sorted(range(len(rows)), key=place.__getitem__)
        largest = max(Counter(names).values())
        if 2 * largest > len(rows):
            raise UserError(f"baseline=shuffled: {largest} of {len(rows)} motions are asked to be the same")
        motions = real_motions(self.clips, rows)
        given = {order[i]: motions[order[i - largest]] for i in range(len(rows))}
        return [given[i] for i in range(len(rows))]

    def _noisy(self, rows: Sequence[Row], replication: int) -> list[np.ndarray]:
        motions = []
        for row, motion in zip(rows, real_motions(self.clips, rows), strict=True):
            keys = torch.tensor([key("baseline", self.seed, replication, row.id)])
            noise = normal(keys, *motion.shape)[0].numpy()
            motions.append((motion + NOISE * noise * self.clips.std).astype(np.float32))
        return motions

    def _static(self, rows: Sequence[Row], replication: int) -> list[np.ndarray]:
        """The first frame is held; where its features say how fast it moves, its joints are held and encoded."""
        representation, motions = self.clips.representation, real_motions(self.clips, rows)
        held = [torch.from_numpy(motion[:1]).expand(len(motion), -1) for motion in motions]
        where = representation.mean.device
        joints = [representation.decode(x.to(where)).cpu() for x in held]
        if any((x - x[:1]).abs().max() > 1e-4 for x in joints):
            longer = [x[:1].expand(len(x) + 1, -1, -1) for x in joints]  # encoders may need a frame more
            held = [x[: len(y)] for x, y in zip(representation.encode_many(longer), motions, strict=True)]
        return [x.numpy().copy() for x in held]


def read_samples(path: Path) -> dict[str, np.ndarray]:
    """A file of generated motions: see `SampleFolder`.

    Raises:
        UserError: it is damaged, or lacks something.
    """
    try:
        content = read_npz(path)
    except ValueError as error:
        raise UserError(f"{path}: {error}; delete it or write it again") from error
    frames = {name: content[name] for name in ("features", "joints") if name in content}
    if not {"ids", "lengths"} <= content.keys() or not frames:
        raise UserError(f"{path}: needs ids, lengths and features or joints, holds {', '.join(content) or 'nothing'}")
    ids, lengths, captions = content["ids"], content["lengths"], content.get("captions", content["ids"])
    numbers = lengths.dtype.kind in "iu" and ids.dtype.kind == captions.dtype.kind == "U"
    whole = numbers and ids.ndim == 1 and ids.shape == lengths.shape == captions.shape and len(ids)
    if not whole or lengths.min() < 1 or any(len(x) != sum(lengths.tolist()) for x in frames.values() if x.ndim):
        raise UserError(f"{path}: ids, lengths, captions and frames do not belong together; write it again")
    for name, array in frames.items():
        if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8 or array.ndim != 2 + (name == "joints"):
            shape = "(frames, joints, 3)" if name == "joints" else "(frames, features)"
            raise UserError(f"{path}: {name} are not an array {shape} of real numbers; write it again")
    return content


def _split(content: Mapping[str, np.ndarray], name: str = "features") -> list[np.ndarray]:
    return np.split(content[name].astype(np.float32), np.cumsum(content["lengths"])[:-1])


def _write(
    path: Path, rows: Sequence[Row], features: Sequence[np.ndarray], cost: Mapping[str, float], condition: str
) -> None:
    content: dict[str, Any] = {
        "ids": np.array([row.id for row in rows]),
        "lengths": np.array([len(x) for x in features]),
        "features": np.concatenate(list(features)),
        **{name: np.array(value) for name, value in cost.items()},
    }
    if condition == "text":
        content["captions"] = np.array([row.text for row in rows])
    with atomic_write(path) as temporary:
        np.savez(temporary, **content)
