"""README and docs: every link, name, path and command in them exists."""

import ast
import importlib
import re
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from support.fixtures import ROOT

from flame_mdm.__main__ import COMMANDS
from flame_mdm.config import sweeps
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.formats.motion import Motion

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OWN = ("mine", "my_", "NAME", "...")
"""Names in examples for files that readers write."""
OPEN = "make prepare DATA=... SOURCE=..."
MINE = "make train EXP=quickstart denoiser=mine"
NOT_COMPOSED = {
    "README.md": [OPEN, MINE],
    "adding.md": [MINE, "make prepare DATA=my_set SOURCE=/path"],
    "data.md": ["make evaluate baseline=real data=bandai data.source.mirror=false ..."],
    "evaluation.md": [f"make train EXP={folder}/..." for folder in ("motion_clip", "t2m", "classifier")],
    "first-problems.md": ["make prepare DATA=... SOURCE=/path/to/what/you/downloaded", OPEN],
    "own-data.md": ["make browse DATA=mine"],
    "tables.md": ["make train EXP=..."],
}
"""Commands of each page that are not composed: they name a part that the reader writes (mine, my_set), or leave a name
open (...)."""
TARGETS = {"setup", "test", "test-fast", "test-tools", "test-robustness", "lint", "bench", "docs", "help"}


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
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            found = getattr(found, part, None)
        return found is not None
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
        found = re.match(r"(?:torchrun .*-m |srun )?(make|flame-mdm|flame_mdm) ([a-z-]+)(.*)", line.strip())
        if found is None:
            continue
        program, command, rest = found.groups()
        words = shlex.split(rest, comments=True)
        known = command in COMMANDS or (program == "make" and command in TARGETS)
        if not known or (command in COMMANDS and words and not is_composed(program, command, tuple(words))):
            wrong.append(" ".join([program, command, *words]))
    return wrong


@cache
def is_composed(program: str, command: str, words: tuple[str, ...]) -> bool:
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
        return main.func(lambda settings: None, *main.args[1:], words) == 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_names_paths_and_commands_of_a_page_exist(page, tmp_path, monkeypatch):
    text = page.read_text()
    assert broken_links(page, text) == []
    assert unknown_names(text) == []
    assert unknown_paths(text) == []
    monkeypatch.chdir(tmp_path)
    for name, content in re.findall(r"^`(\w+\.yaml)`:\n\n```yaml\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        Path(name).write_text(content)
    assert wrong_commands(text) == NOT_COMPOSED.get(str(page.relative_to(ROOT)).removeprefix("docs/"), [])


def python_examples(text: str) -> list[tuple[str, str]]:
    """Returns the Python blocks of a page, each with the reason why it is not run, or with ""."""
    return re.findall(r"(?:^<!-- not run: (.+) -->\n)?^```python\n(.*?)^```", text, re.DOTALL | re.MULTILINE)


EXAMPLES = {page: found for page in PAGES if (found := python_examples(page.read_text()))}


@pytest.mark.parametrize("page", EXAMPLES, ids=lambda page: str(page.relative_to(ROOT)))
def test_the_python_examples_of_a_page_run(page, trained, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    Path("runs/quickstart").mkdir(parents=True)
    Path("runs/quickstart/default").symlink_to(trained.parent.parent)
    walk = next(Synthetic(clips=20).clips(30.0)).motion
    for name in ("walk.npz", "walk.bvh"):
        Motion(walk, 30.0).save(name)
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


def test_examples_that_do_not_run_are_counted():
    """A block that needs registered data, a GPU or the network has `<!-- not run: REASON -->` above it."""
    found = [reason for examples in EXAMPLES.values() for reason, _ in examples]
    assert [reason for reason in found if reason] == []
    assert len(found) >= 9


def unknown_messages(text: str) -> list[str]:
    """Returns messages, set as **`...`**, that no string of the code holds; … stands for what it fills in."""
    known = "\n".join(strings())
    return [
        message
        for message in re.findall(r"\*\*`([^`]+)`\*\*", text)
        if not re.search(".*".join(map(re.escape, message.split("…"))), known)
    ]


def strings() -> Iterator[str]:
    """Yields the strings of the code, with … for what is filled in."""
    for path in [*(ROOT / "flame_mdm").rglob("*.py"), *(ROOT / "evaluators").rglob("*.py")]:
        for node in ast.walk(ast.parse(path.read_text())):
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "…" for part in parts)


def test_messages_on_the_page_of_first_problems_are_those_of_the_code():
    text = (ROOT / "docs" / "first-problems.md").read_text()
    assert text.count("**`") > 20
    assert unknown_messages(text) == []


def test_the_checks_can_fail():
    assert unknown_messages("**`unknown experiment '…'`** **`unknown … x'`** `no message`") == ["unknown … x'"]
    assert broken_links(PAGES[0], "[a](docs/data.md#x) [b](docs/nothing.md) [c](https://d.e)") == ["docs/nothing.md"]
    assert unknown_names("flame_mdm.load evaluators.audit flame_mdm.nothing flame_mdm.config.nothing") == [
        "flame_mdm.config.nothing",
        "flame_mdm.nothing",
    ]
    assert unknown_paths("experiments/base.yaml experiments/nothing.yaml") == ["experiments/nothing.yaml"]
    text = "```sh\nmake train EXP=quickstart a.b=1\n```\n    make trian\n`make edit FRAMEZ=1` `make train EXP=nothing`"
    text += " `make sample x` `flame-mdm sample seconds=soon` `make sample TEXT='a person' MP4=true` `make lint`"
    assert wrong_commands(text) == [
        *("make train EXP=quickstart a.b=1", "make trian", "make edit FRAMEZ=1", "make train EXP=nothing"),
        *("make sample x", "flame-mdm sample seconds=soon"),
    ]


def test_the_examples_can_fail():
    text = "```python\na = b\n```\n\n<!-- not run: needs a GPU -->\n```python\n1 / 0\n```\n"
    assert python_examples(text) == [("", "a = b\n"), ("needs a GPU", "1 / 0\n")]
    with pytest.raises(NameError):
        run_examples(python_examples(text))
    run_examples(python_examples(text)[1:])
    for comment in ("(2, 3)", "Motion('x')"):
        with pytest.raises(AssertionError):
            run_examples([("", f"import numpy\nx = numpy.zeros(2)\nx    # {comment}\n")])


def test_make_forwards_every_command():
    make = shutil.which("make")
    assert make is not None
    words = [make, "-n", "-s", "-o", ".venv/.ready", "-C", str(ROOT)]
    for name in COMMANDS:
        done = subprocess.run([*words, name], capture_output=True, text=True, check=True)
        assert done.stdout == f".venv/bin/python -m flame_mdm {name} --from-make\n"


def test_make_refuses_a_text_without_quotes_before_it_samples():
    make = shutil.which("make")
    assert make is not None
    words = [make, "-C", str(ROOT), "sample", "CKPT=x", "TEXT=a", "person", "walks"]
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert 'sample person walks: one command at a time; quote a value with spaces, as in TEXT="a' in done.stderr
