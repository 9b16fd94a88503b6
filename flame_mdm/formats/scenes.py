"""Animations in files with a scene of nodes, FBX and GLB, and the names of the nodes as joints of a skeleton."""

import re
from pathlib import Path

from flame_mdm.formats import fbx_scene, glb_animation
from flame_mdm.formats.animated import AnimatedNodes

TIP = re.compile(r"[_. ]?(end|nub|tip)(site)?$", re.IGNORECASE)
"""How programs name the node at the tip of the last bone, which BVH files call an end site."""


def read(path: Path, animation: str | None = None) -> AnimatedNodes:
    """Reads an animation by its name or number, from 1; None = the first one. Raises `UserError`, see the readers."""
    reader = fbx_scene if path.suffix.lower() == ".fbx" else glb_animation
    return reader.read(path, animation)


def animations(path: Path) -> list[str]:
    """Returns the names of the animations of a file. Raises `UserError` if it is damaged."""
    reader = fbx_scene if path.suffix.lower() == ".fbx" else glb_animation
    return reader.animations(path)


def joint_names(scene: AnimatedNodes) -> tuple[str, ...]:
    """Returns a name per node, as the layouts of skeletons expect them.

    Bones of a humanoid that the file identifies get SMPL's names. A node at the tip of a bone is
    named as the end site of the bone in a BVH file, `NAME.end`, also if the tip has the name of
    the bone with another ending.
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
