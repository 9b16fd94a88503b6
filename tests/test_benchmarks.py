"""The benchmark of speed: it runs at a toy size, and the page is rendered from its figures."""

import json
import math

import pytest
from support.fixtures import ROOT, script

steps = script("benchmarks/steps.py")


def test_the_page_is_rendered_from_the_figures_and_keeps_those_of_earlier_scripts(tmp_path, monkeypatch):
    page = tmp_path / "speed.md"
    monkeypatch.setattr(steps, "PAGE", page)
    section = {"title": "Steps", "text": "A text.", "summary": "Summary."}
    section |= {"tables": {"speeds": [{"way": "a", "ms": 1234.5}]}}  # type: ignore[dict-item]
    monkeypatch.setattr(steps, "measure", lambda *words: dict(section))
    kept = section | {"title": "Text", "script": "benchmarks/text.py at commit x", "date": "2001-02-03"}
    kept |= {"machine": {"cores": 1}}  # type: ignore[dict-item]
    page.with_suffix(".json").write_text(json.dumps({"text": kept}))
    with pytest.raises(SystemExit, match="DEVICE=tpu: give cpu, or cuda on a machine with a CUDA GPU"):
        steps.main("tpu")
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


@pytest.mark.slow
@pytest.mark.robustness  # trains models
def test_the_benchmark_runs_at_a_toy_size():
    section = steps.measure(quick=True)
    numbers = [value for rows in section["tables"].values() for row in rows for value in row.values()]
    assert all(math.isfinite(value) for value in numbers if isinstance(value, int | float))
    columns = [{tuple(row) for row in rows} for rows in section["tables"].values()]
    assert all(len(names) == 1 for names in columns)
    assert section["title"] in steps.render({"steps": section | {"date": "2001-02-03", "machine": steps.machine()}})
