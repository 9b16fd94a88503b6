"""Streams: blocks join, depend on texts and seed alone, and `generate` with the same model is a cut of a stream."""

import json
import math
import re
import shutil
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.fixtures import ROOT, script
from support.npm import node
from support.runs import TINY_DIP, untrained
from torch import Tensor

import flame_mdm
from flame_mdm import generate, stream
from flame_mdm.batch import Condition, Edit, MotionBatch, length_mask
from flame_mdm.data.standing import standing
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.denoisers import Denoiser
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import Blocks, MotionGenerator
from flame_mdm.processes.guidance import Positions
from flame_mdm.representations.humanml import HumanML
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling import streams as streams_module
from flame_mdm.sampling import waypoints
from flame_mdm.sampling.editing import edit
from flame_mdm.sampling.keywords import SamplerKeywords
from flame_mdm.sampling.placement import Placement
from flame_mdm.sampling.reading import decoded, with_features
from flame_mdm.sampling.streams import (
    OnlineCleanup,
    Schedule,
    Streams,
    root_target,
    starting_point,
)
from flame_mdm.sampling.targets import Targets, errors, read_targets
from flame_mdm.sampling.waypoints import RouteGuide, bends

CONTEXT, BLOCK, FPS = 10, 30, 20.0


def built(*words: str) -> MotionGenerator:
    """A tiny model of `synthetic/dip` with random weights, whose motions are about as large as real ones."""
    model = untrained([*TINY_DIP, *words], CONTEXT + BLOCK, "synthetic/dip")
    model.representation.std.fill_(0.05)
    return model


@pytest.fixture(scope="module")
def model() -> MotionGenerator:
    return built()


def joints(blocks: Any) -> np.ndarray:
    return np.concatenate([block.joints for block in blocks])


def assert_same(ours: np.ndarray, expected: np.ndarray, tolerance: float = 2e-4) -> None:
    np.testing.assert_allclose(ours, expected, rtol=0, atol=tolerance)


class Recalling(Denoiser):
    """A denoiser that knows a motion (F, D) by heart, and continues any frames of it."""

    def __init__(self, motion: Tensor):
        super().__init__()
        self.context_frames, self.motion = CONTEXT, motion
        self.scale = torch.nn.Parameter(torch.ones(()))

    def forward(self, x_t: Tensor, t: Tensor, mask: Tensor, cond: Condition) -> Tensor:
        assert cond.prefix is not None
        windows = self.motion.unfold(0, CONTEXT, 1).transpose(1, 2)
        starts = [
            (windows - prefix).square().sum((1, 2)).argmin() + CONTEXT for prefix in cond.prefix
        ]
        longer = torch.cat([self.motion, self.motion[-1:].expand(x_t.shape[1], -1)])
        return torch.stack([longer[start : start + x_t.shape[1]] for start in starts])


@pytest.fixture(scope="module")
def walk(model) -> Motion:
    """A walk of three seconds along a curve, with features."""
    source = Synthetic(clips=1)
    for index in range(200):
        clip = source.clip(index, FPS)
        if clip.attributes["action"] == "walk" and clip.attributes.get("direction") in (
            "left",
            "right",
        ):
            break
    motion = Motion(np.asarray(clip.motion), FPS)
    return with_features(model.representation, motion)


@pytest.mark.parametrize("block", [BLOCK, 7, 1])
def test_blocks_continue_in_the_world_where_the_frames_before_them_end(model, walk, block):
    knowing = built()
    features = torch.from_numpy(walk.features)
    knowing.denoiser = Recalling(knowing.representation.normalize(features))
    begun = decoded(knowing.representation, features[:CONTEXT], "", "begun")
    running = stream(knowing, "a person walks", begun, block=block)
    running._streams.blocks.fade = 0  # the oracle has no jumps
    blocks = list(islice(running, (len(features) - CONTEXT) // block))
    assert all(len(piece.joints) == block for piece in blocks)
    whole = decoded(knowing.representation, features, "", "whole").joints
    new = joints(blocks)
    assert_same(new, whole[CONTEXT : CONTEXT + len(new)])


def test_a_motion_without_jumps_is_hardly_changed_where_blocks_meet(model, walk):
    knowing = built()
    features = torch.from_numpy(walk.features)
    knowing.denoiser = Recalling(knowing.representation.normalize(features))
    begun = decoded(knowing.representation, features[:CONTEXT], "", "begun")
    new = joints(islice(stream(knowing, "a person walks", begun), 1))
    whole = decoded(knowing.representation, features, "", "whole").joints
    assert_same(new, whole[CONTEXT : CONTEXT + len(new)], 0.02)


def test_a_seam_has_no_greater_step_than_a_block(model, walk):
    """The network has random weights, so that its blocks do not continue each other by themselves."""
    sizes = {}
    for fade in (0, 10):
        running = stream(model, "a person walks", walk, block=BLOCK)
        running._streams.blocks.fade = fade
        blocks = list(islice(running, 8))
        features = np.concatenate([block.features for block in blocks])[
            :, model.representation.pose
        ]
        steps = np.abs(np.diff(features, axis=0)).mean(1)
        at_seam = np.arange(1, 8) * BLOCK - 1
        sizes[fade] = steps[at_seam].mean() / np.delete(steps, at_seam).mean()
    assert sizes[0] > 1.5
    assert sizes[10] < 1.05


def test_a_motion_may_stand_anywhere_when_a_stream_continues_it(model, walk):
    moved = decoded(model.representation, torch.from_numpy(walk.features[:20]), "", "moved")
    placement = Placement(
        torch.tensor([0.7], dtype=torch.float64),
        torch.tensor([[3.0, 0.0, -2.0]], dtype=torch.float64),
    )
    here = next(stream(model, "a person walks", moved)).joints
    moved.joints = (
        placement.apply(torch.from_numpy(moved.joints)[None])[0].numpy().astype(np.float32)
    )
    there = next(stream(model, "a person walks", moved)).joints
    assert_same(there, placement.apply(torch.from_numpy(here)[None])[0].numpy())


def test_places_are_found_and_undone():
    generator = torch.Generator().manual_seed(0)
    pose = torch.randn(4, 22, 3, generator=generator)
    placement = Placement(
        torch.tensor([0.0, 1.0, -2.0, 3.1], dtype=torch.float64),
        torch.randn(4, 3, generator=generator),
    )
    placement.shift[:, 1] = 0
    moved = placement.apply(pose)
    fitted = Placement.fit(pose, moved)
    torch.testing.assert_close(fitted.turn, placement.turn)
    torch.testing.assert_close(fitted.shift, placement.shift.double())
    torch.testing.assert_close(placement.undo(moved), pose.double())


def test_a_placement_does_not_change_heights():
    local = torch.randn(1, 22, 3, generator=torch.Generator().manual_seed(0)).double()
    placement = Placement(
        torch.tensor([0.7], dtype=torch.float64), torch.tensor([[1.0, 0.0, -2.0]]).double()
    )
    raised = placement.apply(local) + torch.tensor([0.0, 0.5, 0.0])
    fitted = Placement.fit(local, raised)
    torch.testing.assert_close(vars(fitted), vars(placement))


def test_a_text_changes_later_blocks_only(model):
    plain, changed = (
        stream(model, "a person walks", seed=3),
        stream(model, "a person walks", seed=3),
    )
    before = [next(plain), next(plain)], [next(changed), next(changed)]
    changed.change("a person sits down")
    after = next(plain), next(changed)
    assert np.array_equal(joints(before[0]), joints(before[1]))
    assert not np.allclose(after[0].joints, after[1].joints, atol=1e-3)
    assert (after[0].text, after[1].text, changed.text) == (
        "a person walks",
        "a person sits down",
        "a person sits down",
    )
    assert not np.allclose(
        next(stream(model, "a person walks", seed=4)).joints, before[0][0].joints, atol=1e-3
    )


def test_a_text_is_read_in_the_words_of_the_captions_as_in_generate():
    reading = built()
    words = ["a", "person", "walks", "waves", "forward", "with", "the", "left", "hand"]
    reading.add_facts(
        {"verbs": ["walks", "waves"], "actions": ["walk", "wave"], "vocabulary": words}
    )
    running = stream(reading, "somebody is strolling forwards")
    first = next(running)
    running.change("he waved his left hand")
    second = next(running)
    assert (first.text, second.text) == ("somebody is strolling forwards", "he waved his left hand")
    motion = generate(reading, "somebody is strolling forwards @1.5 | he waved his left hand @1.5")[
        0
    ]
    assert_same(motion.joints, joints([first, second]))
    with pytest.raises(UserError):
        running.change("xyzzy plugh")


def test_each_block_has_its_own_noise_which_no_text_changes(model):
    def starts(text: str) -> list[Tensor]:
        """The noise that each of three blocks starts from."""
        inputs: list[Tensor] = []
        hook = model.denoiser.register_forward_hook(
            lambda _, arguments, __: inputs.append(arguments[0])
        )
        running = stream(model, "a person walks", guidance_scale=1.0)
        next(running)
        running.change(text)
        list(islice(running, 2))
        hook.remove()
        return inputs[:: len(inputs) // 3]

    sitting, waving = starts("a person sits down"), starts("a person waves")
    assert all(torch.equal(one, other) for one, other in zip(sitting, waving, strict=True))
    assert torch.isclose(sitting[0], sitting[1], atol=1e-3).float().mean() < 0.01


def test_texts_at_times_give_the_same_motion_whenever_they_are_typed(model):
    early, late = stream(model, "a person walks"), stream(model, "a person walks")
    for text, at in (("a person sits down", 2.25), ("a person waves", 3.5)):
        early.change(text, at=at)
    blocks = [next(late)]
    late.change("a person sits down", at=2.25)
    blocks.append(next(late))
    late.change("a person waves", at=3.5)
    blocks += [next(late), next(late)]
    assert [len(block.joints) for block in blocks] == [30, 15, 25, 30]
    assert np.array_equal(joints(islice(early, 4)), joints(blocks))
    with pytest.raises(
        UserError, match=r"at=1: the stream is already at 5 seconds\. Use a later time"
    ):
        late.change("a person jumps", at=1)


def test_frames_that_were_not_used_can_be_replaced(model, subtests):
    early, late = stream(model, "a person walks"), stream(model, "a person walks")
    early.change("a person sits down", at=2.25)
    expected = joints(islice(early, 4))
    ahead = list(islice(late, 3))
    late.change("a person jumps", at=6)
    late.go_back(2.25)
    late.change("a person sits down")
    assert late.frames == 45
    assert_same(joints([*ahead[:1], *islice(late, 2)]), np.delete(expected, slice(30, 45), 0))
    assert next(late).text == "a person sits down"
    for at in (0, 30):
        with (
            subtests.test(at=at),
            pytest.raises(
                UserError, match=r"is not in the last 4 blocks, which end at frame 135\."
            ),
        ):
            late.go_back(at)
        assert late.text == "a person sits down", "a refused request changes nothing"
    with pytest.raises(UserError, match="cleanup=true: a cleaned block depends on the next block"):
        stream(model, "a person walks", cleanup=True).go_back(1)


@pytest.mark.parametrize("frames", [2, 30, 75])
def test_generate_is_a_cut_of_the_stream(model, frames):
    motion = generate(model, "a person walks", frames=frames, seed=5)[0]
    assert len(motion.joints) == frames
    assert_same(motion.joints, joints(islice(stream(model, "a person walks", seed=5), 3))[:frames])
    assert motion.parts == ()


def test_parts_are_changes_of_the_text(model):
    motion = generate(model, "a person walks @2 | a person sits down @1.5")[0]
    running = stream(model, "a person walks")
    running.change("a person sits down", at=2)
    assert_same(motion.joints, joints(islice(running, 4))[:70])
    assert motion.parts == (("a person walks", 0, 40), ("a person sits down", 40, 70))


def test_a_motion_is_continued(model, walk):
    motion = generate(model, "a person sits down", after=walk, seconds=2)[0]
    assert len(motion.joints) == len(walk.joints) + 40
    assert_same(motion.joints[: len(walk.joints)], walk.joints)
    new = joints(islice(stream(model, "a person sits down", walk), 2))
    assert_same(motion.joints[len(walk.joints) :], new[:40])


def test_samples_and_lengths_in_a_batch_are_those_alone(model):
    together = generate(
        model, ["a person walks", "a person waves | sits"], samples=2, seconds=[1.0, 2.0]
    )
    assert [len(motion.joints) for motion in together] == [20, 20, 80, 80]
    assert not np.allclose(together[0].joints, together[1].joints, atol=1e-3)
    assert_same(generate(model, "a person walks", frames=20)[0].joints, together[0].joints)
    assert_same(generate(model, "a person waves | sits", seconds=2.0)[0].joints, together[2].joints)


def test_a_batch_of_streams_gives_what_single_ones_give(model):
    texts = ["a person walks", "a person waves"]
    prefix, _ = starting_point(model, None)
    ids = [f"{text}#0" for text in texts]
    streams = Streams(model, ids, texts, prefix.expand(2, -1, -1), None, SamplerOptions())
    streams.schedules[1].add(40, "a person sits down")
    pairs = [next(streams) for _ in range(3)]
    walking, waving = (stream(model, text) for text in texts)
    waving.change("a person sits down", at=2)
    for blocks, alone in zip(zip(*pairs, strict=True), (walking, waving), strict=True):
        assert_same(joints(blocks), joints(islice(alone, 3)))


def test_options_of_the_sampler_reach_the_stream(model, subtests):
    first = next(stream(model, "a person walks")).joints
    changes: list[SamplerKeywords] = [
        {"guidance_scale": 1.0},
        {"sampler": "ddim"},
        {"num_inference_steps": 2},
    ]
    for options in changes:
        with subtests.test(options=options):
            assert not np.allclose(
                next(stream(model, "a person walks", **options)).joints, first, atol=1e-4
            )
    with pytest.raises(UserError, match="unknown sampler 'dddim'"):
        stream(model, "a person walks", sampler="dddim")


def test_the_path_is_reached_through_many_blocks(model):
    path = [(0.0, 0.6), (0.4, 1.2)]
    motion = generate(model, "a person walks", seconds=4, path=path)[0]
    aims = read_targets(
        model.representation,
        {"root": [{"time": 3.8, "position": list(path[-1])}]},
    )
    assert errors(motion, aims).max() < 0.03
    free = generate(model, "a person walks", seconds=4)[0]
    assert errors(free, aims).max() > 0.1


def test_a_model_trained_with_targets_also_reads_them():
    aiming = built("denoiser=dip_target", "task=generation_targets", "denoiser.context_frames=10")
    seen: list[Tensor | None] = []
    aiming.denoiser.register_forward_hook(lambda _, inputs, __: seen.append(inputs[3].target))
    generate(aiming, "a person walks", seconds=3, path=[(0.5, 1.0)])
    target = seen[0]
    assert target is not None
    # A straight way at an even speed: the first block ends after 30 of the 57 frames to the goal.
    torch.testing.assert_close(
        target[0, 6], torch.tensor([0.5 * 30 / 57, 0.0, 30 / 57, 1.0]), rtol=0, atol=1e-4
    )
    assert not target[0, [0, 1, 2, 3, 4, 5, 7]].any()
    seen.clear()
    next(stream(aiming, "a person walks"))
    assert seen
    assert all(target is None for target in seen)


def test_a_model_in_training_streams_without_dropout_and_stays_in_training(model):
    expected = next(stream(model, "a person walks")).joints
    model.train()
    try:
        training = next(stream(model, "a person walks")).joints
        assert model.training
    finally:
        model.eval()
    assert_same(training, expected)


def test_samples_of_a_text_with_shared_noise_are_the_same_stream(model):
    one, other = generate(model, "a person walks", seconds=1, samples=2, shared_noise=True)
    assert_same(one.joints, other.joints)
    seeded = generate(model, "a person walks", seconds=1, shared_noise=True, seed=1)[0]
    assert not np.allclose(one.joints, seeded.joints, atol=1e-3)


def test_a_person_stands_still_before_the_first_block(model):
    still = standing(model.representation, CONTEXT)
    assert np.ptp(still.joints, axis=0).max() < 1e-4
    assert abs(still.joints[..., 1].min()) < 0.01
    assert 0.8 < still.joints[0, 0, 1] < 1.1
    columns = model.representation.slices
    assert np.abs(still.features[:, columns["velocities"]]).max() < 1e-5
    assert still.features[:, columns["contacts"]].min() == 1


def test_cleanup_is_applied_to_generated_motions(model):
    raw, clean = (generate(model, "a person walks", cleanup=flag)[0] for flag in (False, True))
    assert clean.cleanup
    assert not np.allclose(raw.joints, clean.joints, atol=1e-4)


def test_online_cleanup_waits_for_one_block_and_has_no_jump_between_blocks(walk):
    knowing = built()
    features = torch.from_numpy(walk.features)
    noisy = features + 0.02 * torch.randn(
        features.shape, generator=torch.Generator().manual_seed(1)
    )
    knowing.denoiser = Recalling(knowing.representation.normalize(noisy))
    begun = decoded(knowing.representation, noisy[:CONTEXT], "", "begun")
    running, plain = (
        stream(knowing, "a person walks", begun, block=10, cleanup=cleanup)
        for cleanup in (True, False)
    )
    for one in (running, plain):
        one._streams.blocks.fade = 0  # only cleanup removes the noise
    raw = joints(islice(plain, 4))
    first = next(running)
    assert (running.frames, len(first.joints), first.cleanup, len(first.features)) == (
        20,
        10,
        True,
        0,
    )
    clean = np.concatenate([first.joints, *(next(running).joints for _ in range(3))])
    assert np.linalg.norm(clean - raw, axis=-1).mean() < 0.1

    def jumps(motion: np.ndarray) -> np.ndarray:
        """Change of velocity, in meters per frame, around each frame."""
        return np.linalg.norm(np.diff(motion, 2, axis=0), axis=-1).max(1)

    seams = np.isin(np.arange(1, len(clean) - 1), [9, 10, 19, 20, 29, 30])
    assert jumps(clean)[seams].max() <= 1.2 * jumps(clean)[~seams].max()
    assert jumps(clean).max() < jumps(raw).max()
    assert jumps(clean).mean() < 0.8 * jumps(raw).mean()


def test_online_cleanup_moves_blocks_over_the_floor_and_blends_heights(monkeypatch):
    """The stand-in for cleanup moves all joints by the number of its frames times (1, 10, 100)."""
    direction = np.array([1.0, 10.0, 100.0], np.float32)

    def moved(joints: np.ndarray, fps: float, skeleton: Any, contacts: np.ndarray) -> np.ndarray:
        assert (fps, len(contacts)) == (30.0, len(joints))
        return joints + len(joints) * direction

    monkeypatch.setattr(streams_module, "clean_joints", moved)
    representation: Any = SimpleNamespace(contacts=lambda features: features[:, :2])
    cleanup = OnlineCleanup(representation)
    rng = np.random.default_rng(0)
    blocks = [
        Motion(
            rng.normal(size=(count, 22, 3)).astype(np.float32),
            30.0,
            features=np.zeros((count, 4), np.float32),
            representation="humanml3d",
        )
        for count in (4, 6, 5, 7)
    ]
    assert cleanup.add(blocks[0]) is None
    results = [cleanup.add(block) for block in blocks[1:]]
    # The first block is cleaned with 10 frames, the next ones with 10 and then 15 or 18 frames.
    heights = [np.full(4, 100.0), np.linspace(100, 150, 6), np.linspace(150, 180, 5)]
    for result, block, height in zip(results, blocks, heights, strict=False):
        assert result is not None
        assert (result.cleanup, result.representation, result.features.size) == (True, "", 0)
        offset = np.stack([np.full_like(height, 10), height, np.full_like(height, 1000)], -1)
        np.testing.assert_allclose(result.joints, block.joints + offset[:, None], atol=1e-3)


def test_times_are_rounded_to_the_nearest_frame(model):
    running = stream(model, "a person walks")
    running.change("a person sits down", at=2.29)
    blocks = list(islice(running, 3))
    assert [len(block.joints) for block in blocks] == [30, 16, 30]
    running.go_back(2.69)
    assert running.frames == 54
    running.change("a person waves", at=2.7)  # in the next frame
    assert next(running).text == "a person waves"


def test_a_path_is_straight_from_where_the_last_block_ended(model, monkeypatch):
    """The path to a target starts at the root of the last frame."""
    starts, ends = [], []
    window = Targets.window

    def recorded(self: Targets, begin: int, frames: int, here: Any) -> Targets:
        starts.append([begin, *here])
        return window(self, begin, frames, here)

    monkeypatch.setattr(Targets, "window", recorded)
    running = Streams(
        model, ["#0"], ["a person walks"], *starting_point(model, None), SamplerOptions()
    )
    goal = {"root": [{"time": 4.0, "position": [0.5, 1.0]}]}
    running.targets = read_targets(model.representation, goal)
    for _ in range(2):
        (block,) = next(running)
        ends.append(block.joints[-1, 0, [0, 2]].tolist())
    next(running)
    assert starts[0] == [0, 0.0, 0.0]
    for start, frame, end in zip(starts[1:], (30, 60), ends, strict=True):
        assert start == pytest.approx([frame, *end], abs=1e-5)


def test_a_jump_between_blocks_fades_in_half_a_second(model, monkeypatch):
    for fps, frames in ((20.0, 10), (30.0, 15), (60.0, 30)):
        monkeypatch.setattr(model.representation, "fps", fps)
        running = stream(model, "a person walks")
        assert running._streams.blocks.fade == frames
        running.change("a person sits down", at=0.7)
        assert running._streams.schedules[0].until_change(0) == round(0.7 * fps)


def test_a_fade_moves_the_generated_pose_but_not_what_an_edit_keeps(model):
    prefix, _ = starting_point(model, None)
    options = SamplerOptions(num_inference_steps=2).over(model.sampler_options)
    batch = MotionBatch(prefix, torch.ones(1, CONTEXT, dtype=torch.bool), ["a"], text=["walks"])
    cond = model.encode(batch)
    features = torch.full((1, BLOCK, prefix.shape[2]), 3.0)
    keep = torch.zeros_like(features, dtype=torch.bool)
    keep[:, 1:4, 4:70] = True
    edit = Edit(features, keep)
    sharp, faded = (
        Blocks(model, ["a"], prefix, options, fade=fade).sample(cond, edit=edit) for fade in (0, 8)
    )
    assert (sharp[keep] == 3).all()
    assert (faded[keep] == 3).all()
    pose = model.representation.pose
    changed = (sharp != faded).any(1)[0]
    assert not changed[: pose.start].any()
    assert not changed[pose.stop :].any()
    assert changed[pose].any()
    assert torch.equal(sharp[:, 8:], faded[:, 8:])


def test_the_target_of_a_block_is_the_position_in_its_last_frame_seen_from_its_first_one():
    """The body is at x = 1 and z = 2 and faces +x. A goal 3 m further along z is to its right, at -x."""
    placement = Placement(
        torch.tensor([math.pi / 2], dtype=torch.float64), torch.tensor([[1.0, 0, 2]]).double()
    )
    frames, axes = torch.tensor([29, 29, 10, 10, 29]), torch.tensor([0, 2, 0, 2, 1])
    joints = torch.tensor([0, 0, 0, 0, 5])
    values = torch.tensor([1.0, 5.0, -7.0, -7.0, 9.0])
    window = Targets(Positions(frames, joints, axes, values), ())
    target = root_target(window, 30, placement)
    assert target is not None
    expected = torch.zeros(1, 8, 4)
    expected[0, 6] = torch.tensor([-3.0, 0.0, 0.0, 1.0])
    torch.testing.assert_close(target, expected, rtol=0, atol=1e-6)
    for left in (slice(1, None), slice(1)):  # only z or only x
        part = Targets(Positions(frames[left], joints[left], axes[left], values[left]), ())
        assert root_target(part, 30, placement) is None
    assert root_target(window, 31, placement) is None


def test_a_replication_has_its_own_noise(model):
    prefix, _ = starting_point(model, None)
    batch = MotionBatch(
        prefix[:, :1].expand(1, BLOCK, -1),
        torch.ones(1, BLOCK, dtype=torch.bool),
        ["a"],
        text=["a person walks"],
    )
    first, again, other = (
        model.generate(batch, prefix=prefix, replication=number) for number in (0, 0, 1)
    )
    assert torch.equal(first, again)
    assert not torch.allclose(first, other, atol=1e-3)


def test_noise_that_is_shared_is_the_same_for_all_names_also_block_by_block(model):
    prefix, _ = starting_point(model, None)
    mask, texts = torch.ones(2, BLOCK + 3, dtype=torch.bool), ["a person walks"] * 2
    x = prefix[:, :1].expand(2, BLOCK + 3, -1)
    batch, prefix = MotionBatch(x, mask, ["a", "b"], text=texts), prefix.expand(2, -1, -1)
    shared, separate = (
        model.generate(batch, prefix=prefix, shared_noise=flag) for flag in (True, False)
    )
    torch.testing.assert_close(shared[0], shared[1])
    assert not torch.allclose(separate[0], separate[1], atol=1e-3)
    assert shared.shape[1] == BLOCK + 3


def two_people(model: MotionGenerator, lengths: list[int]) -> tuple[MotionBatch, torch.Tensor]:
    """A batch of two walking people, and the frames before it."""
    standing, _ = starting_point(model, None)
    prefix = torch.cat([standing, standing + 0.1])
    mask = length_mask(torch.tensor(lengths))
    x = torch.zeros(2, mask.shape[1], prefix.shape[2])
    return MotionBatch(x, mask, ["a", "b"], text=["a person walks"] * 2), prefix


def test_each_person_continues_from_the_frames_before_the_last_one_that_is_kept(model):
    batch, prefix = two_people(model, [BLOCK, BLOCK])
    cond = model.encode(batch)
    options = SamplerOptions(num_inference_steps=2).over(model.sampler_options)
    for kept in ([3, BLOCK], [BLOCK - 1, 1], [0, CONTEXT]):
        blocks = Blocks(model, batch.ids, prefix, options)
        both = torch.cat([prefix, blocks.sample(cond, torch.tensor(kept))], 1)
        assert blocks.prefix is not None
        for row, count in enumerate(kept):
            assert torch.equal(blocks.prefix[row], both[row, count : count + CONTEXT])
        assert blocks.number == 1


def test_continued_motions_of_a_batch_end_in_zeros_and_are_those_of_each_person_alone(model):
    lengths = [BLOCK + 5, 7]
    batch, prefix = two_people(model, lengths)
    options = SamplerOptions(num_inference_steps=2)
    x = model.generate(batch, options, prefix=prefix, seed=3)
    assert x.shape == batch.x.shape
    for row, length in enumerate(lengths):
        assert not x[row, length:].any()
        alone = MotionBatch(
            batch.x[:1, :length],
            batch.mask[row : row + 1, :length],
            batch.ids[row : row + 1],
            text=["a person walks"],
        )
        expected = model.generate(alone, options, prefix=prefix[row : row + 1], seed=3)[0]
        torch.testing.assert_close(x[row, :length], expected, rtol=0, atol=1e-3)


def test_a_model_that_continues_motions_is_left_in_its_mode_and_samples_without_dropout():
    model = built()
    for module in model.denoiser.modules():
        if isinstance(module, torch.nn.Dropout):
            module.p = 0.5
    batch, prefix = two_people(model, [5, 5])
    options = SamplerOptions(num_inference_steps=2)
    expected = model.eval().generate(batch, options, prefix=prefix)
    assert not model.training
    sampled = model.train().generate(batch, options, prefix=prefix)
    torch.testing.assert_close(sampled, expected)
    assert model.training
    assert model.denoiser.training


def test_what_such_a_model_cannot_do_is_said_in_one_line(model, walk, subtests):
    short = decoded(model.representation, torch.from_numpy(walk.features[:4]), "", "short")
    ordinary = untrained(["denoiser.latent_dim=16", "denoiser.num_layers=1"], 60)
    for call, message in (
        (
            lambda: stream(ordinary, "a person walks"),
            "does not continue frames, so it cannot stream",
        ),
        (
            lambda: stream(model, "a person walks", short),
            "start=short: the motion has 4 frames. Use a motion of at least 10 frames",
        ),
        (lambda: stream(model, "a person walks", "nowhere.bvh"), "nowhere.bvh"),
        (
            lambda: stream(model, "a person walks", block=31),
            "block=31: this model predicts 30 frames at once",
        ),
        (lambda: stream(model, " "), "expected a description of what happens"),
        (
            lambda: generate(model, "a person walks", loop=True),
            "loop=true: this model only extends a motion",
        ),
        (
            lambda: generate(model, "a person walks", stages=[]),
            "trajectory: not supported by models that continue motions",
        ),
        (
            lambda: generate(model, "a person walks", after=short),
            "after=short: the motion has 4 frames",
        ),
        (
            lambda: edit(model, walk, region="in_between"),
            "this model can only continue motions",
        ),
        (
            lambda: generate(model, "a person walks", seconds=601),
            "601 seconds is too long. Use at most 600",
        ),
        (lambda: generate(model, "a person walks", seconds=0), "0 seconds is too short"),
    ):
        with subtests.test(message=message):
            with pytest.raises((UserError, FileNotFoundError), match=message) as error:
                call()
            assert "\n" not in str(error.value)


def test_streams_are_public():
    assert "stream" in flame_mdm.__all__
    assert Path(flame_mdm.stream.__code__.co_filename).name == "streams.py"


def test_a_condition_ends_in_the_frame_before_the_next_one():
    schedule = Schedule("a person walks")
    schedule.add(5, "a person jumps")
    assert [schedule.until_change(frame) for frame in (0, 3, 4, 5)] == [5, 2, 1, None]
    assert [schedule.at(frame) for frame in (4, 5)] == ["a person walks", "a person jumps"]


@pytest.mark.parametrize(("frame", "left"), [(0, 1), (5, 1), (6, 2), (9, 2), (10, 3)])
def test_changes_are_dropped_from_a_frame_on_but_the_first_condition_stays(frame: int, left: int):
    schedule = Schedule("a person walks")
    schedule.add(5, "a person jumps")
    schedule.add(9, "a person waves")
    schedule.drop(frame)
    assert [begin for begin, _ in schedule.changes] == [0, 5, 9][:left]


# Waypoints -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def walking() -> MotionGenerator:
    """A tiny model with random weights, whose motions are almost a person who glides forward at 1 m/s."""
    return gliding(0.05)


def gliding(step: float) -> MotionGenerator:
    model = built()
    still = standing(model.representation, CONTEXT).features[0]
    model.representation.mean.copy_(torch.from_numpy(still))
    model.representation.mean[2] = step
    model.representation.std.fill_(0.005)
    return model


@pytest.mark.parametrize(
    "points",
    [
        [(1.5, 1.0), (0.0, 3.0)],
        # behind the person, and inside the narrowest circle that a walk describes
        [(0.0, -2.0)],
        [(0.5, 0.0)],
    ],
)
def test_the_person_passes_waypoints_in_order(walking, points, subtests):
    running = stream(walking, "a person walks")
    running.lead(points)
    places = joints(islice(running, 7))[:, 0, [0, 2]]
    assert len(running.reached) == len(points)
    assert running.reached == sorted(running.reached)
    for frame, point in zip(running.reached, points, strict=True):
        with subtests.test(point=point):
            assert np.linalg.norm(places[frame] - point) < 0.3
    free = joints(islice(stream(walking, "a person walks"), 7))[:, 0, [0, 2]]
    assert np.linalg.norm(free - points[0], axis=1).min() > 0.4


def test_the_way_bends_no_more_than_feet_allow(subtests):
    rng = np.random.default_rng(0)
    for speed in (0.0, 0.01, 0.06):
        steps = [(0.0, speed)] * 40
        for goal in rng.uniform(-4, 4, (20, 2)).tolist():
            with subtests.test(speed=speed, goal=goal):
                added = bends([0.0] * 40, steps, 0.0, (0.0, 0.0), [tuple(goal)], FPS)
                assert np.abs(added).max() <= min(1.3 / FPS, speed / 0.7) + 1e-9


def test_a_person_who_stands_does_not_turn_to_a_waypoint():
    still = gliding(0.0)
    free, led = stream(still, "a person stands"), stream(still, "a person stands")
    led.lead([(-2.0, 0.0)])
    places = [next(free).joints for free in (free, led)]
    assert np.abs(places[0] - places[1]).max() < 0.2
    assert led.reached == []


def test_waypoints_change_later_blocks_alone_and_are_ahead_again_after_going_back(walking):
    plain, led = stream(walking, "a person walks"), stream(walking, "a person walks")
    assert np.array_equal(next(plain).joints, next(led).joints)
    led.lead([(0.2, 2.4)])
    blocks = [next(led) for _ in range(2)]
    (frame,) = led.reached
    led.go_back((frame - 3) / FPS)
    assert led.reached == []
    next(led)
    assert len(led.reached) == 1
    with pytest.raises(UserError, match="not in the last 4 blocks"):
        led.go_back(0)
    assert len(led.reached) == 1
    led.lead([])
    assert not np.allclose(next(plain).joints, blocks[0].joints, atol=1e-2)
    assert not led.reached


@pytest.mark.parametrize(
    "point", [(1.0,), (1.0, 2.0, 3.0), (np.nan, 0.0), (np.inf, 0.0), (2e4, 0.0), ("1", 0.0)]
)
def test_waypoints_are_two_numbers(walking, point):
    running = stream(walking, "a person walks")
    with pytest.raises(UserError, match=r"waypoint .*: expected x and z in meters"):
        running.lead([point])


def test_a_path_with_turns_and_side_steps_bends_as_measured():
    """At first straight ahead, then to the right as fast as the path allows."""
    turns = [0.02 * math.sin(frame) for frame in range(24)]
    steps = [(0.01 * math.cos(frame), 0.04 + 0.001 * frame) for frame in range(24)]
    points = [(1.15, 2.6), (1.3, 2.9), (-3.0, 4.0)]
    added = bends(turns, steps, 0.3, (1.0, 2.0), points, 30)
    assert added == pytest.approx(
        [
            -0.025,
            -0.021817,
            -0.014727,
            -0.005776,
            -8e-05,
            -0.000543,
            -0.005357,
            -0.00962,
            0.004201,
            0.009434,
            0.014009,
            0.0144,
            0.010731,
            0.006607,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
            -0.043333,
        ],
        abs=2e-6,
    )


@pytest.mark.parametrize(
    ("length", "goal", "bend"),
    [
        # At 1 m/s, the circle of 1.2 * 1 m / 1.3 is free up to 0.15 m inside of it.
        (0.05, (1.2 / 1.3 * 2 - 0.16, 0.0), 0.0),
        (0.05, (1.2 / 1.3 * 2 - 0.14, 0.0), 1.3 / 20),
        (0.05, (-1.2 / 1.3 * 2 + 0.14, 0.0), -1.3 / 20),
        # At 0.4 m/s, the smallest radius of 0.7 m counts.
        (0.02, (1.2 * 0.7 * 2 - 0.16, 0.0), 0.0),
        (0.02, (1.2 * 0.7 * 2 - 0.14, 0.0), 0.02 / 0.7),
        # Deviations decay within 0.4 seconds.
        (0.05, (0.3, 3.0), math.atan(0.1) / (0.4 * 20)),
    ],
)
def test_a_bend_leaves_room_for_a_circle_and_is_bounded_by_time_and_path(length, goal, bend):
    assert waypoints._bend(0.0, length, (0.0, 0.0), goal, 20) == pytest.approx(bend, abs=1e-9)


@pytest.mark.parametrize("variant", ["clean", "legacy"])
def test_a_led_block_turns_by_its_bends_and_keeps_everything_else(variant):
    representation = HumanML(variant=variant)
    representation.std.uniform_(0.5, 2.0, generator=torch.Generator().manual_seed(1))
    placement = Placement(torch.tensor([0.4]).double(), torch.tensor([[0.5, 0, -1.0]]).double())
    points = [(2.0, 1.0)]
    x = 0.02 * torch.randn(1, BLOCK, 263, generator=torch.Generator().manual_seed(0))
    guide = RouteGuide(representation, placement, points)
    led = guide.reach(x)
    (before, steps), (after, _) = (
        representation.root_steps(representation.denormalize(motion[0])) for motion in (x, led)
    )
    expected = bends(before.tolist(), steps.tolist(), 0.4, (0.5, -1.0), points, FPS)
    assert max(map(abs, expected)) > 0.01
    assert (after - before).tolist() == pytest.approx(expected, abs=1e-5)
    assert torch.equal(led[..., 1:], x[..., 1:])
    assert guide.steer(lambda y: y, x) is x


def test_every_waypoint_is_reached_at_any_speed(subtests):
    rng = np.random.default_rng(1)
    turns = [0.0] * BLOCK
    for speed in (0.02, 0.05, 0.15):
        steps = [(0.0, speed)] * BLOCK
        for goal in [(0.0, -1.0), (0.4, 0.0), *rng.uniform(-4, 4, (10, 2)).tolist()]:
            with subtests.test(speed=speed, goal=goal):
                heading, x, z, nearest = 0.0, 0.0, 0.0, math.inf
                for _ in range(20):
                    for bend in bends(turns, steps, heading, (x, z), [(goal[0], goal[1])], FPS):
                        x += speed * math.sin(heading)
                        z += speed * math.cos(heading)
                        heading += bend
                        nearest = min(nearest, math.dist((x, z), goal))
                assert nearest < 0.3, (speed, goal)


@pytest.mark.parametrize("name", ["NEAR", "FASTEST", "TIGHTEST", "ROOM", "PATIENCE", "SMOOTHING"])
def test_the_web_page_has_the_same_numbers_for_waypoints(name):
    script = (ROOT / "tools/web/waypoints.js").read_text()
    (number,) = re.findall(rf"const {name} = ([\d.]+);", script)
    assert float(number) == getattr(waypoints, name)


@pytest.mark.tools
@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
def test_the_web_page_bends_the_way_in_the_same_manner(tmp_path):
    rng = np.random.default_rng(2)
    cases = [
        (
            rng.normal(0, 0.03, BLOCK).tolist(),
            rng.normal((0, speed), 0.01, (BLOCK, 2)).tolist(),
            float(rng.uniform(-4, 4)),
            rng.uniform(-3, 3, 2).tolist(),
            rng.uniform(-3, 3, (rng.integers(1, 5), 2)).tolist(),
            FPS,
        )
        for speed in (0.0, 0.02, 0.06, 0.15)
        for _ in range(20)
    ]
    shutil.copy(ROOT / "tools/web/waypoints.js", tmp_path)
    (tmp_path / "package.json").write_text('{"type": "module"}')
    (tmp_path / "cases.json").write_text(json.dumps(cases))
    theirs = node("web_waypoints.mjs", tmp_path)
    np.testing.assert_allclose(theirs, [bends(*case) for case in cases], rtol=0, atol=1e-12)


def test_the_page_of_long_streams_is_rendered_from_the_committed_figures():
    folder = ROOT / "docs" / "benchmarks"
    drift = script("tools/stream_drift.py")
    results = json.loads((folder / "streams.json").read_text(encoding="utf-8"))
    assert (folder / "streams.md").read_text(encoding="utf-8") == drift.page(results)
    drawing = drift.svg_file(drift.figure(results))
    assert (folder / "streams-figure.svg").read_text(encoding="utf-8") == drawing


def test_the_last_minute_of_a_long_stream_has_the_texts_of_the_first_one():
    drift = script("tools/stream_drift.py")
    requests = drift.texts(0)
    assert len(requests) == drift.MINUTES * 60 / drift.SECONDS_PER_TEXT
    assert requests[-6:] == requests[:6]
    assert requests[6:12] != requests[:6]
    assert drift.texts(1) != requests


def test_steps_at_seams_are_told_from_steps_inside_blocks():
    """All joints go 1 cm per frame, and jump by 7 cm where the second block begins."""
    x = np.arange(20) * 0.01
    x[10:] += 0.06
    joints = np.zeros((2, 20, 22, 3))
    joints[..., 0] = x[:, None]
    figures = script("tools/stream_drift.py").seams_of(joints, np.array([10]))
    assert figures["step, seam, median"] == pytest.approx(0.07)
    assert figures["step, inside, percentile 99"] == pytest.approx(0.01)
    assert figures["change of step, seam, median"] == pytest.approx(0.06)
    assert figures["change of step, inside, percentile 99"] == pytest.approx(0.0, abs=1e-9)


def test_an_action_counts_as_recognized_if_it_is_shown_in_time(subtests):
    drift = script("tools/stream_drift.py")
    source = Synthetic(clips=1)
    clips = (source.clip(index, FPS) for index in range(100))
    clip = next(c for c in clips if c.attributes["action"] == "kick" and len(c.motion) >= 45)
    kick = np.asarray(clip.motion)
    still = np.repeat(kick[:1], 100, 0)
    for frames, right in ((10, 1), (90, 0)):  # half a second, or too late
        with subtests.test(frames=frames):
            motion = np.concatenate([still[:frames], kick, np.repeat(kick[-1:], 100, 0)])[None]
            request = [[("kicks", {"action": "kick"})]]
            recognized = drift.recognized(motion, request, FPS)
            assert recognized["right"] == recognized["in_time"] == right


def test_times_of_a_stream_are_frames_at_the_rate_of_the_model(model, monkeypatch):
    monkeypatch.setattr(model.representation, "fps", 30.0)
    running = stream(model, "a person walks")
    schedule = running._streams.schedules[0]
    running.change("a person jumps", at=1.5)
    assert schedule.changes == [(0, "a person walks"), (45, "a person jumps")]
    block = next(running)
    assert (len(block.joints), block.fps, running.frames) == (30, 30.0, 30)
    assert len(next(running).joints) == 15  # until the change
    running.go_back(0.5)
    assert running.frames == 15
    assert schedule.changes == [(0, "a person walks")]
    assert running._streams._root == pytest.approx(block.joints[14, 0, [0, 2]].tolist(), abs=1e-5)
    with pytest.raises(UserError, match=r"^at=0.4: the stream is already at 0.5 seconds"):
        running.change("a person jumps", at=0.4)
    again = next(running).joints
    apart = np.linalg.norm(again[0, 0] - block.joints[14, 0])
    assert apart < 0.1 + np.linalg.norm(np.diff(block.joints[:, 0], axis=0), axis=1).max()


def test_streams_of_actions_and_without_a_condition_are_encoded_as_such(model, monkeypatch):
    batches: list[tuple[MotionBatch, bool]] = []
    prefix, _ = starting_point(model, None)
    monkeypatch.setitem(model.facts, "actions", ["run", "walk", "sit"])
    monkeypatch.setattr(
        model, "encode", lambda batch, unconditioned: batches.append((batch, unconditioned))
    )
    names = ["sit", "run"]
    for kind in ("action", "none", "text"):
        streams = Streams(
            model, ["a#0", "b#0"], names, prefix.expand(2, -1, -1), None, SamplerOptions(), kind=kind
        )  # fmt: skip
        streams._encode(names)
        streams._encode(list(names))  # not encoded again
        streams._encode(["sit", "walk"])
    numbers = [batch.action.tolist() for batch, _ in batches[:2] if batch.action is not None]
    assert numbers == [[2, 0], [2, 1]]
    assert [unconditioned for _, unconditioned in batches] == [False] * 2 + [True] * 2 + [False] * 2
    assert [batch.text for batch, _ in batches] == [None] * 4 + [["sit", "run"], ["sit", "walk"]]


def test_waypoints_are_reached_one_after_another_within_three_decimeters():
    route = waypoints.Route([(0.0, 1.0), (0.1, 1.0), (2.0, 1.0), (0.0, 1.0)])
    roots = np.array([[0, 9, 0.69], [0.1, 9, 0.8], [1.7, 9, 1.0], [1.71, 9, 1.0], [0, 9, 1.0]])
    route.follow(100, roots)
    assert route.reached == [101, 101, 103, 104]
    assert route.left == []
    route.go_back(103)
    assert (route.reached, route.left) == ([101, 101], [(2.0, 1.0), (0.0, 1.0)])
    route.go_back(102)
    assert len(route.left) == 2
    route.follow(103, roots[3:4])
    assert route.reached == [101, 101, 103]
