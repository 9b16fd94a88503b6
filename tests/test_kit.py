import json
import math
import shutil

import numpy as np
import pytest
import torch
from support.fixtures import golden
from support.stores import line, published, write_folder

from evaluators.metrics.reconstruction import PARTS, temos_parts
from flame_mdm.__main__ import main
from flame_mdm.config import compose, instantiate
from flame_mdm.data.kit import KITTemos, read_joints
from flame_mdm.data.store import Store, write_store
from flame_mdm.errors import UserError
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rifke import Rifke
from flame_mdm.representations.skeleton import KIT21

TEXTS = {
    "00001": (24, [line("a person walks", "nan", "nan")]),
    "00002": (23, [line("too short")]),
    "00003": (199, [line("someone runs"), line("somebody jogs")]),
    "00004": (60, [line("a person bows")]),
}


def kit_legacy():
    return HumanML("kit21", "legacy", fps=12.5, units_per_metre=640)


def test_a_processed_folder_becomes_batches(tmp_path):
    splits = {"train": ["00001", "00002", "00003"], "val": ["00004"], "test": []}
    folder = write_folder(tmp_path / "KIT-ML", TEXTS, splits, 251)
    overrides = [f"data.source.path={folder}", f"data_root={tmp_path / 'data'}", "data.batch_size=4"]
    config = compose("quickstart", ["data=kit", "representation=kit_legacy", *overrides, "data.num_workers=0"])
    representation = instantiate(config["representation"])
    data = instantiate(config["data"], representation=representation, seed=0)
    data.prepare_data()
    data.setup("fit")
    assert [len(part) for part in (data.train, data.val, data.test)] == [4, 2, 0]
    batch = next(iter(data.train_dataloader()))
    assert set(batch.ids) == {"00001", "M00001", "00003", "M00003"}
    assert batch.x.shape[2] == 251
    assert set((batch.lengths % 4).tolist()) == {0}
    assert int(batch.lengths.max()) <= 196
    assert data.store.info["excluded"] == {"names of train shorter than 24 frames": 2}
    counts = {"motions": 4, "texts": 5, "train": 6, "val": 2, "test": 0}
    counts |= {"train share, %": 75, "val share, %": 25, "test share, %": 0}
    assert data.source.counts() == counts | {"vocabulary": 10, "words per caption": 2.4}
    assert data.source.counts().keys() >= published("kit").keys()


# TEMOS's joints -------------------------------------------------------------------------------------------------------

SPLITS = {
    "train": ["00001", "00002", "00003", "00004", "00005"],
    "val": ["00006"],
    "test": ["00007", "00008"],
    "ghosh-test": ["00008"],
}
FRAMES = {"00001": 801, "00002": 72, "00003": 73, "00004": 4001, "00005": 90, "00006": 100, "00007": 9, "00008": 161}


def walk(frames):
    """(F, 21, 3) in KIT's unit at 100 frames a second: a rigid body on a wide circle."""
    body = np.random.default_rng(3).normal([0, 900, 0], 300, (21, 3))
    time = np.arange(frames)[:, None, None] / 100
    turn = 0.4 * time[..., 0]
    x, y, z = np.moveaxis(np.broadcast_to(body, (frames, 21, 3)), -1, 0)
    turned = np.stack([np.cos(turn) * x + np.sin(turn) * z, y, np.cos(turn) * z - np.sin(turn) * x], -1)
    return turned + 1000 * np.concatenate([np.sin(time), 0 * time, np.cos(time)], 2)


@pytest.fixture
def mmm(tmp_path):
    """Files as TEMOS reads them."""
    folder = tmp_path / "kit-mmm-xyz"
    folder.mkdir()
    names = [name.split("_")[-1] for name in KIT21.joints]
    head = ",".join(["", *(f"{number}{name}_{axis}" for number, name in enumerate(names) for axis in "xyz")])
    for name, frames in FRAMES.items():
        captions = [] if name == "00005" else ["A person walks in a circle.", f"Somebody walks, take {name}."]
        (folder / f"{name}_annotations.json").write_text(json.dumps(captions))
        (folder / f"{name}_meta.json").write_text(json.dumps({"nb_annotations": len(captions), "motion": {}}))
        rows = np.column_stack([np.arange(frames), walk(frames).reshape(frames, 63)])
        np.savetxt(folder / f"{name}_fke.csv", rows, "%.4f", ",", header=head, comments="")
    (tmp_path / "kit-splits").mkdir()
    for split, listed in SPLITS.items():
        (tmp_path / "kit-splits" / split).write_text("\n".join(listed) + "\n")
    return folder


def source(mmm, **options):
    return KITTemos(str(mmm), str(mmm.parent / "kit-splits"), **options)


def test_temos_motions_become_a_store(mmm, tmp_path):
    kit = source(mmm)
    store = write_store(tmp_path / "store", kit, Rifke())
    clips = {clip.id: clip for clip in store.clips}
    assert {name: clip.length for name, clip in clips.items()} == {
        "00001": 101,
        "00003": 10,
        "00006": 13,
        "00007": 2,
        "00008": 21,
    }
    assert kit.count() == len(clips)
    assert store.info["excluded"] == {
        "motions of train without a caption": 1,
        "motions of train shorter than 10 frames": 1,
        "motions of train longer than 500 frames": 1,
    }
    assert store.info["clips"] == {"train": 2, "val": 1, "test": 2}
    assert len(clips["00001"].captions) == 2
    assert clips["00008"].captions == ["A person walks in a circle."], "the test split has the first caption alone"
    assert (clips["00007"].attributes, clips["00008"].attributes) == ({"ghosh_test": False}, {"ghosh_test": True})
    expected = Rifke().encode(torch.from_numpy(walk(801)[::8] / 640))
    np.testing.assert_allclose(store.motion(clips["00001"]), expected, atol=2e-3)
    training = np.concatenate([store.motion(clip) for clip in store.clips if clip.split == "train"])
    training = training.astype(np.float64)
    np.testing.assert_allclose(store.mean, training.mean(0), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(store.std, np.where(training.std(0) > 0, training.std(0, ddof=1), 1), rtol=1e-6)
    assert kit.counts() == {"motions": 8, "texts": 14, "train": 5, "val": 1, "test": 2, "ghosh_test": 1}
    assert kit.counts().keys() == published("kit-temos").keys()


def evaluated(mmm, out, protocol, *words):
    """Exit code of evaluating real motions on the prepared files, with their splits."""
    raw = [f"data.source.splits={mmm.parent / 'kit-splits'}", f"data_root={mmm.parent / 'data'}"]
    if not (mmm.parent / "data").exists():
        assert main(["prepare", "data=kit_temos", f"source={mmm}", *raw]) == 0
    return main(["evaluate", "baseline=real", "data=kit_temos", *raw, f"protocol={protocol}", f"out={out}", *words])


def test_the_protocol_compares_with_the_recordings_of_520_clips_at_100_fps(mmm, tmp_path, capsys):
    out = tmp_path / "result.json"
    assert evaluated(mmm, out, "reconstruction_kit") == 0
    result = json.loads(out.read_text())
    assert (result["protocol"]["name"], result["protocol"]["version"]) == ("reconstruction_kit", 2)
    recording = torch.from_numpy(walk(161)).float().double()  # of 00008, the only clip in ghosh-test
    motion = Rifke().decode(Rifke().encode(recording[::8] / 640)) * 640
    times = np.arange(161) / 8
    joints = np.stack([np.interp(times, np.arange(21), x) for x in motion.flatten(1).numpy().T], 1)
    parts = [temos_parts(x) for x in (torch.from_numpy(joints.reshape(161, 21, 3)), recording)]
    apart = {name: (parts[0][name] - parts[1][name]).norm(dim=-1).mean().item() / 1000 for name in PARTS}
    assert 1e-4 < apart["root"] < 0.01
    for name, value in apart.items():
        for kind in ("values", "ground_truth"):
            found = result[kind][f"temos/ape_{name}"]
            assert found["n"] == 1, "all 587 clips, of which 520 are compared"
            assert found["mean"] == pytest.approx(value, rel=0.02, abs=1e-6)
    assert evaluated(mmm, out, "reconstruction_kit", "split=val") == 1
    assert "the split has no clip with at least 1 frames and ghosh_test=True" in capsys.readouterr().err


def test_stores_without_recordings_are_prepared_again(mmm, tmp_path, capsys):
    assert evaluated(mmm, tmp_path / "a.json", "reconstruction_kit") == 0
    store = Store(mmm.parent / "data" / "kit-temos-rifke")
    store.verify()
    path = store.folder / "references.npz"
    content = path.read_bytes()
    path.write_bytes(content[:-1])
    with pytest.raises(ValueError, match=r"references\.npz: damaged: its hash"):
        store.verify()
    assert evaluated(mmm, tmp_path / "a.json", "reconstruction_kit") == 1
    assert "references.npz: damaged: its hash" in capsys.readouterr().err
    path.unlink()
    del store.info["sha256"]["references.npz"]
    (store.folder / "store.json").write_text(json.dumps(store.info))
    Store(store.folder).verify()
    assert evaluated(mmm, tmp_path / "a.json", "reconstruction_kit") == 1
    assert "Prepare the data set again with force=true" in capsys.readouterr().err


@pytest.mark.golden
@pytest.mark.parametrize("stem", [pytest.param("temos64", id="temos64-subsample")])
def test_every_eighth_frame_is_kept(stem, tmp_path):
    frames = int(golden(stem)["subsample/n_in"])
    rows = np.zeros((frames, 64))
    rows[:, 1:] = np.arange(frames)[:, None]
    np.savetxt(tmp_path / "1_fke.csv", rows, delimiter=",", header="head", comments="")
    kept = read_joints(tmp_path / "1_fke.csv")[:, 20, 2] * 640
    np.testing.assert_allclose(kept, golden(stem)["subsample/idx_100_to_12.5"], rtol=1e-6)


def rewrite(path, change):
    lines = path.read_text().splitlines()
    path.write_text("\n".join(change(lines)) + "\n")


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "00003_fke.csv").unlink(), r"1 of 24 files are missing, such as 00003_fke\.csv"),
        (lambda f: (f / "00001_annotations.json").write_text("[]"), r"00001_meta\.json: nb_annotations does not match"),
        (lambda f: rewrite(f / "00001_fke.csv", lambda x: [*x[:9], "a,b", *x[10:]]), r"00001_fke\.csv: damaged"),
        (
            lambda f: rewrite(f / "00001_fke.csv", lambda x: [y[: y.rindex(",")] for y in x]),
            "63 columns, not a row number",
        ),
        (lambda f: np.savetxt(f / "00001_fke.csv", np.full((90, 64), math.nan), delimiter=","), "non-finite"),
        (lambda f: shutil.rmtree(f.parent / "kit-splits"), r"kit-splits: not found; .*TEMOS"),
        (lambda f: (f.parent / "kit-splits/val").write_text("00001"), r"kit-splits/val: 00001 is also in train"),
    ],
)
def test_a_damaged_folder_is_named(mmm, tmp_path, damage, message):
    damage(mmm)
    with pytest.raises((ValueError, UserError, FileNotFoundError), match=message) as error:
        write_store(tmp_path / "store", source(mmm), Rifke())
    assert "\n" not in str(error.value)
