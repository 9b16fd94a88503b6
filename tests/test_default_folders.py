"""Where samples go when nobody says where."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from support.runs import TINY

from flame_mdm.__main__ import main
from flame_mdm.commands.sample import default_folder

pytestmark = pytest.mark.slow


def folder(
    experiment: Any,
    what: str = "a person walks",
    seed: int = 0,
    run: Any = "default",
    digest: str = "f00d",
    **options: Any,
) -> str:
    model: Any = SimpleNamespace(config={"experiment": experiment, "run": {"name": run}}, steps=3000)
    return default_folder(model, digest, what, seed, options).as_posix()


def test_prompts_share_no_folder_even_if_the_file_system_ignores_case():
    texts = [
        "a person walks",
        "A person walks",
        "a Person walks",
        "a person-walks",
        "a person  walks",
        "a person_walks",
    ]
    texts += ["a per\u017fon walks", "A PERSON WALKS", "straße", "strasse"]
    assert len({folder("a", text).casefold() for text in texts}) == len(texts)


def test_other_options_are_another_folder():
    assert folder("humanml3d/mdm") == "samples/humanml3d/mdm/default-step3000-f00d/a-person-walks-seed0"
    assert (
        folder("a", guidance_scale=2.5, sampler=None)
        == "samples/a/default-step3000-f00d/a-person-walks-seed0-guidance_scale=2.5"
    )
    names = [folder("a", guidance_scale=scale) for scale in (-1, 1, 1.5, None)]
    names += [folder("a", frames=frames) for frames in ("in_between", [1, 2], [12])]
    names += [folder("a", sampler="ddim"), folder("a", seed=1), folder("a", run="b"), folder("a", digest="cafe")]
    names += [
        folder("a", text)
        for text in ("a person walks.", "a person, walks", "🕺💃", "💃🕺", "人が歩く", "a" * 70, "a" * 71)
    ]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize(
    "experiment",
    ["../../x", "/etc/x", "..", "a/../../../b", ".x", "a\0b", "~/x", "-/..", None, 3, "", "\\..\\x", ". ."],
)
def test_no_checkpoint_leads_out_of_the_folder(experiment, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = Path(folder(experiment, "../../../etc passwd\0", 0, experiment, sampler="../../x", joints=["/a", ".."]))
    assert ".." not in path.parts
    assert "\0" not in str(path)
    assert path.resolve().is_relative_to(tmp_path / "samples")


def test_a_sweep_writes_a_folder_for_each_value(tmp_path, data_root, monkeypatch):
    words = [*TINY, f"data_root={data_root}", f"run.dir={tmp_path / 'run'}", "callbacks.samples=null"]
    assert main(["train", "quickstart", *words, "callbacks.best=null", "trainer.max_steps=1", "logger=csv"]) == 0
    monkeypatch.chdir(tmp_path)
    asked = [f"ckpt={tmp_path / 'run/checkpoints/last.ckpt'}", "text=a person walks", "samples=1", "seconds=1"]
    assert main(["sample", *asked, "guidance_scale=1,2.5", "--multirun"]) == 0
    made = sorted(path.parent.name for path in tmp_path.glob("samples/quickstart/default-step1-*/*/motion_000.npz"))
    assert made == [f"a-person-walks-seed0-seconds=1-guidance_scale={scale}" for scale in ("1", "2.5")]


def test_fewer_samples_leave_no_stale_motions(tmp_path, data_root, monkeypatch):
    words = [*TINY, f"data_root={data_root}", f"run.dir={tmp_path / 'run'}", "callbacks.samples=null"]
    assert main(["train", "quickstart", *words, "callbacks.best=null", "trainer.max_steps=1", "logger=csv"]) == 0
    for count in (3, 1):
        words = [f"ckpt={tmp_path / 'run'}", "text=a person walks", f"samples={count}", "seconds=1"]
        assert main(["sample", *words, f"out={tmp_path / 'out'}"]) == 0
        assert len(list((tmp_path / "out").glob("motion_*.npz"))) == count
