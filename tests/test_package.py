"""What surrounds the code: version, changelog, citation, workflows, and old names that still work."""

import hashlib
import json
import re
import tomllib

import pytest
import yaml
from support.fixtures import ROOT

import flame_mdm
from flame_mdm.data.mixture import known_licenses
from flame_mdm.errors import renamed_names
from flame_mdm.safe_io import read_package_yaml
from flame_mdm.task import GeneratorTask
from flame_mdm.training import distillation

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
CONTENTS = ROOT / "tests" / "golden" / "contents.json"
REWORDED = ROOT / "flame_mdm" / "conditions" / "language"  # words, which other tests read
FORMS = sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"))


def test_the_version_is_the_same_everywhere():
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"] == flame_mdm.__version__
    newest = re.search(r"^## (\d+\.\d+\.\d+)", (ROOT / "CHANGELOG.md").read_text(), re.MULTILINE)
    assert newest is not None
    assert newest[1] == flame_mdm.__version__
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert project["project"]["dynamic"] == ["version"]
    assert (ROOT / project["tool"]["hatch"]["version"]["path"]).is_file()


def test_type_checkers_see_the_types_of_both_packages():
    assert (ROOT / "flame_mdm" / "py.typed").is_file()
    assert (ROOT / "evaluators" / "py.typed").is_file()


def test_the_citation_has_the_papers_of_all_methods():
    references = yaml.safe_load((ROOT / "CITATION.cff").read_text())["references"]
    addresses = {reference["url"].rpartition("/")[2] for reference in references}
    assert addresses == {"2209.00349", "2209.14916", "2312.08895", "2410.03441"}


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_workflows_call_what_exists(path, subtests):
    workflow = yaml.safe_load(path.read_text())
    steps = [step for job in workflow["jobs"].values() for step in job["steps"]]
    commands = [step["run"] for step in steps if "run" in step]
    assert commands
    targets = set(re.findall("^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for command in commands:
        with subtests.test(command=command):
            words = command.split()
            if words[0] == "make":
                assert words[1] in targets
            elif words[0].startswith("."):
                assert (ROOT / words[0]).is_file()
    assert all(job["runs-on"] for job in workflow["jobs"].values())


@pytest.mark.parametrize("path", FORMS, ids=lambda path: path.stem)
def test_forms_of_issues_ask_for_something(path):
    form = yaml.safe_load(path.read_text())
    assert form["name"]
    assert form["description"]
    assert any(field.get("validations", {}).get("required") for field in form["body"])


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        ("flame_mdm.task", "MotionGeneration", GeneratorTask),
        (
            "flame_mdm.training.distillation",
            "ConsistencyDistillation",
            distillation.DistillationTask,
        ),
    ],
)
def test_an_old_name_works_and_says_the_new_one(module, old, new):
    get = renamed_names(module, {old: new.__name__}, since="0.3")
    with pytest.warns(
        DeprecationWarning, match=f"{old} was renamed to {new.__name__} in version 0.3"
    ):
        assert get(old) is new
    with pytest.raises(AttributeError, match="has no attribute 'Nothing'"):
        get("Nothing")


def test_the_modules_still_have_their_old_names():
    import flame_mdm.task as task

    with pytest.warns(DeprecationWarning, match="GeneratorTask"):
        assert task.MotionGeneration is GeneratorTask
    with pytest.warns(DeprecationWarning, match="DistillationTask"):
        assert distillation.ConsistencyDistillation is distillation.DistillationTask


def test_licenses_and_the_uses_that_they_permit():
    uses = {name: license["use"] for name, license in known_licenses().items()}
    assert uses == {
        **dict.fromkeys(("MIT", "CC0", "CC-BY-4.0", "CMU"), "any"),
        "CC-BY-NC-4.0": "research",
    }


def contents() -> dict[str, str]:
    """Hashes of the values in recipes, protocols, published numbers and other data files, without comments."""
    files = [
        path
        for folder in ("experiments", "flame_mdm")
        for path in sorted((ROOT / folder).rglob("*.yaml"))
        if REWORDED not in path.parents
    ]
    texts = {path: json.dumps(read_package_yaml(path), default=str) for path in files}
    return {
        path.relative_to(ROOT).as_posix(): hashlib.sha256(text.encode()).hexdigest()[:12]
        for path, text in texts.items()
    }


def test_numbers_in_data_files_change_only_on_purpose():
    """A protocol with other numbers needs another version; a paper's number and a rig do not change at all."""
    kept, now = json.loads(CONTENTS.read_text()), contents()
    changed = sorted(name for name in kept.keys() | now.keys() if kept.get(name) != now.get(name))
    assert changed == [], "if this is intended, run: python tests/test_package.py"


if __name__ == "__main__":
    CONTENTS.write_text(json.dumps(contents(), indent=0) + "\n")
