"""The benchmarks of speed: every script at a toy size, and the page that is rendered from their figures."""

import json
import math
import sys
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parent.parent
sys.path.append(str(ROOT / "benchmarks"))  # the scripts import each other

import run  # noqa: E402
import sections  # noqa: E402

TOY = {
    "steps": "--quick",
    "sampling": "--frames 4 --latent-dim 16 --num-layers 1 --repeats 1 --longest 0",
}


def stub(name: str, *words: str) -> dict[str, Any]:
    return sections.section(f"Title of {name}", "A text.", f"Summary of {name}.", steps=[{"way": name, "ms": 1234.5}])


@pytest.fixture
def page(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(run, "PAGE", tmp_path / "speed.md")
    monkeypatch.setattr(run, "run", stub)
    return tmp_path / "speed.md"


def test_the_page_is_rendered_from_the_figures_and_keeps_those_that_are_not_measured_again(page):
    run.main("only=steps,sampling", "device=")
    data = page.with_suffix(".json")
    kept = json.loads(data.read_text())
    kept["sampling"]["date"] = "2001-02-03"
    data.write_text(json.dumps(kept))
    run.main("only=steps")
    again = json.loads(data.read_text())
    assert again["sampling"] == kept["sampling"]
    text = page.read_text()
    assert text == run.render(again)
    assert "| sampling | 1,234 |" in text
    assert "`benchmarks/sampling.py`, 2001-02-03, machine 1." in text
    assert text.index("## Title of steps") < text.index("## Title of sampling")
    assert "torch: " in text.split("## Machine")[1].split("##")[0]


def test_unknown_sections_and_devices_are_refused_in_one_line(page, monkeypatch):
    for word, start in (
        ("only=steps,none", "ONLY=none: give some of steps, "),
        ("device=tpu", "DEVICE=tpu: give cpu"),
    ):
        with pytest.raises(SystemExit, match=start):
            run.main(word)
    monkeypatch.setattr(run.torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit, match=r"^DEVICE=cuda: torch finds no CUDA GPU on this machine$"):
        run.main("device=cuda")
    assert not page.exists()


def test_the_committed_page_is_rendered_from_the_committed_figures():
    sections = json.loads((ROOT / "docs" / "benchmarks" / "speed.json").read_text())
    assert (ROOT / "docs" / "benchmarks" / "speed.md").read_text() == run.render(sections)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sampling", pytest.param("steps", marks=pytest.mark.robustness)])  # trains models
def test_every_benchmark_runs_at_a_toy_size(name):
    section = import_module(name).measure(*TOY[name].split())
    numbers = [value for rows in section["tables"].values() for row in rows for value in row.values()]
    assert all(math.isfinite(value) for value in numbers if isinstance(value, int | float))
    assert any(isinstance(value, float) for value in numbers)
    columns = [{tuple(row) for row in rows} for rows in section["tables"].values()]
    assert all(len(names) == 1 for names in columns)
    assert section["title"] in run.render({name: section | {"date": "2001-02-03", "machine": run.machine()}})
