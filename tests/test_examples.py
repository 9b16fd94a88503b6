"""The numbered examples run as they are, in a folder of their own."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from support.fixtures import ROOT
from support.runs import TINY

from flame_mdm.__main__ import main

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
SLOW = {"04_own_denoiser", "07_train_in_python"}
LONG = {"08_evaluate", "09_distill", "10_adapt"}  # half a minute or more each
STREAM = "02_stream"


def run(path: Path, folder: Path, *words: str) -> str:
    """Runs an example in a folder, and returns what it prints."""
    environment = os.environ | {"PYTHONPATH": str(ROOT), "FLAME_MDM_DATA": str(folder / "data")}
    line = [sys.executable, str(path), *words]
    finished = subprocess.run(
        line, cwd=folder, env=environment, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    return finished.stdout


def marks(name: str) -> list[pytest.MarkDecorator]:
    if name in LONG:
        return [pytest.mark.robustness]
    return [pytest.mark.slow] if name in SLOW else []


@pytest.mark.parametrize(
    "path",
    [
        pytest.param(path, id=path.stem, marks=marks(path.stem))
        for path in EXAMPLES
        if path.stem != STREAM
    ],
)
def test_an_example_runs(path: Path, tmp_path: Path):
    printed = run(path, tmp_path)
    assert printed.strip()
    assert "nan" not in printed.lower()


@pytest.mark.slow
def test_the_example_of_streams_runs_with_a_model_that_continues_frames(tmp_path: Path):
    model, data = tmp_path / "dip", tmp_path / "data"
    tiny = [word for word in TINY if not word.startswith(("condition.pretrain", "process."))]
    words = [*tiny, f"data_root={data}", f"run.dir={model}", "trainer.max_steps=2", "logger=csv"]
    assert (
        main(["train", "synthetic/dip", *words, "callbacks.samples=null", "callbacks.best=null"])
        == 0
    )
    assert "until second" in run(ROOT / "examples" / f"{STREAM}.py", tmp_path, str(model))


def test_examples_are_short_numbered_and_say_what_they_show():
    assert [int(path.stem.partition("_")[0]) for path in EXAMPLES] == list(range(1, 11))
    for path in EXAMPLES:
        text = path.read_text()
        assert text.count("\n") <= 60, path.stem
        assert text.startswith('"""'), path.stem
