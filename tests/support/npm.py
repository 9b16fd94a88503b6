"""Packages of npm that read motion files, and scripts that use them."""

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
