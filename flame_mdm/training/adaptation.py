# pyright: standard
"""Adaptation of a trained model to a few of the user's clips. Guide: `docs/own-motion.md`."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from lightning.pytorch.utilities import rank_zero_only
from torch import Tensor

from flame_mdm.batch import MotionBatch, ceil_div, collate, sent
from flame_mdm.checkpoints.adapters import About, read_merged, word_rows, write_adapter
from flame_mdm.checkpoints.hub import export
from flame_mdm.checkpoints.loading import GENERATORS, load_task
from flame_mdm.checkpoints.locating import find
from flame_mdm.checkpoints.model_files import state_sha256
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.conditions.vocabulary import words
from flame_mdm.config import EXPERIMENTS, Config, check, instantiate
from flame_mdm.config.composition import ConfigSource, prepare_overrides, quoted, resolve
from flame_mdm.data import Clip, MotionSource
from flame_mdm.data.adaptation import KEPT, LessonData, check_clips, styled
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import Store, write_store
from flame_mdm.errors import UserError, say
from flame_mdm.formats.conversion import needs_rotations
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.reporting.page import number, page, render
from flame_mdm.safe_io import write_text
from flame_mdm.safe_io.paths import check_tree
from flame_mdm.sampling.generation import BATCH, generate
from flame_mdm.sampling.reading import decoded
from flame_mdm.task import GeneratorTask
from flame_mdm.training.start import train
from flame_mdm.visualize import player_page

# Number of motions that are sampled from the base model if its training data is missing
SAMPLED = 300
# Number of clips for which the page compares the losses of the models
COMPARED = 32
# Parts of the recipe that are taken from the base model
OF_BASE = (
    "task",
    "losses",
    "representation",
    "process",
    "condition",
    "denoiser",
)


class AdaptationTask(GeneratorTask):
    """Continues training on the user's clips and some of the model's original training data."""

    def pretrain(self) -> None:
        """Does nothing, because the text encoder is already trained."""

    def dropped(self, batch: MotionBatch) -> Tensor:
        """Draws which captions to drop, but never drops the captions of the user's clips.

        If these clips were trained with the null condition, guidance would steer samples away from
        their motions.
        """
        is_kept = torch.tensor([name.startswith(KEPT) for name in batch.ids])
        return super().dropped(batch) & sent(is_kept, self.device)


TASK = f"{AdaptationTask.__module__}.{AdaptationTask.__name__}"


def adapt(
    base: str | Path,
    source: str | Path,
    name: str,
    out: str | Path | None = None,
    *,
    action: bool = False,
    full: bool = False,
    force: bool = False,
    rank: int = 8,
    data_root: str | Path = "data",
    overrides: Sequence[str] = (),
) -> Path:
    """Teaches a text-conditioned model the motions in a folder. Resumes an interrupted run.

    The model is trained on the user's clips and on clips from its original training data, so that
    it does not forget what it has learned. Prompts request the new motions with "in NAME style".
    For a guide, see `docs/own-motion.md`.

    Args:
        base: the model to adapt: a run directory, a .ckpt or .safetensors file, the name of a
            model in this package, or "user/name[@revision]" on the Hugging Face hub.
        source: folder of motions with captions.
        name: name of the style, a single word of letters and digits.
        out: run directory. Default: runs/adapt/NAME.
        action: whether the clips show an action that is new to the model, rather than a style.
        full: whether to train all weights. If so, the result is a model file instead of an adapter.
        force: whether to accept clips that drift upward or float.
        rank: rank of the low-rank weight updates, at least 1. Increase it for motions that
            differ greatly from the model's training data.
        data_root: folder of the prepared data sets. If the base model's data set is not in this
            folder, 300 motions sampled from the base model are used instead.
        overrides: overrides of `experiments/adapt.yaml`, such as "trainer.max_steps=2000".

    Returns:
        Path of the adapter or, with `full`, of the model file: OUT/NAME.safetensors. The page
        OUT/adaptation.html compares motions before and after training.

    Raises:
        FileNotFoundError: If there is no such model or folder.
        UserError: If the name is not one word, if the model is distilled or not conditioned on
            text, if the folder has no captions, or if its clips drift or float.

    Example:
        >>> import flame_mdm
        >>> path = flame_mdm.adapt("quickstart", "my_clips", "limp")  # doctest: +SKIP
        >>> model = flame_mdm.load("quickstart", adapter=path)  # doctest: +SKIP
        >>> flame_mdm.generate(model, "a person walks in limp style")[0].save("limp.glb")  # doctest: +SKIP
    """
    file, out = find(base), Path(out or f"runs/adapt/{name}")
    if not re.fullmatch(r"[^\W_]+", name):
        raise UserError(
            f"name={name}: expected one word of letters and digits, because prompts contain 'in "
            f"{name} style'"
        )
    task = load_task(file, GeneratorTask)
    model = task.generator
    if "distillation" in model.config:
        raise UserError(
            f"{base}: a distilled model cannot be adapted. Adapt its teacher, and distill the result"
        )
    if model.conditioned_on != "text":
        raise UserError(
            f"{base}: conditioned on {model.conditioned_on}. Use a model that is conditioned "
            f"on text"
        )
    captions = sorted({text for note in Folder(str(source)).notes.values() for text in note.texts})
    if not captions:
        raise UserError(
            f"{source}: no captions. Describe each motion in NAME.txt next to it, or in "
            f"captions.csv"
        )
    if not force:
        check_clips(source, model.representation.fps)
    check_tree(out)  # `_prior` writes motions to this folder before training begins
    config = _recipe(model, captions, name, out, overrides)
    config["base"], config["adapter"] = (
        str(base),
        None if full else _about(model, captions, name, rank, file, action),
    )
    # With a vocabulary, the model would reject prompts that contain the new words.
    model.facts.pop("vocabulary", None)
    prior = _prior(model, Path(data_root), out / "data", captions)
    config["data"]["source"] |= {"path": str(source), "prior": str(prior)}
    check(config)
    train(config)
    path, last = out / f"{name}.safetensors", out / "checkpoints" / "last.ckpt"

    @rank_zero_only
    def write_results() -> None:
        export(last, path) if full else write_adapter(path, last)
        data = instantiate(config["data"], representation=model.representation)
        adapted = load_task(path if full else file, GeneratorTask, adapter=() if full else path)
        body = _comparison(name, data, task, adapted)
        write_text(out / "adaptation.html", page(f"Adaptation: {name}", body))
        say(
            f"written: {path}", f"before and after: {out / 'adaptation.html'} (open in any browser)"
        )

    write_results()
    # All processes wait here, because the launcher terminates them when the first one exits.
    if torch.distributed.is_initialized():
        torch.distributed.barrier()
    return path


def _about(
    model: MotionGenerator, captions: Sequence[str], name: str, rank: int, file: Path, action: bool
) -> About:
    texts, seen = [styled(text, name) for text in captions], model.facts.get("vocabulary", ())
    new = [word for word in dict.fromkeys(words(" ".join(texts))) if word not in seen]
    return {
        "name": name,
        "action": action,
        "rank": rank,
        "words": new,
        "rows": word_rows(model.condition, new, seen)
        if isinstance(model.condition, LearnedTokens)
        else [],
        "captions": texts[:20],
        "base": state_sha256(read_merged(file)["state_dict"]),
    }


def _recipe(
    model: MotionGenerator, captions: Sequence[str], name: str, out: Path, overrides: Sequence[str]
) -> Config:
    """Returns the recipe of an adaptation.

    Raises `UserError` if an override changes a part that is taken from the base model.
    """
    if fixed := [word for word in overrides if word.partition(".")[0] in OF_BASE]:
        raise UserError(
            f"{fixed[0]}: an adaptation keeps the {fixed[0].partition('.')[0]} of its base model. "
            f"Remove this override"
        )
    recipe = ConfigSource(EXPERIMENTS, "adapt")  # the caller checks the complete recipe
    config = resolve(recipe, *prepare_overrides(recipe, [quoted(f"run.dir={out}"), *overrides]))
    config |= {part: model.config[part] for part in OF_BASE if part in model.config}
    if config["task"]["_target_"] in GENERATORS:  # not the user's own class
        config["task"] = config["task"] | {"_target_": TASK}
    config["experiment"] = f"adapt/{name}"
    config["run"]["name"] = config["data"]["name"] = name

    # The crop, the kind of motion and the learning rate are taken from the base model. The recipe
    # of a released model has no data section, so its crops are as long as its longest motion,
    # rounded down to a multiple of 4 frames.
    data, longest = model.config.get("data") or {}, model.facts["max_frames"] // 4 * 4
    config["data"]["crop"] = data.get("crop") or config["data"]["crop"] | {"max_frames": longest}
    if not any(word.startswith("optimizer.lr=") for word in overrides):
        config["optimizer"]["lr"] = (model.config.get("optimizer") or config["optimizer"])["lr"]
    kind = "smpl" if needs_rotations(model.representation) else "joints"
    config["data"]["source"]["motion"] = kind

    # Samples show three captions of the user's clips, and three captions of the base model in the
    # new style.
    few = captions[:: ceil_div(len(captions), 3)]
    texts = [*few, *list(model.facts.get("captions", ()))[:3]]
    config["callbacks"]["samples"]["prompts"] = [styled(text, name) for text in texts]
    return config


def _prior(model: MotionGenerator, root: Path, out: Path, captions: Sequence[str]) -> Path:
    """Returns the folder of a store that contains the base model's training data or a substitute.

    If `root` does not contain the store of the training data, motions are sampled from the base
    model and stored in a folder in `out`.
    """
    representation = model.representation
    folder = root / f"{(model.config.get('data') or {}).get('name')}-{representation.name}"
    if (folder / "store.json").exists() and Store(folder).fingerprint == model.facts.get(
        "fingerprint"
    ):
        return folder
    folder = out / f"prior-{representation.name}"
    if not (folder / "store.json").exists():
        say(
            f"the training data of the base model is not in {root}: sampling {SAMPLED} motions from "
            f"the base model instead"
        )
        write_store(
            folder,
            _Samples(model, list(model.facts.get("captions", ())) or captions),
            representation,
        )
    return folder


class _Samples(MotionSource):
    """A data set of `SAMPLED` motions from a model. A tenth of them is used for validation."""

    name, workers = "prior", 1

    def __init__(self, model: MotionGenerator, captions: Sequence[str]):
        self.model = model
        self.captions = [captions[row * len(captions) // SAMPLED] for row in range(SAMPLED)]

    def count(self) -> int:
        return SAMPLED

    def statistics(self) -> tuple[np.ndarray, np.ndarray]:
        return self.model.representation.mean.numpy(), self.model.representation.std.numpy()

    def clips(self, fps: float) -> Iterator[Clip]:
        frames, encoded = self.model.facts["max_frames"], self.model.representation.name
        for first in range(0, SAMPLED, BATCH):
            motions = generate(
                self.model, self.captions[first : first + BATCH], frames=frames, seed=first
            )
            for row, motion in enumerate(motions, first):
                split, name = "train" if row % 10 else "val", f"sample_{row:03d}"
                yield Clip(name, motion.features, [motion.text], split, name, encoded=encoded)


def _comparison(name: str, data: LessonData, *tasks: GeneratorTask) -> str:
    """Returns the body of a page that compares the base model and the adapted model.

    The page shows motions and losses of both models.
    """
    data.setup("fit")
    before, after = (task.generator for task in tasks)
    clips = data.train.clips
    lesson, kept = (rows[:: ceil_div(len(rows), COMPARED)] for rows in data.halves())
    plain, taught = (
        {clips[row].captions[0]: clips[row] for row in rows} for rows in (kept, lesson)
    )
    texts = [*list(taught)[:3], *(styled(text, name) for text in list(plain)[:3]), *list(plain)[:3]]
    pairs: list[Motion] = []
    for old, new in zip(generate(before, texts), generate(after, texts), strict=True):
        pairs += [replace(old, id="before"), replace(new, id="after")]
    beside: list[Motion] = []
    for text, clip in list(taught.items())[:4]:
        features = torch.from_numpy(data.store.motion(clip)[: data.crop.longest()].copy())
        beside.append(decoded(before.representation, features, text, "your clip"))
        beside += [
            replace(motion, id="model") for motion in generate(after, text, frames=len(features))
        ]
    rows: list[list[str]] = []
    for label, chosen in (
        (f"loss on {len(lesson)} of your clips", lesson),
        (f"loss on {len(kept)} clips from its own data", kept),
    ):
        batch = collate(data.train.__getitems__([(int(row), -1) for row in chosen]))
        with torch.no_grad():
            losses = [float(task.losses_of(batch)["loss"].mean()) for task in tasks]
        rows.append([label, *map(number, losses)])
    players = {
        "prompts": player_page(pairs, "", columns=2),
        "clips": player_page(beside, "", columns=2),
    }
    return render("adaptation.html", name=name, rows=rows, **players)
