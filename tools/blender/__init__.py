"""Blender extension that generates motions from sentences, in the sidebar of the 3D view."""

import json
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, FloatProperty, IntProperty, PointerProperty, StringProperty
from mathutils import Matrix, Quaternion

from .posture import complete, rotations_about, world_rotations
from .reading import Reader
from .rig import Rig, follow, matched, recognized, rest_pose
from .runner import USUAL_SECONDS, Sampler
from .skeleton import SMPL22

FOLDER = Path(__file__).parent
AXES = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
"""Rotation from coordinates with y up, facing +z, to Blender's coordinates with z up, facing -y."""
POOL = ThreadPoolExecutor(1)


# Sampling, in a thread: nothing here uses Blender ---------------------------------------------------------------------


@dataclass
class Sampled:
    """A sampled motion of SMPL's 22 joints.

    Attributes:
        joints: joint positions (F, 22, 3) in meters, y up.
        world: world rotations (F, 22, 3, 3).
        offsets: positions of the joints relative to their parents (22, 3) at rest, in meters.
        fps: frames per second.
        summary: the actions as the model understood them, such as "walks forward".
        warnings: differences between the sentence and the motion, one line each.
    """

    joints: np.ndarray
    world: np.ndarray
    offsets: np.ndarray
    fps: float
    summary: str
    warnings: list[str]


@cache
def sampler() -> Sampler:
    return Sampler(FOLDER / "model")


@cache
def reader() -> Reader:
    return Reader(sampler().content)


def sample(sentence: str, seconds: float, seed: int, in_place: bool) -> Sampled:
    """Samples a motion.

    Args:
        sentence: the actions to show. The extension samples the first of several actions.
        seconds: length of the motion. 0 = as long as the sentence needs.
        seed: seed of the noise.
        in_place: whether to remove the path of the hips over the floor.

    Raises:
        ValueError: If the sentence names no action that the model knows, or the length is invalid.
    """
    model, reading = sampler(), reader().read(sentence)
    warnings = reading.warnings()
    if len(reading.captions) > 1:
        warnings.append(f"several actions: only the first is sampled, '{reading.captions[0]}'")
    text = sentence if len(reading.captions) == 1 else reading.texts[0]
    length = seconds or None
    counted = reading.seconds()[0] if reading.steps else None
    if length is None and counted is not None:
        content = model.content
        length = min(counted, USUAL_SECONDS, content["max_frames"] / content["fps"])
    joints = model.decode(model.generate(reading.captions[0], length, seed, text=text))
    if in_place:
        joints[..., [0, 2]] -= joints[:, :1, [0, 2]] - joints[:1, :1, [0, 2]]
    offsets, quaternions = (values.astype(float) for values in model.rotations(joints))
    sine = np.linalg.norm(quaternions[..., 1:], axis=-1)
    axes = quaternions[..., 1:] / np.maximum(sine, 1e-9)[..., None]
    world = world_rotations(rotations_about(axes, 2 * np.arctan2(sine, quaternions[..., 0])))
    return Sampled(
        joints.astype(float), world, offsets, model.content["fps"], reading.summary(), warnings
    )


# Armatures ------------------------------------------------------------------------------------------------------------


@cache
def known_skeletons() -> list[dict[str, str]]:
    try:
        return json.loads((FOLDER / "skeletons.json").read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(
            f"skeletons.json is damaged ({error}). Install the extension again"
        ) from error


def read_armature(armature):
    """Returns the rest pose of an armature, moved to the origin, and the scale of the armature.

    Raises:
        ValueError: If the bones match no known skeleton, or if the armature is mirrored, scaled
            unevenly or not upright.
    """
    bones = sorted(armature.data.bones, key=lambda bone: len(bone.parent_recursive))
    names = [bone.name for bone in bones]
    labels = dict(enumerate(names))
    joints, missing = matched(armature.name, labels, recognized(labels, known_skeletons()))
    if missing:
        rigs = "Mixamo, Unreal, Unity, SMPL, or Rigify's metarig"
        raise ValueError(
            f"{armature.name}: no bone found for {', '.join(missing)}. Use names of {rigs}"
        )
    matrix = np.array(armature.matrix_world)
    sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if np.linalg.det(matrix[:3, :3]) <= 0 or sizes[0] > 1.01 * sizes[2]:
        raise ValueError(f"{armature.name}: mirrored or scaled unevenly. Apply its scale")
    worlds = matrix @ np.array([bone.matrix_local for bone in bones])
    corners, place = [worlds[:, :3, 3]], matrix[:3, 3] * [1, 1, 0]
    for item in bpy.data.objects:
        moved = any(
            modifier.type == "ARMATURE" and modifier.object == armature
            for modifier in item.modifiers
        )
        if moved and item.type == "MESH":
            corners.append(
                np.array([item.matrix_world @ vertex.co for vertex in item.data.vertices]).reshape(
                    -1, 3
                )
            )
    parents = [names.index(bone.parent.name) if bone.parent else -1 for bone in bones]
    positions, turned, lowest = (
        worlds[:, :3, 3] - place,
        worlds[:, :3, :3] / sizes[1],
        np.concatenate(corners) - place,
    )
    return rest_pose(
        armature.name, names, parents, positions, turned, joints, lowest, (0, 0, 1)
    ), sizes[1]


def new_armature(context, name: str, motion: Sampled):
    """Adds an armature in a T-pose on the floor, with the bone lengths of a motion, and returns it."""
    rest = np.zeros_like(motion.offsets)
    for parent, joint in SMPL22.edges:
        rest[joint] = rest[parent] + motion.offsets[joint]
    rest = (rest - [0, rest[:, 1].min(), 0]) @ AXES.T
    armature = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    context.collection.objects.link(armature)
    for item in context.selected_objects:
        item.select_set(False)
    armature.select_set(True)
    context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    bones = armature.data.edit_bones
    for joint, (label, parent) in enumerate(zip(SMPL22.joints, SMPL22.parents, strict=True)):
        bone = bones.new(label)
        children = [child for child, above in enumerate(SMPL22.parents) if above == joint]
        highest = max(children, key=lambda child: rest[child, 2], default=None)
        bone.head = rest[joint]
        bone.tail = (
            rest[joint] + (rest[joint] - rest[parent]) / 2 if highest is None else rest[highest]
        )
        bone.parent = bones[parent] if parent >= 0 else None
    bpy.ops.object.mode_set(mode="OBJECT")
    return armature


def animate(context, armature, name: str, motion: Sampled, own: bool) -> int:
    """Inserts the keyframes of a motion into a new action, and returns the number of frames.

    The action starts at the first frame of the scene.

    Args:
        context: Blender's context.
        armature: the armature to animate.
                name: name of the new action.
        motion: the motion to insert.
        own: whether `new_armature` created the armature. If so, every joint is moved to its
            position in the motion.
    """
    pose, size = read_armature(armature)
    if own:
        rig = replace(pose.rig, neutral=pose.rig.turns)
        world, positions = rig.turned(motion.world), motion.joints[:, rig.sources]
    else:
        neutral, completed, _ = complete(motion.joints, motion.offsets, motion.world)
        world, positions, rig = follow(pose, motion.joints, motion.offsets, neutral, completed)
    turns = np.swapaxes(rig.rest(), -1, -2) @ rig.local(world)
    scene, data = context.scene, armature.animation_data_create()
    if data.action:
        data.action.use_fake_user = True  # the previous action stays in the file
    data.action = bpy.data.actions.new(name)
    rate = scene.render.fps / scene.render.fps_base
    times = np.arange(round((len(world) - 1) / motion.fps * rate) + 1) * motion.fps / rate
    times = np.minimum(times, len(world) - 1)
    before = np.minimum(times.astype(int), len(world) - 2)
    followed = {rig.joints[number] for number in pose.map.values()}
    for joint, source in enumerate(rig.sources):
        bone = armature.pose.bones[rig.joints[joint]]
        if source < 0:
            if not followed.isdisjoint(child.name for child in bone.children_recursive):
                bone.matrix_basis = Matrix()
            continue
        bone.rotation_mode = "QUATERNION"
        quaternions = [Matrix(turn).to_quaternion() for turn in turns[:, joint]]
        places = located(rig, world, positions, joint) / size
        moves = own or joint == rig.hips
        last = Quaternion()
        for number, (time, low) in enumerate(zip(times, before, strict=True)):
            turn = quaternions[low].slerp(quaternions[low + 1], time - low)
            turn.make_compatible(last)
            bone.rotation_quaternion = last = turn
            bone.keyframe_insert(
                "rotation_quaternion", frame=scene.frame_start + number, group=bone.name
            )
            if moves:
                bone.location = places[low] + (time - low) * (places[low + 1] - places[low])
                bone.keyframe_insert("location", frame=scene.frame_start + number, group=bone.name)
    scene.frame_end = max(scene.frame_end, scene.frame_start + len(times) - 1)
    return len(times)


def located(rig: Rig, world: np.ndarray, positions: np.ndarray, joint: int) -> np.ndarray:
    """Returns the location (F, 3) of a bone relative to its rest pose, such that its head is at `positions`."""
    parent = rig.parents[joint]
    if parent < 0:
        return (positions[:, joint] - rig.positions[joint]) @ rig.turns[joint]
    apart = ((positions[:, joint] - positions[:, parent])[:, None] @ world[:, parent])[:, 0]
    return (apart - rig.offsets()[joint]) @ rig.rest()[joint]


# Panel ----------------------------------------------------------------------------------------------------------------


class Settings(bpy.types.PropertyGroup):
    __annotations__ = {
        "sentence": StringProperty(
            name="", description="What the person does", default="a person walks forward"
        ),
        "seconds": FloatProperty(
            name="Seconds",
            description="0: as long as the sentence needs",
            default=0,
            min=0,
            step=10,
            precision=1,
        ),
        "seed": IntProperty(
            name="Seed", description="A different seed gives a different motion", default=0
        ),
        "in_place": BoolProperty(
            name="In place", description="Remove the path of the hips over the floor"
        ),
        "onto_selected": BoolProperty(
            name="Onto the selected armature",
            description="Animate the selected armature, with bone names of Mixamo, Unreal, Unity, SMPL or Rigify",
        ),
    }


class Generate(bpy.types.Operator):
    bl_idname, bl_label, bl_options = "flame_mdm.generate", "Generate", {"UNDO"}
    bl_description = "Generate a motion"
    running: Future[Sampled] | None = None
    """The last job, which may still be running."""

    @classmethod
    def poll(cls, context):
        return Generate.running is None or Generate.running.done()

    def start(self, context) -> bool:
        """Starts sampling, and returns whether the settings are valid."""
        settings, self.armature = context.scene.flame_mdm, None
        self.sentence = settings.sentence.strip()
        try:
            if not self.sentence:
                raise ValueError("the sentence is empty: write what the person does")
            if settings.onto_selected:
                selected = context.active_object
                if selected is None or selected.type != "ARMATURE" or not selected.select_get():
                    raise ValueError("select an armature, or turn off 'Onto the selected armature'")
                read_armature(selected)
                self.armature = selected.name
        except (ValueError, OSError) as error:
            self.report({"ERROR"}, str(error))
            return False
        self.sampled = POOL.submit(
            sample, self.sentence, settings.seconds, settings.seed, settings.in_place
        )
        Generate.running = self.sampled
        return True

    def finish(self, context) -> set[str]:
        """Adds the motion to the scene once it has been sampled."""
        armature = bpy.data.objects.get(self.armature) if self.armature else None
        made = None
        try:
            motion = self.sampled.result()
            if context.mode != "OBJECT":
                bpy.ops.object.mode_set(mode="OBJECT")
            if self.armature and armature is None:
                raise ValueError(f"{self.armature}: the armature was deleted")
            if armature is None:
                made = new_armature(context, self.sentence, motion)
            frames = animate(context, made or armature, self.sentence, motion, made is not None)
        except (ValueError, OSError, ImportError) as error:
            if made:
                bpy.data.armatures.remove(made.data)
            self.report({"ERROR"}, str(error).strip().splitlines()[0])
            return {"CANCELLED"}
        for warning in motion.warnings:
            self.report({"WARNING"}, warning)
        self.report({"INFO"}, f"{(made or armature).name}: {motion.summary}, {frames} frames")
        return {"FINISHED"}

    def execute(self, context):
        return self.finish(context) if self.start(context) else {"CANCELLED"}

    def invoke(self, context, event):
        if not self.start(context):
            return {"CANCELLED"}
        self.timer = context.window_manager.event_timer_add(0.1, window=context.window)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type != "TIMER" or not self.sampled.done():
            return {"PASS_THROUGH"}
        context.window_manager.event_timer_remove(self.timer)
        return self.finish(context)


class Sidebar(bpy.types.Panel):
    bl_space_type, bl_region_type, bl_category, bl_label = (
        "VIEW_3D",
        "UI",
        "Motion",
        "Motion from a sentence",
    )
    bl_idname = "FLAME_MDM_PT_sidebar"

    def draw(self, context):
        for name in Settings.__annotations__:
            self.layout.prop(context.scene.flame_mdm, name)
        self.layout.operator(
            Generate.bl_idname, text="Generate" if Generate.poll(context) else "Sampling"
        )


CLASSES = Settings, Generate, Sidebar


def register():
    for item in CLASSES:
        bpy.utils.register_class(item)
    bpy.types.Scene.flame_mdm = PointerProperty(type=Settings)


def unregister():
    del bpy.types.Scene.flame_mdm
    for item in reversed(CLASSES):
        bpy.utils.unregister_class(item)
