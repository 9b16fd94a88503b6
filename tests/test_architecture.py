"""The shape of the code: which part may import which."""

import ast
import re
import subprocess
import sys
from collections.abc import Mapping
from functools import cache
from graphlib import CycleError, TopologicalSorter

import pytest
from support.fixtures import ROOT

FILES = sorted([*(ROOT / "flame_mdm").rglob("*.py"), *(ROOT / "evaluators").rglob("*.py")])

AXES = {"denoisers", "processes", "conditions", "representations"}
GROUND = {
    "errors",
    "signals",
    "sampler_options",
    "losses",
    "safe_io",
    "config",
    "batch",
    "seeds",
    "progress",
}
MODELS = GROUND | AXES | {"visualize", "formats", "data", "generator", "task"}
ALL = MODELS | {"sampling", "checkpoints", "schemas", "records", "runs", "reporting", "training"}
MAY_IMPORT: dict[str, set[str]] = {
    "errors": set(),
    "sampler_options": {"errors", "config"},
    "losses": {"batch"},
    "signals": set(),
    "progress": {"signals"},
    "representations": {"errors"},
    "safe_io": {"errors"},
    "batch": {"errors"},
    "seeds": {"errors", "batch"},
    "config": {"errors", "safe_io", "signals"},
    "denoisers": GROUND,
    "processes": GROUND,
    "conditions": GROUND,
    "visualize": GROUND | {"representations"},
    "formats": GROUND | {"representations", "visualize"},
    "data": GROUND | {"representations", "visualize", "formats", "schemas"},
    "generator": GROUND | AXES,
    "task": GROUND | AXES | {"data", "generator"},
    "schemas": GROUND,
    "records": GROUND | {"schemas"},
    "runs": GROUND | {"schemas", "records"},
    "reporting": GROUND
    | {"representations", "visualize", "formats", "data", "schemas", "records", "runs"},
    "sampling": MODELS | {"schemas"},
    "checkpoints": MODELS | {"schemas"},
    "training": ALL - {"training"},
    "demo": MODELS | {"sampling", "checkpoints"},
    "__init__": MODELS | {"sampling", "checkpoints", "training"},
    "evaluators": ALL,
    "commands": ALL | {"evaluators", "demo"},
    "__main__": GROUND | {"commands"},
}
"""Parts of the project, from the ground up, and what each may import besides itself."""


@cache
def parsed(text: str) -> ast.Module:
    """Syntax tree of a module, which no check changes."""
    return ast.parse(text)


@cache
def sources() -> dict[str, str]:
    """Text of each module, by its dotted name."""
    names = [
        ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        for path in FILES
    ]
    return {name: path.read_text() for name, path in zip(names, FILES, strict=True)}


def imports(texts: Mapping[str, str]) -> dict[str, set[str]]:
    """Modules of this project that each module imports, in functions and for type checking included."""
    graph: dict[str, set[str]] = {name: set() for name in texts}
    for name, text in texts.items():
        for node in ast.walk(parsed(text)):
            if isinstance(node, ast.Import):
                graph[name] |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                assert not node.level, f"{name}: relative import"
                for alias in node.names:
                    module = f"{node.module}.{alias.name}"
                    graph[name].add(
                        module
                        if module in texts or node.module == "flame_mdm"
                        else str(node.module)
                    )
    own = ("flame_mdm", "evaluators")
    return {
        name: {module for module in used if module.split(".")[0] in own}
        for name, used in graph.items()
    }


def part(module: str) -> str:
    package, *rest = module.split(".")
    return package if package == "evaluators" else rest[0] if rest else "__init__"


def upward(graph: Mapping[str, set[str]]) -> list[str]:
    """Imports that `MAY_IMPORT` does not list."""
    return sorted(
        f"{name} imports {module}"
        for name, used in graph.items()
        for module in used
        if part(module) not in MAY_IMPORT[part(name)] | {part(name)}
    )


def cycle(graph: Mapping[str, set[str]]) -> list[str]:
    """Modules that import one another in a circle; empty if there is none."""
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        return error.args[1]
    return []


def strings_with_evaluators(text: str) -> list[str]:
    """Strings, apart from docstrings, that name a module inside `evaluators`."""
    nodes = list(ast.walk(parsed(text)))
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    strings = [
        str(node.value)
        for node in nodes
        if isinstance(node, ast.Constant) and id(node) not in docstrings
    ]
    return [string for string in strings if re.search(r"\bevaluators\.\w", string)]


def reachable(name: str) -> set[str]:
    """Parts that a part may import, directly or through others."""
    return MAY_IMPORT[name].union(*(reachable(other) for other in MAY_IMPORT[name]))


def test_a_part_imports_only_what_its_rule_lists_and_no_modules_import_one_another_in_a_circle():
    graph = imports(sources())
    assert {part(name) for name in graph} - MAY_IMPORT.keys() == set(), "every part has a rule"
    assert upward(graph) == []
    assert cycle(graph) == []


def test_the_rules_are_those_of_the_design():
    assert cycle(MAY_IMPORT) == []
    assert [name for name, parts in MAY_IMPORT.items() if "evaluators" in parts] == ["commands"]
    assert [name for name, parts in MAY_IMPORT.items() if "commands" in parts] == ["__main__"]
    assert not reachable("reporting") & {
        "task",
        "denoisers",
        "checkpoints",
        "sampling",
        "evaluators",
    }
    assert all(not MAY_IMPORT[axis] & AXES for axis in AXES)
    assert not reachable("visualize") & {"formats", "data", "task"}
    assert not reachable("formats") & {"data", "task"}
    assert not reachable("data") & {"task", "checkpoints"}
    assert not reachable("task") & {"checkpoints", "sampling"}


def test_strings_outside_commands_name_no_module_of_the_evaluators():
    texts = {
        name: text
        for name, text in sources().items()
        if part(name) not in ("commands", "evaluators")
    }
    assert {
        name: found for name, text in texts.items() if (found := strings_with_evaluators(text))
    } == {}


def test_these_checks_can_fail(tmp_path, subtests):
    for name, line in (
        ("flame_mdm.denoisers.mdm", "from flame_mdm.conditions.text import TextEncoder"),
        ("flame_mdm.formats.readers", "def f():\n    from flame_mdm.data.folder import read_bvh"),
        ("flame_mdm", "import flame_mdm.reporting.report"),
        ("flame_mdm.__main__", "if TYPE_CHECKING:\n    from evaluators import evaluation"),
    ):
        with subtests.test(name=name, line=line):
            assert len(upward(imports({name: line}))) == 1
    text = "from flame_mdm import config\nimport flame_mdm.task\nfrom flame_mdm.data.store import Store\nimport torch\n"
    assert imports({"a": text})["a"] == {
        "flame_mdm.config",
        "flame_mdm.task",
        "flame_mdm.data.store",
    }
    texts = {
        "flame_mdm.data.a": "from flame_mdm.data import b",
        "flame_mdm.data.b": "import flame_mdm.data.a",
    }
    assert set(cycle(imports(texts))) == texts.keys()
    text = '"""See evaluators.run."""\nmodule = "evaluators.protocol:change"\nimport_module(f"evaluators.{module}")\n'
    assert strings_with_evaluators(text) == ["evaluators.protocol:change"]
    lines = [
        "torch.load(f)",
        "torch.load(f, weights_only=False)",
        "np.load(f, allow_pickle=True)",
        "yaml.load(f)",
    ]
    lines += [
        "pickle.load(f)",
        "os.system(f)",
        "run(f, shell=True)",
        "M.from_pretrained(f, trust_remote_code=f)",
    ]
    assert unsafe_calls("\n".join(lines)) == lines
    long = "\n".join(["def f(given):", *["    pass"] * 80])
    wide = "\n".join(["class A:", *[f"    def f{n}(self): pass" for n in range(16)]])
    assert shape(long) == ["f: function of 80 statements", "given: filler name"]
    assert shape(wide) == ["A: class of 16 methods"]
    assert shape("found = 1\n" * 451)[:2] == ["module of 451 statements", "found: filler name"]
    assert undocumented("import ast\nclass A: pass\nclass _B: pass") == ["A", "module"]


def undocumented(text: str) -> list[str]:
    """Public classes without a docstring, and "module" if it has none."""
    tree = parsed(text)
    classes = [
        node
        for node in tree.body
        if isinstance(node, ast.ClassDef) and not node.name.startswith("_")
    ]
    lacking = [node.name for node in classes if not ast.get_docstring(node)]
    return lacking + ["module"] * bool(tree.body and not ast.get_docstring(tree))


def test_modules_and_public_classes_say_what_they_are():
    assert {
        name: lacking for name, text in sources().items() if (lacking := undocumented(text))
    } == {}


def test_requests_are_checked_before_torch_is_imported():
    code = "import sys, flame_mdm.sampling.motion_request; sys.exit('torch' in sys.modules or 'numpy' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


UNSAFE = {
    "eval",
    "exec",
    "os.system",
    "os.popen",
    "pickle.load",
    "pickle.loads",
    "pickle.Unpickler",
    "joblib.load",
}
SWITCHES = ("allow_pickle", "shell", "trust_remote_code")
"""Keyword arguments that let a call run code out of files or words out of a shell, unless they are False."""
UNSAFE |= {"yaml.load", "yaml.unsafe_load", "yaml.full_load", "torch.hub.load"}


def unsafe_calls(text: str) -> list[str]:
    """Calls that run code out of files or words out of a shell."""
    unsafe = []
    for node in (node for node in ast.walk(parsed(text)) if isinstance(node, ast.Call)):
        called = ast.unparse(node.func)
        options = {"weights_only": str(called != "torch.load")}
        options |= {
            str(keyword.arg): ast.unparse(keyword.value)
            for keyword in node.keywords
            if keyword.arg in ("weights_only", *SWITCHES)
        }
        switches = {options.get(name, "False") for name in SWITCHES}
        if called in UNSAFE or switches != {"False"} or options["weights_only"] != "True":
            unsafe.append(ast.unparse(node))
    return unsafe


ON_DEMAND = ["torch.load(path, map_location='cpu', weights_only=not run_code)"]
"""Uses of `run_code_in_file=true`, which only `flame_mdm.checkpoints` may have."""


def test_no_untrusted_file_or_word_is_executed():
    unsafe = {name: calls for name, text in sources().items() if (calls := unsafe_calls(text))}
    assert all(
        part(name) == "checkpoints" and calls == ON_DEMAND for name, calls in unsafe.items()
    ), unsafe


WRITERS = {
    "np.save",
    "np.savez",
    "np.savez_compressed",
    "torch.save",
    "onnx.save",
    "json.dump",
    "pickle.dump",
}
WRITERS |= {
    "os.open",
    "os.replace",
    "os.rename",
    "os.link",
    "os.symlink",
    "os.truncate",
    "os.mkfifo",
}
WRITERS |= {
    f"shutil.{name}" for name in ("copy", "copy2", "copyfile", "copytree", "move", "make_archive")
}
WRITING_METHODS = {
    "save",
    "save_file",
    "write_text",
    "write_bytes",
    "rename",
    "symlink_to",
    "hardlink_to",
    "touch",
}
OPENERS = {
    "open": 1,
    "io.open": 1,
    "gzip.open": 1,
    "tarfile.open": 1,
    "zipfile.ZipFile": 1,
    "ZipFile": 1,
}
"""Functions that open a file, and the position of the mode; of a method `open`, the mode is the first argument."""
TEMPORARIES = {
    "atomic_write",
    "atomic_folder",
    "temporary_beside",
    "_temporary",
    "TemporaryDirectory",
    "mkdtemp",
}
TEMPORARIES |= {"BytesIO", "token_hex"}
"""Functions whose result names a file of this process alone; the runner, which stands alone, draws its own name."""


def writing_calls(text: str) -> list[str]:
    """Calls that write to a file, as "function: call", unless they name a temporary file or a value made of one."""
    calls = []
    tree = parsed(text)
    for scope in (tree, *(node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))):
        writers = [node for node in within(scope) if isinstance(node, ast.Call) and is_writer(node)]
        temporary = temporary_names(scope) if writers else set()
        function = getattr(scope, "name", "module")
        calls += [
            f"{function}: {ast.unparse(node.func)}"
            for node in writers
            if not names_in(node) & temporary
        ]
    return sorted(set(calls))


def within(scope: ast.AST) -> list[ast.AST]:
    """Nodes of a module or function, without the nodes of the functions in it."""
    nodes: list[ast.AST] = []
    for node in ast.iter_child_nodes(scope):
        if not isinstance(node, ast.FunctionDef):
            nodes += [node, *within(node)]
    return nodes


def names_in(node: ast.AST) -> set[str]:
    return {name.id for name in ast.walk(node) if isinstance(name, ast.Name)}


def temporary_names(scope: ast.AST) -> set[str]:
    """Names that a function binds to a temporary path or to something made of one."""
    bindings = []
    for node in within(scope):
        if isinstance(node, ast.withitem) and node.optional_vars:
            bindings.append((node.optional_vars, node.context_expr))
        elif isinstance(node, ast.Assign):
            bindings += [(target, node.value) for target in node.targets]
    links = [(names_in(target), names_in(value)) for target, value in bindings]
    temporary = {
        name
        for target, value in bindings
        if called_names(value) & TEMPORARIES
        for name in names_in(target)
    }
    while (
        new := {name for target, used in links if used & temporary for name in target} - temporary
    ):
        temporary |= new
    return temporary


def called_names(node: ast.AST) -> set[str]:
    """Last names of the functions that an expression calls."""
    return {
        ast.unparse(call.func).split(".")[-1]
        for call in ast.walk(node)
        if isinstance(call, ast.Call)
    }


def is_writer(call: ast.Call) -> bool:
    called, method = ast.unparse(call.func), isinstance(call.func, ast.Attribute) and call.func.attr
    if called in OPENERS or method == "open":
        modes = [keyword.value for keyword in call.keywords if keyword.arg == "mode"]
        modes += call.args[OPENERS.get(called, 0) :][:1]
        texts = [str(mode.value) for mode in modes if isinstance(mode, ast.Constant)]
        return called == "os.open" or any(
            re.fullmatch("[rbt]*[wax+][wax+bt]*([:|].*)?", text) for text in texts
        )
    one = len(call.args) == 1 and not call.keywords  # a text's `replace` takes two arguments
    return called in WRITERS or method in WRITING_METHODS or (method == "replace" and one)


PUBLIC = "a method that writes under a temporary name itself"
INSIDE = "in the temporary folder that the caller has opened"
MAY_WRITE = {
    "flame_mdm.checkpoints.onnx_export": {
        "_shrink: onnx.save": INSIDE,
        "write_graph: program.save": INSIDE,
    },
    "flame_mdm.commands.convert": {"_convert: motion.save": PUBLIC},
    "flame_mdm.commands.sample": {"_write_files: written.save": PUBLIC},
    "flame_mdm.data.store": {
        "_pack: (folder / 'features.npy').open": INSIDE,
        "_pack: zipfile.ZipFile": INSIDE,
        "_write: (folder / 'clips.jsonl').write_text": INSIDE,
        "_write: (folder / 'store.json').write_text": INSIDE,
        "_write: np.savez": INSIDE,
    },
    "flame_mdm.errors": {"drop: os.open": "the null device, for output that nobody reads"},
    "flame_mdm.formats.characters": {"write: binary.save": PUBLIC},
    "flame_mdm.formats.glb_writer": {"write: binary.save": PUBLIC},
    "flame_mdm.formats.vrma": {"write: binary.save": PUBLIC},
    "flame_mdm.training.callbacks": {
        "log_values: logger.save": "loggers write their own files, as after a step of Lightning"
    },
    "flame_mdm.training.checkpointing": {
        "save_checkpoint: path.replace": "the last checkpoint becomes the previous one"
    },
}
"""Calls outside `safe_io` that write to a file without naming a temporary one, and why they may."""


def test_files_are_written_under_a_temporary_name():
    texts = {name: text for name, text in sources().items() if part(name) != "safe_io"}
    assert {name: calls for name, text in texts.items() if (calls := writing_calls(text))} == {
        name: sorted(calls) for name, calls in MAY_WRITE.items()
    }


@pytest.mark.parametrize(
    "call",
    [
        *(
            "open(path, 'w')",
            "open(path, mode='ab')",
            "path.open('xb')",
            "path.open('r+')",
            "zipfile.ZipFile(path, 'w')",
        ),
        *(
            "tarfile.open(path, 'w:gz')",
            "path.write_text('')",
            "path.write_bytes(b'')",
            "image.save(path)",
            "np.save(path, x)",
        ),
        *(
            "np.savez(path, x=x)",
            "np.savez_compressed(path, x=x)",
            "torch.save(x, path)",
            "json.dump(x, open(path, 'w'))",
        ),
        *(
            "shutil.copy(x, path)",
            "os.replace(x, path)",
            "x.replace(path)",
            "x.rename(path)",
            "path.symlink_to(x)",
        ),
        "os.open(path, os.O_WRONLY)",
    ],
)
def test_a_call_that_writes_in_place_is_seen_and_one_to_a_temporary_file_is_not(call):
    assert writing_calls(f"def f(path, x):\n    {call}")
    assert writing_calls(
        f"def f(path, x):\n    with atomic_write(path) as temporary:\n        {call}"
    )
    made = f"with atomic_folder(out) as made:\n        path = x = made / 'part'\n        {call}"
    assert not writing_calls(f"def f(out):\n    {made}")


@pytest.mark.parametrize(
    "call",
    [
        "open(path)",
        "path.open('rb')",
        "text.replace('a', 'b')",
        "zipfile.ZipFile(path)",
        "Cache.open(path, a)",
    ],
)
def test_a_call_that_reads_is_not_taken_for_one_that_writes(call):
    assert not writing_calls(f"def f(path, text):\n    {call}")


FILLERS = {"found", "each", "given", "known", "wanted", "place", "places", "told", "asked"}
FILLERS |= {"own", "what", "how", "made", "way"}
"""Names that do not say what a value holds."""
KEPT = {"flame_mdm.batch": ["known: filler name"]}
"""`Edit.known`, the name of the kept part in the papers on inpainting."""


def statements(node: ast.AST) -> int:
    """The number of statements in a module or function."""
    return sum(isinstance(part, ast.stmt) for part in ast.walk(node) if part is not node)


def shape(text: str) -> list[str]:
    """Modules and functions that are too long, classes with too many methods, and filler names."""
    faults = []
    module = parsed(text)
    if statements(module) > 320:
        faults.append(f"module of {statements(module)} statements")
    for node in ast.walk(module):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            if statements(node) > 60:
                faults.append(f"{node.name}: function of {statements(node)} statements")
        elif isinstance(node, ast.ClassDef):
            methods = sum(
                isinstance(item, ast.FunctionDef | ast.AsyncFunctionDef) for item in node.body
            )
            if methods > 15:
                faults.append(f"{node.name}: class of {methods} methods")
        elif isinstance(node, ast.arg) and node.arg in FILLERS:
            faults.append(f"{node.arg}: filler name")
        elif isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in FILLERS:
            faults.append(f"{node.id}: filler name")
    return faults


def test_modules_functions_and_classes_are_short_and_names_say_what_a_value_holds():
    faults = {name: sorted(set(shape(text))) for name, text in sources().items()}
    assert {name: lines for name, lines in faults.items() if lines} == KEPT


def test_the_house_has_few_rooms_and_files_are_nouns():
    rooms = {".".join(name.split(".")[:2]) for name in sources() if name.startswith("flame_mdm.")}
    assert len(rooms) + 2 <= 30  # and flame_mdm, evaluators
    drawers = {"utils", "util", "misc", "helpers", "common", "tools"}
    assert not drawers & {part for name in sources() for part in name.split(".")}
