"""Builds the web page that requires no installation, in build/web: `make web`.

The page runs a model from this package in the browser. A pinned version of onnxruntime-web is
downloaded from npm.
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
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import flame_mdm
import flame_mdm.demo
from flame_mdm.checkpoints.onnx_export import write_folder
from flame_mdm.checkpoints.runner import SCHEMA
from flame_mdm.conditions.language import (
    abilities,
    attributes,
    clauses,
    matching,
    meaning,
    morphology,
    parsing,
    reading,
    spelling,
    tables,
    tokens,
    vectors,
    wording,
)
from flame_mdm.demo.chips import SHOWN
from flame_mdm.demo.still_pictures import still
from flame_mdm.errors import UserError, say
from flame_mdm.formats.body import fit_body
from flame_mdm.formats.motion import END_SITES, Motion
from flame_mdm.formats.posture import TOES
from flame_mdm.generator import MotionGenerator
from flame_mdm.representations.skeleton import JOINT, SMPL22
from flame_mdm.safe_io import read_npz, write_json, write_text
from flame_mdm.sampling.motion_request import USUAL_SECONDS
from flame_mdm.sampling.streams import check_streams
from flame_mdm.visualize.body import HELPERS
from flame_mdm.visualize.player import player_page

SOURCE = Path(__file__).with_suffix("")
# Files of the page with a stream, which the demo also uses
LIVE = [Path(flame_mdm.demo.__file__).with_name(name) for name in ("live.js", "live.css")]
RUNTIME, INTEGRITY = (
    "onnxruntime-web@1.30.0",
    "q0y+JrrtukXSzsBWEMccVfqX25LRmosXHF+CaRJmg8pZClzcV7svNc4rKY3jL02Vb7QmRMDs1SigqR4CXAfKYQ==",
)
"""The npm package, and the SHA-512 of its archive."""
RUNTIME_FILES = ("ort.wasm.min.mjs", "ort-wasm-simd-threaded.mjs", "ort-wasm-simd-threaded.wasm")
STREAM = "stream"  # folder for the stream's model, unless it is also the model for single motions
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; base-uri 'none'; form-action 'none'"
)


def build(model: MotionGenerator, out: Path, streaming: MotionGenerator | None = None) -> None:
    """Writes the page for single motions and, if a model can stream, the page with a stream.

    Both models must have a learned text encoder, captions for single actions and SMPL's 22 joints.

    Args:
        model: the model for single motions.
        out: output folder for both pages.
        streaming: the model for the stream, which must continue frames. By default, `model` is used
            if it continues frames; otherwise, the page with a stream is omitted.

    Raises:
        UserError: If a model's captions do not name single actions, if `streaming` does not continue
            frames, or if onnxruntime-web cannot be downloaded.
    """
    check_captions(model)
    write_model(model, out)
    stream = "" if model.denoiser.context_frames else None
    if streaming is not None:
        check_captions(streaming)
        check_streams(streaming)
        write_model(streaming, out / STREAM)
        stream = f"{STREAM}/"
    for path in (*SOURCE.iterdir(), *LIVE):
        shutil.copy(path, out)
    if stream is None:
        (out / "live.html").unlink()
    # Folder that contains the stream's model; null = no stream
    write_text(out / "models.js", f"export const STREAM = {json.dumps(stream)};\n")
    write_text(out / "schema.js", f"export const SCHEMA = {json.dumps(SCHEMA)};\n")
    fetch_runtime(out / "ort")
    write_language(out)
    models = [model] if streaming is None else [model, streaming]
    known = [action for entry in models for action in abilities.Abilities(entry.facts).actions]
    write_pictures(out, list(dict.fromkeys(known)))
    example = flame_mdm.generate(model, model.facts["captions"][0])[0]
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


def check_captions(model: MotionGenerator) -> None:
    """Raises `UserError` if the captions of a model do not name single actions."""
    if not reading.Reader.fits(model.facts):
        experiment = model.config["experiment"]
        raise UserError(
            f"{experiment}: its captions do not name single actions. Use a model like quickstart"
        )


def write_model(model: MotionGenerator, folder: Path) -> None:
    """Writes the ONNX graphs of a model and `model.json` to a folder."""
    write_folder(model, folder, half=True)
    (folder / "runner.py").unlink()


def write_language(out: Path) -> None:
    """Writes the tables that the page uses to interpret text: `language.json` and `language.bin`.

    `language.bin` contains the word vectors, with 8 bits per number, followed by the words.
    """
    arrays = read_npz(vectors.FILE)
    count, dimensions = arrays["vectors"].shape
    content = {
        "actions": [asdict(entry) for entry in tables.actions().values()],
        "phrases": tables.phrases(),
        "vectors": {"count": count, "dimensions": dimensions},
        "constants": language_constants(),
    }
    listed = json.dumps(content, default=sorted, ensure_ascii=False)
    write_text(out / "language.json", listed)
    (out / "language.bin").write_bytes(arrays["vectors"].tobytes() + arrays["words"].tobytes())


def language_constants() -> dict[str, Any]:
    """Returns the constants of `flame_mdm.conditions.language` that the page needs in addition to the tables."""
    return {
        "vowels": morphology.VOWELS,
        "never_corrected": spelling.NEVER_CORRECTED,
        "frequent": spelling.FREQUENT,
        "smoothing": vectors.SMOOTHING,
        "similar": meaning.SIMILAR,
        "neighbors": meaning.NEIGHBORS,
        "rare": tokens.RARE,
        "nearest": parsing.NEAREST,
        "longest_gap": matching.LONGEST_GAP,
        "weak_phrases": [" ".join(words) for words in matching.WEAK_PHRASES],
        "connectors": [
            {"words": words, "link": link} for words, link in clauses.CONNECTORS.items()
        ],
        "at_the_end": sorted(word for (word,) in clauses.AT_THE_END),
        "need_subject": clauses.NEED_SUBJECT,
        "need_clause": clauses.NEED_CLAUSE,
        "measures": attributes.MEASURES,
        "who": wording.WHO,
        "directions": wording.DIRECTIONS,
        "speeds": wording.SPEEDS,
        "times": wording.TIMES,
        "plurals": wording.PLURALS,
        "choices": abilities.CHOICES,
        "words_of_values": abilities.WORDS_OF_VALUES,
        "attributes": reading.ATTRIBUTES,
        "longest_count": reading.LONGEST_COUNT,
        "start_and_end": reading.START_AND_END,
        "repetition": reading.REPETITION,
        "usual_seconds": USUAL_SECONDS,
        "shown": SHOWN,
    }


def write_pictures(out: Path, actions: Sequence[str]) -> None:
    """Writes the pictures of actions, and `pictures.json`, which lists the picture of each action."""
    (out / "pictures").mkdir(exist_ok=True)
    pictures = {}
    for number, action in enumerate(actions):
        if (image := still(action)) is not None:
            pictures[action] = f"pictures/{number}.webp"
            (out / pictures[action]).write_bytes(image)
    write_json(out / "pictures.json", pictures)


def figure(example: Motion) -> dict[str, Any]:
    """Returns the data that the page needs to draw motions as the mannequin, computed from an example motion."""
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
    """Downloads onnxruntime-web with npm.

    Raises:
        UserError: If npm is missing or fails, or if the downloaded archive does not have the pinned
            hash.
    """
    if shutil.which("npm") is None:
        raise UserError("make web requires npm to download onnxruntime-web. Install Node.js")
    with tempfile.TemporaryDirectory() as temporary:
        command = ["npm", "pack", RUNTIME, "--silent", "--pack-destination", temporary]
        if subprocess.run(command, check=False, stdout=subprocess.DEVNULL).returncode:
            raise UserError(f"npm cannot download {RUNTIME}. Is the registry reachable?")
        (archive,) = Path(temporary).iterdir()
        if base64.b64encode(hashlib.sha512(archive.read_bytes()).digest()).decode() != INTEGRITY:
            raise UserError(
                f"{RUNTIME}: the downloaded archive is not the pinned archive (its SHA-512 differs)"
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
        name, streaming = (*sys.argv[1:], "", "")[:2]
        if not name:
            name, streaming = "package", streaming or "package_dip"
        single = flame_mdm.load(name)
        build(single, Path("build/web"), flame_mdm.load(streaming) if streaming else None)
        say("written: build/web. To see it: python3 -m http.server -d build/web")
    except UserError as error:
        say(f"error: {error}", error=True)
        sys.exit(1)
