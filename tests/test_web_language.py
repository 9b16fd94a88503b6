"""The page that samples in the browser understands texts as the package does; its scripts run in Node.js."""

import json
import shutil
from dataclasses import asdict
from typing import Any

import pytest
from support.fixtures import ROOT, script
from support.npm import node

from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.reading import NotUnderstood, Reader
from flame_mdm.conditions.language.wording import predicate
from flame_mdm.data.synthetic import prompts
from flame_mdm.errors import UserError
from flame_mdm.safe_io import read_package_yaml

pytestmark = [
    pytest.mark.tools,
    pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js"),
]
FIXTURES = ROOT / "tests" / "fixtures"
ODD = [
    "",
    "!!!",
    "kicks ４ times",
    "kicks ² times",
    "kicks x 3, then faster",
    "jumps 13 times",
    "a person jumps followed by bowing",
    "constructor walks __proto__ toString",
    "он идёт вперёд",
    "一个人走路",
    "a person walks in limp style",
    "stretches both arms above the head and leans to the left",
    "while walking, a man waves with the left hand",
    "a person somersaults | he bows @2",
    "ÉLÈVE WALKS",
    f"a person {'very ' * 40}slowly yodels",
]
"""Texts at the limits of what is understood: no words, digits of other scripts, names of JavaScript's objects."""


def typed_texts() -> list[str]:
    """Returns the texts of both fixtures, and those at the limits."""
    lines = (FIXTURES / "typed_requests.jsonl").read_text(encoding="utf-8").splitlines()
    sentences = read_package_yaml(FIXTURES / "sentences.yaml")
    return [
        *(json.loads(line)["text"] for line in lines),
        *(row["text"] for row in sentences),
        *ODD,
    ]


def models() -> list[dict[str, Any]]:
    """Returns the facts of two models: actions of the synthetic set, and more actions with two of them at once."""
    captions = [text for text, _ in prompts()]
    few = {
        "actions": list(dict.fromkeys(str(attributes["action"]) for _, attributes in prompts())),
        "captions": captions,
        "vocabulary": sorted({word for text in captions for word in text.lower().split()}),
    }
    both = "a person walks forward while waving with the left hand"
    added = "stretches sideways sneaks slowly limps yodels crawls somersaults"
    many = {
        "actions": [*few["actions"], "stretch sideways", "sneak", "limp", "no_action"],
        "captions": [*captions, both],
        "vocabulary": sorted({*few["vocabulary"], *both.split(), *added.split()}),
    }
    return [few, many]


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Readings of all texts by the scripts of the page, and the choices that they offer."""
    folder = tmp_path_factory.mktemp("language")
    for path in (ROOT / "tools" / "web").glob("language_*.js"):
        shutil.copy(path, folder)
    script("tools/web.py").write_language(folder)
    (folder / "package.json").write_text('{"type": "module"}')
    content = {"models": models(), "texts": typed_texts()}
    (folder / "requests.json").write_text(json.dumps(content), encoding="utf-8")
    return node("web_language.mjs", folder)


def understanding(text: str) -> dict[str, Any]:
    content = asdict(understand(text))
    return content | {"isForeign": content.pop("is_foreign")}


def reading(reader: Reader, text: str) -> dict[str, Any]:
    try:
        read = asdict(reading := reader.read(text))
    except UserError as error:
        if isinstance(error, NotUnderstood):
            return {"refused": error.message, "nearest": error.nearest}
        return {"refused": str(error), "nearest": ()}
    predicates = [predicate(mention) for step in reading.steps for mention in step]
    names = ("captions", "texts", "changes", "ignored")
    seconds = min(3, next(iter(reading.seconds()), None) or 3)
    added = {"predicates": predicates, "seconds": seconds}
    return {name: read[name] for name in names} | added


def plain(content: Any) -> Any:
    """Returns a content as JSON gives it back: lists for tuples."""
    return json.loads(json.dumps(content))


def differences(texts: list[str], ours: list[Any], theirs: list[Any]) -> list[tuple[str, Any, Any]]:
    rows = zip(texts, plain(ours), theirs, strict=True)
    return [(text, own, other) for text, own, other in rows if own != other]


def test_the_page_understands_all_texts_as_the_package_does(page: dict[str, Any]) -> None:
    texts = typed_texts()
    assert len(texts) > 500
    ours = [understanding(text) for text in texts]
    assert differences(texts, ours, [answer["understanding"] for answer in page["answers"]]) == []


@pytest.mark.parametrize("number", [0, 1])
def test_models_read_the_same_captions_on_the_page(page: dict[str, Any], number: int) -> None:
    texts, reader = typed_texts(), Reader(models()[number])
    ours = [reading(reader, text) for text in texts]
    theirs = [answer["readings"][number] for answer in page["answers"]]
    assert differences(texts, ours, theirs) == []
    refused = sum("refused" in row for row in ours)
    assert 0.05 < refused / len(ours) < 0.95


@pytest.mark.parametrize("number", [0, 1])
def test_the_chips_of_the_page_offer_the_values_that_the_model_knows(
    page: dict[str, Any], number: int
) -> None:
    abilities = Reader(models()[number]).abilities
    ours = [(action, abilities.choices(action)) for action in abilities.actions]
    assert plain(ours) == page["choices"][number]
