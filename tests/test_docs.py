"""README and docs: every link, name, path and command exists, the notebook runs, and the site is complete."""

import ast
import importlib
import importlib.util
import pkgutil
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any, get_type_hints

import pytest
from support.fixtures import ROOT
from support.motions import synthetic

from flame_mdm.__main__ import COMMANDS
from flame_mdm.config import composition, guarded, sweeps
from flame_mdm.config.command_line import make_variables, read_settings

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OWN = ("mine", "my_", "NAME", "...")
"""Names in examples for files that readers write."""
OPEN = "make prepare DATA=... SOURCE=..."
NOT_COMPOSED = {
    "README.md": [OPEN],
    "adding.md": ["make prepare DATA=my_set SOURCE=/path"],
    "data.md": ["make evaluate baseline=real data=bandai data.source.mirror=false ..."],
    "evaluation.md": [f"make train EXP={folder}/..." for folder in ("motion_clip", "t2m", "classifier")],
    "first-problems.md": ["make prepare DATA=... SOURCE=/path/to/what/you/downloaded"],
    "tables.md": ["make train EXP=..."],
}
"""Commands of each page that are not composed: they name a part that the reader writes (mine, my_set), or leave a name
open (...)."""
TARGETS = {"setup", "test", "test-fast", "test-tools", "test-robustness", "lint", "bench", "docs"}
TARGETS |= {"web", "blender", "help"}


def broken_links(page: Path, text: str) -> list[str]:
    """Returns relative links that lead to no file."""
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    return [link for link in links if "://" not in link and not (page.parent / link).exists()]


def unknown_names(text: str) -> list[str]:
    """Returns dotted names inside the packages that cannot be imported."""
    names = set(re.findall(r"\b(?:flame_mdm|evaluators)(?:\.[A-Za-z_]\w*)+", text))
    return sorted(name for name in names if not exists(name))


def exists(name: str) -> bool:
    """Returns whether a dotted name is a module, or an attribute of one."""
    try:
        return pkgutil.resolve_name(name) is not None
    except (ImportError, AttributeError):
        return False


def unknown_paths(text: str) -> list[str]:
    """Returns paths inside the repository's folders that do not exist; targets of links are left to `broken_links`."""
    text = re.sub(r"\]\([^)]*\)|benchmarks/\w+\.py`?\s+at\s+commit", "]", text)
    paths = set(re.findall(r"(?<![\w/.-])(?:flame_mdm|evaluators|experiments|benchmarks|tests)/[\w./-]*\w", text))
    return sorted(path for path in paths if not (ROOT / path).exists() and not any(word in path for word in OWN))


def code(text: str) -> list[str]:
    """Returns the lines of code blocks, and inline code."""
    text = text.replace("\\\n", " ")
    blocks = re.findall(r"^ *```\w*\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE)
    text = re.sub(r"^ *```\w*\n.*?^ *```", "", text, flags=re.DOTALL | re.MULTILINE)
    inline = [" ".join(words.split()) for words in re.findall(r"`([^`]+)`", text)]
    return [
        *(line for block in blocks for line in block.splitlines()),
        *re.findall(r"^ {4,}(\S.*)$", text, re.M),
        *inline,
    ]


def wrong_commands(text: str) -> list[str]:
    """Returns commands that do not exist, or whose recipe, parts, keys or values are refused before any work."""
    wrong = []
    for line in dict.fromkeys(code(text)):
        match = re.match(r"(?:torchrun .*-m |srun )?(make|flame-mdm|flame_mdm) ([a-z-]+)(.*)", line.strip())
        if match is None:
            continue
        program, command, rest = match.groups()
        words = shlex.split(rest, comments=True)
        legal = command in COMMANDS or (program == "make" and command in TARGETS)
        if not legal or (command in COMMANDS and words and not is_composed(program, command, tuple(words))):
            wrong.append(" ".join([program, command, *words]))
    return wrong


@cache
def is_composed(program: str, command: str, words: Sequence[str]) -> bool:
    """Returns whether a command line is parsed, composed and checked without an error; its work is not done."""
    main = importlib.import_module(f"flame_mdm.commands.{'import_released' if command == 'import' else command}").main
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sweeps, "hydra_main", lambda **_: lambda _: lambda: None)  # runs the jobs of a sweep
        if program == "make":
            if not all("=" in word for word in words):
                return False
            escaped = [re.sub(r"([\\ ])", r"\\\1", word) for word in words]
            patch.setenv("MAKEFLAGS", " -- " + " ".join(reversed(escaped)))
            words = ("--from-make",)
        if command == "train":
            return main.func(lambda config: None, *main.args[1:], words) == 0
        words = make_variables() if program == "make" else [word for word in words if word != "--help"]
        if not words:
            return True
        return guarded(lambda: read_settings(get_type_hints(main)["settings"], words)) == 0  # files need not exist


@pytest.fixture
def resolved_once(monkeypatch):
    """Hydra composes once what several commands name."""
    resolve, known = composition.resolve, {}

    def once(source: composition.ConfigSource, overrides: list[str], base: Any = None) -> dict[str, Any]:
        key = repr((source, overrides))
        known[key] = known.get(key) or resolve(source, overrides, base)
        return deepcopy(known[key])

    for module in (composition, sweeps):
        monkeypatch.setattr(module, "resolve", once)


@pytest.mark.slow
def test_links_names_paths_and_commands_exist(tmp_path, monkeypatch, resolved_once):
    wrong = {}
    for number, page in enumerate(PAGES):
        text, name = page.read_text(), str(page.relative_to(ROOT)).removeprefix("docs/")
        (tmp_path / str(number)).mkdir()
        monkeypatch.chdir(tmp_path / str(number))
        for file, content in re.findall(r"^`(\w+\.yaml)`:\n\n```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
            Path(file).write_text(content)
        commands = wrong_commands(text)
        commands = commands if commands != NOT_COMPOSED.get(name, []) else []
        wrong[name] = [*broken_links(page, text), *unknown_names(text), *unknown_paths(text), *commands]
    assert {name: words for name, words in wrong.items() if words} == {}


def python_examples(text: str) -> list[tuple[str, str]]:
    """Returns the Python blocks of a page, each with the reason why it is not run, or with ""."""
    return re.findall(r"(?:^<!-- not run: (.+) -->\n)?^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


EXAMPLES = {page: blocks for page in PAGES if (blocks := python_examples(page.read_text()))}


@pytest.mark.parametrize("page", EXAMPLES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_examples_of_a_page_run(page, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    Path("runs/quickstart").mkdir(parents=True)
    Path("runs/quickstart/default").symlink_to(trained.parent.parent)
    for name in ("walk.npz", "walk.bvh"):
        synthetic(fps=30.0, size=20).save(name)
    run_examples(EXAMPLES[page])


def run_examples(examples: list[tuple[str, str]]) -> None:
    """Runs blocks one after the other, as a reader would, and checks the shapes and texts that comments tell."""
    names: dict[str, Any] = {"__name__": "example"}
    for reason, block in examples:
        if reason:
            continue
        exec(block, names)
        for expression, shape in re.findall(r"^([\w.\[\]]+) +# (\(\d+(?:, \d+)+\))", block, re.MULTILINE):
            assert str(eval(expression, names).shape) == shape, expression
        for expression, text in re.findall(r"^([\w.\[\]]+) +# ([A-Z]\w+\(.*\))$", block, re.MULTILINE):
            assert repr(eval(expression, names)) == text, expression


def test_few_examples_do_not_run():
    """A block that needs registered data, a GPU or the network has `<!-- not run: REASON -->` above it."""
    reasons = [reason for examples in EXAMPLES.values() for reason, _ in examples]
    assert len(reasons) >= 9
    assert list(filter(None, reasons)) == ["it needs clips, and trains for minutes"]


def unknown_messages(text: str) -> list[str]:
    """Returns messages, set as **`...`**, that no string of the code holds; … stands for what it fills in."""
    messages = "\n".join(strings())
    return [
        message
        for message in re.findall(r"\*\*`([^`]+)`\*\*", text)
        if not re.search(".*".join(map(re.escape, message.split("…"))), messages)
    ]


def strings() -> Iterator[str]:
    """Yields the strings of the code, with … for what is filled in."""
    for path in [*(ROOT / "flame_mdm").rglob("*.py"), *(ROOT / "evaluators").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.JoinedStr):
                yield "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in node.values)
            elif isinstance(node, ast.Constant):
                yield str(node.value)


def test_messages_on_the_page_of_first_problems_are_those_of_the_code():
    text = (ROOT / "docs" / "first-problems.md").read_text()
    assert text.count("**`") > 20
    assert unknown_messages(text) == []


def make(*words: str) -> subprocess.CompletedProcess[str]:
    program = shutil.which("make")
    assert program is not None
    return subprocess.run([program, "-C", str(ROOT), *words], capture_output=True, text=True, check=False)


def test_make_forwards_every_command_and_refuses_a_text_without_quotes():
    for name in COMMANDS:
        done = make("-n", "-s", "-o", ".venv/.ready", name)
        assert done.stdout == f".venv/bin/python -m flame_mdm {name} --from-make\n"
    done = make("sample", "CKPT=x", "TEXT=a", "person", "walks")
    assert done.returncode == 2
    assert 'sample person walks: one command at a time; quote a value with spaces, as in TEXT="a' in done.stderr


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
