"""Where samples are written if no folder is given."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from flame_mdm.commands.sample import default_folder


def folder(experiment: Any, text: str = "a person walks", seed: int = 0, run: Any = "default", **options: Any) -> str:
    model: Any = SimpleNamespace(config={"experiment": experiment, "run": {"name": run}}, steps=3000)
    return default_folder(model, "f00d", text, seed, options).as_posix()


def test_requests_for_different_motions_share_no_folder():
    texts = ["a person walks", "A person walks", "a Person walks", "a person-walks", "a person  walks"]
    texts += ["a person_walks", "a per\u017fon walks", "A PERSON WALKS", "straße", "strasse", "a person walks."]
    texts += ["a person, walks", "🕺💃", "💃🕺", "人が歩く", "a" * 70, "a" * 71]
    names = [folder("a", text).casefold() for text in texts]  # as file systems that ignore case
    names += [folder("a", guidance_scale=scale) for scale in (-1, 1, 1.5)]
    names += [folder("a", frames=frames) for frames in ("in_between", [1, 2], [12])]
    names += [folder("a", sampler="ddim"), folder("a", seed=1), folder("a", run="b")]
    assert len(set(names)) == len(names)
    assert re.fullmatch(r"samples/humanml3d/mdm/a-person-walks-[0-9a-f]{6}", folder("humanml3d/mdm"))
    named = folder("a", "walks " * 20, 1, guidance_scale=2.5, sampler=None)
    assert re.fullmatch(r"samples/a/(walks-){6}walk-seed1-guidance_scale=2.5-[0-9a-f]{6}", named)


def test_no_checkpoint_leads_out_of_the_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["../../x", "/etc/x", "..", "a/../../../b", ".x", "a\0b", "~/x", "-/..", None, 3, "", "\\..\\x", ". ."]
    for name in names:
        path = Path(folder(name, "../../../etc passwd\0", 0, name, sampler="../../x", joints=["/a", ".."]))
        assert ".." not in path.parts
        assert "\0" not in str(path)
        assert path.resolve().is_relative_to(tmp_path / "samples")
