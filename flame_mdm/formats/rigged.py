"""Moving skeletons of other programs, including a person's skin, for .glb, .fbx and USD files.

Lengths are in meters, and y is up. The rest pose faces +z. F, J and V are the numbers of frames,
joints and vertices.
"""

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch

from flame_mdm.errors import UserError
from flame_mdm.formats.body import local_rotations
from flame_mdm.formats.poses import Poses
from flame_mdm.formats.retarget import retarget
from flame_mdm.formats.rig import Rig
from flame_mdm.representations.skeleton import SMPL22
from flame_mdm.visualize.body import ANCHORS, MATERIALS, FittedBody, largest_weights

MATERIAL_NAMES = ("skin", "hair", "shirt", "trousers", "shoes")  # in the order of `MATERIALS`


@dataclass(frozen=True, eq=False)
class Material:
    """A material of a mesh.

    Attributes:
        name: the name of the material.
        color: red, green and blue from 0 to 1, in sRGB.
        image: contents of a PNG or JPEG file. Its colors are multiplied by `color`. Empty = no
            image.
    """

    name: str
    color: tuple[float, float, float]
    image: bytes = b""


PALETTE = tuple(
    Material(name, (red / 255, green / 255, blue / 255))
    for name, (red, green, blue) in zip(MATERIAL_NAMES, MATERIALS, strict=True)
)
"""Materials of the package's person."""
CONTACTS = ("LeftFootContact", "RightFootContact")
"""Properties in .fbx and USD files that state whether the left and right foot are planted."""


@dataclass(frozen=True, eq=False)
class Skin:
    """A skinned mesh in the pose in which it is bound to the skeleton.

    Attributes:
        name: the name of the mesh.
        points: (V, 3), vertices in the coordinates of the mesh.
        normals: (V, 3), unit normals of the vertices.
        triangles: (T, 3), vertex indices of the triangles, counterclockwise when seen from outside.
        palette: the materials of the mesh.
        materials: (T,), each triangle's material, as an index in `palette`.
        ordered: indices of the skeleton's joints that can move the mesh. For a person, joints that
            follow SMPL's joints come first, in SMPL's order.
        bones: (V, K), the joints that move each vertex, as indices in `ordered`.
        weights: (V, K), weights of these joints; each row adds up to 1.
        binds: (len(ordered), 4, 4), matrices from the coordinates of the mesh to the coordinates
            of each joint.
        colors: (V, 3), vertex colors in sRGB, from 0 to 255; (0, 3) if only the materials have
            colors.
        uvs: (V, 2), texture coordinates of the vertices, measured from the lower left corner of the
            images; (0, 2) if there are no images.
    """

    name: str
    points: np.ndarray
    normals: np.ndarray
    triangles: np.ndarray
    palette: tuple[Material, ...]
    materials: np.ndarray
    ordered: tuple[int, ...]
    bones: np.ndarray
    weights: np.ndarray
    binds: np.ndarray
    colors: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    uvs: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))


@dataclass(frozen=True, eq=False)
class RiggedClip:
    """A moving skeleton.

    Attributes:
        name: the name of the animation.
        fps: frames per second.
        joints: names of the J joints.
        parents: index of each joint's parent, smaller than the joint's own index, or -1 for the
            root.
        offsets: (J, 3), position of each joint relative to its parent in the rest pose.
        rest: (J, 3, 3), rotation of each joint relative to its parent in the rest pose.
        turns: (F, J, 3, 3), rotations relative to the parents.
        moves: for each joint whose position changes, its positions (F, 3) relative to the parent.
        lift: the thickness of the soles. Writers raise the person above the joint positions in this
            clip by this height.
        skins: the skinned meshes; () if the clip contains no person.
        scales: (J,), scale of each joint: units of its parent per unit of the joint.
        root: index of the joint on the floor that is the parent of the hips; -1 = no such joint.
        contacts: (F, 2), whether the left and the right toes are planted; (0, 2) = unknown.
    """

    name: str
    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    rest: np.ndarray
    turns: np.ndarray
    moves: dict[int, np.ndarray]
    lift: float
    skins: tuple[Skin, ...]
    scales: np.ndarray
    root: int = -1
    contacts: np.ndarray = field(default_factory=lambda: np.zeros((0, 2), bool))

    def world(self) -> tuple[np.ndarray, np.ndarray]:
        """Returns the joints' world positions (F, J, 3) and world rotations (F, J, 3, 3).

        The positions do not include `lift`. All joints of the skeleton must have a scale of 1.
        """
        positions = np.tile(self.offsets, (len(self.turns), 1, 1))
        for joint, moved in self.moves.items():
            positions[:, joint] = moved
        turns = self.turns.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                bone = turns[:, parent] @ positions[:, joint, :, None]
                positions[:, joint] = positions[:, parent] + bone[..., 0]
                turns[:, joint] = turns[:, parent] @ turns[:, joint]
        return positions, turns

    def part(self, frames: slice, name: str, contacts: np.ndarray) -> "RiggedClip":
        """Returns a range of frames as a new clip with the given `name` and `contacts` (F, 2)."""
        moves = {joint: moved[frames] for joint, moved in self.moves.items()}
        return replace(self, name=name, turns=self.turns[frames], moves=moves, contacts=contacts)

    def contact_changes(self) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """For each of `CONTACTS`, returns the K frames with a change and the K values after them.

        The first frame is always included. The result is empty if the contacts are unknown.
        """
        if not len(self.contacts):
            return {}
        changes = {}
        for name, planted in zip(CONTACTS, self.contacts.T, strict=True):
            frames = np.flatnonzero(np.r_[True, planted[1:] != planted[:-1]])
            changes[name] = frames, planted[frames]
        return changes

    def on_path(self, path: np.ndarray, heading: np.ndarray) -> "RiggedClip":
        """Moves an in-place clip along a path.

        The path moves the root or, if the skeleton has no root on the floor, the hips.

        Args:
            path: (F, 2), x and z in meters.
            heading: (F,), rotations about the vertical axis in radians; positive angles turn to
                the left.
        """
        joint = self.root if self.root >= 0 else max(self.moves)
        facing = np.tile(np.eye(3), (len(heading), 1, 1))
        facing[:, 0, 0] = facing[:, 2, 2] = np.cos(heading)
        facing[:, 0, 2] = np.sin(heading)
        facing[:, 2, 0] = -np.sin(heading)

        turns, moves = self.turns.copy(), dict(self.moves)
        turns[:, joint] = facing @ turns[:, joint]
        before = moves.get(joint, np.tile(self.offsets[joint], (len(heading), 1)))
        after = (facing @ before[..., None])[..., 0]
        after[:, [0, 2]] += path
        moves[joint] = after
        return replace(self, turns=turns, moves=moves)

    def on_soles(self) -> tuple[np.ndarray, dict[int, np.ndarray]]:
        """Returns `offsets` and `moves`, raised so that the person stands on the soles of the feet.

        The hips are raised, but a root on the floor stays on the floor.
        """
        offsets = self.offsets.copy()
        moves = {joint: moved.copy() for joint, moved in self.moves.items()}
        hips = max(moves)
        up = np.array([0, self.lift, 0])
        if self.root < 0:
            offsets[hips] += up
            moves[hips] += up
        else:
            offsets[hips] += self.rest[self.root].T @ up
            moves[hips] += (self.turns[:, self.root].mT @ up[:, None])[..., 0]
        return offsets, moves


class ContactEvent(NamedTuple):
    """A moment at which a foot is planted on the floor or lifted."""

    time: float  # seconds
    frame: int
    # Side of the foot: left or right
    foot: str
    # What happens: plant or lift
    event: str


def contact_events(contacts: np.ndarray, fps: float) -> list[ContactEvent]:
    """Returns the moments at which a foot is planted on the floor or lifted, sorted by time.

    `contacts` (F, 2) state whether the left and the right toes are planted.
    """
    events = []
    for foot, flags in zip(("left", "right"), contacts.T, strict=True):
        for frame in np.flatnonzero(np.diff(flags.astype(int))).tolist():
            event = "plant" if flags[frame + 1] else "lift"
            events.append(ContactEvent(round((frame + 1) / fps, 4), frame + 1, foot, event))
    return sorted(events)


def rigged(
    poses: Poses,
    name: str,
    fps: float,
    skeleton: Rig,
    fitted: FittedBody | None = None,
    root_motion: bool = False,
) -> RiggedClip:
    """Converts a moving body to a clip on a skeleton.

    Args:
        poses: the moving body.
        name: name of the animation.
        fps: frames per second.
        skeleton: the skeleton, with the bone lengths of the body.
        fitted: the person's body, with toes that bend as in rendered images, or None for no skin.
        root_motion: whether the root on the floor follows the position and direction of the hips.
            Otherwise, the root stays in place.

    Raises:
        UserError: If `root_motion` is set for a skeleton without a root on the floor.
    """
    moved = (
        poses
        if fitted is None
        else Poses(poses.offsets, torch.from_numpy(local_rotations(fitted)), poses.root)
    )
    turns, hips = retarget(moved, skeleton)
    moves = {skeleton.hips: hips}
    if root_motion:
        if skeleton.parents[skeleton.hips] < 0:
            raise UserError(
                "root_motion=true: this skeleton has no root on the floor. Use rig=unreal or rig=soma"
            )
        turns, moves = _with_root_motion(turns, hips, skeleton)
    return RiggedClip(
        name=name,
        fps=fps,
        joints=skeleton.joints,
        parents=skeleton.parents,
        offsets=skeleton.offsets(),
        rest=skeleton.rest(),
        turns=turns,
        moves=moves,
        lift=fitted.lift if fitted else 0.0,
        skins=() if fitted is None else (_skin(fitted, skeleton),),
        scales=np.ones(len(skeleton.joints)),
        root=skeleton.parents[skeleton.hips],
    )


def _with_root_motion(
    turns: np.ndarray, hips: np.ndarray, skeleton: Rig
) -> tuple[np.ndarray, dict[int, np.ndarray]]:
    """Transfers the horizontal path and the heading of the hips to the root, which is their parent.

    The heading is the rotation of the hips about the vertical axis, relative to the rest pose.
    """
    root, joint = skeleton.parents[skeleton.hips], skeleton.hips
    above = skeleton.turns[root]
    world = above @ turns[:, joint] @ skeleton.turns[joint].T  # from the rest pose
    left = world[:, :, 0]
    heading = np.unwrap(np.arctan2(-left[:, 2], left[:, 0]))
    cosine, sine = np.cos(heading), np.sin(heading)
    facing = np.tile(np.eye(3), (len(turns), 1, 1))
    facing[:, 0, 0] = facing[:, 2, 2] = cosine
    facing[:, 0, 2] = sine
    facing[:, 2, 0] = -sine

    path = hips * [1, 0, 1]
    turns = turns.copy()
    turned_root = facing @ above
    turns[:, joint] = turned_root.mT @ (above @ turns[:, joint])
    turns[:, root] = turned_root
    local_hips = (turned_root.mT @ (hips - path)[..., None])[..., 0]
    return turns, {root: path, joint: local_hips}


def _skin(body: FittedBody, rig: Rig) -> Skin:
    """Returns a body's mesh in its stored pose, with the hips at their rest position in the rig."""
    mesh = body.mesh
    moved = rig.positions[rig.hips] + [0, body.lift, 0] - body.joints[0]
    weights = mesh.weights[:, : len(SMPL22)].copy()  # helper bones are merged into their joints
    np.add.at(weights.T, list(ANCHORS[len(SMPL22) :]), mesh.weights[:, len(SMPL22) :].T)
    bones, shares = largest_weights(weights)

    skinned = [rig.sources.index(number) for number in range(len(SMPL22))]
    others = [joint for joint, source in enumerate(rig.sources) if source < 0]
    stored = body.neutral @ mesh.turns[: len(SMPL22)].mT
    moves = -(stored @ (body.joints + moved)[..., None])
    binds = np.tile(np.eye(4), (len(rig.joints), 1, 1))
    count = len(skinned)
    binds[:count, :3] = rig.neutral[skinned].mT @ np.concatenate([stored, moves], -1)

    # Joints without vertices keep their positions relative to their parents, because three.js reads
    # these positions from the pose of the mesh.
    worlds = np.tile(np.eye(4), (len(rig.joints), 1, 1))
    worlds[skinned] = np.linalg.inv(binds[:count])
    local = np.tile(np.eye(4), (len(rig.joints), 1, 1))
    local[:, :3, :3], local[:, :3, 3] = rig.rest(), rig.offsets()
    for joint in others:
        parent = rig.parents[joint]
        worlds[joint] = worlds[parent] @ local[joint] if parent >= 0 else local[joint]
    binds[count:] = np.linalg.inv(worlds[others])

    faces = mesh.colors[mesh.triangles].mean(1)
    differences = np.linalg.norm(faces[:, None] - np.array(MATERIALS, float), axis=-1)
    return Skin(
        name="person",
        points=body.points + moved,
        normals=mesh.normals,
        triangles=mesh.triangles,
        palette=PALETTE,
        materials=differences.argmin(1),
        ordered=(*skinned, *others),
        bones=bones,
        weights=shares / 255,
        binds=binds,
        colors=mesh.colors,
    )
