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


@pytest.mark.parametrize(
    ("name", "digest"),
    [
        ("data/amass", "eb69a76e9733471d"),
        ("data/bandai", "be2db24dfbe55768"),
        ("data/cmu", "c912be610f6b8c6f"),
        ("data/published", "0e1b47ee3d6e05a1"),
        ("data/synthetic", "a891a9df1200c9ea"),
        ("data/synthetic_more", "116f19aa4b8a05db"),
        ("formats/layouts", "c9cc2a1eeed72df0"),
        ("formats/rigs", "967abdb9cff59ec3"),
    ],
)
def test_names_and_numbers_of_others_and_captions_do_not_change(name: str, digest: str):
    """Prepared stores and models depend on them. After an intended change, update the digest."""
    content = read_package_yaml(ROOT / "flame_mdm" / f"{name}.yaml")
    text = json.dumps(content, sort_keys=True)
    assert hashlib.sha256(text.encode()).hexdigest()[:16] == digest


def test_licenses_and_the_uses_that_they_permit():
    uses = {name: license["use"] for name, license in known_licenses().items()}
    assert uses == {
        **dict.fromkeys(("MIT", "CC0", "CC-BY-4.0", "CMU"), "any"),
        "CC-BY-NC-4.0": "research",
    }
