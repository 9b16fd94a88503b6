"""Protocols: which motions are generated, how often, and what is measured of them."""

from __future__ import annotations

import hashlib
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from evaluators.confidence import mean_ci
from evaluators.evaluator import Evaluator, Extracted, Motions
from evaluators.extractors import Extractor
from flame_mdm.config import Config, UserError, instantiate
from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Entry
from flame_mdm.motion import MotionBatch, length_mask
from flame_mdm.noise import key
from flame_mdm.representations import Representation
from flame_mdm.task import MotionGeneration

QUICK_REPLICATIONS, QUICK_SAMPLES = 2, 64


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


@dataclass
class Samples:
    """Generated motions and what they cost.

    Attributes:
        rows: what was asked for, in order.
        features: (F, D) float32 each, in the data's units.
        cost: calls of the denoiser a motion, and seconds a motion at its batch size; empty for motions of others.
    """

    rows: list[Row]
    features: list[np.ndarray]
    cost: dict[str, float]


class Protocol:
    """A way to evaluate, named and versioned; its file is never changed, another version gets another file.

    Caption and crop of a clip are a function of (seed, replication, id), and so is the noise of its motion. Motions are
    generated at the length of the real clip. Real motions are measured first, by the same metrics, against a second
    draw of themselves.

    Args:
        name: of the protocol.
        version: of the protocol.
        condition: what motions are generated for: "text", "action" or "none".
        extractor: a mapping with the `_target_` of an `Extractor`, which is opened with a path; None = needs none.
        metrics: mappings with the `_target_` of a metric, by name.
        replications: how often all is repeated.
        samples: motions a replication; clips are drawn, and taken repeatedly where there are fewer. None = each clip of
            the split once.
        multimodality: `prompts`, `samples` a prompt, `replications` and `metrics` of an evaluation of its own, in which
            several motions are generated for each of some prompts; None = none.
        expected: by data set or sha256 of the extractor, the values that real motions of the test split must have:
            metric -> [value, tolerance]. Where they have others, the model's values are not valid.
    """

    def __init__(
        self,
        *,
        name: str,
        version: int,
        condition: str,
        extractor: Config | None,
        metrics: dict[str, Config],
        replications: int,
        samples: int | None = None,
        multimodality: dict[str, Any] | None = None,
        expected: dict[str, dict[str, list[float]]] | None = None,
    ):
        if condition not in ("text", "action", "none"):
            raise ValueError(f"protocol {name}: condition is text, action or none, not {condition}")
        self.name, self.version, self.condition = name, version, condition
        self.extractor, self.metrics, self.replications, self.samples = extractor, metrics, replications, samples
        self.multimodality, self.expected = multimodality, expected or {}
        self.quick = False

    def change(self, *, replications: int | None, samples: int | None, quick: bool, clips: int) -> dict[str, Any]:
        """Makes the protocol cheaper, for a split of so many clips.

        Returns:
            What is no longer as published, to stand in the result.

        Raises:
            UserError: fewer than one replication or motion.
        """
        self.quick = quick
        if quick:
            replications, samples = replications or QUICK_REPLICATIONS, samples or min(QUICK_SAMPLES, clips)
        changed: dict[str, Any] = {}
        for name, value in (("replications", replications), ("samples", samples)):
            if value is not None and value < 1:
                raise UserError(f"{name}={value}: at least 1 is needed")
            if value is not None and value != getattr(self, name):
                setattr(self, name, value)
                changed[name] = value
        if self.multimodality and replications is not None:
            fewer = min(replications, self.multimodality["replications"])
            self.multimodality = {**self.multimodality, "replications": fewer}
        return changed

    def open_extractor(self, path: str | None, representation: Representation, dataset: str) -> Extractor | None:
        """The extractor at `path`, on the device of the representation; "none" leaves its metrics without values.

        Raises:
            UserError: none given where one is needed, or one of another representation or data set.
            FileNotFoundError, ValueError: no such file, or not one of the protocol's extractor.
        """
        if self.extractor is None or path == "none":
            return None
        if path is None:
            raise UserError(
                f"protocol {self.name} needs a feature extractor: extractor=FILE, such as a checkpoint of make train "
                "EXP=motion_clip/...; extractor=none leaves the metrics that read features without values"
            )
        extractor: Extractor = instantiate(self.extractor, path=path, device=representation.mean.device)
        extractor.check(representation, dataset)
        return extractor

    # What is generated ------------------------------------------------------------------------------------------------

    def rows(self, clips: Clips, seed: int, replication: int, *, purpose: str = "generated") -> list[Row]:
        """What one replication generates, or, for another purpose, another draw of captions and crops of all clips."""
        entries = sorted(clips.clips, key=lambda clip: key("sample", seed, replication, clip.id))
        if not entries:
            raise UserError(f"the split has no clip of {clips.crop.shortest()} frames or more to evaluate on")
        count = self.samples if self.samples is not None and purpose == "generated" else len(entries)
        rows = []
        for number in range(count):
            clip = entries[number % len(entries)]
            again = number // len(entries)
            name = f"{clip.id}#{again}" if again else clip.id
            generator = np.random.default_rng(key("crop", purpose, seed, replication, name))
            caption = key("caption", purpose, seed, replication, name) % len(clip.captions) if clip.captions else None
            rows.append(Row(name, clip, clips.crop(clip.length, generator), caption, name))
        return rows

    def prompts(self, clips: Clips, seed: int, replication: int) -> list[Row]:
        """What one replication of multimodality generates: several motions for each of the first prompts."""
        assert self.multimodality is not None
        prompts = self.rows(clips, seed, replication)[: self.multimodality["prompts"]]
        return [
            Row(f"{row.id}~{number}", row.clip, row.frames, row.caption, row.id)
            for row in prompts
            for number in range(self.multimodality["samples"])
        ]

    def asked(self, rows: Sequence[Row], features: list[np.ndarray], captions: list[str] | None = None) -> Motions:
        """Motions for the rows, with what the rows ask for; `captions` replace theirs."""
        text = self.condition == "text"
        texts = captions or [_caption(row) for row in rows] if text else None
        labels = [row.clip.action for row in rows]
        return Motions(
            ids=[row.id for row in rows],
            features=features,
            captions=texts,
            tokens=[_tokens(row, caption) for row, caption in zip(rows, texts, strict=True)] if texts else None,
            labels=[int(label) for label in labels if label is not None] if self.condition == "action" else None,
            groups=[row.prompt for row in rows],
            asked=[row.clip.attributes for row in rows] if self.condition != "none" else None,
        )

    def real(self, clips: Clips, rows: Sequence[Row]) -> list[np.ndarray]:
        """Features (F, D) of the real motions of the rows, in the data's units."""
        store, rebase = clips.store, clips.representation.rebase
        return [np.ascontiguousarray(rebase(store.motion(row.clip)[row.frames]), np.float32) for row in rows]

    def check_data(self, clips: Clips) -> None:
        """Refuses data that lacks what the protocol's motions are generated for.

        Raises:
            UserError: no captions, no labels, or no clip.
        """
        rows = self.rows(clips, 0, 0)
        lacking = {
            "text": any(row.caption is None for row in rows),
            "action": any(row.clip.action is None for row in rows),
            "none": False,
        }
        if lacking[self.condition]:
            raise UserError(
                f"protocol {self.name} generates motions for {self.condition}, but the data set "
                f"{clips.store.info['dataset']} has clips without: choose another protocol"
            )

    def generator(
        self,
        model: MotionGeneration,
        folder: Path | None,
        options: Mapping[str, Any],
        *,
        batch_size: int,
        count: int,
        progress: bool = True,
    ) -> Generator:
        """The source of a model's motions; see `Generator`. `count` is the number of clips of the split."""
        total = self.replications * (self.samples or count)
        if self.multimodality and not self.quick:
            several = self.multimodality
            total += several["replications"] * several["samples"] * min(several["prompts"], self.samples or count)
        return Generator(
            model,
            folder,
            options,
            condition=self.condition,
            batch_size=batch_size,
            total=total,
            progress=progress,
        )

    def given(self, folder: Path, representation: Representation) -> Given:
        """The source of motions that others made, a replication a file, of any clips of the split; see `Given`."""
        source = Given(folder, representation)
        self.replications, self.samples = len(source.files), None
        return source

    # The evaluation ---------------------------------------------------------------------------------------------------

    def evaluate(
        self,
        source: Generator | Given | None,
        clips: Clips,
        extractor: Extractor | None,
        representation: Representation,
        *,
        seed: int = 0,
        batch_size: int = 64,
        rank: int = 0,
        world: int = 1,
        ground_truth: bool = True,
    ) -> dict[str, Any]:
        """Evaluates motions, and real ones before them.

        Args:
            source: of the motions; None = real ones alone.
            clips: the split.
            extractor: opened; None = metrics of features have no value.
            representation: of the motions, on the device to compute on.
            seed: of all draws.
            batch_size: of the extractor.
            rank, world: with several processes, each takes its share of the motions and all get the values.
            ground_truth: whether real motions are measured, too.

        Returns:
            "ground_truth" and "values": by metric, `mean`, `ci` (half the width of the 95 % interval), `replications`,
            `n` motions, each None where not computable; "not_computed": reasons by metric; "cost"; "valid" and
            "invalid_because".
        """
        device = representation.mean.device if world > 1 else torch.device("cpu")
        found: dict[str, list[tuple[dict[str, float | None], int]]] = {"ground_truth": [], "values": []}
        reasons: dict[str, str] = {}
        costs: list[dict[str, float]] = []
        evaluator = Evaluator(extractor, self.metrics, representation, batch_size=batch_size, device=device)

        def score(kind: str, motions: Extracted, paired: Extracted, real: Extracted, replication: int, n: int) -> None:
            values, why = evaluator.score(motions, paired, real, key("draws", seed, replication))
            found[kind].append((values, n))
            reasons.update(why)

        for replication in range(self.replications):
            rows = self.rows(clips, seed, replication)
            mine = rows[rank::world]
            again = self.rows(clips, seed, replication, purpose="real")[rank::world]
            paired = evaluator.extract(self.asked(mine, self.real(clips, mine)))
            real = evaluator.extract(self.asked(again, self.real(clips, again)))
            if ground_truth:
                score("ground_truth", paired, paired, real, replication, len(rows))
            if source is not None:
                samples, captions = source(f"rep_{replication}", mine, replication)
                costs.append(samples.cost)
                if len(samples.rows) != len(mine):  # motions of others, not one for each clip
                    wanted = {row.id for row in samples.rows}
                    paired = _take(paired, [i for i, row in enumerate(mine) if row.id in wanted])
                generated = evaluator.extract(self.asked(samples.rows, samples.features, captions))
                score("values", generated, paired, real, replication, len(samples.rows) if world == 1 else len(rows))
        results = {kind: _summary(values) for kind, values in found.items()}
        if self.multimodality and source is not None:
            measure = Evaluator(
                extractor, self.multimodality["metrics"], representation, batch_size=batch_size, device=device
            )
            results["values"] |= self._several(source, clips, measure, seed, slice(rank, None, world), reasons)
        if extractor is None and self.extractor is not None:
            reasons["extractor"] = "none was given, metrics of its features have no values"
        gate = ground_truth and not self.quick and clips.clips[0].split == "test"
        invalid = self._off(results["ground_truth"], clips, extractor) if gate else []
        return {
            "ground_truth": results["ground_truth"] if ground_truth else None,
            "values": results["values"] if source is not None else None,
            "not_computed": reasons,
            "cost": _mean_cost(costs),
            "valid": not invalid,
            "invalid_because": invalid,
        }

    def _several(
        self,
        source: Generator | Given,
        clips: Clips,
        evaluator: Evaluator,
        seed: int,
        share: slice,
        reasons: dict[str, str],
    ) -> dict[str, Any]:
        """Multimodality: values of the metrics that need several motions a prompt."""
        assert self.multimodality is not None
        found = []
        for replication in range(self.multimodality["replications"]):
            motions, count = evaluator.extract(self.asked([], [])), 0
            if isinstance(source, Generator) and not self.quick:
                rows = self.prompts(clips, seed, replication)
                samples, _ = source(f"multimodality_{replication}", rows[share], replication)
                motions, count = evaluator.extract(self.asked(samples.rows, samples.features)), len(rows)
            values, why = evaluator.score(motions, motions, motions, key("draws", seed, replication))
            found.append((values, count))
            reasons |= why
        if self.quick or isinstance(source, Given):
            why_not = "left out of a quick evaluation" if self.quick else "the samples are one a clip"
            reasons["multimodality"] = f"{why_not}, but it takes several motions for each of some prompts"
        return _summary(found)

    def _off(self, values: Mapping[str, Any], clips: Clips, extractor: Extractor | None) -> list[str]:
        """In which expected values real motions fail."""
        names = [clips.store.info["dataset"], *([extractor.sha256] if extractor else [])]
        lines = []
        for metric, (wanted, tolerance) in (item for name in names for item in self.expected.get(name, {}).items()):
            mean = values.get(metric, {}).get("mean")
            if mean is not None and not abs(mean - wanted) <= tolerance:
                lines.append(f"real motions have {metric} {mean:.4g}, expected {wanted:g} +- {tolerance:g}")
        return lines


def _caption(row: Row) -> str:
    assert row.caption is not None
    return row.clip.captions[row.caption]


def _tokens(row: Row, caption: str) -> list[str] | None:
    """The "word/PART" of a caption of the clip, where the data has them."""
    tagged = row.clip.attributes.get("tokens")
    return tagged[row.clip.captions.index(caption)] if tagged and caption in row.clip.captions else None


def _take(extracted: Extracted, indices: list[int]) -> Extracted:
    rows = {n: v[indices] if isinstance(v, Tensor) else [v[i] for i in indices] for n, v in extracted.rows.items()}
    return Extracted(rows, [extracted.joints[i] for i in indices])


def _summary(found: Sequence[tuple[Mapping[str, float | None], int]]) -> dict[str, Any]:
    """Means over replications; None as soon as one has no value."""
    table = {}
    for name in found[0][0] if found else ():
        values = [value for replication, _ in found if (value := replication[name]) is not None]
        mean, ci = mean_ci(values) if len(values) == len(found) else (None, None)
        table[name] = {"mean": mean, "ci": ci, "replications": len(found), "n": found[0][1]}
    return table


def _mean_cost(costs: Sequence[dict[str, float]]) -> dict[str, float | None]:
    names = ("nfe", "seconds_per_sample", "batch_size")
    return {name: float(np.mean([cost[name] for cost in costs])) if all(costs) and costs else None for name in names}


# Sources of motions ---------------------------------------------------------------------------------------------------


class Generator:
    """Motions of a model, kept in a folder so that a killed evaluation goes on and new metrics need no new motions.

    Args:
        model: the model, on its device.
        folder: of the motions, `rep_0.npz` and so on, as `Given` reads them; None = not kept.
        options: for `MotionGeneration.generate`: guidance_scale, sampler, num_inference_steps, seed.
        condition: "text", "action" or "none".
        batch_size: motions at once.
        total: motions of the whole evaluation, for the time left.
        progress: whether to show it.
    """

    def __init__(
        self,
        model: MotionGeneration,
        folder: Path | None,
        options: Mapping[str, Any],
        *,
        condition: str,
        batch_size: int,
        total: int = 0,
        progress: bool = True,
    ):
        self.model, self.folder, self.options = model, folder, dict(options)
        self.condition, self.batch_size = condition, batch_size
        self.bar = tqdm(total=total, desc="generating", unit=" motions", disable=not progress)

    def __call__(self, name: str, rows: list[Row], replication: int) -> tuple[Samples, None]:
        """The motions of the rows, from the folder or else from the model."""
        path = self.folder / f"{name}.npz" if self.folder else None
        if path is not None and path.exists():
            content = read_samples(path)
            if content["ids"].tolist() != [row.id for row in rows]:
                raise UserError(f"{path}: holds other motions than these; delete it")
            self.bar.update(len(rows))
            cost = {key: float(content[key]) for key in ("nfe", "seconds_per_sample", "batch_size")}
            return Samples(rows, _split(content), cost), None
        features, cost = self._generate(rows, replication)
        if path is not None:
            _write(path, rows, features, cost, self.condition)
        return Samples(rows, features, cost), None

    def _generate(self, rows: Sequence[Row], replication: int) -> tuple[list[np.ndarray], dict[str, float]]:
        features: dict[int, np.ndarray] = {}
        calls = 0

        def count(*_: Any) -> None:
            nonlocal calls
            calls += 1

        order = np.argsort([-len(row.frames) for row in rows], kind="stable").tolist()
        hook = self.model.denoiser.register_forward_hook(count)
        begin, batches = time.perf_counter(), 0
        try:
            for first in range(0, len(rows), self.batch_size):
                indices = order[first : first + self.batch_size]
                batch = self._batch([rows[i] for i in indices])
                x = self.model.generate(
                    batch, replication=replication, unconditioned=self.condition == "none", **self.options
                )
                raw = self.model.representation.denormalize(x.float()).cpu().numpy()
                for i, motion in zip(indices, raw, strict=True):
                    features[i] = motion[: len(rows[i].frames)].copy()
                    if not np.isfinite(features[i]).all():
                        raise UserError(f"the model returned a motion that is not finite for {rows[i].id}")
                batches += 1
                self.bar.update(len(indices))
        finally:
            hook.remove()
        seconds = time.perf_counter() - begin
        cost = {
            "nfe": calls / max(batches, 1),
            "seconds_per_sample": seconds / max(len(rows), 1),
            "batch_size": float(min(self.batch_size, len(rows))),
        }
        return [features[i] for i in range(len(rows))], cost

    def _batch(self, rows: Sequence[Row]) -> MotionBatch:
        model = self.model
        mask = length_mask(torch.tensor([len(row.frames) for row in rows], device=model.device))
        labels = [row.clip.action for row in rows] if self.condition == "action" else None
        return MotionBatch(
            x=torch.zeros(*mask.shape, model.representation.features, device=model.device),
            mask=mask,
            ids=[row.id for row in rows],
            text=[_caption(row) for row in rows] if self.condition == "text" else None,
            action=None if labels is None else torch.tensor(labels, device=model.device),
        )


class Given:
    """Motions that others made: a folder of .npz files, one a replication, in the order of their names.

    Each holds `ids` (N,), names of clips of the split; `lengths` (N,); `features` (sum of lengths, D) in the data's
    units, or `joints` (sum of lengths, J, 3) in metres, y up, at the data's frame rate; and, where they were not made
    for the captions that the protocol draws, `captions` (N,).

    Raises:
        UserError: no such files.
    """

    def __init__(self, folder: Path, representation: Representation):
        self.representation = representation
        self.files = sorted(folder.glob("*.npz"), key=lambda path: (len(path.name), path.name))
        self.files = [path for path in self.files if not path.name.startswith("multimodality_")]
        if not self.files:
            raise UserError(f"from_samples={folder}: no .npz file there")

    @property
    def sha256(self) -> str:
        """Of all files."""
        digest = hashlib.sha256()
        for path in self.files:
            digest.update(path.read_bytes())
        return digest.hexdigest()

    def __call__(self, name: str, rows: list[Row], replication: int) -> tuple[Samples, list[str] | None]:
        """The motions of one file, those of the rows' clips, and their captions.

        Raises:
            UserError: it names other clips, or lacks most.
        """
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
        asked = [row for row in rows if row.id in place]
        captions = content.get("captions")
        given = None if captions is None else [str(captions[place[row.id]]) for row in asked]
        return Samples(asked, [features[place[row.id]] for row in asked], {}), given


def read_samples(path: Path) -> dict[str, np.ndarray]:
    """A file of generated motions: see `Given`.

    Raises:
        UserError: it is damaged, or lacks something.
    """
    try:
        with path.open("rb") as raw, np.load(raw, allow_pickle=False) as file:
            content = {name: file[name] for name in file.files}
    except Exception as error:  # numpy raises many kinds for damaged archives
        raise UserError(f"{path}: damaged, or not an .npz file of plain arrays; delete it or write it again") from error
    frames = content.get("features", content.get("joints"))
    if not {"ids", "lengths"} <= content.keys() or frames is None:
        raise UserError(f"{path}: needs ids, lengths and features or joints, holds {', '.join(content) or 'nothing'}")
    if len(content["ids"]) != len(content["lengths"]) or len(frames) != content["lengths"].sum() or not len(frames):
        raise UserError(f"{path}: ids, lengths and frames do not belong together")
    return content


def _split(content: Mapping[str, np.ndarray], name: str = "features") -> list[np.ndarray]:
    return np.split(content[name].astype(np.float32), np.cumsum(content["lengths"])[:-1])


def _write(
    path: Path, rows: Sequence[Row], features: Sequence[np.ndarray], cost: Mapping[str, float], condition: str
) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    content: dict[str, Any] = {
        "ids": np.array([row.id for row in rows]),
        "lengths": np.array([len(x) for x in features]),
        "features": np.concatenate(list(features)),
        **{name: np.array(value) for name, value in cost.items()},
    }
    if condition == "text":
        content["captions"] = np.array([_caption(row) for row in rows])
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez(file, **content)
    partial.replace(path)
