"""The command that prepares and verifies data sets: reports, misuse, interruption, the same result on any machine."""

import gc
import hashlib
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from multiprocessing import active_children
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.runs import TINY, no_children
from support.stores import (
    TAKES,
    line,
    small_babel,
    synthetic_take,
    write_folder,
    write_humanact12,
    write_uestc,
)
from test_humanml3d import downloads  # noqa: F401  a fixture
from test_kit import mmm  # noqa: F401  a fixture

from flame_mdm.__main__ import main
from flame_mdm.config import EXPERIMENTS, compose, instantiate
from flame_mdm.data import Clip
from flame_mdm.data.bandai import Bandai, split_of
from flame_mdm.data.store import Store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats import bvh

SYNTHETIC = ("data=synthetic", "data.source.clips=30")


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in the layout of Bandai-Namco's."""
    folder = tmp_path_factory.mktemp("takes")
    held_out = next(number for number in range(1, 33) if split_of(2, "walk", "active", number) == "val")
    for seed, (name, frames) in enumerate([*TAKES.items(), (f"dataset-2_walk_active_{held_out:03d}", 45)]):
        bvh.write(synthetic_take(seed, frames), folder / f"{name}.bvh")
    return folder


@pytest.fixture(scope="module")
def fingerprint(takes: Path, tmp_path_factory: pytest.TempPathFactory) -> str:
    """Of the takes prepared without a break by one process."""
    root = tmp_path_factory.mktemp("whole")
    assert main(["prepare", "data=bandai", f"source={takes}", "data.source.workers=1", f"data_root={root}"]) == 0
    return only_store(root).fingerprint


def only_store(root: Path) -> Store:
    """The one store under a data root, beside which nothing stands."""
    (folder,) = root.iterdir()
    return Store(folder)


def humanml(root: Path, width: int = 263) -> Path:
    motions = {name: (frames, [line(f"a person walks {name}")]) for name, frames in {"a": 50, "b": 60, "c": 70}.items()}
    return write_folder(root, motions, {"train": ["a"], "val": ["b"], "test": ["c"]}, width)


def test_verify_reports_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    root = tmp_path / "data"
    assert main(["prepare", *SYNTHETIC, f"data_root={root}"]) == 0
    store = only_store(root)
    capsys.readouterr()
    assert main(["prepare", *SYNTHETIC, f"data_root={root}", "verify=true"]) == 0
    output = capsys.readouterr().out
    report = json.loads((store.folder / "verify.json").read_text())
    assert not (store.folder / "verify.partial").exists()
    assert report["fingerprint"] == store.fingerprint
    assert store.fingerprint in output
    assert report["files"] == store.info["sha256"]
    for split, number in store.info["clips"].items():
        assert report["figures"][split] == {"found": number, "published": None, "state": "not published"}
    texts = {caption for clip in store.clips for caption in clip.captions}
    assert report["captions"]["different captions"] == len(texts)
    assert 20 < report["captions"]["different words"] < len(" ".join(texts).split())
    assert sum(sum(splits.values()) for splits in report["actions"].values()) == len(store.clips) == 30
    assert report["frames"]["shortest clip"] == min(clip.length for clip in store.clips)
    assert report["frames"]["clips below the 24 frames that cropping needs"] == 0
    assert report["still"] == report["duplicates"] == []
    assert max(report["statistics"].values()) < 1e-4
    figures = output.splitlines()[output.splitlines().index("") + 1 :][:5]
    assert len({row.index(word) for row, word in zip(figures[1:], ["-"] * 4, strict=True)}) == 1, "columns are aligned"
    assert main(["prepare", *SYNTHETIC, f"data_root={root}", "verify=true"]) == 0, (
        "the report itself is not part of the store"
    )


def test_differences_from_published_figures_are_loud_but_not_fatal(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    folder = humanml(tmp_path / "HumanML3D")
    words = ["data=humanml3d", f"source={folder}", f"data_root={tmp_path / 'data'}"]
    assert main(["prepare", *words]) == 0
    assert main(["prepare", *words, "verify=true"]) == 0
    output = capsys.readouterr().out
    assert "DIFFERS from the published figures:\n  motions: 3 found, 14,616 published (-14,613, -99.98%)\n" in output
    assert "  vocabulary: 5 found, 5,371 published (-5,366, -99.91%)" in output
    assert "  words per caption: 4.0 found, 12 published (-8, -66.67%)" in output
    assert "  train share, %: 33.33 found, 80 published (-46.67, -58.34%)" in output
    report = json.loads((only_store(tmp_path / "data").folder / "verify.json").read_text())
    assert report["figures"]["motions"] == {"found": 3, "published": 14616, "state": "differs"}
    frames = np.load(folder / "new_joint_vecs" / "a.npy")[:, 0], np.load(folder / "new_joint_vecs" / "Ma.npy")[:, 0]
    mean = np.concatenate(frames).mean()
    given = np.load(folder / "Mean.npy")
    off = np.abs(given - mean).max() / np.concatenate(frames).std()
    assert report["statistics"]["largest difference of a mean, in std"] == pytest.approx(off, rel=1e-3)


def test_still_clips_duplicates_and_short_clips_are_listed(tmp_path: Path):
    folder = tmp_path / "own"
    folder.mkdir()
    walk = next(clip for clip in Synthetic(clips=30).clips(20.0) if clip.attributes["action"] == "walk").motion
    for name, motion in {"a": walk, "b": walk, "c": np.tile(walk[:1], (40, 1, 1)), "d": walk[5:20]}.items():
        np.savez(folder / f"{name}.npz", joints=motion, fps=20)
    rows = [f"{name},a person,{split}" for name, split in zip("abcd", ("train", "test", "train", "val"), strict=True)]
    (folder / "captions.csv").write_text("\n".join(["id,text,split", *rows]) + "\n")
    words = ["data=folder", f"source={folder}", f"data_root={tmp_path / 'data'}"]
    assert main(["prepare", *words]) == 0
    assert main(["prepare", *words, "verify=true"]) == 0
    report = json.loads((only_store(tmp_path / "data").folder / "verify.json").read_text())
    assert report["still"] == ["c"]
    assert report["duplicates"] == [["a", "b"]]
    assert report["duplicates_across_splits"] == 1
    assert report["frames"]["clips below the 24 frames that cropping needs"] == 1


def resealed(store: Store, change: Callable[[Path], None]) -> Store:
    """The store with changed files, and hashes that fit them."""
    change(store.folder)
    info = store.info
    info["sha256"] = {name: hashlib.sha256((store.folder / name).read_bytes()).hexdigest() for name in info["sha256"]}
    (store.folder / "store.json").write_text(json.dumps(info))
    return Store(store.folder)


def test_numbers_that_are_not_finite_are_damage(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    words = [*SYNTHETIC, f"data_root={tmp_path}"]
    assert main(["prepare", *words]) == 0
    store = only_store(tmp_path)
    clip = store.clips[7]

    def spoil(folder: Path) -> None:
        features = np.load(folder / "features.npy", mmap_mode="r+")
        features[clip.start + 3, 5] = np.nan
        features.flush()

    resealed(store, spoil)
    assert main(["prepare", *words, "verify=true"]) == 1
    assert f"frame 3 of clip {clip.id} is not finite" in capsys.readouterr().err


LARGE = """
import sys, pathlib, numpy as np
from flame_mdm.data import Clip, MotionSource
from flame_mdm.data.store import write_store
from flame_mdm.representations.humanml import HumanML

class Large(MotionSource):
    name = "large"
    def count(self):
        return 4000
    def clips(self, fps):
        for number in range(4000):
            motion = np.random.default_rng(number).normal(size=(100, 263)).astype(np.float32)
            yield Clip(f"{number}", motion, ["a person walks"], "train", f"{number}", encoded="humanml-clean-smpl22")

write_store(pathlib.Path(sys.argv[1], "large"), Large(), HumanML())
# Not ru_maxrss, which a process inherits from the one that started it.
print(next(line.split()[1] for line in open('/proc/self/status') if line.startswith('VmHWM:')))
"""


@pytest.mark.slow
def test_frames_are_not_kept_in_memory(tmp_path: Path):
    """400,000 frames, which have 420 MB, are prepared in less than 800 MB, of which PyTorch takes 330."""
    process = subprocess.run([sys.executable, "-c", LARGE, tmp_path], capture_output=True, text=True, check=True)
    assert int(process.stdout) < 800_000


@pytest.mark.slow
@pytest.mark.parametrize(("how", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_an_interrupted_preparation_leaves_nothing(
    how: signal.Signals, code: int, takes: Path, fingerprint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    root = tmp_path / "data"
    words = ["data=bandai", f"source={takes}", f"data_root={root}"]
    clips = 0
    make = Bandai._clip

    def interrupted(self: Bandai, *arguments: Any, **options: Any) -> Clip:
        nonlocal clips
        clips += 1
        if clips == 5:
            os.kill(os.getpid(), how)
        return make(self, *arguments, **options)

    gc.collect()  # readers that other tests left open end their processes
    before = signal.getsignal(signal.SIGTERM)
    earlier = active_children()
    ignored = signal.signal(signal.SIGINT, signal.default_int_handler)  # it is, where the tests run in the background
    with monkeypatch.context() as patch:
        patch.setattr(Bandai, "_clip", interrupted)
        assert main(["prepare", *words, "data.source.workers=2"]) == code
    signal.signal(signal.SIGINT, ignored)
    assert not root.exists()
    assert no_children(earlier)
    assert signal.getsignal(signal.SIGTERM) is before
    assert main(["prepare", *words, "data.source.workers=1"]) == 0
    assert only_store(root).fingerprint == fingerprint


WHERE = {
    "babel": "babel.is.tue.mpg.de",
    "bandai": "github.com/BandaiNamcoResearchInc",
    "folder": "give a folder of .bvh, .npz, .npy, .json files",
    "humanact12": "github.com/Mathux/ACTOR",
    "humanml3d": "github.com/EricGuo5513/HumanML3D",
    "humanml3d_smpl": "github.com/EricGuo5513/HumanML3D",
    "kit": "github.com/EricGuo5513/HumanML3D",
    "kit_temos": "github.com/Mathux/TEMOS",
    "uestc": "github.com/Mathux/ACTOR",
}


def test_every_set_is_covered_here():
    sets = {path.stem for path in (EXPERIMENTS / "data").glob("*.yaml")}
    assert sets == {*WHERE, "synthetic", "humanact12_unconstrained", "bandai_compositional"}


@pytest.mark.parametrize("data", WHERE)
def test_a_missing_source_says_where_to_get_the_set(data: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    for words in ([], [f"source={tmp_path / 'nowhere'}"]):
        assert main(["prepare", f"data={data}", f"data_root={tmp_path / 'data'}", *words]) == 1
        (message,) = capsys.readouterr().err.splitlines()
        assert message.startswith("error: ")
        assert WHERE[data] in message
    assert not any((tmp_path / "data").glob("*"))


@pytest.mark.parametrize("data", sorted({*WHERE} - {"folder", "bandai"}))
def test_another_set_as_source_is_refused(data: str, takes: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert main(["prepare", f"data={data}", f"source={takes}", f"data_root={tmp_path / 'data'}"]) == 1
    (message,) = capsys.readouterr().err.splitlines()
    assert str(takes) in message or data == "kit_temos"
    assert not any((tmp_path / "data").glob("*"))


def words_of(data: str, request: pytest.FixtureRequest, tmp_path: Path) -> list[str]:
    """What names a small generated set on the command line."""
    if data == "bandai":
        return [f"source={request.getfixturevalue('takes')}"]
    if data in ("humanml3d", "kit"):
        return [f"source={humanml(tmp_path / 'set', 263 if data == 'humanml3d' else 251)}"]
    if data == "humanml3d_smpl":
        root = request.getfixturevalue("downloads")
        return [
            f"source={root / 'HumanML3D/HumanML3D'}",
            f"data.source.amass={root / 'amass'}",
            "data.source.workers=1",
        ]
    if data == "kit_temos":
        path = request.getfixturevalue("mmm")
        return [f"source={path}", f"data.source.splits={path.parent / 'kit-splits'}"]
    if data == "babel":
        path, amass = small_babel(tmp_path)
        return [f"source={path}", f"data.source.amass={amass}", "data.source.workers=1"]
    if data == "humanact12":
        return [f"source={write_humanact12(tmp_path / 'set')}"]
    return [f"source={write_uestc(tmp_path / 'set')}"]


@pytest.mark.slow
@pytest.mark.parametrize("data", sorted({*WHERE} - {"folder"}))  # own data goes this way in the tests of its tutorial
def test_every_set_from_raw_files_to_a_training_step(data: str, request: pytest.FixtureRequest, tmp_path: Path):
    root = f"data_root={tmp_path / 'data'}"
    words = [f"data={data}", root, *words_of(data, request, tmp_path)]
    assert main(["prepare", *words]) == 0
    assert main(["prepare", *words, "verify=true"]) == 0
    store = only_store(tmp_path / "data")

    condition = "action" if data in ("humanact12", "uestc") else "learned"
    tiny = [word for word in TINY if "clips" not in word and "samples" not in word and "features" not in word]
    few = [
        "data.batch_size=4",
        "data.num_workers=0",
        "trainer.max_steps=1",
        "callbacks.samples=null",
        f"condition={condition}",
    ]
    recipe = [f"data={data}", root, *tiny, *few, f"run.dir={tmp_path / 'run'}"]
    config = compose("quickstart", recipe)
    module = instantiate(config["data"], representation=instantiate(config["representation"]))
    module.setup("fit")
    batch = next(iter(module.train_dataloader()))
    places = {clip.id: number for number, clip in enumerate(module.train.clips)}
    for number, name in enumerate(batch.ids):
        clip = module.train.clips[places[name]]
        (first,), (drawn,), _ = module.train.draw([places[name]], 0)
        frames = np.minimum(first + np.arange(drawn), clip.length - 1)
        length = int(batch.mask[number].sum())
        assert clip.split == "train"
        assert length == len(frames) <= module.crop.longest()
        assert set(np.diff(frames)) <= {0, 1}
        wanted = module.representation.rebase(np.array(store.motion(clip)[frames]))
        found = batch.x[number, :length].numpy() * store.std + store.mean
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-3)
        assert (batch.x[number, length:] == 0).all()
        if batch.text is not None:
            assert batch.text[number] in clip.captions
        if batch.action is not None:
            assert batch.action[number] == clip.action
    assert (batch.action if condition == "action" else batch.text) is not None

    assert main(["train", "quickstart", *recipe]) == 0
    assert (tmp_path / "run" / "checkpoints" / "last.ckpt").is_file()
