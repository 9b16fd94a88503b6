"""HumanAct12 and UESTC in the layout of ACTOR's pickles, the reader of pickles, and classifiers to train."""

import contextlib
import hashlib
import json
import os
import pickle
import pickletools
import re
import sys
import types
from collections import Counter, OrderedDict
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.sparse import csc_matrix
from scipy.spatial.transform import Rotation
from support.fixtures import golden, golden_case
from support.runs import TINY
from support.stores import VIDEOS, write_humanact12, write_uestc, written

from evaluators.extractors import OwnClassifierExtractor, UnconstrainedExtractor
from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.classifier import ClassifierTask
from evaluators.extractors.stgcn import UNCONSTRAINED_JOINTS, Unconstrained
from flame_mdm.__main__ import main
from flame_mdm.batch import length_mask
from flame_mdm.config import compose, instantiate
from flame_mdm.data import SPLITS, restricted_pickle, uestc
from flame_mdm.data.body_model import load_offsets
from flame_mdm.data.crops import Fixed
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.humanact12 import HumanAct12
from flame_mdm.data.store import write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.data.uestc import TRAIN_SUBJECTS, UESTC, front_view
from flame_mdm.errors import UserError
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import SMPL24
from flame_mdm.runs import read_history


class Attack:
    """A hostile pickle, which calls a function when it is read."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


ragged = np.empty(2, object)
ragged[:] = [np.arange(6, dtype=np.float32).reshape(2, 3), np.zeros((1, 3), np.float16)]
CONTENT = {
    "poses": [np.arange(6.0).reshape(2, 3), np.asfortranarray(np.arange(6).reshape(2, 3))],
    "ragged": ragged,
    "y": [np.int64(3), 2, True],
    "number": (np.float32(0.5), 1.5, None),
    "raw": b"\x00\xff",
    "big": np.arange(3, dtype=">i2"),
    "texts": np.array(["a", "bc"]),
}


def test_arrays_and_plain_values_are_read(tmp_path: Path, subtests):
    for protocol, core in product(range(6), (b"core", b"_core")):
        with subtests.test(protocol=protocol, core=core):
            data = pickle.dumps(CONTENT, protocol)
            if protocol < 4:  # where names are lines, and not counted
                data = data.replace(b"numpy._core.", b"numpy.%s." % core)
            (tmp_path / "x.pkl").write_bytes(data)
            content = restricted_pickle.read(tmp_path / "x.pkl")
            assert all(content[key] == CONTENT[key] for key in ("number", "raw", "y"))
            assert (content["big"].tolist(), content["texts"].tolist()) == ([0, 1, 2], ["a", "bc"])
            for one, other in zip(
                [*content["poses"], *content["ragged"]], [*CONTENT["poses"], *ragged], strict=True
            ):
                np.testing.assert_array_equal(one, other)
                assert one.dtype == other.dtype
    numbers = np.array([1.5, -2.5])  # as Python 2 wrote it
    head = b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R(K\x01K\x02\x85"
    dtype = b"cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb"
    (tmp_path / "x.pkl").write_bytes(head + dtype + b"\x89U\x10" + numbers.tobytes() + b"tb.")
    np.testing.assert_array_equal(restricted_pickle.read(tmp_path / "x.pkl"), numbers)


ATTACKS = {
    "posix.mkdir": lambda path: Attack(os.mkdir, str(path)),
    r"builtin(s|__)\.eval": lambda path: Attack(eval, f"__import__('os').mkdir({str(path)!r})"),
    r"numpy\.save": lambda path: Attack(np.save, str(path), 1),
    r"collections\.OrderedDict": lambda path: OrderedDict(a=1),
    "pathlib.*Path": lambda path: {"poses": [Path(path)]},
}


@pytest.mark.parametrize("named", ATTACKS)
def test_anything_else_is_refused_before_it_runs(named: str, tmp_path: Path, subtests):
    for protocol in (0, 2, 4, 5):
        with subtests.test(protocol=protocol):
            path = written(tmp_path / "x.pkl", ATTACKS[named](tmp_path / "run"), protocol)
            with pytest.raises(
                ValueError, match=rf"x\.pkl: cannot be read as a pickle: it refers to .*{named}"
            ) as error:
                restricted_pickle.read(path)
            assert "\n" not in str(error.value)
            assert os.listdir(tmp_path) == ["x.pkl"]  # noqa: PTH208


def test_every_byte_may_be_wrong(tmp_path: Path):
    """NumPy's own functions end the process on some of these, so this test does."""
    path = tmp_path / "x.pkl"
    for protocol in (2, 4):
        data = pickletools.optimize(pickle.dumps({"y": [1, np.arange(2.0), ragged]}, protocol))
        for at in range(len(data)):
            path.write_bytes(data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :])
            with contextlib.suppress(ValueError):  # and nothing else
                restricted_pickle.read(path)


def data_of(source, root: Path, **options) -> MotionDataModule:
    options = {"batch_size": 8, "crop": Fixed(frames=60), "seed": 3, **options}
    data = MotionDataModule(source, Rot6D(), root=str(root / "stores"), name="x", **options)
    data.prepare_data()
    data.setup("fit")
    return data


def test_humanact12_from_raw_file_to_batch(tmp_path: Path, subtests):
    raw = str(write_humanact12(tmp_path / "raw"))
    ours, published = (
        data_of(HumanAct12(raw, flag), tmp_path / str(flag)) for flag in (False, True)
    )
    assert HumanAct12(raw).count() == len(ours.store.clips) == 360
    assert ours.store.info["actions"] == list(HumanAct12.actions)
    assert [clip.action for clip in ours.store.clips] == [k % 12 for k in range(360)]
    for split in SPLITS:
        with subtests.test(split=split):
            assert {clip.action for clip in ours.store.clips if clip.split == split} == set(
                range(12)
            )
    assert len(ours.test) == 120  # of 30 clips an action, one block of ten
    assert [data.store.info["published_split"] for data in (ours, published)] == [False, True]
    assert published.store.info["clips"] == {"train": 360, "val": 0, "test": 0}
    assert [clip.id for clip in published.test.clips] == [clip.id for clip in published.train.clips]
    assert len(published.val) == 0


@golden_case("smpl147")
def test_samples_are_those_of_actor(stem: str, tmp_path: Path, subtests):
    """The whole way: pickle, store, crop, sample."""
    arrays = golden(stem)
    numbers = [key.removeprefix("a2m/inp_") for key in arrays if key.startswith("a2m/inp_")]
    for number in numbers:
        with subtests.test(number=number):
            pose, joints = arrays[f"a2m/pose72_{number}"], arrays[f"a2m/joints3d_{number}"]
            label = int(arrays[f"a2m/label_{number}"])
            raw = write_humanact12(tmp_path / number, poses=[pose], joints3D=[joints], y=[label])
            expected = arrays[f"a2m/inp_{number}"].transpose(2, 0, 1).reshape(-1, 150)
            crop = Fixed(frames=len(expected))
            data = data_of(
                HumanAct12(str(raw), published_split=True),
                raw.parent,
                batch_size=1,
                crop=crop,
                seed=0,
            )
            low, high, drawn = (int(value) for value in arrays[f"a2m/shift_draw_{number}"])
            starts = [int(data.train.draw([0], batch)[0][0]) for batch in range(400)]
            assert set(starts) == set(range(max(low, 0), max(high, 0) + 1))
            _, sample, _, action = data.train[0, starts.index(max(drawn, 0))]
            assert action == label
            np.testing.assert_allclose(sample.numpy(), expected, atol=2e-6, err_msg=number)
    assert numbers


def test_another_humanact12_file_is_named(tmp_path: Path, subtests):
    columns = {
        r"humanact12poses\.pkl: poses, joints3D, y are not lists of equal length": {"y": [0]},
        "clip 0: label 12 is not in the range 0 to 11": {"y": [12]},
        r"clip 0: .* but found shapes \(20, 72\) and \(9, 18, 3\)": {
            "joints3D": [np.zeros((9, 18, 3))]
        },
        "clip humanact12_0000: .* NaN or infinite values": {"poses": [np.full((20, 72), np.nan)]},
    }
    for k, (message, changed) in enumerate(columns.items()):
        with subtests.test(k=k):
            path = write_humanact12(tmp_path / f"raw{k}", 1 + ("equal" in message), **changed)
            with pytest.raises(ValueError, match=message):
                write_store(tmp_path / "store", HumanAct12(str(path)), Rot6D())
    with pytest.raises(ValueError, match="but contains list"):
        HumanAct12(str(written(tmp_path / "humanact12poses.pkl", [1]))).count()
    with pytest.raises(
        FileNotFoundError, match=r"no humanact12poses\.pkl; the data set is published with ACTOR"
    ):
        HumanAct12(str(tmp_path / "nowhere")).count()


def test_unconditioned_motions_are_compared_with_the_reference_motions(tmp_path: Path):
    """24 joints as models generate them, y up, and the same as the 15 of the file, y down and not from the pelvis."""
    motion = torch.randn(70, 20, 24, 3, generator=torch.Generator().manual_seed(0))
    shown = (
        motion[:, :, list(UNCONSTRAINED_JOINTS)] * torch.tensor([1.0, -1.0, -1.0]) + 3
    ).permute(0, 2, 3, 1)
    torch.save(Unconstrained().state_dict(), tmp_path / "humanact12_gru_modi_struct.pth.tar")
    with pytest.raises(
        FileNotFoundError, match=r"humanact12_unconstrained_modi_struct\.npy: no such file"
    ):
        UnconstrainedExtractor(str(tmp_path))
    more_joints = np.pad(shown.numpy(), ((0, 0), (0, 3), (0, 0), (0, 0)))
    np.save(tmp_path / "humanact12_unconstrained_modi_struct.npy", more_joints)
    extractor = UnconstrainedExtractor(str(tmp_path))
    with torch.no_grad():
        features = extractor.motions(
            motion, motion, torch.ones(motion.shape[:2], dtype=torch.bool)
        )["features"]
        torch.testing.assert_close(extractor.reference(), features, atol=1e-5, rtol=1e-4)


def smpl_model(**changed) -> dict:
    """The arrays of SMPL's model file that count, and one that does not."""
    rng = np.random.default_rng(0)
    regressor = rng.random((24, 50)) * (rng.random((24, 50)) < 0.3)
    parents = np.array([[2**32 - 1, *SMPL24.parents[1:]], range(24)])
    model = {
        "J_regressor": regressor,
        "v_template": rng.normal(size=(50, 3)),
        "kintree_table": parents,
    }
    return model | {"bs_style": "lbs"} | changed


def test_smpls_offsets_come_from_its_file_without_running_code(
    tmp_path: Path, monkeypatch, subtests
):
    model = smpl_model()
    np.savez(tmp_path / "SMPL.npz", **model)
    positions = model["J_regressor"] @ model["v_template"]
    offsets = np.array(load_offsets(tmp_path / "SMPL.npz"))
    np.testing.assert_allclose(
        offsets, [*positions[:1], *(positions - positions[list(SMPL24.parents)])[1:]]
    )
    array = type(
        "Ch", (), {"__module__": "chumpy.ch", "__init__": lambda self, x: self.__dict__.update(x=x)}
    )
    with monkeypatch.context() as patch:
        for name in ("chumpy", "chumpy.ch"):
            patch.setitem(sys.modules, name, types.SimpleNamespace(Ch=array))
        parts = {
            "J_regressor": csc_matrix(model["J_regressor"]),
            "v_template": array(model["v_template"]),
        }
        paths = [
            written(tmp_path / f"SMPL_{protocol}.pkl", model | parts, protocol)
            for protocol in (0, 2, 4)
        ]
    for path in paths:
        with subtests.test(path=path.name):
            np.testing.assert_allclose(load_offsets(path), offsets)
            with pytest.raises(ValueError, match=r"it refers to (scipy|copy_?reg)"):
                restricted_pickle.read(path)
    attack, wrong = Attack(os.mkdir, str(tmp_path / "run")), "not an SMPL model with 24 joints"
    wrongs = {"J_regressor": np.ones((52, 50)), "v_template": 3, "kintree_table": np.zeros((2, 24))}
    for name, value, message in (
        ("v_template", attack, "cannot be read as"),
        *((*item, wrong) for item in wrongs.items()),
    ):
        with (
            subtests.test(name=name, value=value, message=message),
            pytest.raises(ValueError, match=rf"bad\.pkl: {message}"),
        ):
            load_offsets(written(tmp_path / "bad.pkl", smpl_model(**{name: value})))
    assert not (tmp_path / "run").exists()


def test_uestcs_training_and_validation_clips_have_a_minimum_length(tmp_path: Path, monkeypatch):
    source = UESTC(str(write_uestc(tmp_path / "uestc")))
    store = data_of(source, tmp_path / "all").store
    longest = max(clip.length for clip in store.clips if clip.split == "val")
    monkeypatch.setattr(uestc, "MIN_FRAMES", longest)
    kept = data_of(source, tmp_path / "long").store.clips
    shortest = {split: min(c.length for c in kept if c.split == split) for split in SPLITS}
    assert shortest["train"] >= longest
    assert shortest["val"] == longest
    assert shortest["test"] < longest


@pytest.mark.slow
def test_classifiers_see_smpls_joints_or_the_result_says_that_they_do_not(tmp_path: Path, capsys):
    raw = ["data=humanact12", f"data_root={tmp_path}"]
    assert main(["prepare", *raw, f"source={write_humanact12(tmp_path / 'raw')}"]) == 0
    np.savez(tmp_path / "SMPL.npz", **smpl_model())
    torch.save({"model": ActionGRU().state_dict()}, tmp_path / "gru.tar")
    words = ["evaluate", "baseline=real", *raw, "protocol=action_to_motion"]
    words += [f"extractor={tmp_path / 'gru.tar'}", "quick=true", "samples=12", "replications=1"]
    digest = hashlib.sha256((tmp_path / "SMPL.npz").read_bytes()).hexdigest()
    diversity = []
    for smpl in ([], [f"smpl={tmp_path / 'SMPL.npz'}"]):
        out = tmp_path / f"{len(smpl)}.json"
        assert main([*words, f"out={out}", *smpl]) == 0
        result = json.loads(out.read_text())
        assert result["skeleton"] == {"stand_in": not smpl, "smpl_sha256": digest if smpl else None}
        assert ("stand-in skeleton" in capsys.readouterr().out) == (not smpl)
        diversity.append(result["values"]["diversity"]["mean"])
    assert diversity[0] != pytest.approx(diversity[1], rel=1e-3), (
        "the classifier sees the same joints"
    )
    assert main([*words, "smpl=absent.pkl"]) == 1
    assert "absent.pkl: no such file" in capsys.readouterr().err


def test_uestc_from_raw_files_to_batch(tmp_path: Path):
    raw = str(write_uestc(tmp_path / "uestc"))
    store = data_of(UESTC(raw), tmp_path).store
    assert len(store.info["actions"]) == 40
    assert store.info["excluded"] == {
        "videos of view 8, side 2": 1,
        "training clips that are too short": 1,
    }
    clips = {clip.id: clip for clip in store.clips}
    assert len(clips) == len(VIDEOS) - 2
    # The test set is not filtered, but cut to the frames of the video
    assert clips["a5_d1_p005_c1"].length == 44
    assert {"a3_d8_p003_c2", "a5_d1_p001_c1"}.isdisjoint(clips)
    assert clips["a3_d8_p004_c1"].attributes == {"subject": 4, "view": 8, "side": 1}
    assert all(clip.action == int(name[1:].split("_")[0]) for name, clip in clips.items())
    train, val, test = (
        {c.attributes["subject"] for c in clips.values() if c.split == split} for split in SPLITS
    )
    assert (len(val), train, test) == (5, set(TRAIN_SUBJECTS) - val, {3, 4, 5, 118})
    published = UESTC(raw, published_split=True)
    assert len(published.actions) == 40, "a model has to know them before the data is prepared"
    assert Counter(published.split(subject) for subject in range(1, 119)) == {
        "train": 51,
        "test": 67,
    }


def test_front_view_is_actors_camera(subtests):
    """Against the depth that reproduces the size of the picture, solved from the joints."""
    rng = np.random.default_rng(1)
    pose, joints, camera = (
        rng.normal(size=(5, 72)),
        rng.normal(size=(5, 49, 3)),
        rng.uniform(0.2, 0.9, (5, 4)),
    )
    places = []
    for points, (scale, _, x, y) in zip(joints, camera, strict=True):
        picture = (scale * (points[:, :2] + [x, y]) + 1) / 2 * 540
        places.append(
            [
                x,
                y,
                500 * np.linalg.norm(np.ptp(points[:, :2], 0)) / np.linalg.norm(np.ptp(picture, 0)),
            ]
        )
    places = np.array(places) - places[0]
    for side, angle in ((2, -5 * np.pi / 4), (1, 0.0)):
        with subtests.test(side=side):
            motion = front_view(
                pose, joints[:, uestc.ROOT], camera, uestc.Video(0, "x", 0, 5, 1, side)
            )
            turn = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
            np.testing.assert_allclose(
                motion[:, :3], (joints[:, uestc.ROOT] + places) @ turn.T, atol=1e-5
            )
            turned, before = (
                Rotation.from_rotvec(vectors).as_matrix()
                for vectors in (motion[:, 3:6], pose[:, :3])
            )
            np.testing.assert_allclose(turned, turn @ before, atol=1e-5)
            np.testing.assert_allclose(motion[:, 6:], pose[:, 3:], atol=1e-6)


def test_damaged_lists_are_named(tmp_path: Path, subtests):
    folder = write_uestc(tmp_path / "uestc")
    for text, message in (
        ("a0_p001.avi\n", r"names\.txt, line 1: 'a0_p001\.avi' does not name a video"),
        ("a40_d0_p001_c1_color.avi\n", r"names\.txt, line 1: .* one of the 40 actions"),
        ("\n".join(VIDEOS[:3]), r"num_frames_min\.txt \d+ and vibe_cache_refined\.pkl 60 clips"),
    ):
        with subtests.test(text=text, message=message):
            (folder / "info/names.txt").write_text(text)
            with pytest.raises(UserError, match=message):
                list(UESTC(str(folder)).clips(20.0))
    (folder / "info/names.txt").unlink()
    with pytest.raises(
        FileNotFoundError, match=r"info/names\.txt: not found; it is published with the poses"
    ):
        list(UESTC(str(folder)).clips(20.0))


DATA = ("data=synthetic", "data.source.clips=300")
RUN = ["data.source.clips=300", "data.batch_size=32", "logger=csv", "trainer.accelerator=cpu"]
RUN += ["trainer.enable_progress_bar=false", "trainer.log_every_n_steps=5"]


@pytest.fixture(scope="module")
def data(data_root) -> str:
    return f"data_root={data_root}/classifier"


@pytest.fixture(scope="module")
def trained(tmp_path_factory, data) -> Path:
    """Checkpoint of a small classifier after 120 steps."""
    folder = tmp_path_factory.mktemp("classifier")
    options = [data, f"run.dir={folder}", "trainer.max_steps=120", "trainer.val_check_interval=60"]
    options += ["task.network.hidden=48", "task.network.num_layers=1", "optimizer.lr=0.004"]
    assert main(["train", "classifier/synthetic", *RUN, *options]) == 0
    return folder / "checkpoints" / "last.ckpt"


def measure(out: Path, *words: str) -> dict:
    assert (
        main(["evaluate", f"out={out}", "device=cpu", "replications=1", "samples=150", *words]) == 0
    )
    return json.loads(out.read_text())


@pytest.mark.slow
def test_training_by_recipe_learns_the_actions(trained, data, tmp_path):
    accuracy = read_history(trained.parent.parent)["val/accuracy"]
    assert accuracy[max(accuracy)] > 0.5  # by chance: about 1 in 11
    words = [
        "baseline=shuffled",
        *DATA,
        data,
        "protocol=action_to_motion_own",
        f"extractor={trained}",
    ]
    result = measure(tmp_path / "real.json", *words)
    assert result["ground_truth"]["accuracy"]["mean"] > 0.5, "motions that were not trained on"
    assert result["values"]["accuracy"]["mean"] < 0.2, "the labels belong to other actions"
    assert all(value["mean"] is not None for value in result["values"].values())
    assert result["extractor"]["data"] == result["data"]["fingerprint"]


@pytest.mark.slow
def test_a_model_of_actions_is_measured_by_it(trained, data, tmp_path):
    words = [word for word in TINY if not word.startswith(("condition", "data.source"))]
    words += [
        RUN[0],
        "condition=action",
        "condition.features=16",
        data,
        f"run.dir={tmp_path / 'run'}",
    ]
    assert main(["train", "quickstart", *words, "trainer.max_steps=1"]) == 0
    shown = (tmp_path / "run" / "samples" / "step_0000001").glob("*.npz")
    texts = [str(np.load(file)["text"]) for file in sorted(shown)]
    assert texts == list(Synthetic.actions)[: len(texts)], "actions instead of the recipe's prompts"
    model = tmp_path / "run" / "checkpoints" / "last.ckpt"
    result = measure(
        tmp_path / "result.json", f"ckpt={model}", f"extractor={trained}", "num_inference_steps=2"
    )
    assert result["protocol"]["name"] == "action_to_motion_own"
    assert result["values"]["accuracy"]["mean"] < result["ground_truth"]["accuracy"]["mean"]
    assert result["values"]["fid"]["mean"] > 2 * result["ground_truth"]["fid"]["mean"]


@pytest.mark.slow
def test_what_was_not_made_for_one_another_is_refused(trained, data, tmp_path, capsys, subtests):
    extractor = OwnClassifierExtractor(str(trained))
    own = extractor.task.representation
    extractor.check(own, "synthetic")
    with pytest.raises(
        UserError, match=r"trained on .* of synthetic at .*, but the motions are .* of bandai"
    ):
        extractor.check(own, "bandai")
    with pytest.raises(
        UserError, match=r"rot6d-25 features of synthetic at 20\. Train a matching ex"
    ):
        extractor.check(Rot6D(), "synthetic")

    released = tmp_path / "released.tar"
    torch.save({"model": ActionGRU().state_dict()}, released)
    for protocol, file, message in (
        ("action_to_motion", trained, "contains no weights under 'model'"),
        ("action_to_motion_own", released, f"{released}: not a checkpoint of this framework"),
    ):
        with subtests.test(protocol=protocol, file=file, message=message):
            words = ["baseline=real", *DATA, data, f"protocol={protocol}", f"extractor={file}"]
            assert main(["evaluate", *words]) == 1
            assert message in capsys.readouterr().err


def test_data_without_labels_is_refused(monkeypatch, tmp_path, capsys):
    config = compose("classifier/synthetic")
    with pytest.raises(UserError, match="with at least two actions, but this one has 1"):
        ClassifierTask.build(config, instantiate(config["representation"]), actions=["walk"])

    whole = list(Synthetic(clips=40).clips(20.0))
    bare = [replace(clip, action=None if clip.id.endswith("7") else clip.action) for clip in whole]
    monkeypatch.setattr(Synthetic, "clips", lambda *_: iter(bare))
    words = [
        "data.source.clips=40",
        "data.batch_size=8",
        f"data_root={tmp_path}",
        f"run.dir={tmp_path / 'run'}",
    ]
    assert main(["train", "classifier/synthetic", *RUN, *words]) == 1
    assert re.search(
        r"\d clips have no action label, such as synthetic_0_0000\d7\.", capsys.readouterr().err
    )


def test_recipes_build_the_sizes_of_their_data(subtests):
    for words in (["synthetic"], ["synthetic", "task=classifier_stgcn"], ["humanact12"], ["uestc"]):
        with subtests.test(words=words):
            config = compose(f"classifier/{words[0]}", words[1:])
            task = ClassifierTask.build(
                config, instantiate(config["representation"]), actions=list("abcdefg")
            )
            joints = torch.randn(2, 12, len(task.representation.skeleton.parents), 3)
            mask = length_mask(torch.tensor([12, 7]))
            assert task.network.logits(joints, mask).shape == (2, 7)
            assert len(task(joints, mask)) == 2


def test_actions_have_the_numbers_of_actors_code():
    assert HumanAct12.actions == (
        *("warm_up", "walk", "run", "jump", "drink", "lift_dumbbell"),
        *("sit", "eat", "turn steering wheel", "phone", "boxing", "throw"),
    )
    assert len(TRAIN_SUBJECTS) == 51
    assert sum(TRAIN_SUBJECTS) == 3081
    assert (uestc.ROOT, uestc.MIN_FRAMES) == (8, 45)


def first_hashes(names: dict[int, str]) -> list[int]:
    """The numbers of names in the order of the hashes of these names."""
    return sorted(names, key=lambda n: hashlib.sha1(names[n].encode()).hexdigest())


def test_splits_of_the_action_sets_follow_from_the_hashes_of_their_names(tmp_path: Path):
    source = UESTC("there")
    ranked = first_hashes({subject: f"uestc_p{subject:03d}" for subject in TRAIN_SUBJECTS})
    validated = {subject for subject in TRAIN_SUBJECTS if source.split(subject) == "val"}
    assert validated == set(ranked[:5])

    clips = list(HumanAct12(str(write_humanact12(tmp_path / "raw"))).clips(20.0))
    for action, label in enumerate(HumanAct12.actions):
        ranked = first_hashes({block: f"humanact12_{action}_{block}" for block in range(3)})
        expected = {f"{label} {ranked[k]}": split for k, split in enumerate(("test", "val"))}
        expected[f"{label} {ranked[2]}"] = "train"
        of_action = [clip for clip in clips if clip.action == action]
        assert {clip.source: clip.split for clip in of_action} == expected
        assert [clip.source for clip in of_action] == [f"{label} {k // 10}" for k in range(30)]


def test_all_videos_and_the_subjects_of_the_used_videos_are_counted():
    source = UESTC("there")
    videos = [(1, 8, 1), (2, 8, 2), (3, 7, 2), (1, 0, 1)]
    source.videos = [
        uestc.Video(k, f"{k}", 0, view, subject, side)
        for k, (subject, view, side) in enumerate(videos)
    ]
    assert source.counts() == {"videos": 4, "subjects": 2}
    assert [video.index for video in source.used] == [0, 2, 3]
    assert source.count() == 3


@pytest.mark.parametrize("side", [1, 2])
def test_a_camera_of_negative_scale_has_the_depth_of_its_size(side: int):
    rng = np.random.default_rng(0)
    pose, root = rng.normal(size=(4, 72)), rng.normal(size=(4, 3))
    camera = rng.uniform(0.2, 0.9, (4, 4))
    flipped = camera * [-1, 1, 1, 1]
    video = uestc.Video(0, "x", 0, 3, 1, side)
    shown, again = (front_view(pose, root, values, video) for values in (camera, flipped))
    np.testing.assert_array_equal(shown, again)
    assert shown.dtype == np.float32
    np.testing.assert_allclose(shown[0, 1], root[0, 1], rtol=1e-6)
    depth = 500 / (camera[:, 0] * 270)
    if side == 1:
        np.testing.assert_allclose(shown[:, 2], root[:, 2] + depth - depth[0], rtol=1e-5)
