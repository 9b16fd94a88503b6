"""Builds the extension for Blender 4.2 and later: `make blender [PLATFORM=windows-x64]`.

The script writes build/flame_mdm-PLATFORM.zip. The extension contains a model from this package and
generates motions with it. The onnxruntime wheels come from the package index.
"""

from __future__ import annotations

import platform
import re
import shutil
import subprocess
import sys
import tempfile
import zipfile
from importlib.metadata import requires, version
from pathlib import Path

from flame_mdm.checkpoints.onnx_export import RUNNER, export_onnx
from flame_mdm.conditions import language
from flame_mdm.errors import UserError, did_you_mean, say
from flame_mdm.formats import names, posture, rig
from flame_mdm.formats.characters import known_skeletons
from flame_mdm.representations import skeleton
from flame_mdm.safe_io import atomic_write, read_package_yaml, write_json, write_text

SOURCE = Path(__file__).with_suffix("")
PYTHON = "3.11"
"""Python version of Blender 4.2 to 5.0."""
PLATFORMS = {
    "linux-x64": ("manylinux_2_28_x86_64", "manylinux2014_x86_64"),
    "windows-x64": ("win_amd64",),
    "macos-arm64": ("macosx_14_0_arm64",),
}
"""Blender's platform names -> the tags of their wheels."""
LANGUAGE = Path(str(language.__file__)).parent
MODULES = (
    RUNNER,
    *(
        Path(str(module.__file__))
        for module in (skeleton, names, posture, rig, sys.modules[UserError.__module__])
    ),
    *sorted(LANGUAGE.glob("[!_]*.py")),
)
"""Modules that are copied into the extension. They depend only on numpy."""


def this_machine() -> str:
    """Returns Blender's name for this platform, such as linux-x64."""
    system = {"Darwin": "macos"}.get(platform.system(), platform.system().lower())
    return f"{system}-{'arm64' if platform.machine().lower() in ('arm64', 'aarch64') else 'x64'}"


def build(model: str, out: Path, target: str) -> None:
    """Builds the extension for one platform.

    Args:
        model: the model to include, as in `flame_mdm.load`.
        out: path of the zip file.
        target: Blender's name for the platform, such as linux-x64.

    Raises:
        UserError: If the platform is unknown, or if pip finds no wheels for it.
    """
    if target not in PLATFORMS:
        raise UserError(
            f"PLATFORM={target}: unknown.{did_you_mean(target, PLATFORMS)} Use one "
            f"of {', '.join(PLATFORMS)}"
        )
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        fetch_wheels(folder / "wheels", target)
        export_onnx(model, folder / "model", half=True)
        (folder / "model" / RUNNER.name).unlink()
        for path in (*MODULES, *sorted(SOURCE.glob("*.py"))):
            write_text(folder / path.name, relative_imports(path.read_text(encoding="utf-8")))
        write_language(folder)
        write_json(folder / "skeletons.json", known_skeletons(), indent=None)
        wheels = ", ".join(
            f'"./wheels/{path.name}"' for path in sorted((folder / "wheels").iterdir())
        )
        manifest = (SOURCE / "blender_manifest.toml").read_text(encoding="utf-8")
        manifest += (
            f'version = "{version("flame-mdm")}"\nplatforms = ["{target}"]\nwheels = [{wheels}]\n'
        )
        write_text(folder / "blender_manifest.toml", manifest)
        with atomic_write(out) as file, zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as packed:
            for path in sorted(path for path in folder.rglob("*") if path.is_file()):
                packed.write(path, path.relative_to(folder))


def relative_imports(code: str) -> str:
    """Returns a module's code with imports from the folder of the extension.

    Inside Blender, the extension is imported under a different package name, and all its modules
    are in one folder.
    """
    code = code.replace("from flame_mdm.conditions.language import", "from . import")
    return re.sub(r"from flame_mdm\.(\w+\.)*(\w+) import", r"from .\2 import", code)


def write_language(folder: Path) -> None:
    """Writes the tables with which the extension interprets sentences."""
    for path in LANGUAGE.glob("*.yaml"):
        write_json(folder / f"{path.stem}.json", read_package_yaml(path), indent=None)
    for name in ("word_vectors.npz", "word_vectors.md"):
        shutil.copy(LANGUAGE / name, folder)


def fetch_wheels(folder: Path, target: str) -> None:
    """Downloads the wheels for onnxruntime and its dependencies, in the versions installed here."""
    names = [
        re.split(r"[^\w-]", line)[0]
        for line in requires("onnxruntime") or []
        if "extra ==" not in line
    ]
    # numpy is part of Blender
    pinned = [f"{name}=={version(name)}" for name in ("onnxruntime", *names) if name != "numpy"]
    command = [
        sys.executable,
        "-m",
        "pip",
        "download",
        "--quiet",
        "--no-deps",
        "--only-binary=:all:",
        *pinned,
    ]
    command += [
        f"--python-version={PYTHON}",
        f"--dest={folder}",
        *(f"--platform={tag}" for tag in PLATFORMS[target]),
    ]
    done = subprocess.run(command, check=False, capture_output=True, text=True)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise UserError(f"pip cannot download the onnxruntime wheels for {target}: {reason}")


if __name__ == "__main__":
    try:
        target = sys.argv[1] if sys.argv[1:] else this_machine()
        path = Path(f"build/flame_mdm-{target}.zip")
        build("package", path, target)
        say(f"written: {path}. In Blender: Edit > Preferences > Get Extensions > Install from Disk")
    except UserError as error:
        say(f"error: {error}", error=True)
        sys.exit(1)
