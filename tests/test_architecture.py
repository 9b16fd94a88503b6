"""The shape of the code: who may import whom."""

import ast
from pathlib import Path

import pytest
from fixtures import ROOT

FILES = sorted([*(ROOT / "flame_mdm").rglob("*.py"), *(ROOT / "evaluators").rglob("*.py")])

AXES = ("denoisers", "processes", "conditions", "representations")
VOCABULARY = {"flame_mdm.motion"}
LEGAL = {
    "motion": set(),
    "noise": VOCABULARY,
    "config": set(),
    "losses": set(),
    "denoisers": VOCABULARY | {"flame_mdm.denoisers"},
    "processes": VOCABULARY | {"flame_mdm.processes", "flame_mdm.losses"},
    "conditions": VOCABULARY | {"flame_mdm.conditions", "flame_mdm.config"},
    "representations": VOCABULARY | {"flame_mdm.representations"},
    "data": VOCABULARY | {"flame_mdm.data", "flame_mdm.representations", "flame_mdm.noise", "flame_mdm.config"},
    "visualize": {"flame_mdm.visualize", "flame_mdm.representations"},
}
"""What each part may import of this project; parts that are not listed stand above all of these."""


def imports(path: Path) -> set[str]:
    """Names of the modules of this project that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names.add(node.module)
            if node.module == "flame_mdm":
                names |= {f"flame_mdm.{alias.name}" for alias in node.names}
    return {name for name in names if name.split(".")[0] in ("flame_mdm", "evaluators") and name != "flame_mdm"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_in_one_direction(path):
    relative = path.relative_to(ROOT)
    used = imports(path)
    if relative.parts[0] == "flame_mdm":
        assert not any(name.startswith("evaluators") for name in used), "flame_mdm must not import evaluators"
    part = relative.with_suffix("").parts[1]
    if relative.parts[0] == "flame_mdm" and part in LEGAL:
        illegal = {name for name in used if not any(name == p or name.startswith(f"{p}.") for p in LEGAL[part])}
        assert not illegal


def test_the_check_of_imports_can_fail(tmp_path):
    path = tmp_path / "file.py"
    path.write_text("from flame_mdm import config\nimport flame_mdm.task\nfrom flame_mdm.data.store import Store\n")
    assert imports(path) == {"flame_mdm.config", "flame_mdm.task", "flame_mdm.data.store"}


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_modules_and_public_classes_say_what_they_are(path):
    tree = ast.parse(path.read_text())
    assert ast.get_docstring(tree) or not tree.body, "no docstring"
    for node in tree.body:
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
            assert ast.get_docstring(node), node.name


def test_files_are_nouns_not_drawers():
    forbidden = {"utils", "util", "misc", "helpers", "common", "tools"}
    assert not forbidden & {part for path in FILES for part in path.relative_to(ROOT).with_suffix("").parts}


def unsafe_calls(path: Path) -> list[str]:
    """Calls that run code out of files or words out of a shell."""
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if not isinstance(node, ast.Call):
            continue
        called = ast.unparse(node.func)
        options = {keyword.arg: ast.unparse(keyword.value) for keyword in node.keywords}
        unsafe = (
            called in ("eval", "exec", "os.system", "os.popen", "pickle.load", "pickle.loads", "pickle.Unpickler")
            or (called == "torch.load" and options.get("weights_only") != "True")
            or (called in ("np.load", "numpy.load") and options.get("allow_pickle", "False") != "False")
            or (called in ("yaml.load", "yaml.unsafe_load", "yaml.full_load", "joblib.load", "torch.hub.load"))
            or options.get("shell", "False") != "False"
            or options.get("trust_remote_code", "False") != "False"
        )
        if unsafe:
            found.append(ast.unparse(node))
    return found


ON_DEMAND = ["torch.load(path, map_location='cpu', weights_only=not run_code)"]
"""What `--run-code-in-file` asks for."""


@pytest.mark.parametrize("path", FILES, ids=lambda path: str(path.relative_to(ROOT)))
def test_no_file_and_no_word_of_strangers_is_run(path):
    assert unsafe_calls(path) == (ON_DEMAND if path.name == "checkpoints.py" else [])


@pytest.mark.parametrize(
    "line",
    [
        *("torch.load(f)", "torch.load(f, weights_only=False)", "np.load(f, allow_pickle=True)", "yaml.load(f)"),
        *(
            "pickle.load(f)",
            "os.system(f)",
            "subprocess.run(f, shell=True)",
            "M.from_pretrained(f, trust_remote_code=f)",
        ),
    ],
)
def test_the_check_of_calls_can_fail(tmp_path, line):
    path = tmp_path / "file.py"
    path.write_text(f"def g(f):\n    return {line}\n")
    assert unsafe_calls(path) == [line]
