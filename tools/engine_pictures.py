"""Draws the pictures in docs/engines.md with Blender: `python tools/engine_pictures.py [SET]`.

The environment variable `FLAME_MDM_BLENDER` must be the path of a Python interpreter that has the
package bpy. SET is a folder with a set of FBX files for game engines. With SET, a picture of every
frame of its clips is also written to SET/frames.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

from PIL import Image, ImageDraw

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.errors import UserError, say

ASSETS = Path(__file__).parents[1] / "docs" / "assets" / "engines"
RENDER = Path(__file__).with_name("blender_render.py")
TEXT = "a person walks forward, then waves with the left hand"
COUNT = 8  # pictures per row
SIZE = (108, 150)  # size of one picture
SMALL = (84, 112)  # size of one picture in a sheet with every frame
QUALITY = 82  # quality of the WebP files
LABEL = (20, 20, 20)
CLIPS = ("Walk_Fwd_Start", "Walk_Fwd_Loop", "Walk_Fwd_Stop", "Run_Fwd_Loop", "Turn_90_Left")


def rendered(
    files: Sequence[Mapping[str, object]], size: tuple[int, int], samples: int, folder: Path
) -> list[list[Path]]:
    """Renders motion files in Blender and returns the paths of the pictures for each file, in frame order.

    Args:
        files: the path and the drawing options of each file, as in `blender_render.py`, but without
            `out`, which this function adds.
        size: width and height of a picture in pixels.
        samples: rays per pixel.
        folder: folder to which the pictures are written.

    Raises:
        UserError: If `FLAME_MDM_BLENDER` is not set, or if Blender fails.
    """
    python = os.environ.get("FLAME_MDM_BLENDER")
    if python is None:
        raise UserError(
            "FLAME_MDM_BLENDER is not set. Set it to the path of a Python that has the package bpy"
        )
    named = [{**file, "out": str(folder / f"{n:03d}")} for n, file in enumerate(files)]
    job = {"width": size[0], "height": size[1], "samples": samples, "files": named}
    (folder / "job.json").write_text(json.dumps(job))
    command = [python, str(RENDER), str(folder / "job.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise UserError(f"Blender cannot render the files: {reason}")
    return [sorted(folder.glob(f"{n:03d}_*.png")) for n in range(len(files))]


def sheet(path: Path, rows: Sequence[Sequence[Path]], labels: Sequence[str]) -> None:
    """Combines pictures of equal size into one picture with labeled rows, and saves it."""
    width, height = Image.open(rows[0][0]).size
    whole = Image.new("RGB", (width * max(map(len, rows)), height * len(rows)), "white")
    draw = ImageDraw.Draw(whole)
    for row, (pictures, label) in enumerate(zip(rows, labels, strict=True)):
        for column, picture in enumerate(pictures):
            whole.paste(Image.open(picture).convert("RGB"), (column * width, row * height))
        draw.text((4, row * height + 3), label, fill=LABEL)
    path.parent.mkdir(exist_ok=True)
    whole.save(path, quality=QUALITY, method=6)


def draw_files() -> None:
    """Draws a motion as a skinned character (from an FBX and a GLB file), and as the bones of two rigs."""
    motion = flame_mdm.generate(flame_mdm.load("package"), TEXT)[0]
    versions = {
        "walk.fbx, rig=unreal": (".fbx", "unreal", False),
        "walk.glb": (".glb", None, False),
        "walk.fbx, rig=mixamo: the bones": (".fbx", "mixamo", True),
        "walk.glb, rig=unity: the bones": (".glb", "unity", True),
    }
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        files = []
        for number, (ending, rig, bones) in enumerate(versions.values()):
            path = folder / f"motion{number}{ending}"
            motion.save(path, rig=rig)
            files.append({"path": str(path), "count": COUNT, "bones": bones})
        sheet(ASSETS / "blender.webp", rendered(files, SIZE, 16, folder), list(versions))


def draw_set() -> None:
    """Draws some clips from the locomotion set."""
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        if main(["sample", "package", "set=locomotion", f"out={folder / 'set'}"]):
            raise UserError("the set cannot be written")
        files = [{"path": str(folder / "set" / f"{name}.fbx"), "count": COUNT} for name in CLIPS]
        sheet(ASSETS / "set.webp", rendered(files, SIZE, 16, folder), CLIPS)


def draw_frames(folder: Path) -> None:
    """Draws every frame of all clips with root motion in a set, one file per clip."""
    described = json.loads((folder / "set.json").read_text())["clips"]
    paths = [folder / entry["files"]["root_motion"] for entry in described]
    with tempfile.TemporaryDirectory() as temporary:
        files = [{"path": str(path), "every": 1} for path in paths]
        drawn = rendered(files, SMALL, 4, Path(temporary))
        for path, pictures in zip(paths, drawn, strict=True):
            rows = [pictures[k : k + 15] for k in range(0, len(pictures), 15)]
            labels = [f"{path.stem} {15 * k}" for k in range(len(rows))]
            sheet(folder / "frames" / f"{path.stem}.webp", rows, labels)


if __name__ == "__main__":
    try:
        if sys.argv[1:]:
            draw_frames(Path(sys.argv[1]))
        else:
            draw_files()
            draw_set()
    except UserError as error:
        say(f"error: {error}", error=True)
        sys.exit(1)
