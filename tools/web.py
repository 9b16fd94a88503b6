"""Builds the page that needs no installation, in build/web: `make web`.

The page samples with the model in this package in the browser. onnxruntime-web comes from npm at a pinned version.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import flame_mdm
from flame_mdm.checkpoints.onnx_export import export_onnx
from flame_mdm.checkpoints.runner import SCHEMA
from flame_mdm.errors import UserError, say
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.motion import END_SITES, Motion
from flame_mdm.formats.posture import TOES
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.safe_io import write_json, write_text
from flame_mdm.visualize.body import HELPERS
from flame_mdm.visualize.player import player_page

SOURCE = Path(__file__).with_suffix("")
RUNTIME, INTEGRITY = (
    "onnxruntime-web@1.30.0",
    "q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
)
"""Package of npm and the SHA-512 of its archive."""
RUNTIME_FILES = ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm")
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; base-uri 'none'; form-action 'none'"
)


def build(model: str, out: Path) -> None:
    """Writes the page of a model with a learned text encoder and SMPL's 22 joints."""
    export_onnx(model, out, half=True)
    (out / "runner.py").unlink()
    for path in SOURCE.iterdir():
        shutil.copy(path, out)
    write_text(out / "schema.js", f"export const SCHEMA = {json.dumps(SCHEMA)};\n")
    fetch_runtime(out / "ort")
    loaded = flame_mdm.load(model)
    example = flame_mdm.generate(loaded, loaded.facts["captions"][0])[0]
    for ending in ("glb", "fbx"):
        example.save(out / f"template.{ending}")
    page = player_page([example], "")
    style, code = (
        re.findall(rf"<{tag}>\n(.*?)</{tag}>", page, re.DOTALL)[0] for tag in ("style", "script")
    )
    data = re.findall(r'<script type="application/json" id="data">(.*?)</script>', page)[0]
    page = page.replace(style, "").replace(code, "").replace(data, "__DATA__")
    page = page.replace("<style>\n</style>", '<link rel="stylesheet" href="player.css">')
    page = page.replace("<script>\n</script>", '<script src="player.js"></script>')
    page = re.sub(r'(http-equiv="Content-Security-Policy" content=)"[^"]*"', rf'\1"{POLICY}"', page)
    for name, content in (("player.css", style), ("player.js", code), ("player.html", page)):
        write_text(out / name, content)
    write_json(out / "figure.json", figure(example) | {"motion": json.loads(data)[0]}, indent=None)


def figure(example: Motion) -> dict[str, Any]:
    """Returns what the page needs to dress a motion with the mannequin: numbers of the example's body."""
    body, names = fit_body(example), list(SMPL22.joints)
    offsets = np.asarray(example.posed().offsets)
    helpers = []
    for joint, share in HELPERS:
        child = SMPL22.parents.index(joint)
        of_wrist = names[joint].endswith("elbow")
        above, below = (joint, child) if of_wrist else (SMPL22.parents[joint], joint)
        axis = (offsets[child] / np.linalg.norm(offsets[child])).tolist()
        share = share if of_wrist else share - 1
        helpers.append(
            {"joint": joint, "above": above, "below": below, "share": share, "axis": axis}
        )
    return {
        **{"names": names, "parents": SMPL22.parents, "helpers": helpers, "toes": TOES},
        "lift": body.lift,
        "feet": [JOINT["left_foot"], JOINT["right_foot"]],
        "ends": {JOINT[name]: np.asarray(site).tolist() for name, site in END_SITES.items()},
        "neutral": _quaternions(body.neutral),
        "stored": _quaternions(body.mesh.turns.mT),
    }


def _quaternions(turns: np.ndarray) -> list[list[float]]:
    return Rotation.from_matrix(turns).as_quat(scalar_first=True).tolist()


def fetch_runtime(folder: Path) -> None:
    """Fetches onnxruntime-web by npm.

    Raises:
        UserError: If npm is missing or fails, or the archive is not the pinned one.
    """
    if shutil.which("npm") is None:
        raise UserError("make web needs npm, which fetches onnxruntime-web: install Node.js")
    with tempfile.TemporaryDirectory() as temporary:
        command = ["npm", "pack", RUNTIME, "--silent", "--pack-destination", temporary]
        if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode:
            raise UserError(f"npm cannot fetch {RUNTIME}. Is the registry reachable?")
        (archive,) = Path(temporary).iterdir()
        if base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode() != INTEGRITY:
            raise UserError(
                f"{RUNTIME}: the archive of npm is not the pinned one (its SHA-512 differs)"
            )
        folder.mkdir(exist_ok=True)
        with tarfile.open(archive) as packed:
            for name in RUNTIME_FILES:
                member = packed.extractfile(f"package/dist/{name}")
                assert member is not None
                (folder / name).write_bytes(member.read())
    write_text(
        folder / "LICENSE.txt", f"{RUNTIME}, Copyright (c) Microsoft Corporation, MIT license\n"
    )


if __name__ == "__main__":
    try:
        build("quickstart", Path("build/web"))
        say("written: build/web. To see it: python3 -m http.server -d build/web")
    except UserError as error:
        say(f"error: {error}", error=True)
        sys.exit(1)
