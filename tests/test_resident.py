"""Data on the training device: the batches of the data loader, bit for bit, and what happens without enough memory."""

from collections.abc import Iterable
from itertools import islice, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.stores import OwnClips, clip

from flame_mdm.__main__ import main
from flame_mdm.batch import MotionBatch
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.data import datamodule, resident
from flame_mdm.data.crops import Crop, Fixed, Units, Whole
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.resident import ResidentLoader, free_memory
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rot6d import Rot6D

CROPS = [Units(24, 60, 4), Whole(1, 45), Fixed(50)]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("data")
    module(root, CROPS[0]).prepare_data()
    return root


def module(root: Path, crop: Crop, **options: Any) -> MotionDataModule:
    source = Synthetic(clips=40, seed=1)
    return MotionDataModule(source, HumanML(), root=str(root), name="s", batch_size=4, crop=crop, **options)


def rotations(root: Path, **options: Any) -> MotionDataModule:
    """Clips with a root translation relative to the first frame, labels and statistics; some without a caption."""
    draw = np.random.default_rng(0)
    splits = ("train", "train", "train", "val")
    clips = [
        clip(f"{number}", splits[number % 4], encoded="rot6d-25", action=number % 3,
             motion=draw.normal(size=(20 + number, 150)).astype(np.float32))
        for number in range(24)
    ]  # fmt: skip
    for number in (0, 1, 3):
        clips[number].captions.clear()
    source = OwnClips(*clips)
    source.actions = ("a", "b", "c")
    source.statistics = lambda: (np.full(150, 0.3), np.full(150, 1.7))
    data = MotionDataModule(source, Rot6D(), root=str(root), name="r", batch_size=3, crop=Units(8, 24, 4), **options)
    data.prepare_data()
    return data


def loader(data: MotionDataModule, kind: str, step: int = 0, rank: int = 0, world: int = 1) -> Any:
    data.setup("fit")
    data.trainer = SimpleNamespace(  # type: ignore[assignment]
        global_step=step, accumulate_grad_batches=1, global_rank=rank, world_size=world
    )
    return getattr(data, f"{kind}_dataloader")()


def assert_equal(first: Iterable[MotionBatch], second: Iterable[MotionBatch]) -> None:
    for a, b in zip(first, second, strict=True):
        assert (a.ids, a.text) == (b.ids, b.text)
        assert a.x.numpy().tobytes() == b.x.numpy().tobytes()
        assert a.x.shape == b.x.shape
        assert torch.equal(a.mask, b.mask)
        assert (a.action is None) == (b.action is None)
        if a.action is not None and b.action is not None:
            assert torch.equal(a.action, b.action)
            assert a.action.dtype == b.action.dtype


@pytest.mark.parametrize("crop", CROPS, ids=lambda crop: type(crop).__name__)
def test_batches_are_those_of_the_data_loader(root, crop):
    for (rank, world, step), kind in product(((0, 1, 0), (0, 1, 17), (1, 2, 5)), ("train", "val")):
        on, off = (loader(module(root, crop, resident=r), kind, step, rank, world) for r in (True, False))
        assert (isinstance(on, ResidentLoader), isinstance(off, ResidentLoader)) == (True, False)
        assert_equal(islice(on, 30), islice(off, 30))
        if kind != "train":
            assert len(on) == len(off) > 0


def test_cuts_of_adapted_features_labels_and_missing_captions(tmp_path):
    for kind in ("train", "val"):
        on, off = (loader(rotations(tmp_path, resident=r), kind) for r in (True, False))
        first, second = list(islice(on, 12)), list(islice(off, 12))
        assert_equal(first, second)
        assert all(batch.action is not None for batch in first)
        moved = torch.cat([batch.x[:, 0, 144:147] for batch in first])
        torch.testing.assert_close(moved, torch.full_like(moved, -0.3 / 1.7))
        if kind == "train":
            assert {batch.text is None for batch in first} == {True, False}


def test_batches_are_padded_to_few_lengths(root):
    multiple = 7
    on, off = (module(root, CROPS[0], resident=r, pad_multiple=multiple) for r in (True, False))
    first, second = list(islice(loader(on, "train"), 40)), list(islice(loader(off, "train"), 40))
    assert_equal(first, second)
    assert {batch.x.shape[1] for batch in first} <= {*range(0, 60, multiple), 60}
    plain = list(islice(loader(module(root, CROPS[0]), "train"), 40))
    for padded, batch in zip(first, plain, strict=True):
        frames = batch.x.shape[1]
        assert torch.equal(padded.x[:, :frames], batch.x)
        assert not padded.x[:, frames:].any()
        assert not padded.mask[:, frames:].any()
    one_pass = first[: len(on.train) // 4]
    share = 1 - sum(int(b.mask.sum()) for b in one_pass) / sum(b.mask.numel() for b in one_pass)
    assert on.padding() == pytest.approx(share, abs=1e-9)


@pytest.mark.parametrize(
    ("option", "share", "devices", "kept"),
    [("auto", 4.1, 1, True), ("auto", 3.9, 1, False), ("auto", 5, 2, False), (True, 1.1, 1, True)],
)
def test_what_fits_into_free_memory_is_kept(root, option, share, devices, kept, monkeypatch):
    """Processes share the memory of a CPU."""
    data = module(root, CROPS[0], resident=option)
    size = 4 * data.open().features.size
    monkeypatch.setattr(datamodule, "free_memory", lambda device: int(share * size))
    strategy = SimpleNamespace(root_device=torch.device("cpu"))
    data.trainer = SimpleNamespace(strategy=strategy, num_devices=devices)  # type: ignore[assignment]
    data.setup("fit")
    assert (data.device is not None) == kept
    if option == "auto":
        assert data.choose_device(more=size) is None
    monkeypatch.setattr(datamodule, "free_memory", lambda device: 2**20)
    message = r"data\.resident=true: .* take \d+\.\d GiB, but cpu has 0\.0 GiB free\. Set data\.resident=auto"
    with pytest.raises(UserError, match=message):
        module(root, CROPS[0], resident=True).setup("fit")


def test_free_memory_is_that_of_the_machine_or_the_container(monkeypatch):
    free = free_memory(torch.device("cpu"))
    assert 2**24 < free < 2**50
    limits = {"max": f"{2**30}\n", "current": f"{2**29}\n"}
    read = Path.read_text

    def limited(path: Path, *words: Any, **options: Any) -> str:
        if path.parent == Path("/sys/fs/cgroup"):
            return limits[path.suffix[1:]]
        return read(path, *words, **options)

    monkeypatch.setattr(resident.Path, "read_text", limited)
    assert free_memory(torch.device("cpu")) <= 2**29
    limits["max"] = "max\n"
    assert free_memory(torch.device("cpu")) > 2**24


def test_training_gives_the_same_weights(tiny, tmp_path):
    words = ["train", "quickstart", *tiny, "callbacks.samples=null", "denoiser.dropout=0.1", "trainer.max_steps=8"]
    weights = []
    for option in ("true", "false"):
        assert main([*words, f"run.dir={tmp_path / option}", f"data.resident={option}"]) == 0
        weights.append(read_checkpoint(tmp_path / option / "checkpoints" / "last.ckpt")["state_dict"])
    assert weights[0].keys() == weights[1].keys()
    assert all(torch.equal(value, weights[1][name]) for name, value in weights[0].items())
