"""The command that prepares and verifies data sets: reports, memory, misuse."""

import json
import re
from hashlib import sha256
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.runs import TINY
from support.stores import (
    TAKES,
    OwnClips,
    clip,
    line,
    small_babel,
    synthetic_take,
    write_downloads,
    write_folder,
    write_humanact12,
    write_mmm,
    write_uestc,
)

from flame_mdm.__main__ import main
from flame_mdm.config import EXPERIMENTS
from flame_mdm.data import verify
from flame_mdm.data.bandai import split_of
from flame_mdm.data.store import Entry, Store, write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats import bvh
from flame_mdm.representations.humanml import HumanML

SYNTHETIC = ("data=synthetic", "data.source.clips=30")


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in the layout of Bandai-Namco's."""
    folder = tmp_path_factory.mktemp("takes")
    held_out = next(
        number for number in range(1, 33) if split_of(2, "walk", "active", number) == "val"
    )
    for seed, (name, frames) in enumerate(
        [*TAKES.items(), (f"dataset-2_walk_active_{held_out:03d}", 45)]
    ):
        bvh.write(synthetic_take(seed, frames), folder / f"{name}.bvh")
    return folder


def prepared(root: Path, *words: str) -> Store:
    """The one store under a data root."""
    assert main(["prepare", *words, f"data_root={root}"]) == 0
    (folder,) = root.iterdir()
    return Store(folder)


def verified(root: Path, *words: str) -> dict:
    store = prepared(root, *words)
    assert prepared(root, *words, "verify=true").fingerprint == store.fingerprint
    return json.loads((store.folder / "verify.json").read_text())


def humanml(root: Path, width: int = 263) -> Path:
    motions = {
        name: (frames, [line(f"a person walks {name}")])
        for name, frames in {"a": 50, "b": 60, "c": 70}.items()
    }
    return write_folder(root, motions, {"train": ["a"], "val": ["b"], "test": ["c"]}, width)


def test_verify_reports_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str], subtests):
    report = verified(tmp_path, *SYNTHETIC)
    assert f"fingerprint: {report['fingerprint']}" in capsys.readouterr().out
    store = prepared(tmp_path, *SYNTHETIC)
    assert (report["fingerprint"], report["files"]) == (store.fingerprint, store.info["sha256"])
    for split, number in store.info["clips"].items():
        with subtests.test(split=split):
            assert report["figures"][split] == {
                "found": number,
                "published": None,
                "state": "not published",
            }
    texts = {caption for clip in store.clips for caption in clip.captions}
    assert report["captions"]["different captions"] == len(texts)
    assert 20 < report["captions"]["different words"] < len(" ".join(texts).split())
    assert (
        sum(sum(splits.values()) for splits in report["actions"].values()) == len(store.clips) == 30
    )
    assert report["frames"]["shortest clip"] == min(clip.length for clip in store.clips)
    assert report["still"] == report["duplicates"] == []
    assert max(report["statistics"].values()) < 1e-4
    assert verified(tmp_path, *SYNTHETIC) == report, "the report itself is not part of the store"


def test_differences_from_published_figures_are_loud_but_not_fatal(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    folder = humanml(tmp_path / "HumanML3D")
    report = verified(tmp_path / "data", "data=humanml3d", f"source={folder}")
    output = capsys.readouterr().out
    assert (
        "DIFFERS from the published numbers:\n  motions: 3 found, 14,616 published (-14,613, -99.98%)\n"
        in output
    )
    assert "  words per caption: 4.0 found, 12 published (-8, -66.67%)" in output
    assert report["figures"]["motions"] == {"found": 3, "published": 14616, "state": "differs"}
    frames = np.concatenate(
        [np.load(folder / "new_joint_vecs" / f"{name}.npy")[:, 0] for name in ("a", "Ma")]
    )
    off = np.abs(np.load(folder / "Mean.npy") - frames.mean()).max() / frames.std()
    assert report["statistics"]["largest difference of a mean, in std"] == pytest.approx(
        off, rel=1e-3
    )


def test_still_clips_duplicates_and_short_clips_are_listed(tmp_path: Path):
    folder = tmp_path / "own"
    folder.mkdir()
    walk = next(
        clip for clip in Synthetic(clips=30).clips(20.0) if clip.attributes["action"] == "walk"
    ).motion
    for name, motion in {
        "a": walk,
        "b": walk,
        "c": np.tile(walk[:1], (40, 1, 1)),
        "d": walk[5:20],
        # 1.5 cm from the first frame, but less than 1 cm from the mean
        "e": walk[:1] + np.linspace([[0.0, 0, 0]], [[0.015, 0, 0]], 40),
    }.items():
        np.savez(folder / f"{name}.npz", joints=motion, fps=20)
    (folder / "captions.csv").write_text(
        "id,text,split\na,walk,train\nb,walk,test\nc,stand,train\nd,walk,val\ne,stand,train\n"
    )
    report = verified(tmp_path / "data", "data=folder", f"source={folder}")
    anomalies = [report[key] for key in ("still", "duplicates", "duplicates_across_splits")]
    assert anomalies == [["c"], [["a", "b"]], 1]
    assert report["frames"]["clips below the 24 frames that cropping needs"] == 1


def test_numbers_that_are_not_finite_are_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    store = prepared(tmp_path, *SYNTHETIC)
    entry, file = store.clips[7], store.folder / "features.npy"
    features = np.load(file)
    features[entry.start + 3, 5] = np.nan
    np.save(file, features)
    # Somebody who changes the features may also change their hash.
    store.info["sha256"]["features.npy"] = sha256(file.read_bytes()).hexdigest()
    (store.folder / "store.json").write_text(json.dumps(store.info))
    assert main(["prepare", *SYNTHETIC, f"data_root={tmp_path}", "verify=true"]) == 1
    assert f"frame 3 of clip {entry.id} contains NaN or infinite values" in capsys.readouterr().err


class Large(OwnClips):  # 400,000 frames, which have 420 MB
    def clips(self, fps):
        noise = np.random.default_rng(0).normal(size=(100, 263)).astype(np.float32)
        for number in range(4000):
            yield clip(f"{number}", motion=noise + number % 7, encoded="humanml-clean-smpl22")


def kilobytes(kind: str) -> int:
    """Memory of this process: VmRSS, now, or VmHWM, the peak."""
    return int(re.findall(rf"{kind}:\s+(\d+) kB", Path("/proc/self/status").read_text())[0])


@pytest.mark.slow
def test_frames_are_not_kept_in_memory(tmp_path: Path):
    Path("/proc/self/clear_refs").write_text("5")  # forgets the peak
    before = kilobytes("VmRSS")
    write_store(tmp_path / "large", Large(), HumanML())
    assert kilobytes("VmHWM") - before < 400_000


WHERE = {
    **{"babel": "babel.is.tue.mpg.de", "kit_temos": "github.com/Mathux/TEMOS"},
    **{
        "bandai": "github.com/BandaiNamcoResearchInc",
        "cmu": "clone https://github.com/una-dinosauria/cmu-mocap",
    },
    **dict.fromkeys(("humanact12", "uestc"), "github.com/Mathux/ACTOR"),
    **dict.fromkeys(("humanml3d", "humanml3d_smpl", "kit"), "github.com/EricGuo5513/HumanML3D"),
    "folder": "Use a folder of .npz, .bvh, .fbx, .glb, .vrm, .vrma, .amc, .json, .npy files",
}


@pytest.mark.slow
def test_a_missing_source_or_another_set_is_refused_with_where_to_get_it(
    takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], subtests
):
    sets = {path.stem for path in (EXPERIMENTS / "data").glob("*.yaml")}
    assert sets == {
        *WHERE,
        "synthetic",
        "package",
        "package_dip",
        "humanact12_unconstrained",
        "bandai_compositional",
    }
    cases = [(data, [], where) for data, where in WHERE.items()]
    others = WHERE.keys() - {"folder", "bandai"}
    cases += [
        (data, [f"source={takes}"], "" if data == "kit_temos" else str(takes))
        for data in sorted(others)
    ]
    for data, words, expected in cases:
        with subtests.test(data=data, expected=expected):
            assert (
                main(["prepare", f"data={data}", f"data_root={tmp_path / 'data'}", *words]) == 1
            ), (
                data,
                words,
            )
            message = capsys.readouterr().err
            assert re.fullmatch(rf"error: .*{re.escape(expected)}.*\n", message), (
                data,
                words,
                message,
            )
    assert not any((tmp_path / "data").glob("*"))


def words_of(data: str, takes: Path, root: Path) -> list[str]:
    """Command-line options of a small generated set whose parts are read by one process."""
    if data == "bandai":
        return [f"source={takes}", "data.source.workers=1"]
    if data in ("humanml3d", "kit"):
        return [f"source={humanml(root / 'set', 263 if data == 'humanml3d' else 251)}"]
    if data == "humanml3d_smpl":
        write_downloads(root)
        source = f"source={root / 'HumanML3D/HumanML3D'}"
        return [source, f"data.source.amass={root / 'amass'}", "data.source.workers=1"]
    if data == "kit_temos":
        return [f"source={write_mmm(root)}", f"data.source.splits={root / 'kit-splits'}"]
    if data == "babel":
        path, amass = small_babel(root)
        return [f"source={path}", f"data.source.amass={amass}", "data.source.workers=1"]
    return [f"source={(write_humanact12 if data == 'humanact12' else write_uestc)(root / 'set')}"]


@pytest.mark.slow
@pytest.mark.parametrize("data", sorted({*WHERE} - {"folder", "cmu"}))  # their own tests do so
def test_every_set_from_raw_files_to_a_training_step(data: str, takes: Path, tmp_path: Path):
    verified(tmp_path / "data", f"data={data}", *words_of(data, takes, tmp_path))
    condition = "action" if data in ("humanact12", "uestc") else "learned"
    tiny = [
        word for word in TINY if not any(part in word for part in ("clips", "samples", "condition"))
    ]
    few = [
        "data.batch_size=4",
        "data.num_workers=0",
        "trainer.max_steps=1",
        "callbacks.samples=null",
    ]
    recipe = [
        f"data={data}",
        *tiny,
        *few,
        f"condition={condition}",
        f"data_root={tmp_path / 'data'}",
    ]
    assert main(["train", "quickstart", *recipe, f"run.dir={tmp_path / 'run'}"]) == 0
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()


def test_figures_are_compared_within_the_rounding_of_the_published_ones(monkeypatch):
    published = {"set": {"clips": 9, "words": [12, 0.5], "hours": [3, 0.1], "takes": 7}}
    monkeypatch.setattr(verify, "read_package_yaml", lambda path: published)
    actions = {"train": (0, 0, 0, 1), "val": (1, 1), "test": (1, 1, 1)}
    clips = [
        SimpleNamespace(action=action, split=split)
        for split, numbers in actions.items()
        for action in numbers
    ]
    splits = {split: len(numbers) for split, numbers in actions.items()}
    store: Any = SimpleNamespace(
        clips=clips,
        info={
            "dataset": "set",
            "clips": splits,
            "counts": {"words": 12.5, "hours": 3.11, "val": 8},
        },
    )
    figures = verify._figures(store)
    assert {
        name: figure["state"] for name, figure in figures.items() if name in published["set"]
    } == {
        "clips": "ok",
        "words": "ok",
        "hours": "differs",
        "takes": "not counted",
    }
    counted = {name: figure["found"] for name, figure in figures.items()}
    assert counted == {
        **{"clips": 9, "words": 12.5, "hours": 3.11, "takes": None, "actions": 2},
        **{"train": 4, "val": 8, "val of the store": 2, "test": 3},
        **{"fewest clips per action": 3, "most clips per action": 6},
        **{"fewest training clips per action": 3, "most training clips per action": 3},
    }


def test_a_report_describes_the_lengths_captions_and_actions_of_the_clips(tmp_path: Path):
    draw = np.random.default_rng(0)
    facts = [(10, "train", 0), (20, "train", 1), (30, "val", 1), (45, "test", None)]
    clips = [
        clip(
            f"{frames}",
            split,
            motion=draw.normal(2, 3, (frames, 263)).astype(np.float32),
            encoded="humanml-clean-smpl22",
            action=action,
        )
        for frames, split, action in facts
    ]
    clips[0].captions = ["A person walks", "he  walks"]
    clips[1].captions = ["A person walks"]
    clips[2].captions = []
    clips[3].captions = ["walks, walks"]
    source = OwnClips(*clips)
    source.actions = ("walk", "sit")
    training = np.concatenate([clip.motion for clip in clips[:2]])
    mean, std = HumanML().statistics(torch.from_numpy(training))
    source.statistics = lambda: ((mean - 0.25 * std).numpy(), (3 * std).numpy())
    store = write_store(tmp_path / "store", source, HumanML())
    crop = SimpleNamespace(min_frames=20)
    data: Any = SimpleNamespace(open=lambda: store, crop=crop, representation=HumanML())
    report = verify.report(data)
    assert report == json.loads((store.folder / "verify.json").read_text())
    assert report["frames"] == {
        **{"frames": 105, "features": 263, "shortest clip": 10, "median clip": 25.0},
        **{"longest clip": 45, "clips below the 20 frames that cropping needs": 1},
    }
    assert report["captions"] == {
        **{"captions": 4, "different captions": 3, "different words": 4},
        "clips without a caption": 1,
    }
    assert report["actions"] == {
        "walk": {"train": 1, "val": 0, "test": 0},
        "sit": {"train": 1, "val": 1, "test": 0},
    }
    assert report["statistics"] == pytest.approx(
        {"largest difference of a mean, in std": 0.25, "largest relative difference of a std": 2},
        rel=1e-4,
    )


def test_a_clip_is_still_if_no_joint_moves_by_a_centimeter_from_its_first_position():
    paths = {
        "moves": [0.0, 0.0, 0.011, 0.0],
        "trembles": [0.0, 0.009, -0.009, 0.009],
        "stands": [0.5] * 4,
        "drifts": [0.0, 0.004, 0.008, 0.012],
    }
    joints = np.zeros((16, 2, 3), np.float32)
    joints[:, 1, 0] = np.concatenate(list(paths.values()))
    clips = [Entry(name, 4 * n, 4, "train", name, [], None) for n, name in enumerate(paths)]
    clips.append(Entry("copy", 8, 4, "train", "copy", [], None))
    store: Any = SimpleNamespace(
        clips=clips, folder=Path("x"), motion=lambda clip: features[clip.start :][: clip.length]
    )
    features = joints.reshape(16, 6)
    representation: Any = SimpleNamespace(decode=lambda x: x.unflatten(-1, (2, 3)))
    still, duplicates = verify._anomalies(store, representation)
    assert [clip.id for clip in still] == ["trembles", "stands", "copy"]
    assert duplicates == []
    joints[8:12] = joints[4:8]
    _, duplicates = verify._anomalies(store, representation)
    assert [[clip.id for clip in group] for group in duplicates] == [["trembles", "stands"]]
