"""KIT-ML as processed by Guo et al., and as TEMOS reads it."""

import json
import math
import shutil

import numpy as np
import pytest
import torch
from support.fixtures import golden, golden_case
from support.stores import kit_walk, line, published, write_folder, write_mmm

from evaluators.metrics.reconstruction import PARTS, temos_parts
from flame_mdm.__main__ import main
from flame_mdm.data import Split
from flame_mdm.data.kit import KIT, KITTemos, read_joints
from flame_mdm.data.store import Store, write_store
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rifke import Rifke


def test_a_processed_folder_becomes_a_store(tmp_path):
    motions = {
        name: (frames, [line("a person walks")])
        for name, frames in (("1", 24), ("2", 23), ("3", 199))
    }
    source = KIT(
        str(write_folder(tmp_path, motions, {"train": ["1", "2"], "val": ["3"], "test": []}, 251))
    )
    store = write_store(
        tmp_path / "store", source, HumanML("kit21", "legacy", fps=12.5, units_per_metre=640)
    )
    assert {clip.id: clip.split for clip in store.clips} == {
        "1": "train",
        "M1": "train",
        "3": "val",
        "M3": "val",
    }
    assert store.info["excluded"] == {"names in train shorter than 24 frames": 2}
    assert source.counts().keys() >= published("kit").keys()


@pytest.fixture
def mmm(tmp_path):
    return write_mmm(tmp_path)


def source(mmm, **options):
    return KITTemos(str(mmm), str(mmm.parent / "kit-splits"), **options)


def test_temos_motions_become_a_store(mmm, tmp_path):
    kit = source(mmm)
    store = write_store(tmp_path / "store", kit, Rifke())
    clips = {clip.id: clip for clip in store.clips}
    lengths = {"00001": 101, "00003": 10, "00006": 13, "00007": 2, "00008": 21}
    assert {name: clip.length for name, clip in clips.items()} == lengths
    assert kit.count() == len(clips)
    assert store.info["excluded"] == {
        "motions in train without a caption": 1,
        "motions in train shorter than 10 frames": 1,
        "motions in train longer than 500 frames": 1,
    }
    assert store.info["clips"] == {"train": 2, "val": 1, "test": 2}
    assert len(clips["00001"].captions) == 2
    assert clips["00008"].captions == ["A person walks in a circle."], (
        "the test split has the first caption alone"
    )
    assert (clips["00007"].attributes, clips["00008"].attributes) == (
        {"ghosh_test": False},
        {"ghosh_test": True},
    )
    expected = Rifke().encode(torch.from_numpy(kit_walk(801)[::8] / 640))
    np.testing.assert_allclose(store.motion(clips["00001"]), expected, atol=2e-3)
    training = np.concatenate(
        [store.motion(clip) for clip in store.clips if clip.split == "train"]
    ).astype(float)
    np.testing.assert_allclose(store.mean, training.mean(0), rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(
        store.std, np.where(training.std(0) > 0, training.std(0, ddof=1), 1), rtol=1e-6
    )
    assert kit.counts() == {
        "motions": 8,
        "texts": 14,
        "train": 5,
        "val": 1,
        "test": 2,
        "ghosh_test": 1,
    }
    assert kit.counts().keys() == published("kit-temos").keys()


def evaluated(mmm, out, protocol, *words):
    """Exit code of evaluating real motions on the prepared files, with their splits."""
    raw = [f"data.source.splits={mmm.parent / 'kit-splits'}", f"data_root={mmm.parent / 'data'}"]
    if not (mmm.parent / "data").exists():
        assert main(["prepare", "data=kit_temos", f"source={mmm}", *raw]) == 0
    return main(
        [
            "evaluate",
            "baseline=real",
            "data=kit_temos",
            *raw,
            f"protocol={protocol}",
            f"out={out}",
            *words,
        ]
    )


def test_the_protocol_compares_with_the_recordings_of_520_clips_at_100_fps(
    mmm, tmp_path, capsys, subtests
):
    out = tmp_path / "result.json"
    assert evaluated(mmm, out, "reconstruction_kit") == 0
    result = json.loads(out.read_text())
    assert (result["protocol"]["name"], result["protocol"]["version"]) == ("reconstruction_kit", 2)
    # Motion 00008 is the only clip in ghosh-test.
    recording = torch.from_numpy(kit_walk(161)).float().double()
    motion = Rifke().decode(Rifke().encode(recording[::8] / 640)) * 640
    times = np.arange(161) / 8
    joints = np.stack([np.interp(times, np.arange(21), x) for x in motion.flatten(1).numpy().T], 1)
    parts = [temos_parts(x) for x in (torch.from_numpy(joints.reshape(161, 21, 3)), recording)]
    apart = {
        name: (parts[0][name] - parts[1][name]).norm(dim=-1).mean().item() / 1000 for name in PARTS
    }
    assert 1e-4 < apart["root"] < 0.01
    for name, value in apart.items():
        for kind in ("values", "ground_truth"):
            with subtests.test(name=name, kind=kind):
                error = result[kind][f"temos/ape_{name}"]
                assert error["n"] == 1, "all 587 clips, of which 520 are compared"
                assert error["mean"] == pytest.approx(value, rel=0.02, abs=1e-6)
    assert evaluated(mmm, out, "reconstruction_kit", "split=val") == 1
    line = capsys.readouterr().err
    assert "the split has no clip with at least 1 frames and ghosh_test=True" in line
    assert "captions.csv" not in line, "the splits of a published data set are fixed"


@pytest.mark.slow
def test_stores_without_recordings_are_prepared_again(mmm, tmp_path, capsys):
    assert evaluated(mmm, tmp_path / "a.json", "reconstruction_kit") == 0
    store = Store(mmm.parent / "data" / "kit-temos-rifke")
    path = store.folder / "references.npz"
    path.write_bytes(path.read_bytes()[:-1])
    assert evaluated(mmm, tmp_path / "a.json", "reconstruction_kit") == 1
    assert "references.npz is damaged: its hash" in capsys.readouterr().err
    path.unlink()
    del store.info["sha256"]["references.npz"]
    (store.folder / "store.json").write_text(json.dumps(store.info))
    assert evaluated(mmm, tmp_path / "a.json", "reconstruction_kit") == 1
    assert "Prepare the data set again with force=true" in capsys.readouterr().err


@golden_case("temos64")
def test_every_eighth_frame_is_kept(stem, tmp_path):
    frames = int(golden(stem)["subsample/n_in"])
    rows = np.zeros((frames, 64))
    rows[:, 1:] = np.arange(frames)[:, None]
    np.savetxt(tmp_path / "1_fke.csv", rows, delimiter=",", header="head", comments="")
    kept = read_joints(tmp_path / "1_fke.csv")[:, 20, 2] * 640
    np.testing.assert_allclose(kept, golden(stem)["subsample/idx_100_to_12.5"], rtol=1e-6)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda f: (f / "00003_fke.csv").unlink(), r"00003_fke\.csv: no such file"),
        (
            lambda f: (f / "00001_annotations.json").write_text("[]"),
            r"does not match 00001_meta\.json",
        ),
        (
            lambda f: (f / "00001_fke.csv").write_text("head\n" + "a,b\n" * 99),
            r"00001_fke\.csv: damaged",
        ),
        (
            lambda f: np.savetxt(f / "00001_fke.csv", np.zeros((90, 63)), delimiter=","),
            r"63\), but each row must contain",
        ),
        (
            lambda f: np.savetxt(f / "00001_fke.csv", np.full((90, 64), math.nan), delimiter=","),
            "63 finite coordinates",
        ),
        (lambda f: shutil.rmtree(f.parent / "kit-splits"), r"kit-splits: not found; .*TEMOS"),
        (
            lambda f: (f.parent / "kit-splits/val").write_text("00001"),
            r"kit-splits/val: 00001 is also in train",
        ),
    ],
)
def test_a_damaged_folder_is_named(mmm, tmp_path, damage, message):
    damage(mmm)
    with pytest.raises((ValueError, FileNotFoundError), match=message) as error:
        write_store(tmp_path / "store", source(mmm), Rifke())
    assert "\n" not in str(error.value)


def test_limits_of_the_length_are_included_and_do_not_apply_to_the_test_split(mmm):
    kit = source(mmm)
    kit.frames = {"a": 9, "b": 10, "c": 500, "d": 501, "e": 9, "f": 501}
    names: dict[str, Split] = {name: "train" if name < "e" else "test" for name in kit.frames}
    kit.names = names
    assert [name for name in kit.frames if kit._fits(name)] == ["b", "c", "e", "f"]


@pytest.mark.parametrize(
    ("rows", "frames", "fits"),
    [(1, 1, False), (72, 9, False), (73, 10, True), (4000, 500, True), (4001, 501, False)],
)
def test_a_last_group_of_fewer_than_eight_rows_has_a_frame(tmp_path, rows, frames, fits):
    numbers = "1" + ",0" * 63 + "\n"
    (tmp_path / "1_fke.csv").write_text("head\n" + numbers * rows)
    kit = KITTemos(str(tmp_path), "")
    kit.texts, kit.names = {"1": ["walks"]}, {"1": "train"}
    assert kit.frames == {"1": frames}
    assert kit._fits("1") == fits
    if rows < 100:
        assert len(read_joints(tmp_path / "1_fke.csv")) == frames
