"""Stores, crops, and the batches of training and evaluation, also of data on the training device."""

import hashlib
import shutil
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from inspect import signature
from itertools import islice, product
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from hydra.utils import instantiate
from omegaconf import OmegaConf
from support.fixtures import ROOT
from support.stores import OwnClips, clip

from flame_mdm.batch import MotionBatch, collate
from flame_mdm.data import (
    Split,
    datamodule,
    hashed_split,
    mirrored,
    resident,
    some,
    split_blocks,
    swap_sides,
)
from flame_mdm.data.adaptation import Lesson
from flame_mdm.data.babel import Babel
from flame_mdm.data.bandai import Bandai
from flame_mdm.data.cmu import CMU
from flame_mdm.data.crops import Crop, Fixed, Units, Whole
from flame_mdm.data.datamodule import Clips, MotionDataModule, TrainingBatches, evaluation_batches
from flame_mdm.data.folder import Folder
from flame_mdm.data.humanact12 import HumanAct12
from flame_mdm.data.humanml3d import HumanML3D, HumanML3DSMPL
from flame_mdm.data.kit import KIT, KITTemos
from flame_mdm.data.mixture import Mixture
from flame_mdm.data.resident import ResidentLoader, free_memory, resident_features
from flame_mdm.data.store import (
    Entry,
    Store,
    _entries,
    _fingerprint,
    _line,
    write_store,
)
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.data.synthetic_sequences import SyntheticSequences
from flame_mdm.data.uestc import UESTC
from flame_mdm.errors import UserError
from flame_mdm.representations import Frames
from flame_mdm.representations.essential import Essential
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rifke import Rifke
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.seeds import integers

ENCODED = "humanml-clean-smpl22"


CROPS = [Units(24, 60, 4), Whole(1, 45), Fixed(50)]


@pytest.fixture(scope="module")
def root(tmp_path_factory) -> Path:
    root = tmp_path_factory.mktemp("data")
    module(root, CROPS[0]).prepare_data()
    return root


def module(root: Path, crop: Crop, **options: Any) -> MotionDataModule:
    source = Synthetic(clips=40, seed=1)
    return MotionDataModule(
        source, HumanML(), root=str(root), name="s", batch_size=4, crop=crop, **options
    )


@pytest.fixture
def store(root) -> Store:
    return Store(root / "s-humanml-clean-smpl22")


def test_samples_are_padded_to_a_multiple_and_masks_mark_the_real_frames():
    samples = [
        ("a", torch.ones(5, 2), "walks", 1),
        ("b", 2 * torch.ones(3, 2), "sits", 0),
    ]
    for multiple, most, frames in ((1, 0, 5), (4, 100, 8), (4, 7, 7), (4, 2, 5), (5, 9, 5)):
        batch = collate(samples, multiple, most)
        assert batch.x.shape == (2, frames, 2), (multiple, most)
        assert batch.mask.tolist() == [[i < length for i in range(frames)] for length in (5, 3)]
        assert batch.x[..., 0].sum(1).tolist() == [5, 6]
        assert not batch.x[~batch.mask].any()
    assert batch.lengths.tolist() == [5, 3]
    assert (batch.ids, batch.text, len(batch)) == (["a", "b"], ["walks", "sits"], 2)
    assert batch.action is not None
    assert batch.action.tolist() == [1, 0]
    partly = collate([samples[0], ("b", torch.ones(3, 2), None, None)])
    assert partly.text is None
    assert partly.action is None


def test_all_tensors_of_a_batch_move_to_a_device():
    batch = collate([("a", torch.ones(5, 2), "walks", 1), ("b", torch.ones(3, 2), "sits", 0)])
    for moved in (batch, replace(batch, action=None)):
        there = moved.to(torch.device("meta"))
        assert there.x.device.type == there.mask.device.type == "meta"
        assert (there.x.shape, there.mask.dtype) == ((2, 5, 2), torch.bool)
        assert (there.action is None) == (moved.action is None)
        assert there.action is None or there.action.device.type == "meta"
        assert (there.ids, there.text) == (batch.ids, batch.text)


def test_a_store_holds_what_was_encoded_and_samples_are_normalized_crops(store, tmp_path):
    made = next(iter(Synthetic(clips=40, seed=1).clips(20.0)))
    entry = next(e for e in store.clips if e.id == made.id)
    expected = HumanML().encode(torch.from_numpy(made.motion)).numpy()
    np.testing.assert_allclose(store.motion(entry), expected, atol=1e-6)
    assert (entry.captions, entry.split, entry.source) == (made.captions, made.split, made.source)
    assert sum(store.info["clips"].values()) == len(store.clips) == 40
    store.verify()
    clips = Clips(store, "train", representation=HumanML(), crop=Units(24, 60, 4), seed=0)
    name, x, text, _ = clips[3, 7]
    entry, ((first,), (length,), _) = clips.clips[3], clips.draw([3], 7)
    expected = (store.motion(entry)[first : first + length] - store.mean) / store.std
    np.testing.assert_allclose(x.numpy(), expected, atol=1e-5)
    assert (name, text in entry.captions) == (entry.id, True)
    assert len({len(clips[3, batch][1]) for batch in range(20)}) > 1
    assert len({clips[3, batch][2] for batch in range(40)}) == len(set(entry.captions))

    features = np.random.default_rng(0).normal(size=(30, 263)).astype(np.float32)
    source = OwnClips(clip("a", motion=features, encoded=ENCODED))
    source.statistics = lambda: (np.full(263, 2.0), np.full(263, 3.0))
    store = write_store(tmp_path / "store", source, HumanML())
    np.testing.assert_array_equal(store.motion(store.clips[0]), features)
    assert (set(store.mean.tolist()), set(store.std.tolist())) == ({2.0}, {3.0})


def test_the_same_input_gives_the_same_fingerprint(store, tmp_path, monkeypatch):
    other = write_store(tmp_path / "other", Synthetic(clips=40, seed=2), HumanML())
    clock = iter(range(2 * 10**9, 0, -1000))  # one that goes backwards changes nothing
    monkeypatch.setattr("time.time", lambda: float(next(clock)))
    again = write_store(tmp_path / "again", Synthetic(clips=40, seed=1), HumanML())
    assert store.fingerprint == again.fingerprint != other.fingerprint
    info = store.info
    print_of = partial(
        _fingerprint, store.folder, info["representation"], info["fps"], std=store.std, version=1
    )
    zero = np.zeros_like(store.mean)
    assert print_of(mean=store.mean) == print_of(mean=store.mean - 1e-9) == store.fingerprint, (
        "nor does rounding"
    )
    assert print_of(mean=zero + 4e-23) == print_of(mean=zero - 3e-22)
    assert print_of(mean=store.mean + 0.01) != store.fingerprint
    assert print_of(mean=store.mean, version=2) != store.fingerprint


@pytest.mark.parametrize(
    "changed",
    [
        {"captions": ["a person runs"]},
        {"captions": ["a person walks", "somebody walks"]},
        {"captions": []},
        {"id": "c"},
        {"source": "c"},
        {"split": "val"},
        {"window": (0, 20)},
        {"attributes": {"speed": "slow"}},
        {"license": "CC0-1.0"},
    ],
)
def test_the_fingerprint_tells_each_field_of_a_clip(tmp_path, changed):
    def fingerprint(name: str, **fields: Any) -> str:
        clips = OwnClips(clip("a"), replace(clip("b"), **fields))
        return write_store(tmp_path / name, clips, HumanML("smpl22", "clean")).fingerprint

    assert fingerprint("one") != fingerprint("other", **changed)


def test_damaged_files_are_named(store, tmp_path, subtests):
    for name, part in product(
        ("features.npy", "clips.jsonl", "statistics.npz", "store.json"), (None, 0, 0.5)
    ):
        with subtests.test(name=name, part=part):
            path = shutil.copytree(store.folder, tmp_path / f"{name}-{part}") / name
            content = path.read_bytes()
            path.unlink()
            if part is not None:
                path.write_bytes(content[: int(part * len(content))])
            with pytest.raises((ValueError, FileNotFoundError), match=str(path.parent)) as error:
                Store(path.parent)
            assert "\n" not in str(error.value)
    path = shutil.copytree(store.folder, tmp_path / "flipped") / "features.npy"
    data = bytearray(path.read_bytes())
    data[-5] ^= 1
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"features\.npy is damaged: its hash"):
        Store(path.parent).verify()


@pytest.mark.parametrize(
    ("clips", "message"),
    [
        ([clip("a"), clip("b", motion=np.full((30, 22, 3), np.nan))], "clip b: "),
        ([clip("a"), clip("b", motion=np.zeros((30, 21, 3)))], "clip b: "),
        (
            [clip("a", "train", "take"), clip("Ma", "test", "take")],
            "clips of take are in both train and test",
        ),
        ([clip("a"), clip("a")], "two clips have the same id"),
        ([clip("a", "test")], "no clip is in the training split"),
        (
            [clip("a", motion=np.zeros((9, 263)), encoded="other")],
            "clip a: its features are in the other representation",
        ),
        (
            [clip("a", motion=np.zeros((9, 5)), encoded=ENCODED)],
            r"clip a: its features have shape \(9, 5\), not \(frames, 263\)",
        ),
    ],
)
def test_bad_clips_stop_preparation_and_leave_nothing(clips, message, tmp_path):
    with pytest.raises(ValueError, match=message):
        write_store(tmp_path / "store", OwnClips(*clips), HumanML())
    assert list(tmp_path.iterdir()) == []


def test_crops_follow_the_rule_of_the_field_or_repeat_the_last_frame():
    crop, generator = Units(40, 196, 4), np.random.default_rng(0)
    draws = [crop(101, generator) for _ in range(3000)]
    assert {len(d) for d in draws} == {100, 96}
    assert abs(sum(len(d) == 96 for d in draws) / 3000 - 1 / 3) < 0.03
    assert {d[0] for d in draws if len(d) == 96} == set(range(6))
    assert all((np.diff(d) == 1).all() and d[-1] <= 100 for d in draws)
    assert len(crop(500, generator)) in (196, 192)
    np.testing.assert_array_equal(crop(101, None), np.arange(100))
    np.testing.assert_array_equal(Fixed(60)(3, generator), [0, 1] + [2] * 58)
    assert {int(Fixed(60)(65, generator)[0]) for _ in range(200)} == set(range(5))
    np.testing.assert_array_equal(Whole(1, 10)(30, generator), np.arange(10))


def test_integers_are_uniform_and_independent(subtests):
    below = integers(np.arange(60_000))
    first, second, many = below(6), below(6), below(np.tile([1, 2, 3], 20_000))
    for a, b in ((first, second), (first[:-1], first[1:])):
        with subtests.test(a=a, b=b):
            expected, counts = len(a) / 36, np.bincount(6 * a + b, minlength=36)
            # Chi-squared with 35 degrees: p < 0.0005 beyond
            assert ((counts - expected) ** 2 / expected).sum() < 70
    assert [set(many[k::3].tolist()) for k in range(3)] == [{0}, {0, 1}, {0, 1, 2}]


def test_batches_are_a_function_of_their_number_and_processes_share_them(subtests):
    lengths = np.random.default_rng(0).integers(24, 60, 103)

    def batches(count, first=0, rank=0, world=1):
        sampler = TrainingBatches(lengths, 8, seed=5, first=first, rank=rank, world=world)
        return list(islice(iter(sampler), count))

    stream = batches(40)
    assert batches(23, first=17) == stream[17:]
    assert len({index for batch in stream[:12] for index, _ in batch}) == 96, (
        "a pass has no clip twice"
    )
    assert all(number == n for n, batch in enumerate(stream) for _, number in batch)
    assert [batches(20, rank=rank, world=2) for rank in (0, 1)] == [stream[0::2], stream[1::2]]
    resumed = [batches(15, first=5, rank=rank, world=2) for rank in (0, 1)]
    assert resumed == [stream[10::2], stream[11::2]], "each process has taken five batches"
    lengths = np.random.default_rng(0).integers(24, 60, 31)
    for world in (1, 2, 3):
        with subtests.test(world=world):
            parts = [
                evaluation_batches(lengths, 4, rank=rank, world=world) for rank in range(world)
            ]
            assert sorted(index for part in parts for batch in part for index, _ in batch) == list(
                range(31)
            )


def test_statistics_of_frames_read_in_parts_are_those_of_all_frames(
    tmp_path, monkeypatch, subtests
):
    rng = np.random.default_rng(0)
    frames = (
        rng.normal(size=(997, 64)) * 10 ** rng.uniform(-2, 2, 64) + rng.normal(size=64)
    ).astype(np.float32)
    constant = torch.arange(64) >= 50
    frames[:, 50:] = rng.normal(size=14)
    parts = Frames(lambda: np.split(frames, np.sort(rng.integers(0, 997, 30))), 997)
    whole = torch.from_numpy(frames)
    for size in (1, 7, 64, 996, 997, 5000):
        with subtests.test(size=size):
            assert all(
                torch.equal(*pair)
                for pair in zip(parts.split(size), whole.split(size), strict=True)
            )
    mean, std = Rifke().statistics(parts)
    whole = whole.double()
    assert torch.equal(mean, whole.mean(0).float())
    assert torch.equal(std, torch.where(constant, 1.0, whole.std(0)).float())

    monkeypatch.setattr("flame_mdm.data.store.BLOCK", 50)
    store = write_store(tmp_path / "store", Synthetic(clips=40, seed=1), HumanML())
    training = np.concatenate([store.motion(clip) for clip in store.clips if clip.split == "train"])
    mean, std = HumanML().statistics(torch.from_numpy(training))
    np.testing.assert_array_equal([store.mean, store.std], [mean.numpy(), std.numpy()])


def rotations(root: Path, **options: Any) -> MotionDataModule:
    """Clips with a root translation relative to the first frame, labels and statistics; some without a caption."""
    draw = np.random.default_rng(0)
    splits = ("train", "train", "train", "val")
    motions = [draw.normal(size=(20 + number, 150)).astype(np.float32) for number in range(24)]
    options_of = (
        {"encoded": "rot6d-25", "action": number % 3, "motion": x}
        for number, x in enumerate(motions)
    )
    clips = [
        clip(f"{number}", splits[number % 4], **facts) for number, facts in enumerate(options_of)
    ]
    for number in (0, 1, 3):
        clips[number].captions.clear()
    source = OwnClips(*clips)
    source.actions = ("a", "b", "c")
    source.statistics = lambda: (np.full(150, 0.3), np.full(150, 1.7))
    data = MotionDataModule(
        source, Rot6D(), root=str(root), name="r", batch_size=3, crop=Units(8, 24, 4), **options
    )
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
        for one, other in ((a.x, b.x), (a.mask, b.mask), (a.action, b.action)):
            torch.testing.assert_close(one, other, rtol=0, atol=0)


@pytest.mark.parametrize("crop", CROPS, ids=lambda crop: type(crop).__name__)
def test_batches_are_those_of_the_data_loader(root, crop, subtests):
    for (rank, world, step), kind in product(((0, 1, 0), (0, 1, 17), (1, 2, 5)), ("train", "val")):
        with subtests.test(kind=kind):
            on, off = (
                loader(module(root, crop, resident=r), kind, step, rank, world)
                for r in (True, False)
            )
            assert (isinstance(on, ResidentLoader), isinstance(off, ResidentLoader)) == (
                True,
                False,
            )
            assert_equal(islice(on, 30), islice(off, 30))
            if kind != "train":
                assert len(on) == len(off) > 0


def test_workers_change_nothing(root):
    data = module(root, CROPS[0], resident=False, num_workers=1)
    batches = list(islice(loader(data, "train"), 3))
    draws = islice(TrainingBatches(data.train.lengths, 4, seed=0, first=0, rank=0, world=1), 3)
    expected = [collate([data.train[draw] for draw in batch]) for batch in draws]
    assert_equal(batches, expected)
    assert all(not batch.x[~batch.mask].any() for batch in batches)


def test_a_store_of_another_representation_is_refused(root):
    data = module(root, CROPS[0])
    data.representation.name = "humanml-legacy-smpl22"
    with pytest.raises(
        ValueError, match="the recipe specifies representation=humanml-legacy-smpl22"
    ):
        data.open()


def test_cuts_of_adapted_features_labels_and_missing_captions(tmp_path, subtests):
    for kind in ("train", "val"):
        with subtests.test(kind=kind):
            first, second = (
                list(islice(loader(rotations(tmp_path, resident=r), kind), 12))
                for r in (True, False)
            )
            assert_equal(first, second)
            assert all(batch.action is not None for batch in first)
            moved = torch.cat([batch.x[:, 0, 144:147] for batch in first])
            torch.testing.assert_close(moved, torch.full_like(moved, -0.3 / 1.7))
            if kind == "train":
                assert {batch.text is None for batch in first} == {True, False}


def test_batches_are_padded_to_few_lengths(root, subtests):
    options = ({"resident": True, "pad_multiple": 7}, {"resident": False, "pad_multiple": 7}, {})
    first, second, plain = (
        list(islice(loader(module(root, CROPS[0], **o), "train"), 40)) for o in options
    )
    assert_equal(first, second)
    assert {batch.x.shape[1] for batch in first} <= {*range(0, 60, 7), 60}
    for number, (padded, batch) in enumerate(zip(first, plain, strict=True)):
        with subtests.test(batch=number):
            frames = batch.x.shape[1]
            assert torch.equal(padded.x[:, :frames], batch.x)
            assert not padded.x[:, frames:].any()
            assert not padded.mask[:, frames:].any()


@pytest.mark.parametrize(
    ("option", "share", "devices", "kept"),
    [("auto", 4.1, 1, True), ("auto", 3.9, 1, False), ("auto", 5, 2, False), (True, 1.1, 1, True)],
)
def test_what_fits_into_free_memory_is_kept(root, option, share, devices, kept, monkeypatch):
    data = module(root, CROPS[0], resident=option)  # processes share the memory of a CPU
    size = 4 * data.open().features.size
    monkeypatch.setattr(datamodule, "free_memory", lambda device: int(share * size))
    strategy = SimpleNamespace(root_device=torch.device("cpu"))
    data.trainer = SimpleNamespace(strategy=strategy, num_devices=devices)  # type: ignore[assignment]
    data.setup("fit")
    assert (data.device is not None) == kept
    if option == "auto":
        assert data.choose_device(more=size) is None
    monkeypatch.setattr(datamodule, "free_memory", lambda device: 2**20)
    with pytest.raises(
        UserError,
        match=r"data\.resident=true: .* take \d+\.\d GiB, but only 0\.0 GiB are free on cpu",
    ):
        module(root, CROPS[0], resident=True).setup("fit")


def test_free_memory_is_that_of_the_machine_or_the_container(monkeypatch):
    texts = {
        "meminfo": "MemFree: 1 kB\nMemAvailable: 2048 kB\n",
        "memory.max": "max\n",
        "memory.current": "1000\n",
    }
    monkeypatch.setattr(resident.Path, "read_text", lambda path: texts[path.name])
    assert free_memory(torch.device("cpu")) == 2**21
    texts["memory.max"] = "5000\n"
    assert free_memory(torch.device("cpu")) == 4000


def test_captions_of_an_evaluation_follow_from_the_seed(store):
    parts = {"representation": HumanML(), "crop": Units(24, 60, 4)}
    first, again, other = (Clips(store, "train", seed=seed, **parts) for seed in (0, 0, 1))
    assert first.captions.max() > 1
    np.testing.assert_array_equal(first.evaluated, again.evaluated)
    assert (first.evaluated != other.evaluated).any()


def test_a_clip_of_the_minimum_length_is_used_and_no_sample_is_longer_than_the_maximum(store):
    lengths = sorted(clip.length for clip in store.clips if clip.split == "train")
    shortest, longest = lengths[5], lengths[-5] - 1
    crop = Whole(shortest, longest)
    clips = Clips(store, "train", representation=HumanML(), crop=crop, seed=0)
    assert min(clip.length for clip in clips.clips) == shortest
    assert clips.too_short == sum(length < shortest for length in lengths)
    assert clips.lengths.max() == longest
    assert sorted(clips.frames) == [length for length in lengths if length >= shortest]


def test_a_clip_of_one_unit_is_never_shortened_to_nothing():
    crop, generator = Units(4, 196, 4), np.random.default_rng(0)
    assert {len(crop(frames, generator)) for frames in (4, 5, 7) for _ in range(50)} == {4}
    assert {len(crop(8, generator)) for _ in range(50)} == {4, 8}


def test_the_caption_of_an_evaluation_does_not_depend_on_other_clips(store):
    short, long = (
        Clips(store, "train", representation=HumanML(), crop=Whole(frames, 200), seed=0)
        for frames in (1, 45)
    )
    assert 3 < len(long) < len(short)
    captions = {clip.id: number for clip, number in zip(short.clips, short.evaluated, strict=True)}
    assert [captions[clip.id] for clip in long.clips] == long.evaluated.tolist()


def test_groups_of_sixteen_batches_are_sorted_by_length_and_shuffled():
    lengths = np.random.default_rng(0).permutation(40 * 8)
    sampler = TrainingBatches(lengths, 8, seed=5, first=0, rank=0, world=1)
    batches = [lengths[[index for index, _ in batch]] for batch in islice(iter(sampler), 40)]
    firsts = np.array([batch.min() for batch in batches])
    assert (np.diff(firsts) < 0).any()

    order = np.random.default_rng((5, 0)).permutation(320)
    expected = []
    for begin in (0, 128, 256):
        expected += np.sort(lengths[order[begin : begin + 128]]).reshape(-1, 8).tolist()
    assert sorted(sorted(batch.tolist()) for batch in batches) == sorted(expected)


def test_each_pass_and_each_seed_has_another_order():
    lengths = np.arange(64)

    def order(seed: int, first: int) -> list[int]:
        sampler = TrainingBatches(lengths, 8, seed=seed, first=first, rank=0, world=1)
        return [index for batch in islice(iter(sampler), 8) for index, _ in batch]

    orders = [order(0, 0), order(0, 8), order(0, 16), order(1, 0)]
    assert len({tuple(clips) for clips in orders}) == 4
    assert all(sorted(clips) == list(range(64)) for clips in orders)


def test_few_clips_fill_a_batch_and_occur_equally_often():
    sampler = TrainingBatches(np.arange(5), 13, seed=0, first=0, rank=0, world=1)
    for batch in islice(iter(sampler), 20):
        counts = Counter(index for index, _ in batch)
        assert sorted(counts.values()) == [2, 2, 3, 3, 3]


def test_an_evaluation_begins_with_the_longest_clips():
    lengths = np.array([5, 9, 7, 9, 1])
    batches = evaluation_batches(lengths, 2, rank=0, world=1)
    assert batches == [[(1, -1), (3, -1)], [(2, -1), (0, -1)], [(4, -1)]]
    assert evaluation_batches(lengths, 2, rank=1, world=2) == [[(3, -1), (0, -1)]]


@pytest.mark.parametrize("resident", [True, False])
def test_a_resumed_run_counts_the_batches_of_accumulated_steps(root, resident):
    data = module(root, CROPS[0], resident=resident)
    data.setup("fit")
    data.trainer = SimpleNamespace(  # type: ignore[assignment]
        global_step=5, accumulate_grad_batches=3, global_rank=1, world_size=2
    )
    first = next(iter(data.train_dataloader()))
    stream = TrainingBatches(data.train.lengths, 4, seed=0, first=0, rank=1, world=2)
    draws = next(islice(iter(stream), 15, None))
    assert first.ids == [data.train.clips[index].id for index, _ in draws]


@pytest.mark.parametrize(
    ("owner", "name", "value"),
    [
        ("source", "name", "other"),
        ("source", "version", 3),
        ("source", "published_split", True),
        ("representation", "fps", 30.0),
    ],
)
def test_a_store_of_another_set_rate_or_version_is_refused(root, owner, name, value):
    data = module(root, CROPS[0])
    setattr(getattr(data, owner), name, value)
    with pytest.raises(UserError, match=rf"the recipe specifies (dataset|{name})={value}"):
        data.open()


def test_a_store_of_other_options_is_refused(root):
    data = module(root, CROPS[0])
    data.source.options = {**data.source.options, "seed": 2}
    with pytest.raises(UserError, match="prepared with seed=1, but the recipe specifies seed=2"):
        data.open()


def test_splits_by_name_are_shares_of_the_upper_bits_of_the_hash():
    names = [f"take {number}" for number in range(2000)]
    shares = [int(hashlib.sha1(name.encode()).hexdigest()[:8], 16) % 100 for name in names]
    assert set(shares) == set(range(100))
    expected = ["train" if n < 85 else "val" if n < 90 else "test" for n in shares]
    assert [hashed_split(name, val=5, test=10) for name in names] == expected


def test_blocks_of_clips_are_rounded_to_their_shares_and_each_split_has_one():
    splits = split_blocks("jump", 96, 10, val=0.15, test=0.26)
    ranked = sorted(range(10), key=lambda n: hashlib.sha1(f"jump_{n}".encode()).hexdigest())
    expected = ["test"] * 3 + ["val"] * 2 + ["train"] * 5
    assert splits == dict(zip(ranked, expected, strict=True))
    assert Counter(split_blocks("jump", 21, 10, val=0.01, test=0.01).values()) == {
        "train": 1,
        "val": 1,
        "test": 1,
    }


@pytest.mark.parametrize(
    ("text", "mirrored"),
    [
        ("Left, then the right-hand side", "Right, then the left-hand side"),
        ("turns anticlockwise", "turns clockwise"),
        ("Clockwise and counterclockwise", "Counterclockwise and clockwise"),
        ("the brightest leftover", "the brightest leftover"),
    ],
)
def test_words_for_sides_are_swapped(text, mirrored):
    assert swap_sides(text) == mirrored


def test_overlapping_cuts_and_other_splits_do_not_change_the_statistics(tmp_path):
    features = np.random.default_rng(0).normal(size=(60, 263)).astype(np.float32)
    windows: dict[str, tuple[Split, int, int]] = {
        "a": ("train", 0, 30),
        "b": ("train", 20, 15),
        "c": ("val", 30, 30),
    }
    cuts = [
        clip(name, split, motion=features, encoded=ENCODED, window=(first, length))
        for name, (split, first, length) in windows.items()
    ]
    store = write_store(tmp_path / "store", OwnClips(*cuts), HumanML())
    np.testing.assert_allclose(store.mean, features[:35].mean(0), atol=1e-6)
    assert store.info["shape"] == [60, 263]
    np.testing.assert_array_equal(store.motion(store.clips[1]), features[20:35])


def test_hours_are_those_of_the_frames(tmp_path):
    features = np.zeros((3600, 263), np.float32)
    store = write_store(
        tmp_path / "store", OwnClips(clip("a", motion=features, encoded=ENCODED)), HumanML(fps=12.5)
    )
    assert store.info["hours"] == 0.08


def test_a_mirrored_clip_has_the_other_side_in_all_its_words():
    facts = {"side": "left", "count": 2, "tokens": ["left/ADJ"]}
    original = clip("a", source="take", action=1, attributes=facts)
    original.captions = ["a person waves the left arm", "waves"]
    actions = ("wave right", "wave left", "throw left")
    image = mirrored(original, original.motion[:3], actions)
    assert (image.id, image.source, image.split, image.action) == ("Ma", "take", "train", 0)
    assert image.captions == ["a person waves the right arm", "waves"]
    assert image.attributes == facts | {"side": "right"}
    assert len(image.motion) == 3
    assert mirrored(replace(original, action=2), original.motion, actions).action == 2


@pytest.mark.parametrize(
    ("name", "crop"),
    [
        ("humanml3d", Units(40, 196, 4)),
        ("kit", Units(24, 196, 4)),
        ("bandai", Units(24, 196, 4)),
        ("humanml3d_smpl", Whole(1, 471)),
        ("kit_temos", Whole(1, 1400)),
        ("babel", Whole(1, 128)),
        ("humanact12", Fixed(60)),
        ("uestc", Fixed(60)),
    ],
)
def test_recipes_of_published_sets_have_their_crops_and_sound_splits(name: str, crop: Crop):
    recipe: Any = OmegaConf.load(ROOT / "experiments" / "data" / f"{name}.yaml")
    assert instantiate(recipe.crop) == crop
    assert not recipe.source.get("published_split", False)


@pytest.mark.parametrize("resident", [True, False])
def test_processes_share_the_validation_unless_there_are_more_processes_than_clips(root, resident):
    data = module(root, CROPS[0], resident=resident)
    data.setup("fit")
    data.val = data.train
    data.val.clips = data.val.clips[:4]
    data.val.lengths, count = data.val.lengths[:4], 4

    def validated(rank: int, world: int) -> list[str]:
        data.trainer = SimpleNamespace(global_rank=rank, world_size=world)  # type: ignore[assignment]
        return [id for batch in data.val_dataloader() for id in batch.ids]

    everything = sorted(clip.id for clip in data.val.clips)
    assert sorted(id for rank in range(count) for id in validated(rank, count)) == everything
    assert all(len(validated(rank, count)) == 1 for rank in range(count))
    assert all(sorted(validated(rank, count + 1)) == everything for rank in range(count + 1))


def test_clips_that_are_too_short_are_counted_by_split(root):
    data = module(root, Units(24, 60, 4))
    lengths = {"train": (24, 23, 60), "val": (20, 21), "test": ()}
    clips = [
        SimpleNamespace(split=split, length=length, captions=[])
        for split, numbers in lengths.items()
        for length in numbers
    ]
    info = {
        "clips": {split: len(numbers) for split, numbers in lengths.items()},
        "actions": [],
        "published_split": False,
    }
    store: Any = SimpleNamespace(clips=clips, info=info)
    first, *advice = data.counts(store)
    assert first == (
        "clips: 2 of 3 (1 shorter than 24 frames) train, "
        "0 of 2 (2 shorter than 24 frames) val, 0 test"
    )
    assert advice[0] == "all val clips are too short. Lower data.crop.min_frames"
    assert advice[1] == "no test clips."
    assert advice[2].startswith("no captions. ")
    info["published_split"] = True
    assert data.counts(store) == [first]


def test_at_most_five_names_are_listed():
    assert some("edcba") == "a, b, c, d, e"
    assert some("gfedcba") == "a, b, c, d, e and 2 more"
    assert some([]) == ""


@pytest.mark.parametrize("resident", [True, False])
def test_the_order_of_training_clips_follows_the_seed_of_the_recipe(root, resident):
    drawn = {}
    for seed in (0, 7):
        data = module(root, CROPS[0], resident=resident, seed=seed)
        drawn[seed] = [batch.ids for batch in islice(loader(data, "train"), 3)]
        stream = TrainingBatches(data.train.lengths, 4, seed=seed, first=0, rank=0, world=1)
        expected = [
            [data.train.clips[index].id for index, _ in draws] for draws in islice(stream, 3)
        ]
        assert drawn[seed] == expected
        assert data.train.seed == data.val.seed == data.test.seed == seed
    assert drawn[0] != drawn[7]


def test_crops_and_captions_of_training_follow_the_seed_and_the_number_of_the_batch(store):
    parts = {"representation": HumanML(), "crop": Units(24, 28, 4)}
    first, again, other = (Clips(store, "train", seed=seed, **parts) for seed in (0, 0, 1))
    rows = np.arange(len(first))
    draws = [first.draw(rows, 3), other.draw(rows, 3), first.draw(rows, 4)]
    np.testing.assert_array_equal(draws[0], again.draw(rows, 3))
    for part in (0, 2):  # first frames and captions
        assert len({tuple(draw[part].tolist()) for draw in draws}) == 3
    half = first.draw(rows[10:], 3)
    np.testing.assert_array_equal(half, np.array(draws[0])[:, 10:])


@pytest.mark.parametrize(
    ("device", "option", "share", "is_kept"),
    [
        ("cpu", "auto", 7.9, False),
        ("cpu", "auto", 8.1, True),
        ("cuda", "auto", 4.1, True),
        ("cuda", "auto", 3.9, False),
        ("mps", "auto", 100, False),
        ("mps", True, 1.1, True),
        ("cuda", False, 100, False),
    ],
)
def test_processes_share_the_memory_of_a_cpu_but_not_that_of_gpus(
    root, device, option, share, is_kept, monkeypatch
):
    data = module(root, CROPS[0], resident=option)
    size = 4 * data.open().features.size
    monkeypatch.setattr(datamodule, "free_memory", lambda device: int(share * size))
    strategy = SimpleNamespace(root_device=torch.device(device))
    data.trainer = SimpleNamespace(strategy=strategy, num_devices=2)  # type: ignore[assignment]
    data.setup("fit")
    assert data.device == (torch.device(device) if is_kept else None)


def test_training_clips_are_tested_only_where_the_published_split_has_no_test_clips(root):
    data = module(root, CROPS[0])
    data.setup("fit")
    counts = data.store.info["clips"]
    ids = {split: [clip.id for clip in data.clips(split).clips] for split in counts}
    assert all(ids.values())
    for published, tests, tested in (
        (False, 0, "test"),
        (True, counts["test"], "test"),
        (True, 0, "train"),
    ):
        data.store.info |= {"published_split": published, "clips": counts | {"test": tests}}
        assert [clip.id for clip in data.clips("test").clips] == ids[tested], (published, tests)
        assert [clip.id for clip in data.clips("val").clips] == ids["val"]


def test_references_come_in_the_order_of_the_request_or_not_at_all(tmp_path):
    draw = np.random.default_rng(0)
    recordings = {name: draw.normal(size=(frames, 22, 3)) for frames, name in enumerate("abc", 3)}
    clips = [clip(name, reference=recording) for name, recording in recordings.items()]
    store = write_store(tmp_path / "store", OwnClips(*clips, clip("without")), HumanML())
    for names in ("b", "ca", "bca"):
        references = store.references(list(names))
        assert references is not None
        for name, joints in zip(names, references, strict=True):
            np.testing.assert_array_equal(joints, recordings[name].astype(np.float32))
    assert store.references(["a", "without"]) is None
    bare = write_store(tmp_path / "bare", OwnClips(clip("a")), HumanML())
    assert bare.references(["a"]) is None


@pytest.mark.parametrize("changed", ["representation", "fps", "mean", "std"])
def test_the_fingerprint_tells_representation_rate_and_statistics(store, changed):
    facts = {
        "representation": store.info["representation"],
        "fps": store.info["fps"],
        "mean": store.mean,
        "std": store.std,
        "version": 1,
    }
    assert _fingerprint(store.folder, **facts) == store.fingerprint
    if changed in ("mean", "std"):
        other = facts[changed].copy()
        other[-1] += 0.001
    else:
        other = {"representation": "another", "fps": 25.0}[changed]
    assert _fingerprint(store.folder, **facts | {changed: other}) != store.fingerprint


PATHS = {"path", "amass", "body_models", "captions", "humanact12", "prior", "splits", "workers"}
"""Arguments of sources that do not define the data."""
OFTEN = {"often": ["nod"], "often_share": 0.2}
MORE_OFTEN = {"clips": 7, "seed": 2, "often": ["wave"], "often_share": 0.3}
CHANGES: list[tuple[Any, list[Any], dict[str, Any], dict[str, Any]]] = [
    (Folder, ["a"], {}, {"motion": "smpl", "mirror": True, "exclude": ["x"], "balance": 3}),
    (Folder, ["a"], {}, {"license": "MIT", "prefixes": {"captured": ["walk"]}}),
    (Folder, ["a"], {"prefixes": {"captured": ["walk"]}}, {"prefixes": {"real": ["walk"]}}),
    (Synthetic, [], {}, {"clips": 7, "seed": 2, "actions": "all"}),
    (Synthetic, [], OFTEN | {"actions": "all"}, MORE_OFTEN | {"core_share": 0.3}),
    (SyntheticSequences, [], OFTEN, MORE_OFTEN),
    (Bandai, ["a"], {}, {"motion": "smpl", "mirror": False, "exclude": ["x"]}),
    (Bandai, ["a"], {}, {"split": "compositional"}),
    (CMU, ["a"], {}, {"motion": "smpl", "exclude": ["x"]}),
    (Babel, ["a", "b"], {}, {"published_split": True}),
    (HumanAct12, ["a"], {}, {"published_split": True}),
    (UESTC, ["a"], {}, {"published_split": True}),
    (HumanML3D, ["a"], {}, {"exclude": ["x"], "bone_lengths": [0.1] * 22}),
    (HumanML3DSMPL, ["a", "b"], {}, {"published_split": True, "exclude": ["x"]}),
    (KIT, ["a"], {}, {"exclude": ["x"]}),
    (KITTemos, ["a", "b"], {}, {"exclude": ["x"]}),
    (Mixture, [], {"parts": {"a": Synthetic(1)}}, {"parts": {"a": Synthetic(2)}}),
    (Mixture, [], {"parts": {"a": Synthetic(1)}}, {"parts": {"b": Synthetic(1)}}),
    (Mixture, [], {"parts": {"a": Synthetic(1)}}, {"use": "research"}),
    (Lesson, ["a", "b"], {}, {"motion": "smpl"}),
]


@pytest.mark.parametrize(("source", "paths", "before", "changes"), CHANGES)
def test_every_option_that_defines_the_data_is_in_the_options_of_a_source(
    source, paths, before, changes
):
    plain = source(*paths, **before).options
    for name, value in changes.items():
        assert source(*paths, **before | {name: value}).options != plain, name


@pytest.mark.parametrize(
    "source", dict.fromkeys(row[0] for row in CHANGES), ids=lambda kind: kind.__name__
)
def test_every_argument_of_a_source_is_a_path_or_an_option(source):
    changed = {name for kind, _, _, changes in CHANGES if kind is source for name in changes}
    assert {*signature(source).parameters} - PATHS == changed


NO_OPTIONS: dict[str, Any] = {"exclude": (), "workers": 0}


@pytest.mark.parametrize(
    ("part", "defaults"),
    [
        (Units, {"min_frames": 40, "max_frames": 196, "unit": 4}),
        (Whole, {"min_frames": 1, "max_frames": 471}),
        (Fixed, {"frames": 60, "min_frames": 1}),
        (Babel, {"published_split": False, "workers": 0}),
        (Bandai, NO_OPTIONS | {"motion": "joints", "mirror": True, "split": "takes"}),
        (CMU, NO_OPTIONS | {"captions": None, "motion": "joints"}),
        (
            Folder,
            NO_OPTIONS
            | {"motion": "joints", "mirror": False, "balance": 0, "license": "", "prefixes": None},
        ),
        (HumanAct12, {"published_split": False}),
        (HumanML3D, NO_OPTIONS | {"amass": None, "body_models": None, "bone_lengths": None}),
        (HumanML3DSMPL, NO_OPTIONS | {"humanact12": None, "published_split": False}),
        (KIT, {"exclude": ()}),
        (KITTemos, NO_OPTIONS),
        (Lesson, {"motion": "joints"}),
        (Mixture, {"use": "any"}),
        (
            Synthetic,
            {
                **{"clips": 5000, "seed": 0, "workers": 0, "actions": "core", "core_share": 0.0},
                **{"often": (), "often_share": 0.0},
            },
        ),
        (
            SyntheticSequences,
            {"clips": 5000, "seed": 0, "workers": 0, "often": (), "often_share": 0.0},
        ),
        (UESTC, {"published_split": False}),
        (MotionDataModule, {"num_workers": 0, "seed": 0, "resident": "auto", "pad_multiple": 1}),
    ],
)
def test_defaults_of_data_do_not_change(part, defaults):
    parameters = signature(part).parameters.values()
    assert {p.name: p.default for p in parameters if p.default is not p.empty} == defaults


@pytest.mark.parametrize(
    ("name", "right", "wrong"),
    [
        ("batch_size", (1,), (0, -1)),
        ("num_workers", (0, 1), (-1,)),
        ("name", ("a", "my data.2"), (".a", "a/b", "", "../a", " a")),
        ("resident", (True, False, "auto"), ("yes", 2)),
        ("pad_multiple", (1, 100_000), (0, 100_001)),
        ("crop", (Whole(1, 100_000), Fixed(1)), (Whole(1, 100_001), Whole(0, 5), Fixed(0), "a")),
    ],
)
def test_options_of_batches_have_limits(tmp_path, name, right, wrong):
    options = {"root": str(tmp_path), "name": "s", "batch_size": 4, "crop": Whole()}
    for value in right:
        MotionDataModule(Synthetic(clips=1), HumanML(), **options | {name: value})
    for value in wrong:
        with pytest.raises(UserError, match=rf"data\.{name}="):
            MotionDataModule(Synthetic(clips=1), HumanML(), **options | {name: value})


@pytest.mark.parametrize(
    ("frames", "is_right"),
    [
        *(((4, 4, 4), True), ((40, 40, 1), True), ((40, 196, 4), True)),
        *(((40, 198, 4), False), ((3, 196, 4), False), ((200, 196, 4), False)),
        *(((40, 196, 0), False), ((40, 41, 40), False)),
    ],
)
def test_the_longest_crop_is_made_of_units_and_the_shortest_has_at_least_one(frames, is_right):
    if is_right:
        assert Units(*frames).longest() == frames[1]
    else:
        with pytest.raises(UserError, match=r"expected 1 <= unit <= min_frames <= max_frames"):
            Units(*frames)


def test_free_memory_is_that_of_the_machine_if_the_available_memory_is_unknown(monkeypatch):
    limits = {"memory.max": "max\n", "memory.current": "1000\n"}
    monkeypatch.setattr(resident.os, "sysconf", {"SC_PHYS_PAGES": 3, "SC_PAGE_SIZE": 4096}.get)

    def read_text(path: Path) -> str:
        if path.name == "meminfo":
            raise FileNotFoundError
        return limits[path.name]

    monkeypatch.setattr(resident.Path, "read_text", read_text)
    assert free_memory(torch.device("cpu")) == 3 * 4096
    limits["memory.max"] = "5000\n"
    assert free_memory(torch.device("cpu")) == 4000


def test_features_are_copied_to_a_device_in_parts(store, monkeypatch):
    cpu = torch.device("cpu")
    normalized = (store.features - store.mean) / store.std
    for size in (7, len(store.features) - 1, len(store.features), len(store.features) + 1):
        monkeypatch.setattr(resident, "CHUNK", size)
        features = resident_features(store, HumanML(), cpu)
        np.testing.assert_array_equal(features[:-1], normalized)
        assert not features[-1].any()
    raw = resident_features(store, Rot6D(), cpu)
    np.testing.assert_array_equal(raw[:-1], store.features)
    assert not raw[-1].any()


@pytest.mark.parametrize(
    ("window", "is_inside"),
    [
        *(((0, 30), True), ((20, 10), True), ((29, 1), True), ((0, 1), True)),
        *(((21, 10), False), ((-1, 10), False), ((5, 0), False), ((30, 1), False)),
    ],
)
def test_windows_end_with_their_motion_at_the_latest(tmp_path, window, is_inside):
    features = np.random.default_rng(0).normal(size=(30, 263)).astype(np.float32)
    first = clip("a", motion=features[:7], encoded=ENCODED)
    source = OwnClips(first, clip("b", motion=features, encoded=ENCODED, window=window))
    if is_inside:
        store = write_store(tmp_path / "store", source, HumanML())
        begin, length = window
        assert store.clips[1].start == 7 + begin
        np.testing.assert_array_equal(store.motion(store.clips[1]), features[begin:][:length])
    else:
        with pytest.raises(UserError, match=r"clip b: window .* exceeds 30 frames"):
            write_store(tmp_path / "store", source, HumanML())


def test_the_first_columns_of_published_features_are_stored_for_a_part_of_them(tmp_path):
    features = np.random.default_rng(0).normal(size=(30, 263)).astype(np.float32)
    source = OwnClips(clip("a", motion=features, encoded=ENCODED))
    source.statistics = lambda: (np.arange(263.0), np.arange(1.0, 264.0))
    store = write_store(tmp_path / "store", source, Essential())
    np.testing.assert_array_equal(store.features, features[:, :67])
    assert (store.mean.tolist(), store.std.tolist()) == ([*range(67)], [*range(1, 68)])
    for representation in (HumanML(variant="legacy"), Essential(variant="legacy")):
        with pytest.raises(UserError, match=f"cannot be converted to {representation.name}"):
            write_store(tmp_path / "other", source, representation)


@pytest.mark.parametrize(
    ("start", "action", "is_valid"),
    [(15, 2, True), (16, 2, False), (0, 3, False), (0, None, True), (10, 0, True)],
)
def test_the_last_frame_and_the_last_action_of_a_store_are_valid(tmp_path, start, action, is_valid):
    path = tmp_path / "clips.jsonl"
    entry = Entry("a", start, 5, "train", "take", ["walks\u2028on"], action)
    path.write_text(_line(entry) + "\n", encoding="utf-8")
    if is_valid:
        assert _entries(path, 20, 3) == [entry]
    else:
        with pytest.raises(UserError, match=r"clips\.jsonl is damaged: line 1: a: "):
            _entries(path, 20, 3)


def test_the_captions_of_a_set_are_those_of_all_splits_without_copies(root):
    data = module(root, CROPS[0])
    clips = data.open().clips
    assert {clip.split for clip in clips} == {"train", "val", "test"}
    assert data.captions() == sorted({caption for clip in clips for caption in clip.captions})
