"""Animations in FBX and GLB files, and joint names for their nodes."""

import re
from pathlib import Path

from flame_mdm.formats import fbx_scene, glb_animation
from flame_mdm.formats.animated import AnimatedNodes

TIP = re.compile(r"[_. ]?(end|nub|tip)(site)?$", re.IGNORECASE)
"""Suffixes of the node at the tip of the last bone, which is called an end site in BVH files."""


def read(path: Path, animation: str | None = None) -> AnimatedNodes:
    """Reads an animation, given by its name or 1-based number, or None for the first animation.

    Raises:
        UserError: If the file is damaged or contains no such animation. See the readers of both
            formats for further errors.
    """
    reader = fbx_scene if path.suffix.lower() == ".fbx" else glb_animation
    return reader.read(path, animation)


def animations(path: Path) -> list[str]:
    """Returns the names of all animations in a file. Raises `UserError` if the file is damaged."""
    reader = fbx_scene if path.suffix.lower() == ".fbx" else glb_animation
    return reader.animations(path)


def joint_names(scene: AnimatedNodes) -> tuple[str, ...]:
    """Returns a joint name for each node, in the form that skeleton layouts use.

    If the file declares the bones of a humanoid, these bones are given SMPL's names. A node at the
    tip of a bone is always named `NAME.end`, like an end site in a BVH file, regardless of the
    node's suffix in the file.
    """
    if scene.humanoid:
        humanoid = {node: joint for joint, node in scene.humanoid.items()}
        return tuple(humanoid.get(node, f"node {node}") for node in range(len(scene.names)))
    has_children = set(scene.parents)
    names = []
    for node, (name, parent) in enumerate(zip(scene.names, scene.parents, strict=True)):
        is_tip = node not in has_children and parent >= 0 and TIP.search(name)
        names.append(f"{scene.names[parent]}.end" if is_tip else name)
    return tuple(names)
