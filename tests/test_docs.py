"""README and docs: every link, name, path and command in them exists."""

import ast
import importlib
import re
import shlex
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from fixtures import ROOT

from flame_mdm.__main__ import COMMANDS
from flame_mdm.config import EXPERIMENTS, recipes

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
OWN = ("mine", "my_", "NAME", "...")
"""Names in examples for files that readers write."""
TARGETS = {"setup", "test", "test-fast", "test-tools", "lint", "bench", "docs", "help"}


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
    text = re.sub(r"\]\([^)]*\)", "]", text)
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
    """Returns commands that do not exist, or that have an unknown key, recipe or data set."""
    wrong = []
    for line in code(text):
        found = re.match(r"(?:torchrun .*-m |srun )?(make|flame-mdm|flame_mdm) ([a-z-]+)(.*)", line.strip())
        if found is None:
            continue
        program, command, rest = found.groups()
        if command not in COMMANDS and not (program == "make" and command in TARGETS):
            wrong.append(f"{program} {command}")
            continue
        legal = keys(command)
        for word in shlex.split(rest, comments=True):
            key, _, value = word.strip("[]").partition("=")
            name = key.lower() if key.isupper() else key
            names = {"exp": recipes() if command == "train" else (), "data": datasets()}.get(name, ())
            unknown = bool(value) and bool(legal) and "." not in name and name not in legal
            if unknown or (names and value not in names and not any(own in value for own in (*OWN, "runs/"))):
                wrong.append(f"{program} {command} {word}")
    return wrong


def keys(command: str) -> set[str]:
    """Returns the keys of a command; empty if a recipe decides."""
    file = EXPERIMENTS / f"{command}.yaml"
    groups = {path.name for path in EXPERIMENTS.iterdir() if path.is_dir()}
    return {*yaml.safe_load(file.read_text()), *groups} if file.exists() else set()


def datasets() -> set[str]:
    """Returns the names of the data sets."""
    return {path.stem for path in (EXPERIMENTS / "data").glob("*.yaml")}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_names_paths_and_commands_of_a_page_exist(page):
    text = page.read_text()
    assert broken_links(page, text) == []
    assert unknown_names(text) == []
    assert unknown_paths(text) == []
    assert wrong_commands(text) == []


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
    assert unknown_names("flame_mdm.load evaluators.run.evaluate flame_mdm.nothing flame_mdm.config.nothing") == [
        "flame_mdm.config.nothing",
        "flame_mdm.nothing",
    ]
    assert unknown_paths("experiments/base.yaml experiments/nothing.yaml") == ["experiments/nothing.yaml"]
    text = "```sh\nmake train EXP=quickstart a.b=1\n```\n    make trian\n`make edit FRAMEZ=1` `make train EXP=nothing`"
    assert wrong_commands(text) == ["make trian", "make edit FRAMEZ=1", "make train EXP=nothing"]


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
