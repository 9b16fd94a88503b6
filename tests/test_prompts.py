"""Requests for samples: a file of prompts, a length per prompt, videos, and where motions are written."""

import importlib.util
import json
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.commands.sample import default_folder
from flame_mdm.errors import UserError
from flame_mdm.formats.readers import read

PROMPTS = ["a person walks", "a person jumps: 100%, twice", "人が歩く, waving"]


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def folders(root: Path) -> dict[str, Path]:
    """The folders of motions below a folder, by the caption of their first motion."""
    return {read(path).text: path.parent for path in sorted(root.rglob("motion_000.npz"))}


@pytest.mark.slow
def test_each_prompt_of_a_file_is_sampled_as_if_alone(here, trained, capsys):
    Path("p.txt").write_bytes(b"\xef\xbb\xbf" + "\r\n\r\n".join(f" {text} " for text in PROMPTS).encode())
    assert main(["sample", str(trained), "prompts=p.txt", "seconds=[1,1.5,1]", "samples=2"]) == 0
    lines = capsys.readouterr().out.splitlines()
    page = lines[-1].removeprefix("6 motions for 3 prompts, a folder for each: ")
    assert page == "samples/quickstart/p.html"
    assert all(json.dumps(text, ensure_ascii=True)[1:-1] in Path(page).read_text() for text in PROMPTS)
    assert "warning: 'a person jumps: 100%, twice': never seen in training: " in "\n".join(lines)
    together = folders(here / "samples")
    assert list(together) == sorted(PROMPTS, key=lambda text: together[text])
    text, kept = PROMPTS[1], {path.name for path in together[PROMPTS[1]].iterdir()}
    assert len(kept) == 5
    before = read(together[text] / "motion_001.npz")
    assert main(["sample", str(trained), f"text={text}", "seconds=1.5", "samples=2"]) == 0
    again = read(together[text] / "motion_001.npz")  # the same folder
    np.testing.assert_allclose(again.joints, before.joints, atol=1e-4)
    assert {path.name for path in together[text].iterdir()} == kept
    assert len(folders(here / "samples")) == 3


@pytest.mark.slow
def test_a_chosen_folder_gets_a_folder_per_prompt(here, trained):
    Path("p.txt").write_text("a person walks\na person jumps\na person walks\n")
    words = ["prompts=p.txt", "seconds=1", "samples=1", "trajectory=true", "out=mine"]
    assert main(["sample", str(trained), *words]) == 0
    jumps, walks, page = sorted(Path("mine").iterdir())
    assert [jumps.name[:-7], walks.name[:-7], page.name] == ["a-person-jumps", "a-person-walks", "p.html"]
    twice = [read(path) for path in sorted(walks.glob("motion_*.npz"))]
    assert len(twice) == 2
    assert np.abs(twice[0].joints - twice[1].joints).max() > 0.001
    assert [path.parent.name[:14] for path in Path("mine").rglob("trajectory.png")] == ["a-person-walks"]


def test_a_bad_request_is_one_line_and_writes_nothing(here, trained, capsys):
    for content, words, message in (
        (None, [], "prompts: p.txt: no such file"),
        (b" \n\t\r\n\n", [], "prompts: p.txt: no prompts. Write one per line"),
        (b"PK\x03\x04\xff\xfe\x00", [], "prompts: p.txt: not a UTF-8 text file"),
        (b"a\n" * 2**20, [], "prompts: p.txt: 2 MiB, but such a file may have at most 1 MiB"),
        (b"walks", ["text=jumps"], "text and prompts exclude each other. Give only one of them"),
        (b"walks\njumps", ["seconds=[1,2,3]"], "seconds=[1, 2, 3]: lengths: 3, prompts: 2. Give one length, or one"),
        (b"walks\njumps", ["seconds=[1,30]"], "30 seconds (600 frames) cannot be sampled"),
        (b"walks\n" + b"a" * 3000, [], "3,000 characters are too many"),
    ):
        Path("p.txt").unlink(missing_ok=True)
        if content is not None:
            Path("p.txt").write_bytes(content)
        assert main(["sample", str(trained), "prompts=p.txt", *words]) == 1
        captured = capsys.readouterr()
        assert message in captured.err
        assert captured.err.count("\n") == 1
        assert not Path("samples").exists()


def test_each_prompt_has_a_length_of_its_own(trained):
    model = flame_mdm.load(trained)
    motions = flame_mdm.generate(model, PROMPTS[:2], seconds=[1, 1.5], samples=2)
    assert [(m.text, len(m.joints)) for m in motions] == [(PROMPTS[0], 20)] * 2 + [(PROMPTS[1], 30)] * 2
    alone = flame_mdm.generate(model, PROMPTS[1], seconds=np.float32(1.5))[0]  # type: ignore[arg-type]
    np.testing.assert_allclose(motions[2].joints, alone.joints, atol=1e-4)
    assert [len(m.joints) for m in flame_mdm.generate(model, PROMPTS, frames=np.array([20, 21, 22]))] == [20, 21, 22]  # type: ignore[arg-type]
    for seconds, message in (
        ([1, 2], r"seconds=\[1, 2\]: lengths: 2, prompts: 1\. Give one length, or one per prompt"),
        ([], "lengths: 0, prompts: 1"),
        *((value, "is not a valid length") for value in ([[1]], ["x"], [float("nan")], 10**400, "3")),
    ):
        with pytest.raises(UserError, match=message):
            flame_mdm.generate(model, PROMPTS[0], seconds=seconds)  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_video_is_written_when_asked_for(here, trained, monkeypatch, capsys):
    words = ["sample", str(trained), "text=a person walks", "samples=2", "seconds=1", "out=out"]
    if importlib.util.find_spec("av"):
        assert main([*words, "mp4=true", "trajectory=true"]) == 0
        assert capsys.readouterr().out.rstrip().endswith("out/player.html, motions.gif, motions.mp4")
        assert b"ftyp" in Path("out/motions.mp4").read_bytes()[:12]
        Path("out/motion_1_of_mine.npz").touch()
        assert main(words) == 0
        assert {path.name for path in Path("out").iterdir()} == {
            *("motion_000.npz", "motion_001.npz", "motions.gif", "motions.png", "player.html"),
            "motion_1_of_mine.npz",
        }
    monkeypatch.setitem(sys.modules, "av", None)
    assert main([*words, "mp4=true", "out=other"]) == 1
    assert 'error: mp4=true: MP4 needs the package av. Run pip install "flame-mdm[video]"' in capsys.readouterr().err
    assert not Path("other").exists()


def folder(experiment: Any, text: str = "a person walks", **options: Any) -> str:
    model: Any = SimpleNamespace(config={"experiment": experiment})
    return default_folder(model, text, "f00d", options).as_posix()


def test_requests_for_different_motions_share_no_folder():
    texts = ["a person walks", "A person walks", "a Person walks", "a person-walks", "a person  walks"]
    texts += ["a person_walks", "a per\u017fon walks", "A PERSON WALKS", "straße", "strasse", "a person walks."]
    texts += ["a person, walks", "🕺💃", "💃🕺", "人が歩く", "a" * 70, "a" * 71]
    options: list[dict[str, Any]] = [{"guidance_scale": scale} for scale in (-1, 1, 1.5)]
    options += [{"frames": [1, 2]}, {"frames": [12]}, {"sampler": "ddim"}, {"seed": 1}]
    names = [folder("a", text).casefold() for text in texts]  # as file systems that ignore case
    names += [folder("a", **changed) for changed in options]
    assert len(set(names)) == len(names)
    assert re.fullmatch(r"samples/humanml3d/mdm/a-person-walks-[0-9a-f]{6}", folder("humanml3d/mdm"))
    assert re.fullmatch(r"samples/a/(walks-){6}walk-[0-9a-f]{6}", folder("a", "walks " * 20, seed=1))


def test_no_checkpoint_leads_out_of_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["../../x", "/etc/x", "..", "a/../../../b", ".x", "a\0b", "~/x", "-/..", None, 3, "", "\\..\\x", ". ."]
    for name in names:
        path = Path(folder(name, "../../../etc passwd\0", sampler="../../x", joints=["/a", ".."]))
        assert ".." not in path.parts
        assert "\0" not in str(path)
        assert path.resolve().is_relative_to(tmp_path / "samples")
