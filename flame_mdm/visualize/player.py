"""HTML player for motions: a single file that opens from disk, without a network connection."""

import base64
import html
import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from flame_mdm.errors import shortened
from flame_mdm.safe_io import write_text
from flame_mdm.visualize.body import (
    ANCHORS,
    Figure,
    FittedBody,
    Mesh,
    head,
    mannequin,
    radii,
    sides,
    target,
)


def write_player(
    path: str | Path, motions: Sequence[Figure], title: str = "Motions", **options: Any
) -> None:
    """Writes an HTML page that plays motions in any browser, without a network connection.

    Args:
        path: the .html file.
        motions: the motions to play.
        title: title of the page.
        options: additional options for `player_page`.

    Example:
        >>> write_player("walk.html", [motion], title="A walk")  # doctest: +SKIP
    """
    write_text(target(path, motions), player_page(motions, title, **options))


def player_page(
    motions: Sequence[Figure],
    title: str = "Motions",
    about: str = "",
    columns: int = 0,
    groups: Sequence[str] = (),
    beside: Sequence[str] = (),
    marks: Sequence[Sequence[tuple[int, int, str, str]]] = (),
    body: Mesh | None = None,
) -> str:
    """Returns a self-contained HTML page that plays motions side by side in 3D.

    All motions share one clock and one camera. If no body fits a motion, a skeleton is shown, and
    the caption states the reason. Positions are rounded to millimeters or, in motions that span
    more than 65.5 m, to 1/65534 of the span.

    Args:
        motions: the motions. Their skeletons, lengths and frame rates may differ.
        title: heading of the page.
        about: HTML for a collapsible section below the heading of the page. Any text in this HTML
            must already be escaped.
        columns: number of motions per row; 0 = as many as fit into the window.
        groups: for each motion, a name to filter by, such as its split; "" = none.
        beside: for each motion, the id of the earlier motion next to which it is shown; "" = none.
            For example, an edited motion is shown next to its original.
        marks: for each motion, the spans of frames to mark on the timeline. Each span consists of
            its first frame, its end (exclusive), its kind and a description.
        body: the body to draw, or None for the mannequin.
    """
    blank = [""] * len(motions)
    rows = zip(motions, groups or blank, beside or blank, marks or [()] * len(motions), strict=True)
    packed = [_packed(*row, body) for row in rows]
    stored = (body or mannequin()).stored
    arrays = {
        name: _base64(stored[name])
        for name in ("points", "normals", "bones", "weights", "colors", "triangles")
    }
    mesh = arrays | {"joints": np.round(stored["joints"], 5).ravel().tolist(), "anchors": ANCHORS}
    fitting = any(motion["body"] for motion in packed)
    content = {
        "TITLE": html.escape(shortened(title)),
        "ABOUT": about
        and f"<details><summary>About these motions</summary><div>{about}</div></details>",
        "COLUMNS": str(columns),
        "BODY": json.dumps(mesh if fitting else None, separators=(",", ":")),
        # "<" never occurs in the data, so no caption can close the script element
        "DATA": json.dumps(packed, separators=(",", ":")).replace("<", "\\u003c"),
    }
    template = Path(__file__).with_suffix(".html").read_text(encoding="utf-8")
    return re.sub("__(TITLE|ABOUT|COLUMNS|BODY|DATA)__", lambda match: content[match[1]], template)


def packed_motion(motion: Figure, begin: int = 0) -> dict[str, Any]:
    """Returns the frames of a motion for the player, starting at `begin`.

    Frames before `begin` only influence the rotations.
    """
    return _packed(motion, "", "", (), None, begin)


def _packed(
    motion: Figure,
    group: str,
    beside: str,
    marks: Sequence[tuple[int, int, str, str]],
    mesh: Mesh | None,
    begin: int = 0,
) -> dict[str, Any]:
    low, high = motion.joints.min((0, 1)).astype(float), motion.joints.max((0, 1)).astype(float)
    center = (low + high) / 2
    step = max(0.001, float((high - low).max()) / 65534)
    body, reason = motion.try_fit(mesh)
    return {
        "id": shortened(motion.id),
        "caption": shortened(motion.text),
        "group": group,
        "beside": beside,
        "marks": list(marks),
        "fps": motion.fps,
        "frames": len(motion.joints) - begin,
        "parents": list(motion.skeleton.parents),
        "sides": sides(motion.skeleton),
        "radii": radii(motion.skeleton),
        "head": head(motion.skeleton),
        "center": center.tolist(),
        "step": step,
        "joints": _base64(np.rint((motion.joints[begin:] - center) / step).astype("<i2")),
        "body": body and _packed_body(body, begin),
        "why": reason,
        "feet": [] if motion.contacts is None else list(motion.skeleton.feet),
        "contacts": ""
        if motion.contacts is None
        else _base64(motion.contacts[begin:].astype("u1")),
    }


def _packed_body(body: FittedBody, begin: int) -> dict[str, Any]:
    """Returns a body's proportions, and a 32-bit quaternion for each frame and bone.

    The quaternions are accurate to about 0.1 degrees. The two highest bits indicate which of x, y,
    z and w is largest. The other three components, which range from -0.71 to 0.71, follow with 10
    bits each.
    """
    quaternions = Rotation.from_matrix(body.turns[begin:].reshape(-1, 3, 3)).as_quat()
    largest = np.abs(quaternions).argmax(1)
    quaternions *= np.sign(np.take_along_axis(quaternions, largest[:, None], 1))
    others = quaternions[np.arange(4) != largest[:, None]].reshape(-1, 3)
    bits = np.rint(np.clip(others / 2**0.5 + 0.5, 0, 1) * 1023).astype(np.uint32)
    packed = (
        (largest.astype(np.uint32) << 30) | (bits[:, 0] << 20) | (bits[:, 1] << 10) | bits[:, 2]
    )
    return {
        "fit": _base64(body.fit.astype("<f4")),
        "rest": _base64(body.joints.astype("<f4")),
        "lift": round(float(body.lift), 5),
        "turns": _base64(packed.astype("<u4")),
    }


def _base64(array: np.ndarray) -> str:
    return base64.b64encode(array.tobytes()).decode("ascii")
