"""Clips of the user in an adaptation: every kind of file, for every representation."""

from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
from support.motions import synthetic
from support.others import amass
from support.runs import TINY

from flame_mdm.config import compose, instantiate
from flame_mdm.config.composition import compose_data
from flame_mdm.data.adaptation import KEPT, Lesson, LessonData
from flame_mdm.data.crops import Units
from flame_mdm.data.folder import Folder
from flame_mdm.data.store import write_store
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
