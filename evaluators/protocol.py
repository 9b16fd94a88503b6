"""Evaluation protocols: which motions are generated, how often, and which metrics are computed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

import numpy as np
from scipy.ndimage import gaussian_filter1d
from torch import Tensor

from evaluators.collectives import shared
from evaluators.evaluator import Evaluator, Extracted, Motions
from evaluators.extractors import Extractor
from evaluators.metrics import make_metrics
from evaluators.metrics.confidence import mean_ci
from evaluators.metrics.distribution import FrechetMotionDistance
from evaluators.metrics.memorization import TrainingMotions
from evaluators.sources import Baseline, Generator, Row, SampleFolder, Source, real_motions
from flame_mdm.config import Config, instantiate
from flame_mdm.data.datamodule import Clips
from flame_mdm.data.store import Entry
from flame_mdm.errors import UserError
from flame_mdm.representations import Representation
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.editing import method_options
from flame_mdm.sampling.request import EditRequest
from flame_mdm.seeds import key
from flame_mdm.task import MotionGeneration

REGION = {"frames": "region"}
"""Maps option names in protocol files, which never change, to arguments of `flame_mdm.sampling.editing.kept_parts`."""
QUICK_REPLICATIONS, QUICK_SAMPLES = 2, 64


class Multimodality(TypedDict):
    """A second evaluation with several motions per prompt; `prompts` None = all prompts of the split."""

    prompts: int | None
    samples: int
    replications: int
    metrics: dict[str, Config]


class Protocol:
    """A named and versioned evaluation procedure. Its file never changes; a new version gets a new file.

    The caption and crop of a clip, and the noise of its generated motion, are functions of (seed, replication, id).
    Motions are generated at the length of the real clip. Real motions are measured first, with the same metrics,
    against a second draw of real motions.

    Args:
        name: name of the protocol.
        version: version of the protocol.
        condition: condition of the generated motions: "text", "action" or "none".
        extractor: a mapping with the `_target_` of an `Extractor`; the evaluation provides its path. None = not needed.
        metrics: mappings with the `_target_` of a metric, by name.
        replications: number of repetitions of the evaluation.
        samples: motions per replication. Clips are drawn at random, and repeatedly if there are too few. None = each
            clip of the split once.
        real_samples: real motions per replication in comparisons of sets, drawn likewise; None = each clip once.
        multimodality: a second evaluation with several motions per prompt; None = none.
        edit: `frames` (the region) and `joints` of `sampling.editing.kept_parts`: motions are edits of real motions;
            None = motions are generated from scratch.
        smoothing: standard deviation, in frames, of a Gaussian filter over time that is applied to the features of
            generated motions before they are measured, with mirrored ends; None = no filter.
        batch_size: motions per batch, if the protocol measures time; a first batch is not timed. None = the protocol
            does not measure time and uses the batch size of the evaluation.
        only: attributes that evaluated clips must have; None = all clips of the split.
        expected: by data set or sha256 of the extractor, the values that real motions of the test split must have:
            metric -> [value, tolerance]. If they differ, nothing is generated.

    Raises:
        UserError: If an option of `multimodality` or of a metric is missing or unknown.
        ValueError: If the condition is unknown.
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
        real_samples: int | None = None,
        multimodality: Multimodality | None = None,
        edit: dict[str, Any] | None = None,
        smoothing: float | None = None,
        batch_size: int | None = None,
        only: dict[str, Any] | None = None,
        expected: dict[str, dict[str, list[float]]] | None = None,
    ):
        if condition not in ("text", "action", "none"):
            raise ValueError(f"protocol {name}: unknown condition: {condition}. Use text, action or none")
        if multimodality is not None and multimodality.keys() != Multimodality.__annotations__.keys():
            raise UserError(
                f"protocol {name}: multimodality has the options {', '.join(multimodality)}. Give exactly "
                f"{', '.join(Multimodality.__annotations__)}"
            )
        make_metrics(metrics | (multimodality["metrics"] if multimodality else {}))  # raises if an option is unknown
        self.name, self.version, self.condition = name, version, condition
        self.extractor, self.metrics, self.replications, self.samples = extractor, metrics, replications, samples
        self.real_samples, self.multimodality, self.expected = real_samples, multimodality, expected or {}
        self.edit = edit and {REGION.get(key, key): value for key, value in edit.items()}
        self.smoothing, self.batch_size, self.only = smoothing, batch_size, only or {}
        self.quick, self.sha256 = False, ""

    def change(
        self,
        *,
        replications: int | None,
        samples: int | None,
        quick: bool,
        clips: int,
        multimodality: bool = True,
        batch_size: int | None = None,
    ) -> dict[str, Any]:
        """Reduces the size of the evaluation.

        Args:
            replications, samples: new values; None = unchanged, or those of a quick evaluation.
            quick: whether the evaluation is quick.
            clips: number of clips in the split.
            multimodality: False = skip multimodality.
            batch_size: new batch size of a protocol that measures time.

        Returns:
            The changed options, for the result.

        Raises:
            UserError: If `replications` or `samples` is less than 1.
        """
        self.quick = quick
        if quick:
            replications = QUICK_REPLICATIONS if replications is None else replications
            samples = min(QUICK_SAMPLES, clips) if samples is None else samples
        changed: dict[str, Any] = {}
        size = batch_size if self.batch_size else None
        for name, value in (("replications", replications), ("samples", samples), ("batch_size", size)):
            if value is not None and value < 1:
                raise UserError(f"{name}={value}: must be at least 1")
            if value is not None and value != getattr(self, name):
                setattr(self, name, value)
                changed[name] = value
        if self.multimodality and replications is not None:
            fewer = min(replications, self.multimodality["replications"])
            self.multimodality = {**self.multimodality, "replications": fewer}
        if self.multimodality and not multimodality:
            self.multimodality, changed["multimodality"] = None, False
        return changed

    def open_extractor(self, path: str | None, representation: Representation, dataset: str) -> Extractor | None:
        """Opens the extractor at `path`, on the device of the representation; None if not needed, or `path` is "none".

        Raises:
            UserError: If a required extractor is not given, or belongs to another representation or data set.
            FileNotFoundError, ValueError: If the file does not exist, or holds another kind of extractor.
        """
        if self.extractor is None or path == "none":
            return None
        if path is None:
            raise UserError(
                f"protocol {self.name} needs a feature extractor. Give extractor=FILE, such as a checkpoint of make "
                "train EXP=motion_clip/..., or extractor=none to skip the metrics that need features"
            )
        extractor: Extractor = instantiate(self.extractor, path=path, device=representation.mean.device)
        extractor.check(representation, dataset)
        return extractor

    # Motions to generate ----------------------------------------------------------------------------------------------

    def selected(self, clips: Clips) -> list[Entry]:
        """Returns the clips of a split that the protocol evaluates on."""
        return [clip for clip in clips.clips if self.only.items() <= clip.attributes.items()]

    def rows(self, clips: Clips, seed: int, replication: int, *, purpose: str = "generated") -> list[Row]:
        """Returns the motions of one replication; another `purpose` gives another draw of clips, captions and crops."""
        drawn = () if purpose == "generated" else (purpose,)
        entries = sorted(self.selected(clips), key=lambda clip: key("sample", *drawn, seed, replication, clip.id))
        if not entries:
            only = "".join(f" and {name}={value}" for name, value in self.only.items())
            raise UserError(
                f"the split has no clip with at least {clips.crop.shortest()} frames{only}. Choose another with "
                "split=..., or, for your own data, add a `split` column to captions.csv"
            )
        count = self.samples if purpose == "generated" else self.real_samples
        rows = []
        for number in range(len(entries) if count is None else count):
            clip = entries[number % len(entries)]
            again = number // len(entries)
            name = f"{clip.id}#{again}" if again else clip.id
            generator = np.random.default_rng(key("crop", purpose, seed, replication, name))
            caption = key("caption", purpose, seed, replication, name) % len(clip.captions) if clip.captions else None
            rows.append(Row(name, clip, clips.crop(clip.length, generator), caption, name))
        return rows

    def prompts(self, clips: Clips, seed: int, replication: int) -> list[Row]:
        """Returns the motions of one replication of multimodality: several for each of the first prompts."""
        assert self.multimodality is not None
        prompts = self.rows(clips, seed, replication)[: self.multimodality["prompts"]]
        return [
            Row(f"{row.id}~{number}", row.clip, row.frames, row.caption, row.id)
            for row in prompts
            for number in range(self.multimodality["samples"])
        ]

    def motions(self, rows: Sequence[Row], features: list[np.ndarray], captions: list[str] | None = None) -> Motions:
        """Returns motions with the conditions of their rows; `captions` replace the captions of the rows."""
        texts = captions or [row.text for row in rows] if self.condition == "text" else None
        labels = [row.clip.action for row in rows]
        return Motions(
            ids=[row.id for row in rows],
            features=features,
            captions=texts,
            tokens=[_tokens(row, caption) for row, caption in zip(rows, texts, strict=True)] if texts else None,
            labels=[int(label) for label in labels if label is not None] if self.condition == "action" else None,
            groups=[row.prompt for row in rows],
            requested=[row.clip.attributes for row in rows] if self.condition != "none" else None,
            edit=self.edit,
        )

    def check_data(self, clips: Clips) -> None:
        """Checks that the data has the captions or labels that the protocol needs.

        Raises:
            UserError: If a clip has no caption or label, or there is no clip.
        """
        rows = self.rows(clips, 0, 0)
        incomplete = {
            "text": any(row.caption is None for row in rows),
            "action": any(row.clip.action is None for row in rows),
            "none": False,
        }
        if incomplete[self.condition]:
            raise UserError(
                f"protocol {self.name} generates motions from {self.condition}, but the data set "
                f"{clips.store.info['dataset']} has clips without {self.condition}. Choose another protocol"
            )

    def sampling(
        self,
        model: MotionGeneration,
        *,
        guidance_scale: float | None = None,
        sampler: str | None = None,
        num_inference_steps: int | Sequence[int] | None = None,
        eta: float | None = None,
        spacing: str | None = None,
        method: str | None = None,
        until: float | None = None,
        strength: float | None = None,
    ) -> dict[str, Any]:
        """Returns the sampling options of a model: those given, otherwise those of its recipe.

        `method`, `until` and `strength` are for edits, as in `flame_mdm.sampling.editing`.

        Raises:
            UserError: If an editing option is given but nothing is edited, or the model's process does not allow it.
        """
        if self.edit is None and (method, until, strength) != (None, None, None):
            raise UserError(f"protocol {self.name} does not edit motions. Remove method, until and strength")
        how: dict[str, Any] = {}
        options = SamplerOptions(
            guidance_scale=guidance_scale,
            sampler=sampler,
            num_inference_steps=num_inference_steps,
            eta=eta,
            spacing=spacing,
        )
        if self.edit is not None:
            editing = EditRequest(method=method, until=until, strength=strength)
            how["edit"], options = method_options(model.process, editing, options)
        return options.over(model.sampler_options).chosen() | how

    def generator(
        self,
        model: MotionGeneration,
        folder: Path | None,
        options: Mapping[str, Any],
        *,
        clips: Clips,
        batch_size: int,
        world: int = 1,
        progress: bool = True,
    ) -> Generator:
        """Returns the source of a model's motions, for one of `world` processes; see `Generator`."""
        count = self.samples or len(self.selected(clips))
        total = self.replications * count
        if self.multimodality and not self.quick:
            several = self.multimodality
            total += several["replications"] * several["samples"] * min(several["prompts"] or count, count)
        return Generator(
            model,
            folder,
            self.sampling(model) | dict(options),
            clips=clips,
            condition=self.condition,
            batch_size=batch_size,
            timed=self.batch_size is not None,
            parts=self.edit,
            total=total // world,
            progress=progress,
        )

    def baseline(self, kind: str, clips: Clips, seed: int) -> Baseline:
        """Returns the source of a sanity-check baseline; see `Baseline`."""
        return Baseline(kind, clips, self.condition, seed)

    def sample_folder(self, folder: Path, representation: Representation) -> SampleFolder:
        """Returns the source of motions in files, one per replication; see `SampleFolder`."""
        source = SampleFolder(folder, representation)
        self.replications, self.samples = len(source.files), None
        return source

    # The evaluation ---------------------------------------------------------------------------------------------------

    def evaluate(
        self,
        source: Source | None,
        clips: Clips,
        extractor: Extractor | None,
        representation: Representation,
        *,
        seed: int = 0,
        batch_size: int = 64,
        rank: int = 0,
        world: int = 1,
        ground_truth: bool = True,
        force: bool = False,
        resamples: int = 0,
        training: Clips | None = None,
    ) -> dict[str, Any]:
        """Evaluates real motions of all replications, and then the motions of the source.

        If there are several processes, each generates and extracts a share of the batches. The first one computes the
        metrics; all return the result.

        Args:
            source: source of the motions; None = real motions only.
            clips: the split.
            extractor: an opened extractor; None = metrics that need features have no value.
            representation: of the motions, on the device to compute on.
            seed: of all random draws.
            batch_size: of the extractor.
            rank, world: rank of this process, and number of processes.
            ground_truth: whether real motions are measured.
            force: generate even if real motions do not have the values that the protocol expects.
            resamples: number of sets drawn from the motions of the first replication, for intervals by bootstrap.
            training: the training split, for metrics that look for copies of its motions.

        Returns:
            "ground_truth" and "values": by metric, `mean`, `ci` (half width of the 95 % interval), `replications`,
            `n` motions and `each` value per replication, each None if not computable; of values, also `resampled`, the
            values of the sets drawn by `resamples`; "nearest": sorted distances in meters, from the nearest training
            motion, of the "generated" and "real" motions of the first replication, if a metric reads them;
            "not_computed": reasons by metric; "cost"; "seeds" of the draws of metrics, by replication; "warnings";
            "valid", "invalid_because" and "forced".

        Raises:
            UserError: If real motions do not have the expected values; nothing has been generated.
        """
        evaluator = Evaluator(
            extractor,
            self.metrics,
            representation,
            batch_size=batch_size,
            skip_features=extractor is None and self.extractor is not None,  # with extractor=none
            rank=rank,
            world=world,
        )
        several = replace(evaluator, metrics=self.multimodality["metrics"]) if self.multimodality else None
        if evaluator.reads("nearest") and training is not None:
            evaluator.training = self._training(training, evaluator, seed)
        reasons: dict[str, str] = {}
        reference, truth = [], []
        for replication in range(self.replications):
            paired, real = self._real(clips, evaluator, seed, replication)
            if ground_truth:
                values, why = evaluator.score(paired, paired, real, key("draws", seed, replication))
                truth.append((values, len(paired)))
                reasons |= why
            if source is not None:
                for each in (evaluator, several):  # before motions are generated
                    if each is not None:
                        each.check(paired)
                # All replications are kept in memory; joints, the largest part, only if metrics compare them.
                reference.append((paired if evaluator.reads("real_joints") else paired.without_joints(), real))
        report: dict[str, Any] = {"ground_truth": _summary(truth) if ground_truth else None, "values": None}
        invalid = shared(self._unexpected(report["ground_truth"] or {}, clips, extractor), world)
        if invalid and source is not None and not force:
            if rank:
                raise SystemExit(1)  # the first process prints the reason
            raise UserError(
                f"nothing was generated, because {'; '.join(invalid)}. Check the data and the extractor, or give "
                "force=true: the result is then marked as not valid"
            )
        report |= {"cost": _mean_cost([]), "warnings": []}
        if source is not None:
            report |= self._measure(source, clips, evaluator, reference, seed, reasons, resamples)
        if source is not None and several is not None:
            report["values"] |= self._measure_multimodality(source, clips, several, seed, reasons)
        if extractor is None and self.extractor is not None:
            reasons["extractor"] = "extractor=none: metrics that need features were not computed"
        report |= {"not_computed": reasons, "seeds": [key("draws", seed, each) for each in range(self.replications)]}
        report |= {"valid": not invalid, "invalid_because": invalid, "forced": bool(invalid) and source is not None}
        return shared(report, world)

    def _training(self, clips: Clips, evaluator: Evaluator, seed: int) -> TrainingMotions:
        """Returns the training motions: a window of each for its features, and all frames."""
        windows = self.rows(clips, seed, 0, purpose="training")
        whole = [replace(row, frames=np.arange(row.clip.length)) for row in windows]
        return evaluator.training_motions(*(self.motions(some, real_motions(clips, some)) for some in (whole, windows)))

    def _has_several_per_prompt(self, source: Source | None) -> bool:
        return self.multimodality is not None and isinstance(source, Generator) and not self.quick

    def _real(self, clips: Clips, evaluator: Evaluator, seed: int, replication: int) -> tuple[Extracted, Extracted]:
        """Returns the real motions of a replication, and real motions for comparisons of sets."""
        again = self.rows(clips, seed, replication, purpose="real")
        once = replace(evaluator, training=None)
        real = evaluator.reference() or once.extract(self.motions(again, real_motions(clips, again)))
        return self._paired(clips, evaluator, self.rows(clips, seed, replication)), real.without_joints()

    def _paired(self, clips: Clips, evaluator: Evaluator, rows: Sequence[Row]) -> Extracted:
        """Returns metric inputs computed from the real motions of rows."""
        motions = self.motions(rows, real_motions(clips, rows))
        motions.references = clips.store.references([row.clip.id for row in rows])
        return evaluator.extract(motions)

    def _measure(
        self,
        source: Source,
        clips: Clips,
        evaluator: Evaluator,
        reference: Sequence[tuple[Extracted, Extracted]],
        seed: int,
        reasons: dict[str, str],
        resamples: int,
    ) -> dict[str, Any]:
        """Returns the values of the source's motions, compared with the real motions of each replication."""
        found: list[tuple[dict[str, float | None], int]] = []
        costs: list[dict[str, float]] = []
        warnings: list[str] = []
        resampled: dict[str, list[float | None]] = {}
        nearest: dict[str, list[float]] = {}
        for replication, (paired, real) in enumerate(reference):
            rows = self.rows(clips, seed, replication)
            samples = source(f"rep_{replication}", rows, replication, evaluator.rank, evaluator.world)
            costs.append(samples.cost)
            if len(samples.rows) != len(rows):  # motions from another system may not cover all clips
                wanted = {row.id for row in samples.rows}
                paired = _select(paired, [i for i, row in enumerate(rows) if row.id in wanted])
            motions = self.motions(samples.rows, self._smoothed(samples.features), samples.captions)
            generated = evaluator.extract(motions)
            values, why = evaluator.score(generated, paired, real, key("draws", seed, replication))
            found.append((values, len(generated)))
            reasons |= why
            if not replication and "nearest" in generated.rows:
                sets = {"generated": generated, "real": paired}
                nearest = {name: _sorted_distances(each.rows["nearest"]) for name, each in sets.items()}
            if not replication:
                warnings = self._warnings(generated, real)
                resampled = evaluator.resample(generated, paired, real, key("draws", seed, 0), resamples)
        table = _summary(found)
        for name, drawn in resampled.items():
            table[name]["resampled"] = drawn
        return {"values": table, "cost": _mean_cost(costs), "warnings": warnings, "nearest": nearest}

    def _measure_multimodality(
        self, source: Source, clips: Clips, evaluator: Evaluator, seed: int, reasons: dict[str, str]
    ) -> dict[str, Any]:
        """Returns the values of the metrics that need several motions per prompt."""
        assert self.multimodality is not None
        found = []
        nothing = evaluator.extract(self.motions([], []))
        for replication in range(self.multimodality["replications"]):
            motions = paired = nothing
            if self._has_several_per_prompt(source):
                rows = self.prompts(clips, seed, replication)
                name = f"multimodality_{replication}"
                samples = source(name, rows, replication, evaluator.rank, evaluator.world)
                motions = evaluator.extract(self.motions(rows, self._smoothed(samples.features)))
                prompts = rows[:: self.multimodality["samples"]]
                real = self._paired(clips, evaluator, prompts)
                paired = _select(real, [i // self.multimodality["samples"] for i in range(len(rows))])
            values, why = evaluator.score(motions, paired, nothing, key("draws", seed, replication))
            found.append((values, len(motions)))
            reasons |= why
        if not self._has_several_per_prompt(source):
            why_not = "not computed in a quick evaluation" if self.quick else "there is one sample per clip"
            reasons["multimodality"] = f"{why_not}: it needs several samples per prompt"
        return _summary(found)

    def _smoothed(self, features: list[np.ndarray]) -> list[np.ndarray]:
        """Smooths each motion over time, without padding, as FLAME's code does."""
        sigma = self.smoothing
        return features if sigma is None else [gaussian_filter1d(motion, sigma, axis=0) for motion in features]

    def _warnings(self, generated: Extracted, real: Extracted) -> list[str]:
        """Returns warnings about biased Fréchet distances."""
        lines = []
        for name, config in self.metrics.items():
            if not config["_target_"].endswith(FrechetMotionDistance.__name__) or "generated" not in generated.rows:
                continue
            width = generated.rows["generated"].shape[1]
            few = min(len(generated), len(real))
            if few < 2 * width:
                lines.append(f"{name}: biased upwards: {few} motions are fewer than twice the {width} features")
            if len(generated) != len(real):
                lines.append(
                    f"{name}: {len(generated)} generated and {len(real)} real motions. Compare it only with values for "
                    "the same two numbers"
                )
        return lines

    def _unexpected(self, values: Mapping[str, Any], clips: Clips, extractor: Extractor | None) -> list[str]:
        """Returns a line for each value of real motions that differs from the expected one.

        Nothing is expected in a quick evaluation, or on splits other than the test split.
        """
        # Without test clips (HumanAct12), the training clips are the test split, so they are checked.
        if self.quick or (clips.clips[0].split != "test" and clips.store.info["clips"]["test"]):
            return []
        names = [clips.store.info["dataset"], *([extractor.sha256] if extractor else [])]
        lines = []
        for metric, (wanted, tolerance) in (item for name in names for item in self.expected.get(name, {}).items()):
            mean = values.get(metric, {}).get("mean")
            if mean is not None and not abs(mean - wanted) <= tolerance:
                lines.append(f"real motions have {metric} {mean:.4g}, expected {wanted:g} +- {tolerance:g}")
        return lines


def _tokens(row: Row, caption: str) -> list[str] | None:
    """Returns the "word/PART" tokens of a caption of the clip, if the data has them."""
    tagged = row.clip.attributes.get("tokens")
    return tagged[row.clip.captions.index(caption)] if tagged and caption in row.clip.captions else None


def _sorted_distances(nearest: Tensor) -> list[float]:
    """Returns distances of joints in meters, rounded to 0.1 mm, for a figure."""
    return [round(distance, 4) for distance in nearest[:, 0].sort().values.tolist()]


def _select(extracted: Extracted, indices: list[int]) -> Extracted:
    rows = {n: v[indices] if isinstance(v, Tensor) else [v[i] for i in indices] for n, v in extracted.rows.items()}
    kept = None if extracted.kept is None else [extracted.kept[i] for i in indices]
    return Extracted(rows, [extracted.joints[i] for i in indices] if extracted.joints else [], kept)


def _summary(found: Sequence[tuple[Mapping[str, float | None], int]]) -> dict[str, Any]:
    """Returns means over replications; None if one replication has no value."""
    table = {}
    for name in found[0][0] if found else ():
        each = [values[name] for values, _ in found]
        known = [value for value in each if value is not None]
        mean, ci = mean_ci(known) if len(known) == len(each) else (None, None)
        table[name] = {"mean": mean, "ci": ci, "replications": len(found), "n": found[0][1], "each": each}
    return table


def _mean_cost(costs: Sequence[dict[str, float]]) -> dict[str, float | None]:
    names = ("nfe", "seconds_per_sample", "batch_size")
    return {name: float(np.mean([cost[name] for cost in costs])) if all(costs) and costs else None for name in names}
