# pyright: standard
"""Streams: endless motions whose text can change at any time.

A stream is generated in blocks, each of which continues the frames before it.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple, Self, Unpack

import numpy as np
import torch
from torch import Tensor

from flame_mdm.batch import Condition, Edit, MotionBatch
from flame_mdm.conditions.prompts import read_prompt
from flame_mdm.conditions.target import SLOTS
from flame_mdm.data.standing import standing
from flame_mdm.errors import UserError
from flame_mdm.formats.cleanup import cleanup as clean_joints
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import FADE, Blocks, MotionGenerator
from flame_mdm.representations import Representation
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rotation import rotate_y
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.keywords import SamplerKeywords
from flame_mdm.sampling.motion_request import check_length
from flame_mdm.sampling.placement import Placement, step_after
from flame_mdm.sampling.reading import read_motion, with_features
from flame_mdm.sampling.targets import Targets
from flame_mdm.sampling.waypoints import Route, RouteGuide

# Number of past blocks of a stream that can still be dropped, for example if a page has not shown
# them yet
HELD = 4


def stream(
    model: MotionGenerator,
    text: str,
    start: str | Path | Motion | None = None,
    seed: int = 0,
    *,
    block: int | None = None,
    cleanup: bool = False,
    **options: Unpack[SamplerKeywords],
) -> Stream:
    """Starts an endless motion whose text can be changed at any time.

    Args:
        model: a model that continues frames (DiP), from `flame_mdm.load`.
        text: what the person does at first.
        start: the motion to continue, as a `Motion`, a file, or "dataset:id" for a clip of a
            prepared data set. Only its last frames are used. By default, the person first stands
            still.
        seed: seed of the noise.
        block: number of frames per block. The default, which is also the maximum, is the number of
            frames that the model predicts at once. Shorter blocks react sooner to a new text, but
            cost more time per second of motion.
        cleanup: whether to smooth the motion, keep bone lengths constant, and keep feet from
            sliding. Each block is then returned only after the next one has been computed, because
            the two blocks must fit together.
        options: `guidance_scale`, `sampler`, `num_inference_steps`, `eta` and `spacing`. Default:
            the model's.

    Returns:
        An iterator of blocks; see `Stream`.

    Raises:
        UserError: If the model does not continue frames or knows none of the text's content words,
            or if the motion to continue cannot be read or is too short.

    Example:
        >>> import flame_mdm
        >>> stream = flame_mdm.stream(dip, "a person walks", block=8)  # dip: a model like synthetic/dip
        >>> block = next(stream)
        >>> stream.change("a person turns left")  # from the next block on
        >>> len(block.joints), next(stream).text
        (8, 'a person turns left')
    """
    prefix, placement = starting_point(model, start)
    condition = read_text(model, text)
    chosen = SamplerOptions(**options)
    streams = Streams(
        model, [f"{condition}#0"], [condition], prefix, placement, chosen, seed=seed, block=block
    )
    streams.texts[condition] = text
    return Stream(streams, cleanup=cleanup)


class Stream(Iterator[Motion]):
    """An endless motion, as an iterator of blocks; created by `flame_mdm.stream`.

    Each block is a `Motion` that is placed in the world where the previous block ends. A block is
    computed when it is requested. With `cleanup`, the next block is computed at the same time. Two
    streams with the same seed are identical if their texts are the same at all times.

    Example:
        >>> import itertools, flame_mdm
        >>> stream = flame_mdm.stream(dip, "a person walks", seed=1)  # dip: a model like synthetic/dip
        >>> blocks = list(itertools.islice(stream, 2))
        >>> stream.frames == len(blocks[0].joints) + len(blocks[1].joints)
        True
    """

    def __init__(self, streams: Streams, *, cleanup: bool = False):
        self._streams = streams
        self._cleanup = OnlineCleanup(streams.model.representation) if cleanup else None

    @property
    def frames(self) -> int:
        """Total number of frames in all blocks so far."""
        return self._streams.frames[0]

    @property
    def text(self) -> str:
        """Text of the next block."""
        condition = self._streams.schedules[0].at(self.frames)
        return self._streams.texts[condition]

    def change(self, text: str, at: float | None = None) -> None:
        """Changes the text from the next block on, or from a given time on.

        A block in which the text changes ends at the change. Blocks that were already computed stay
        the same.

        Args:
            text: what the person does from then on.
            at: time in seconds since the start of the stream. Default: the end of the last block.

        Raises:
            UserError: If the model knows none of the text's content words, or if the time is in the
                past.
        """
        fps = self._streams.model.representation.fps
        frame = self.frames if at is None else round(at * fps)
        if frame < self.frames:
            now = self.frames / fps
            raise UserError(
                f"at={at:g}: the stream is already at {now:g} seconds. Use a later time, or omit at"
            )
        condition = read_text(self._streams.model, text)
        self._streams.texts[condition] = text
        self._streams.schedules[0].add(frame, condition)

    def lead(self, waypoints: Sequence[Sequence[float]]) -> None:
        """Leads the person along waypoints from the next block on.

        The path bends toward the next waypoint, while the text determines how the person moves; a
        person who is standing stays in place. After the last waypoint, the path no longer bends.

        Args:
            waypoints: world positions (x, z) in meters, in order. These waypoints replace all
                earlier waypoints; an empty list only removes the earlier waypoints.

        Raises:
            UserError: If a waypoint does not consist of two finite numbers or is too far away, or
                if the representation is not `HumanML`.
        """
        self._streams.lead(Route(waypoints))

    @property
    def reached(self) -> list[int]:
        """Indices of the frames in which waypoints were reached, in the order of the waypoints."""
        return list(self._streams.waypoints.reached)

    def go_back(self, at: float) -> None:
        """Drops the frames after a given time, so that the next block continues from there.

        If this method is called before the dropped frames are shown, a new text takes effect at
        once, even if blocks were computed in advance. The result is the same as if the text had
        been changed at that time. Later changes of the text are also dropped, and waypoints that
        were reached later count as not yet reached.

        Args:
            at: time in seconds since the start of the stream, in one of the last four blocks.

        Raises:
            UserError: If the time is not in these blocks, or if the stream uses `cleanup`.
        """
        if self._cleanup is not None:
            raise UserError(
                "cleanup=true: a cleaned block depends on the next block, so the stream "
                "cannot go back. Omit cleanup"
            )
        self._streams.go_back(round(at * self._streams.model.representation.fps))

    def __next__(self) -> Motion:
        while True:
            (block,) = next(self._streams)
            if self._cleanup is None:
                return block
            if (cleaned := self._cleanup.add(block)) is not None:
                return cleaned


class OnlineCleanup:
    """Cleanup of a motion that arrives in blocks.

    Each block is cleaned twice, first as the last of three blocks and then as the middle one. The
    first version continues the previous block without a jump, and the second one fits the next
    block. The result blends from the first version to the second one.
    """

    def __init__(self, representation: Representation):
        self.representation = representation
        self.blocks: list[Motion] = []
        self.version: np.ndarray | None = None  # first version of the middle block

    def add(self, block: Motion) -> Motion | None:
        """Adds a block and returns the cleaned previous block, or None for the first block."""
        self.blocks = [*self.blocks[-2:], block]
        if len(self.blocks) == 1:
            return None
        middle = self.blocks[-2]
        contacts = self.representation.contacts(
            np.concatenate([piece.features for piece in self.blocks])
        )
        joints = np.concatenate([piece.joints for piece in self.blocks])
        joints = clean_joints(joints, middle.fps, middle.skeleton, contacts)
        begin = len(joints) - len(block.joints) - len(middle.joints)
        cleaned = joints[begin : begin + len(middle.joints)]
        if self.version is not None:
            # In each version, the body follows its feet from the first of the three blocks on, so
            # that the positions in the two versions differ.
            shift = (self.version[0, 0] - cleaned[0, 0]) * np.array([1, 0, 1], np.float32)
            joints, cleaned = joints + shift, cleaned + shift
            weight = np.linspace(0, 1, len(cleaned), dtype=np.float32)[:, None, None]
            cleaned = (1 - weight) * self.version + weight * cleaned
        self.version = joints[-len(block.joints) :]
        return replace(
            middle,
            joints=cleaned,
            features=np.zeros((0, 0), np.float32),
            representation="",
            cleanup=True,
        )


class PastBlock(NamedTuple):
    """A past block of a single stream, which `go_back` can shorten.

    `begin` is the index of the block's first frame. `number` is the index of the block, which
    determines the block's noise.
    """

    begin: int
    number: int
    prefix: Tensor
    x: Tensor
    joints: Tensor


class Schedule:
    """The condition of each frame in a stream."""

    def __init__(self, condition: str):
        self.changes = [(0, condition)]

    @classmethod
    def of_parts(cls, conditions: Sequence[str], lengths: Sequence[int]) -> Self:
        """Returns the schedule for consecutive parts with the given `lengths` in frames."""
        schedule, begin = cls(conditions[0]), 0
        for condition, length in zip(conditions[1:], lengths, strict=False):
            begin += length
            schedule.add(begin, condition)
        return schedule

    def add(self, frame: int, condition: str) -> None:
        """Changes the condition from the given frame on, until the next change."""
        changes = {**dict(self.changes), frame: condition}
        self.changes = sorted(changes.items())

    def at(self, frame: int) -> str:
        """Returns the condition of a frame."""
        return [condition for begin, condition in self.changes if begin <= frame][-1]

    def drop(self, frame: int) -> None:
        """Drops all changes from the given frame on, but keeps the first condition."""
        self.changes = [entry for entry in self.changes if entry[0] < max(frame, 1)]

    def until_change(self, frame: int) -> int | None:
        """Returns the number of frames from `frame` to the next change, or None without one."""
        return next((begin - frame for begin, _ in self.changes if begin > frame), None)


class Streams(Iterator[list[Motion]]):
    """Several streams that are sampled in one batch.

    Apart from rounding errors, each stream is the same as if it were sampled alone.

    Args:
        model: a model that continues frames.
        ids: names of the B streams, which seed the noise.
        conditions: B texts or actions with which the streams begin, or "" for unconditioned
            motions.
        prefix: (B, C, D) normalized features of the frames before the streams.
        placement: placement of the first frames in the world. If None, each stream starts at
            x = z = 0, facing +z.
        options: sampler options. Options that are None default to the model's values.
        kind: "text", "action", or "none" for unconditioned motions.
        seed: seed of the noise.
        block: number of frames per block. Default: the number that the model predicts at once.

    Attributes:
        schedules: for each stream, the condition of each frame.
        texts: maps a condition to the text that the user typed, which becomes the text of the
            blocks. If a condition has no entry, the condition itself is used.
        frames: number of frames in each stream so far.
        targets: positions that a single stream should reach, or None. Guidance leads the motion to
            these positions. If the model was trained with targets, the positions are also part of
            its condition.
        waypoints: waypoints along which a single stream without targets is led.
    """

    def __init__(
        self,
        model: MotionGenerator,
        ids: Sequence[str],
        conditions: Sequence[str],
        prefix: Tensor,
        placement: Placement | None,
        options: SamplerOptions,
        *,
        kind: str = "text",
        seed: int = 0,
        block: int | None = None,
    ):
        check_streams(model)
        longest = model.block_frames
        self.block = longest if block is None else block
        if type(self.block) is not int or not 1 <= self.block <= longest:
            raise UserError(
                f"block={block}: this model predicts {longest} frames at once. Use 1 to {longest} frames"
            )
        options = options.over(model.sampler_options)
        model.process.find_sampler(options)
        self.model, self.kind = model, kind
        fade = round(FADE * model.representation.fps)
        self.blocks = Blocks(
            model, ids, prefix, options, seed=seed, unconditioned=kind == "none", fade=fade
        )
        self.schedules = [Schedule(condition) for condition in conditions]
        self.frames = [0] * len(ids)
        self.placement = (
            Placement.origin(len(ids), prefix.device) if placement is None else placement
        )
        self.texts = {condition: condition for condition in conditions}
        self.targets: Targets | None = None
        self.waypoints = Route()
        self._root = [0.0, 0.0]  # world (x, z) of the root in the first stream's last frame
        self._encoded: tuple[list[str], Condition] | None = None
        self._past: deque[PastBlock] = deque(maxlen=HELD)

    def __next__(self) -> list[Motion]:
        """Returns the next block of each stream. A block ends early where the condition changes."""
        conditions = self._conditions()
        kept = [self._until_change(row) for row in range(len(self.frames))]
        x, joints = self._advance(kept)
        features = self.model.representation.denormalize(x.float())
        return [
            self._motion(
                features[row, :count], joints[row, :count], self.texts.get(condition, condition)
            )
            for row, (count, condition) in enumerate(zip(kept, conditions, strict=True))
        ]

    def lead(self, waypoints: Route) -> None:
        """Leads a single stream along waypoints, as `Stream.lead` does."""
        representation = self.model.representation
        if waypoints.points and not isinstance(representation, HumanML):
            raise UserError(
                f"representation {representation.name} has no feature for the turn of the root, "
                "which waypoints require. Use a model with humanml3d features"
            )
        self.waypoints = waypoints

    def go_back(self, frame: int) -> None:
        """Drops all frames from `frame` on and all later text changes in a single stream.

        Raises:
            UserError: If the frame is not in one of the last `HELD` blocks.
        """
        blocks = [block for block in self._past if block.begin < frame]
        is_end = frame == self.frames[0]
        if not is_end and (not blocks or frame > self.frames[0]):
            raise UserError(
                f"frame {frame} is not in the last {HELD} blocks, which end at frame {self.frames[0]}. "
                "Use a time in these blocks"
            )
        self.schedules[0].drop(frame)
        self.waypoints.go_back(frame)
        if is_end:
            return
        self._past = deque(blocks, maxlen=HELD)
        block = blocks[-1]
        kept = frame - block.begin
        context = block.prefix.shape[1]
        self.blocks.number = block.number + 1
        self.blocks.prefix = torch.cat([block.prefix, block.x], 1)[:, kept : kept + context]
        last = self.model.representation.denormalize(block.x[:, kept - 1].float())
        self.placement = step_after(self.model.representation, last, block.joints[:, kept - 1])
        self._root = block.joints[0, kept - 1, 0, [0, 2]].tolist()
        self.frames = [frame]

    def take(self, lengths: Sequence[int]) -> list[Tensor]:
        """Returns the next normalized frames (F, D) of each stream.

        `lengths` contains the number of frames for each stream.
        """
        ends = [frame + length for frame, length in zip(self.frames, lengths, strict=True)]
        parts: list[list[Tensor]] = [[] for _ in ends]
        while self.frames != ends:
            kept = [
                min(self._until_change(row), end - self.frames[row]) for row, end in enumerate(ends)
            ]
            x, _ = self._advance(kept)
            for row, count in enumerate(kept):
                parts[row].append(x[row, :count])
        return [torch.cat(part) for part in parts]

    def _conditions(self) -> list[str]:
        """Returns, for each stream, the condition of the next block."""
        return [
            schedule.at(frame) for schedule, frame in zip(self.schedules, self.frames, strict=True)
        ]

    def _until_change(self, row: int) -> int:
        """Returns the number of frames in the next block of a stream.

        A block may end early, at a change.
        """
        change = self.schedules[row].until_change(self.frames[row])
        return self.block if change is None else min(self.block, change)

    def _advance(self, kept: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Samples the next block. `kept` contains the number of frames that each stream keeps.

        Returns the normalized features (B, P, D) and the float64 world joint positions (B, P, J,
        3).
        """
        representation, count = (
            self.model.representation,
            torch.tensor(kept, device=self.model.device),
        )
        was_training = self.model.training
        if was_training:
            self.model.eval()
        cond, edit = self._aimed(self._encode(self._conditions()))
        number, prefix = self.blocks.number, self.blocks.prefix
        x = self.blocks.sample(cond, count, edit)
        if was_training:
            self.model.train()

        features = representation.denormalize(x.float())
        joints = self.placement.apply(representation.decode(features))
        rows, last = torch.arange(len(x), device=x.device), (count - 1).clamp(min=0)
        after = step_after(representation, features[rows, last], joints[rows, last])
        moved = count > 0
        turn = torch.where(moved, after.turn, self.placement.turn)
        self.placement = Placement(
            turn, torch.where(moved[:, None], after.shift, self.placement.shift)
        )
        self._root = joints[0, last[0], 0, [0, 2]].tolist()
        if len(self.frames) == 1:
            self._past.append(PastBlock(self.frames[0], number, prefix, x, joints))
            roots = joints[0, : kept[0], 0]
            self.waypoints.follow(self.frames[0], roots.cpu().numpy())
        self.frames = [frame + new for frame, new in zip(self.frames, kept, strict=True)]
        return x, joints

    def _aimed(self, cond: Condition) -> tuple[Condition, Edit | None]:
        """Returns the condition and the edit that lead the next block to the targets.

        Only the first stream has targets.
        """
        if self.targets is None:
            return cond, self._led()
        model, placement, frames = self.model, self.placement, self.model.block_frames
        representation = model.representation
        window = self.targets.window(self.frames[0], frames, self._root)
        edit = window.edit(
            representation, frames, model.device, lambda x: in_world(representation, placement, x)
        )
        if not (edit.keep.any() or edit.guide):
            return cond, None
        if getattr(model.denoiser, "target", None) is not None:
            cond = replace(cond, target=root_target(window, frames, placement))
        return cond, edit

    def _led(self) -> Edit | None:
        """Returns the edit that leads the next block to the waypoints, or None if none remain."""
        representation, points = self.model.representation, self.waypoints.left
        if not points or not isinstance(representation, HumanML):
            return None
        frames = self.model.block_frames
        nothing = torch.zeros(1, frames, representation.features, device=self.model.device)
        guide = RouteGuide(representation, self.placement, points)
        return Edit(nothing, torch.zeros_like(nothing, dtype=torch.bool), guide=guide)

    @torch.no_grad()
    def _encode(self, conditions: list[str]) -> Condition:
        """Returns the encoded conditions.

        Conditions are encoded again only if they have changed.
        """
        if self._encoded is None or self._encoded[0] != conditions:
            model, device = self.model, self.model.device
            x = torch.zeros(len(conditions), 1, model.representation.features, device=device)
            batch = MotionBatch(
                x, torch.ones(len(conditions), 1, dtype=torch.bool, device=device), self.blocks.ids
            )
            if self.kind == "text":
                batch.text = conditions
            elif self.kind == "action":
                numbers = [model.facts["actions"].index(name) for name in conditions]
                batch.action = torch.tensor(numbers, device=device)
            self._encoded = conditions, model.encode(batch, self.kind == "none")
        return self._encoded[1]

    def _motion(self, features: Tensor, joints: Tensor, text: str) -> Motion:
        representation = self.model.representation
        array = joints.cpu().numpy()
        if not np.isfinite(array).all():
            raise UserError(f"the model returned non-finite numbers for '{text}'")
        return Motion(
            array,
            representation.fps,
            representation.skeleton,
            text,
            features=features.cpu().numpy(),
            representation=representation.name,
        )


def in_world(representation: Representation, placement: Placement, x: Tensor) -> Tensor:
    """Decodes normalized features (..., F, D) to world joint positions (..., F, J, 3)."""
    joints = representation.to_joints(x)
    turn = placement.turn[0].to(joints).expand(joints.shape[:-1])
    return rotate_y(joints, turn) + placement.shift[0].to(joints)


def root_target(window: Targets, frames: int, placement: Placement) -> Tensor | None:
    """Returns the target condition (1, 8, 4) for the root position in a block's last frame.

    Returns None if the window contains no such target.
    """
    goal = window.positions
    of_root = (goal.joints == 0) & (goal.frames == frames - 1)
    values = dict(zip(goal.axes[of_root].tolist(), goal.values[of_root].tolist(), strict=True))
    if not {0, 2} <= values.keys():
        return None
    device = placement.turn.device
    point = torch.tensor([[values[0], 0.0, values[2]]], dtype=torch.float64, device=device)
    slots = torch.zeros(1, len(SLOTS), 4, device=device)
    slots[0, SLOTS.index("traj"), :3] = placement.undo(point)[0].to(slots)
    slots[0, SLOTS.index("traj"), 3] = 1
    return slots


def check_streams(model: MotionGenerator) -> None:
    """Raises `UserError` if a model cannot stream."""
    if not model.denoiser.context_frames:
        raise UserError(
            "this model does not continue frames, so it cannot stream. Train a model that does, such as bandai/dip"
        )
    if not model.representation.relative:
        name = model.representation.name
        raise UserError(
            f"representation {name} contains world positions, which would leave the range of the training data "
            "in a stream. Use a model with humanml3d features"
        )


def read_text(model: MotionGenerator, text: str) -> str:
    """Returns the text in the form that the model reads.

    If the text names one action that occurs in the model's captions, it is rewritten in the words
    of these captions.

    Raises:
        UserError: If the text is empty or too long, or if the model does not understand it.
    """
    if not isinstance(text, str) or not text.strip():
        raise UserError(
            f"text={text!r}: expected a description of what happens, such as 'a person walks'"
        )
    check_length(text)
    if model.conditioned_on != "text":
        raise UserError(
            f"text={text}: this model is conditioned on {model.conditioned_on}, not on text"
        )
    (caption,) = read_prompt(text, [(text, None)], model.facts).captions
    return caption


def starting_point(
    model: MotionGenerator, start: str | Path | Motion | None
) -> tuple[Tensor, Placement | None]:
    """Returns the normalized frames (1, C, D) that precede a stream, and the stream's placement.

    Raises:
        UserError: If the model cannot stream, or if the motion cannot be read or is too short.
    """
    check_streams(model)
    context, representation = model.denoiser.context_frames, model.representation
    if start is None:
        features = torch.from_numpy(standing(representation, context).features)
        return representation.normalize(features.to(model.device))[None], None

    motion = start if isinstance(start, Motion) else read_motion(representation, start)
    motion = with_features(representation, motion)
    if len(motion.features) < context:
        name = motion.id or "the motion"
        raise UserError(
            f"start={name}: the motion has {len(motion.features)} frames. Use a motion of at least {context} frames"
        )
    features = torch.from_numpy(motion.features[-context:]).to(model.device)
    last = torch.from_numpy(motion.joints[-1:]).to(model.device)
    return representation.normalize(features)[None], step_after(representation, features[-1:], last)
