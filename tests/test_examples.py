"""The numbered examples run as they are, in a folder of their own."""

import os
import runpy
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from support.fixtures import ROOT
from support.runs import TINY

from flame_mdm.__main__ import main

EXAMPLES = sorted((ROOT / "examples").glob("*.py"))
LONG = {"08_evaluate", "09_distill", "10_adapt"}  # half a minute or more each
STREAM = "02_stream"
ALONE = [pytest.param(path, id=path.stem) for path in EXAMPLES if path.stem != STREAM]

Run = Callable[..., str]


@pytest.fixture(scope="module")
def prepared(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of the data sets that examples prepare; some use the same one."""
    return tmp_path_factory.mktemp("data")


@pytest.fixture
def run(
    tmp_path: Path,
    prepared: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> Run:
    """Runs an example in this process and the test's folder, and returns what it prints."""

    def run(path: Path, *words: str) -> str:
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("FLAME_MDM_DATA", str(prepared))
        monkeypatch.setattr(sys, "argv", [str(path), *words])
        capsys.readouterr()
        runpy.run_path(str(path), run_name="__main__")
        return capsys.readouterr().out

    return run


@pytest.mark.filterwarnings("default")
@pytest.mark.parametrize("path", [param for param in ALONE if param.id not in LONG])
def test_an_example_runs(path: Path, run: Run):
    printed = run(path)
    assert printed.strip()
    assert "nan" not in printed.lower()


@pytest.mark.robustness
@pytest.mark.parametrize("path", ALONE)
def test_an_example_runs_as_a_program(path: Path, tmp_path: Path):
    environment = os.environ | {"PYTHONPATH": str(ROOT), "FLAME_MDM_DATA": str(tmp_path / "data")}
    words = [sys.executable, str(path)]
    finished = subprocess.run(
        words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
    )
    assert finished.returncode == 0, finished.stderr[-2000:]
    assert finished.stdout.strip()
    assert "nan" not in finished.stdout.lower()


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_example_of_streams_runs_with_a_model_that_continues_frames(tmp_path: Path, run: Run):
    model, data = tmp_path / "dip", tmp_path / "data"
    tiny = [word for word in TINY if not word.startswith(("condition.pretrain", "process."))]
    words = [*tiny, f"data_root={data}", f"run.dir={model}", "trainer.max_steps=2", "logger=csv"]
    assert (
        main(["train", "synthetic/dip", *words, "callbacks.samples=null", "callbacks.best=null"])
        == 0
    )
    assert "until second" in run(ROOT / "examples" / f"{STREAM}.py", str(model))


def test_examples_are_short_numbered_and_say_what_they_show(subtests):
    assert [int(path.stem.partition("_")[0]) for path in EXAMPLES] == list(range(1, 11))
    for path in EXAMPLES:
        with subtests.test(path=path):
            text = path.read_text()
            assert text.count("\n") <= 60, path.stem
            assert text.startswith('"""'), path.stem
