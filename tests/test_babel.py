"""FLAME's clips of BABEL, on folders in the layout of BABEL v1.0 and AMASS."""

import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import torch
from support.fixtures import Arrays, golden, golden_case
from support.stores import BABEL_FILES, label, sequence, small_babel, write_amass, write_babel

from flame_mdm.data.amass import read
from flame_mdm.data.babel import FPS, Babel, Label, Window, _starts
from flame_mdm.data.store import write_store
from flame_mdm.errors import UserError
from flame_mdm.representations.smpl import SMPL


def coded(folder: Path, rules: Arrays) -> Babel:
    """The coded motions and labels of the fixture as files."""

    def text(code: float) -> str:
        return "transition" if code == 999 else f"a{int(code)}"

    sequences: dict[str, dict] = {name: {} for name in BABEL_FILES}
    for file, part, frames, fps in rules["babel_files"].tolist():
        write_amass(folder / "amass" / f"CMU/subject/{file:03d}_poses.npz", frames, fps)
        rows = [row for row in rules["babel_labels"].tolist() if row[0] == file]
        labels = [
            label(text(row[4]), [text(c) for c in row[5:] if c >= 0] or None, row[2], row[3])
            for row in rows
        ]
        entry = sequence(
            f"CMU/subject/{file:03d}_poses.npz", labels, BABEL_FILES[part].startswith("extra")
        )
        sequences[BABEL_FILES[part]][str(file)] = entry
    return open_babel(
        write_babel(folder / "babel", sequences), folder / "amass", published_split=True
    )


def open_babel(babel: Path, amass: Path, published_split: bool = False) -> Babel:
    return Babel(str(babel), str(amass), published_split, workers=1)


def frames_of(amass: Path, key: str) -> np.ndarray:
    """(F, 75) of a motion of `small` or `coded`, decimated."""
    recording = read(amass / f"{key}.npz", key)
    motion = np.concatenate([recording.translation, recording.poses[:, :72]], 1)
    return motion[:: int(recording.fps / 20)].astype(np.float32)


def row_of(window: Window) -> list[int]:
    split = ("train", "val", "test").index(window.split)
    file = int(Path(window.label.motion).name[:3])
    return [split, int(window.id.split("_")[1]), file, window.start, int(window.label.text[1:])]


@pytest.fixture
def small(tmp_path: Path) -> tuple[Path, Path]:
    return small_babel(tmp_path)


@golden_case("rules")
def test_clips_are_those_of_flame(stem: str, tmp_path: Path, subtests):
    source = coded(tmp_path, golden(stem))
    rows = sorted(row_of(window) for window in source.windows)
    assert rows == sorted(golden(stem)["babel_clips"].tolist())
    clips = list(source.clips(FPS))
    assert source.count() == len(clips) == len(rows)
    for clip in clips[:: len(clips) // 5]:
        with subtests.test(clip=clip.id):
            motion = frames_of(tmp_path / "amass", clip.attributes["motion"])
            assert clip.window is not None
            first, length = clip.window
            np.testing.assert_array_equal(
                clip.motion[first : first + length], motion[first:][:length]
            )


def test_labels_become_texts_and_bad_ones_are_counted(small: tuple[Path, Path]):
    babel, amass = small
    source = open_babel(babel, amass)
    texts = [
        (w.label.text, w.start) for w in source.windows if w.label.motion.endswith("/01_01_poses")
    ]
    walks = [("walk", 0), ("walk", 10), ("walk", 20), ("walk", 30)]
    moves = [("move", start) for _, start in walks]
    assert sorted(texts) == sorted([*walks, *moves, ("step", 20), ("wave", 40)])
    assert "another annotator" not in {window.label.text for window in source.windows}
    assert source.excluded == {
        "transitions": 21,
        "labels that end before they start": 42,
        "labels without a time": 21,
        "labels too close to the end of the motion": 21,
        "labels that reach past the motion": 21,
        "labels without a frame": 21,
    }


def test_windows_share_the_frames_of_their_motions(small: tuple[Path, Path], tmp_path: Path):
    store = write_store(tmp_path / "store", open_babel(*small), SMPL())
    assert all(store.info["clips"].values())
    assert len(store.features) == 300 * 23 < sum(clip.length for clip in store.clips)
    assert store.info["excluded"]["transitions"] == 21
    assert {caption for clip in store.clips for caption in clip.captions} == {
        "walk",
        "move",
        "step",
        "wave",
    }
    clip = store.clips[-1]
    expected = SMPL().encode(torch.from_numpy(frames_of(small[1], clip.source)))
    start = clip.attributes["start"]
    np.testing.assert_allclose(store.motion(clip), expected[start : start + 128].numpy(), atol=1e-6)


def test_the_official_training_set_stays_whole_and_val_is_divided_by_motion(tmp_path: Path):
    names = [f"CMU/{k:02d}/{k:02d}_01_poses.npz" for k in range(60)]
    for name in names:
        write_amass(tmp_path / "amass" / name, 300, 20.0)
    labels, sequences = [label("walk", ["walk"], 0.0, 8.0)], {}
    parts = (names[:20], names[20:24], [*names[24:52], names[3]], names[52:])
    for part, listed in zip(BABEL_FILES, parts, strict=True):
        sequences[part] = {
            name: sequence(name, labels, part.startswith("extra")) for name in listed
        }
    source = open_babel(write_babel(tmp_path / "babel", sequences), tmp_path / "amass")
    assert all(
        (window.split == "train") == window.id.startswith("train") for window in source.windows
    )
    splits = {window.label.motion: window.split for window in source.windows}
    assert Counter(splits.values()) == {"train": 24, "val": 28, "test": 8}
    assert len({(window.label.motion, window.split) for window in source.windows}) == 60, (
        "a motion in two splits"
    )
    assert source.excluded == {"labels in the val part for motions in the train part": 1}
    flames = Counter(
        w.split for w in open_babel(tmp_path / "babel", tmp_path / "amass", True).windows
    )
    assert flames["val"] + flames["test"] == 4 * 37


def test_absent_and_damaged_files_are_named(small: tuple[Path, Path], subtests):
    path = small[1] / "CMU/03/03_01_poses.npz"
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"03_01_poses\.npz: damaged"):
        open_babel(*small).count()
    shutil.rmtree(small[1] / "CMU/03")
    with pytest.raises(
        FileNotFoundError, match=r"CMU: 1 of 23 recordings are missing, such as CMU/03/03_01_poses"
    ):
        open_babel(*small).count()
    with pytest.raises(FileNotFoundError, match=r"register at https://amass"):
        open_babel(small[0], small[0] / "none").count()
    for content, message in (
        ("{", r"val\.json: not a JSON file"),
        ("[1]", r"val\.json: not in the layout of BABEL"),
        ('{"1": {"feat_p": "a/b"}}', r"val\.json: not in the layout of BABEL v1\.0: 'frame_ann'"),
    ):
        with subtests.test(content=content, message=message):
            (small[0] / "val.json").write_text(content)
            with pytest.raises(UserError, match=message):
                open_babel(*small).count()
    (small[0] / "val.json").unlink()
    with pytest.raises(FileNotFoundError, match=r"BABEL v1\.0 is published at"):
        open_babel(*small).count()


@pytest.mark.parametrize(
    ("start", "end", "frames", "starts"),
    [
        *((0.0, 6.45, 129, [0]), (0.0, 6.45, 128, []), (0.0, 6.5, 130, [0])),
        *((0.0, 6.95, 139, [0, 10]), (0.0, 6.94, 200, [0]), (0.0, 7.0, 140, [0, 10])),
        *((1.09, 8.05, 161, [21, 31]), (1.05, 8.6, 172, [21, 31, 41]), (1.05, 8.6, 171, [])),
        *((2.0, 2.1, 300, [40]), (2.0, 2.05, 300, []), (2.0, 2.1, 168, []), (-0.1, 9.0, 300, [])),
        *((None, 9.0, 300, []), (0.0, None, 300, []), (3.0, 2.0, 300, [])),
    ],
)
def test_a_label_has_a_clip_every_ten_frames(start, end, frames: int, starts: list[int]):
    drawn, reason = _starts(Label("CMU/a", "walk", start, end, "words"), frames)
    assert list(drawn) == starts
    assert bool(reason) == (not starts)
    assert not _starts(Label("CMU/a", "transition", start, end, "words"), frames)[0]
