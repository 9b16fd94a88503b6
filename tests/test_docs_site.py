"""The notebook runs, and the docs site is complete: no broken link, every page within three clicks."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest
from support.fixtures import ROOT

PACKAGES = ("flame_mdm", "evaluators", "docs")


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    nbclient = pytest.importorskip("nbclient", reason="nbclient is not installed")
    nbformat = pytest.importorskip("nbformat")
    notebook = nbformat.read(ROOT / "docs" / "first-steps.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}).execute()
    outputs = [str(output) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert "<iframe" in "".join(outputs)
    assert "60 frames at 20 per second" in "".join(outputs)
    assert {path.name for path in tmp_path.iterdir()} == {"walk.glb", "walk.bvh", "samples.html"}
    printed = [output for output in outputs if "'stderr'" in output]
    assert [output for output in printed if "IProgress" not in output] == []  # a widget that tqdm names


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site that `make docs` has built if it is newer than its sources, or a new one."""
    if importlib.util.find_spec("sphinx") is None:
        pytest.skip("sphinx is not installed")
    made = ROOT / "build" / "docs"
    sources = [ROOT / "README.md", *(ROOT / "docs").rglob("*.md")]
    sources += [path for name in PACKAGES for path in (ROOT / name).rglob("*.py")]
    marks = [made / "searchindex.js", made / ".doctrees" / "environment.pickle"]
    if all(mark.exists() for mark in marks) and max(map(modified, marks)) > max(map(modified, sources)):
        return made
    folder = tmp_path_factory.mktemp("site")
    words = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", str(ROOT / "docs"), str(folder)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    return folder


def modified(path: Path) -> float:
    return path.stat().st_mtime


def links(page: Path) -> list[str]:
    """Pages that a page and its sidebar link to."""
    return [str((page.parent / link).resolve()) for link in re.findall(r'href="([^"#:]+\.html)', page.read_text())]


@pytest.mark.slow
def test_every_page_is_within_three_clicks_of_the_start(site):
    clicks, new = {str(site / "index.html"): 0}, [str(site / "index.html")]
    while new:
        page = new.pop(0)
        for link in links(Path(page)):
            assert Path(link).exists(), f"{page}: {link}"
            if link not in clicks:
                clicks[link] = clicks[page] + 1
                new.append(link)
    pages = {str(site / path.relative_to(ROOT / "docs").with_suffix(".html")) for path in (ROOT / "docs").rglob("*.md")}
    pages -= {str(site / "space" / "README.html")}
    assert pages - {page for page, count in clicks.items() if count <= 3} == set()
    goals = {"sampling": 1, "demo": 1, "own-data": 1, "humanml3d-to-table": 1, "tables": 1, "api": 1, "recipes": 1}
    assert {goal: clicks[str(site / f"{goal}.html")] for goal in goals} == goals
    start = (site / "index.html").read_text()
    assert "flame-mdm sample quickstart" in re.sub("<[^>]+>", "", start)  # a first motion, without any click
