"""Clips of the user in an adaptation: every kind of file, for every representation."""

from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Literal, cast

import numpy as np
import pytest
import torch
from support.motions import synthetic
from support.others import amass
from support.runs import TINY

from flame_mdm.config import compose, instantiate
from flame_mdm.config.composition import compose_data
from flame_mdm.data import Clip
from flame_mdm.data.adaptation import KEPT, Lesson, LessonData, fault_of, styled
from flame_mdm.data.crops import Clips, Units
from flame_mdm.data.folder import Folder, Note
from flame_mdm.data.store import Entry, Store, write_store
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.training import adaptation

ENDINGS = ("npz", "bvh", "json", "glb", "fbx")


@pytest.fixture(scope="module")
def clips(tmp_path_factory) -> Path:
    """A short walk as files of every kind, with captions."""
    folder = tmp_path_factory.mktemp("clips")
    walk = synthetic("walk")
    walk = Motion(walk.joints[:32], walk.fps)
    for ending in ENDINGS:
        walk.save(folder / f"{ending}.{ending}")
    np.savez(folder / "amass.npz", **amass(walk))
    for name in (*ENDINGS, "amass"):
        (folder / f"{name}.txt").write_text("a person walks\n")
    return folder


@pytest.mark.parametrize(
    ("name", "kind", "features"),
    [
        ("humanml_clean", "joints", 263),
        ("kit_legacy", "joints", 251),
        ("rifke", "joints", 64),
        ("smpl", "smpl", 147),
        ("rot6d", "smpl", 150),
        ("motion272", "smpl", 272),
    ],
)
def test_every_kind_of_file_is_taught_to_models_of_every_representation(
    name: str, kind: Literal["joints", "smpl"], features: int, clips: Path, tmp_path: Path, subtests
):
    recipe = compose_data("folder", [f"representation={name}"])["representation"]
    representation = instantiate(recipe)
    write_store(tmp_path / "prior", Folder(str(clips), kind), representation)
    data = LessonData(
        Lesson(str(clips), str(tmp_path / "prior"), kind),
        representation,
        root=str(tmp_path),
        name="limp",
        batch_size=4,
        crop=Units(min_frames=12, max_frames=60),
    )
    data.prepare_data()
    data.setup("fit")

    of_user = [clip for clip in data.train.clips if not clip.id.startswith(KEPT)]
    names = {clip.id for clip in of_user}
    assert names >= {*ENDINGS, "amass"}
    assert len(names) == 6 * (2 if kind == "joints" else 1), "mirrored copies of joints"
    assert {caption for clip in of_user for caption in clip.captions} == {
        "a person walks in limp style"
    }
    for clip in of_user:
        with subtests.test(clip=clip.id):
            values = torch.from_numpy(np.array(data.store.motion(clip)))
            joints = representation.decode(values)
            head = representation.skeleton.joints.index("head")
            assert values.shape[1] == features
            assert (joints[:, head] - joints[:, 0])[:, 1].min() > 0.3, f"{clip.id} stands"
    batch = next(iter(data.train_dataloader()))
    assert batch.x.isfinite().all()
    assert [id.startswith(KEPT) for id in batch.ids] == [False, False, True, True]


@pytest.mark.parametrize(("name", "kind"), [("humanml_clean", "joints"), ("rot6d", "smpl")])
def test_an_adaptation_reads_rotations_for_models_of_rotations(
    name: str, kind: str, tmp_path: Path
):
    config = compose("quickstart", TINY)
    model = MotionGenerator.build(config, instantiate(config["representation"]))
    recipe = compose_data("folder", [f"representation={name}"])["representation"]
    model.representation = instantiate(recipe)
    model.facts |= {"max_frames": 40, "captions": []}
    model.config["data"] = {}  # such as of a data set whose source has no such option
    adapted = adaptation._recipe(model, ["a person walks"], "limp", tmp_path, [])
    assert adapted["data"]["source"]["motion"] == kind


@pytest.mark.parametrize(("clips", "step", "count"), [(2000, 1, 2000), (2001, 2, 1001), (9, 1, 9)])
def test_clips_of_the_prior_are_evenly_spaced(clips: int, step: int, count: int, tmp_path: Path):
    lesson = Lesson(str(tmp_path), str(tmp_path))
    entries = [Entry(f"{n}", n, 1, "train", "a", [], None) for n in range(clips)]
    entries += [Entry(f"v{n}", n, 1, "val", "a", [], None) for n in range(65)]
    lesson.store = cast(Store, SimpleNamespace(clips=entries))
    kept = [entry.id for entry in lesson.kept()]
    assert kept[:count] == [f"{n}" for n in range(0, clips, step)]
    assert kept[count:] == [f"v{n}" for n in range(0, 65, 2)]


@pytest.mark.parametrize(
    ("rise", "fault"),
    [
        (0.049, ""),
        (0.051, "drifts upward by 5 cm (limit 5)"),
        (-0.2, "floats 20 cm above the floor (limit 10)"),
    ],
)
def test_a_floor_that_rises_by_five_centimeters_is_a_fault(rise: float, fault: str):
    joints = np.zeros((101, 22, 3))
    joints[:, 1:, 1] = 1
    joints[60:, :, 1] += rise
    assert fault_of(joints, 10.0) == fault


def test_a_body_that_jumps_is_no_fault_and_a_body_that_floats_is_one():
    joints = np.zeros((100, 22, 3))
    joints[20:29, :, 1] = 0.5
    assert fault_of(joints, 10.0) == ""
    joints[:] = 0
    joints[20:, :, 1] = 0.11
    joints[-15:, :, 1] = 0
    assert fault_of(joints, 10.0) == "floats 11 cm above the floor (limit 10)"
    joints[..., 1] *= 0.9
    assert fault_of(joints, 10.0) == ""


def test_captions_name_their_style_once_and_before_the_point():
    assert styled("a person walks. ", "limp") == "a person walks in limp style"


def test_an_odd_batch_has_one_more_clip_of_the_user(tmp_path: Path):
    entries = [Entry(f"{KEPT}{n}", n, 1, "train", "a", [], None) for n in range(6)]
    entries += [Entry(f"mine {n}", n, 1, "train", "a", [], None) for n in range(4)]
    data = object.__new__(LessonData)
    data.batch_size, data.crop = 5, Units()
    data.train = cast(Clips, SimpleNamespace(clips=entries, lengths=np.arange(10)))
    batches = iter(data.training_batches(seed=0, first=0, rank=0, world=1))
    for _ in range(9):
        batch = [index for index, _ in next(batches)]
        assert [entries[index].id.startswith(KEPT) for index in batch] == [False] * 3 + [True] * 2
        assert len(set(batch)) == 5


@pytest.mark.parametrize("batch_size", [1, 2, 4])
def test_both_halves_of_a_batch_belong_to_the_same_step(batch_size: int, tmp_path: Path):
    """So that a resumed run continues both of them."""
    entries = [Entry(f"{KEPT}{n}", n, 1, "train", "a", [], None) for n in range(8)]
    entries += [Entry(f"mine {n}", n, 1, "train", "a", [], None) for n in range(8)]
    data = object.__new__(LessonData)
    data.batch_size, data.crop = 2 * batch_size, Units()
    data.train = cast(Clips, SimpleNamespace(clips=entries, lengths=np.arange(16)))

    def batches(first: int, count: int, seed: int = 3) -> list:
        stream = data.training_batches(seed=seed, first=first, rank=0, world=1)
        return list(islice(stream, count))

    whole = batches(0, 20)
    assert batches(7, 13) == whole[7:]
    assert batches(0, 20, seed=4) != whole
    for number, draws in enumerate(whole):
        assert {batch for _, batch in draws} == {number}
        assert sum(index < 8 for index, _ in draws) == batch_size


def test_clips_of_the_prior_keep_their_captions_splits_and_statistics():
    lesson = Lesson("there", "prior")
    lesson.name = "limp"
    entries = [Entry("k", 3, 5, "val", "take", ["a person sits"], 1)]
    statistics = {"mean": np.array([1.0]), "std": np.array([2.0])}
    lesson.store = cast(
        Store,
        SimpleNamespace(
            clips=entries,
            info={"representation": "features"},
            motion=lambda entry: np.full((entry.length, 1), entry.start),
            **statistics,
        ),
    )
    mine = Clip("a", np.zeros((9, 22, 3)), ["a person walks."], "train", "a")
    notes = {"a": Note(), "b": Note(split="test")}
    lesson.folder = cast(
        Folder,
        SimpleNamespace(
            clips=lambda fps: [mine], require_all=lambda: None, notes=notes, count=lambda: 7
        ),
    )
    first, second = lesson.clips(20.0)
    assert (first.id, first.captions, first.encoded) == ("a", ["a person walks in limp style"], "")
    assert (second.id, second.source) == (f"{KEPT}k", f"{KEPT}k")
    assert (second.captions, second.split) == (["a person sits"], "val")
    assert second.encoded == "features"
    assert second.motion.tolist() == [[3]] * 5
    assert lesson.statistics() == tuple(statistics.values())
    assert lesson.count() == 7 + 1
    assert lesson.folder.splits == {"a": "train", "b": "test"}


def test_clips_are_counted_by_who_gave_them():
    entries = [Entry(f"{KEPT}{n}", n, 1, "train", "a", [], None) for n in range(5)]
    entries += [Entry(f"mine {n}", n, 1, "train", "a", [], None) for n in range(3)]
    data = object.__new__(LessonData)
    data.crop, data.source = Units(), Lesson("there", "prior")
    data.source.name = "limp"
    data.train = cast(Clips, SimpleNamespace(clips=entries))
    (line,) = data.counts(cast(Store, None))
    assert line.startswith("clips: 3 from limp, including mirrored copies; 5 that the model")
    assert [rows.tolist() for rows in data.halves()] == [[5, 6, 7], [0, 1, 2, 3, 4]]
    del entries[5:]
    with pytest.raises(UserError, match="limp: all clips are shorter than 40 frames"):
        data.halves()


@pytest.mark.parametrize(
    ("fps", "frames", "rises"),
    [(10.0, 4, 0), (10.0, 6, 1), (12.5, 5, 0), (30.0, 13, 0), (30.0, 16, 1), (60.0, 28, 0)],
)
def test_the_floor_of_the_last_second_is_half_a_second_before_the_end(fps, frames, rises):
    """A foot that leaves the floor for less than half a second at the end does not raise it."""
    joints = np.zeros((120, 22, 3))
    joints[-frames:, :, 1] = 0.2
    assert fault_of(joints, fps) == ("drifts upward by 20 cm (limit 5)" if rises else "")
