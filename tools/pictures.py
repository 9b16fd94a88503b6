"""Draws the pictures of options in the docs and in the demo: `python tools/pictures.py`.

The motions come from the model `package`. The screenshots of the demo require Chromium.
"""

import base64
import io
import sys
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path

from PIL import Image

import flame_mdm
from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.tables import actions
from flame_mdm.conditions.language.understanding import Mention
from flame_mdm.conditions.language.wording import caption
from flame_mdm.data.synthetic_actions import ACTIONS
from flame_mdm.demo.app import serve
from flame_mdm.demo.still_pictures import STILLS
from flame_mdm.formats.readers import read
from flame_mdm.visualize.render import contact_sheet, thumbnail

ASSETS = Path(__file__).parent.parent / "docs" / "assets" / "options"
WALK, STAND, WAVE = (
    "a person walks forward",
    "a person stands still",
    "a person waves with the left hand",
)
PATH = {"root": [{"time": 1, "position": [0.2, 0.6]}, {"time": 2.3, "position": [0.8, 1.4]}]}
WRIST = {"joints": [{"time": 1.25, "joint": "right_wrist", "position": [None, 1.8, None]}]}
SHOTS = {"page": "#stage", "examples": "#examples", "change": "#edit"}


def draw_motions() -> None:
    """Draws six poses for each option of `sample`, `edit` and `convert` that the docs illustrate."""
    model = flame_mdm.load("package")
    texts = {
        "text": WALK,
        "seed": WALK,
        "seconds": WALK,
        "parts": f"{WALK} @1.5 | {WAVE} @2",
        "root": WALK,
        "joints": STAND,
    }
    keys = {
        "seed": {"seed": 1},
        "seconds": {"seconds": 1.2},
        "root": {"targets": PATH},
        "joints": {"targets": WRIST},
    }
    drawn = {
        n: flame_mdm.generate(model, text, **{"seconds": 2.5} | keys.get(n, {}))[0]
        for n, text in texts.items()
    }
    for region in ("in_between", "prediction", "suffix", "interpolate"):
        drawn[region] = flame_mdm.edit(model, drawn["text"], "a person jumps once", region=region)[
            0
        ]
    drawn["upper_body"] = flame_mdm.edit(model, drawn["text"], WAVE, joints="upper_body")[0]
    drawn["strength"] = flame_mdm.edit(model, drawn["text"], "a person runs forward", strength=0.6)[
        0
    ]
    with tempfile.TemporaryDirectory() as folder:
        for rig in ("mixamo", "unreal"):
            drawn["text"].save(f"{folder}/{rig}.bvh", rig=rig, rest_pose=True)
            drawn[rig] = replace(
                read(f"{folder}/{rig}.bvh"), text=f"the rest pose of rig={rig}, and the motion"
            )
    for name, motion in drawn.items():
        contact_sheet(ASSETS / f"{name}.png", [replace(motion, id="")], size=80)


def draw_stills() -> None:
    """Draws the demo's pictures for the actions that the synthetic set does not contain."""
    model = flame_mdm.load("package")
    for action in Abilities(model.facts).actions:
        if not set(actions()[action].names) & set(ACTIONS):
            (motion,) = flame_mdm.generate(model, caption((Mention(action),)), seconds=3)
            (STILLS / f"{action}.webp").write_bytes(thumbnail(motion))


def draw_demo() -> None:
    """Takes screenshots of parts of the demo page and saves them at 60 % of their size with 128 colors."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
    from support.browser import browser

    threading.Thread(target=serve, args=(["package"],), kwargs={"port": 7999}, daemon=True).start()
    with (
        tempfile.TemporaryDirectory() as folder,
        browser(Path(folder) / "profile", 1280, 1500) as tab,
    ):
        tab.wait(
            "fetch('http://127.0.0.1:7999', { mode: 'no-cors' }).then(() => true, () => false)", 60
        )
        tab.open(f"http://127.0.0.1:7999/?text={WALK}&path=0,1+0.5,2")
        tab.wait("!!document.querySelector('#files a')", 60)
        time.sleep(3)  # until the player has drawn the motion
        for name, part in SHOTS.items():
            box = tab.run(f"document.querySelector('{part}').getBoundingClientRect().toJSON()")
            clip = {key: box[key] for key in ("x", "y", "width", "height")} | {"scale": 0.6}
            picture = io.BytesIO(
                base64.b64decode(tab.send("Page.captureScreenshot", clip=clip)["data"])
            )
            Image.open(picture).quantize(128).save(ASSETS / f"demo-{name}.png", optimize=True)


if __name__ == "__main__":
    draw_motions()
    draw_stills()
    draw_demo()
