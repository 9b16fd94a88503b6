"""The benchmark of speed: it runs at a toy size, and the page is rendered from its figures."""

import json
import math
from pathlib import Path

import pytest
from support.fixtures import ROOT, script

steps = script("benchmarks/steps.py")


@pytest.fixture
def page(tmp_path, monkeypatch) -> Path:
    monkeypatch.setattr(steps, "PAGE", tmp_path / "speed.md")
    return tmp_path / "speed.md"


def test_the_page_is_rendered_from_the_figures_and_keeps_those_of_earlier_scripts(page, monkeypatch):
    section = {"title": "Steps", "text": "A text.", "summary": "Summary."}
    section |= {"tables": {"speeds": [{"way": "a", "ms": 1234.5}]}}  # type: ignore[dict-item]
    monkeypatch.setattr(steps, "measure", lambda *words: dict(section))
    kept = section | {"title": "Text", "script": "benchmarks/text.py at commit x", "date": "2001-02-03"}
    kept |= {"machine": {"cores": 1}}  # type: ignore[dict-item]
    page.with_suffix(".json").write_text(json.dumps({"text": kept}))
    steps.main()
    figures = json.loads(page.with_suffix(".json").read_text())
    assert figures["text"] == kept
    text = page.read_text()
    assert text == steps.render(figures)
    assert "Speeds:\n\n| way | ms |\n| --- | ---: |\n| a | 1,234 |" in text
    assert "`benchmarks/text.py at commit x`, 2001-02-03, machine 2." in text
    assert text.index("## Steps") < text.index("## Text")
    assert "torch: " in text.split("## Machine")[1].split("##")[0]
    sections = json.loads((ROOT / "docs" / "benchmarks" / "speed.json").read_text())
    assert (ROOT / "docs" / "benchmarks" / "speed.md").read_text() == steps.render(sections)


def test_a_device_that_is_not_there_is_refused(page, monkeypatch):
    monkeypatch.setattr(steps.torch.cuda, "is_available", lambda: False)
    for device in ("tpu", "cuda"):
        with pytest.raises(SystemExit, match=f"^DEVICE={device}: give cpu, or cuda on a machine with a CUDA GPU$"):
            steps.main(device)
    assert not page.exists()


@pytest.mark.slow
@pytest.mark.robustness  # trains models
def test_the_benchmark_runs_at_a_toy_size():
    section = steps.measure(quick=True)
    numbers = [value for rows in section["tables"].values() for row in rows for value in row.values()]
    assert all(math.isfinite(value) for value in numbers if isinstance(value, int | float))
    columns = [{tuple(row) for row in rows} for rows in section["tables"].values()]
    assert all(len(names) == 1 for names in columns)
    assert section["title"] in steps.render({"steps": section | {"date": "2001-02-03", "machine": steps.machine()}})
