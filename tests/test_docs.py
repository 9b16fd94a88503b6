"""README and docs: every link, name, path and command exists, the notebook runs, and the site is complete."""

import ast
import importlib
import os
import pkgutil
import re
import shlex
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import nbclient
import nbformat
import pytest
from support.fixtures import ROOT
from support.motions import synthetic

from flame_mdm.__main__ import COMMANDS
from flame_mdm.config import guarded, sweeps
from flame_mdm.config.command_line import make_variables, read_settings
from flame_mdm.config.jobs import run_jobs

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OWN = ("mine", "my_", "NAME", "...")
"""Names in examples for files that readers write."""
NOT_COMPOSED = {
    "README.md": ["make prepare DATA=... SOURCE=..."],
    "adding.md": ["make prepare DATA=my_set SOURCE=/path"],
    "data.md": ["make evaluate baseline=real data=bandai data.source.mirror=false ..."],
    "evaluation.md": [
        f"make train EXP={folder}/..." for folder in ("motion_clip", "t2m", "classifier")
    ],
    "first-problems.md": ["make prepare DATA=... SOURCE=/path/to/what/you/downloaded"],
    "tables.md": ["make train EXP=quickstart denoiser=mine"],
    "motion-faults.md": ["make inspect MOTION=samples/.../motion_000.npz"],
}
"""Commands of each page that are not composed: they name a part that the reader writes, or leave a name open."""
TARGETS = set(re.findall("^([a-z-]+):.*##", (ROOT / "Makefile").read_text(), re.MULTILINE))


def broken_links(page: Path, text: str) -> list[str]:
    """Returns relative links that lead to no file."""
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    return [link for link in links if "://" not in link and not (page.parent / link).exists()]


def unknown_names(text: str) -> list[str]:
    """Returns dotted names inside the packages that cannot be imported."""
    unknown = []
    for name in sorted(set(re.findall(r"\b(?:flame_mdm|evaluators)(?:\.[A-Za-z_]\w*)+", text))):
        try:
            pkgutil.resolve_name(name)
        except (ImportError, AttributeError):
            unknown.append(name)
    return unknown


def unknown_paths(text: str) -> list[str]:
    """Returns paths inside the repository's folders that do not exist; targets of links are left to `broken_links`."""
    text = re.sub(r"\]\([^)]*\)|benchmarks/\w+\.py`?\s+at\s+commit", "]", text)
    paths = set(
        re.findall(
            r"(?<![\w/.-])(?:flame_mdm|evaluators|experiments|benchmarks|tests)/[\w./-]*\w", text
        )
    )
    return sorted(
        path
        for path in paths
        if not (ROOT / path).exists() and not any(word in path for word in OWN)
    )


def code(text: str) -> list[str]:
    """Returns the lines of code blocks, and inline code."""
    block = re.compile(r"^ *```\w*\n(.*?)^ *```", re.DOTALL | re.MULTILINE)
    text = text.replace("\\\n", " ")
    lines = "".join(block.findall(text)).splitlines()
    text = block.sub("", text)
    lines += re.findall(r"^ {4,}(\S.*)$", text, re.MULTILINE)
    return lines + [" ".join(words.split()) for words in re.findall(r"`([^`]+)`", text)]


def wrong_commands(text: str) -> list[str]:
    """Returns commands that do not exist, or whose recipe, parts, keys or values are refused before any work."""
    wrong = []
    for line in dict.fromkeys(code(text)):
        match = re.match(
            r"(?:torchrun .*-m |srun )?(make|flame-mdm|flame_mdm) ([a-z-]+)(.*)", line.strip()
        )
        if match is None:
            continue
        program, command, rest = match.groups()
        words = shlex.split(rest, comments=True)
        legal = command in COMMANDS or (program == "make" and command in TARGETS)
        if not legal or (
            command in COMMANDS and words and not is_composed(program, command, tuple(words))
        ):
            wrong.append(" ".join([program, command, *words]))
    return wrong


@cache
def is_composed(program: str, command: str, words: Sequence[str]) -> bool:
    """Returns whether a command line is parsed, composed and checked without an error; its work is not done."""
    main = importlib.import_module(
        f"flame_mdm.commands.{'import_released' if command == 'import' else command}"
    ).main
    with pytest.MonkeyPatch.context() as patch:
        # This function runs the jobs of a sweep.
        patch.setattr(sweeps, "hydra_main", lambda **_: lambda _: lambda: None)
        if program == "make":
            if not all("=" in word for word in words):
                return False
            escaped = [re.sub(r"([\\ ])", r"\\\1", word) for word in words]
            patch.setenv("MAKEFLAGS", " -- " + " ".join(reversed(escaped)))
            words = make_variables()
        if command == "train":
            return main.func(lambda config: None, *main.args[1:], words) == 0
        words = [word for word in words if word != "--help"]
        settings = get_type_hints(main)["settings"]
        sweeps_or_launches = any(
            word == "--multirun" or word.startswith("launch=") for word in words
        )
        if sweeps_or_launches and getattr(settings, "SWEEPS", False):
            # models have to exist
            words = [
                "quickstart",
                *(word for word in words[1:] if not word.startswith("extractor=")),
            ]
            return run_jobs(lambda settings: None, settings, words) == 0
        # files need not exist
        return not words or guarded(lambda: read_settings(settings, words)) == 0


@pytest.mark.slow
def test_links_names_paths_and_commands_exist(tmp_path, monkeypatch):
    # launch=slurm is refused on a machine without the commands of SLURM
    monkeypatch.setenv("PATH", f"{ROOT / 'tests/support/slurm'}{os.pathsep}{os.environ['PATH']}")
    wrong, commands = {}, {}
    for number, page in enumerate(PAGES):
        text, name = page.read_text(), str(page.relative_to(ROOT)).removeprefix("docs/")
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        for file, content in re.findall(
            r"^`(\w+\.yaml)`:\n\n```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE
        ):
            Path(file).write_text(content)
        wrong[name] = [*broken_links(page, text), *unknown_names(text), *unknown_paths(text)]
        commands[name] = wrong_commands(text)
    assert {name: words for name, words in wrong.items() if words} == {}
    assert {name: lines for name, lines in commands.items() if lines} == NOT_COMPOSED


def python_examples(text: str) -> list[tuple[str, str]]:
    """Returns the Python blocks of a page, each with the reason why it is not run, or with ""."""
    return re.findall(
        r"(?:^<!-- not run: (.+) -->\n)?^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE
    )


EXAMPLES = {page: blocks for page in PAGES if (blocks := python_examples(page.read_text()))}


@pytest.mark.parametrize("page", EXAMPLES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_examples_of_a_page_run_and_print_what_they_say(
    page, trained, tmp_path, monkeypatch, subtests
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    Path("runs/quickstart").mkdir(parents=True)
    Path("runs/quickstart/default").symlink_to(trained.parent.parent)
    for name in ("walk.npz", "walk.bvh"):
        synthetic(fps=30.0, size=20).save(name)
    names: dict[str, Any] = {"__name__": "example"}
    for block in (block for reason, block in EXAMPLES[page] if not reason):
        exec(block, names)
        for expression, shape in re.findall(
            r"^([\w.\[\]]+) +# (\(\d+(?:, \d+)+\))", block, re.MULTILINE
        ):
            with subtests.test(expression=expression):
                assert str(eval(expression, names).shape) == shape, expression
        for expression, text in re.findall(
            r"^([\w.\[\]]+) +# ([A-Z]\w+\(.*\))$", block, re.MULTILINE
        ):
            with subtests.test(expression=expression):
                assert repr(eval(expression, names)) == text, expression


def test_few_examples_do_not_run():
    reasons = [reason for examples in EXAMPLES.values() for reason, _ in examples]
    assert len(reasons) >= 9
    assert list(filter(None, reasons)) == ["it needs clips, and trains for minutes"]


def strings() -> Iterator[str]:
    """Yields the strings of the code, with … for what is filled in."""
    for path in [*(ROOT / "flame_mdm").rglob("*.py"), *(ROOT / "evaluators").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                yield "".join(
                    str(part.value) if isinstance(part, ast.Constant) else "…"
                    for part in node.values
                )
            elif isinstance(node, ast.Constant):
                yield str(node.value)


def test_messages_on_the_page_of_first_problems_are_those_of_the_code():
    """They are set as **`...`**; … stands for what the code fills in."""
    messages = re.findall(r"\*\*`([^`]+)`\*\*", (ROOT / "docs" / "first-problems.md").read_text())
    text = "\n".join(strings())
    assert len(messages) > 20
    assert [
        m for m in messages if not re.search(".*".join(map(re.escape, m.split("…"))), text)
    ] == []


def make(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["make", "-C", str(ROOT), *words], capture_output=True, text=True, check=False
    )


def test_make_forwards_every_command_and_refuses_a_text_without_quotes(subtests):
    for name in COMMANDS:
        with subtests.test(name=name):
            done = make("-n", "-s", "-o", ".venv/.ready", name)
            assert done.stdout == f".venv/bin/python -m flame_mdm {name} --from-make\n"
    done = make("sample", "CKPT=x", "TEXT=a", "person", "walks")
    assert (
        'sample person walks: one command at a time; quote a value with spaces, as in TEXT="a'
        in done.stderr
    )


@pytest.mark.slow
def test_the_notebook_runs(tmp_path):
    notebook = nbformat.read(ROOT / "docs" / "first-steps.ipynb", as_version=4)
    assert not any(cell.get("outputs") for cell in notebook.cells)
    nbclient.NotebookClient(
        notebook, timeout=120, resources={"metadata": {"path": str(tmp_path)}}
    ).execute()
    outputs = [str(output) for cell in notebook.cells for output in cell.get("outputs", ())]
    assert all(text in "".join(outputs) for text in ("<iframe", "60 frames at 20 per second"))
    assert {path.name for path in tmp_path.iterdir()} == {"walk.glb", "walk.bvh", "samples.html"}
    printed = [output for output in outputs if "'stderr'" in output]
    # tqdm warns of a widget that is not installed.
    assert [output for output in printed if "IProgress" not in output] == []


@pytest.mark.slow
@pytest.mark.filterwarnings("default")
def test_the_site_is_built_without_warnings_and_every_page_is_within_three_clicks_of_the_start(
    tmp_path,
):
    # In this process, Sphinx would change the signatures of the documented functions.
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", ROOT / "docs", tmp_path]
    built = subprocess.run(command, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    clicks, new = {tmp_path / "index.html": 0}, [tmp_path / "index.html"]
    while new:
        page = new.pop(0)
        for name in re.findall(r'href="([^"#:]+\.html)', page.read_text()):
            link = (page.parent / name).resolve()
            assert link.exists(), f"{page}: {link}"
            if link not in clicks:
                clicks[link] = clicks[page] + 1
                new.append(link)
    pages = {
        tmp_path / page.relative_to(ROOT / "docs").with_suffix(".html")
        for page in (ROOT / "docs").rglob("*.md")
    }
    assert pages - {page for page, count in clicks.items() if count <= 3} == {
        tmp_path / "space" / "README.html"
    }
    goals = {"sampling", "demo", "own-data", "humanml3d-to-table", "tables", "api", "recipes"}
    assert {clicks[tmp_path / f"{goal}.html"] for goal in goals} == {1}
    start = (tmp_path / "index.html").read_text()
    # The page shows how to sample a first motion without any click.
    assert "flame-mdm sample package" in re.sub("<[^>]+>", "", start)
