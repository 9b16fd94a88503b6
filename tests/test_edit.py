"""Edits keep what they promise to keep, whatever the motion comes from."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.motions import synthetic
from support.refusals import one_line_error
from support.runs import TINY, inputs_of, untrained

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.batch import Edit
from flame_mdm.commands import edit as edit_command
from flame_mdm.commands.edit import EditSettings, origin
from flame_mdm.data.store import write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SMPL22, SMPL24, find_joints, part_names
from flame_mdm.representations.smpl import SMPL
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.editing import (
    MFM_STEPS,
    Edited,
    _part_length,
    edit,
    kept_parts,
    method_options,
    resolve_edit,
)
from flame_mdm.sampling.motion_request import EditRequest, SamplingRequest
from flame_mdm.sampling.reading import decoded, part_of, read_motion, with_features
from flame_mdm.seeds import seeded_noise

CLIP = "synthetic:synthetic_0_000003"


def build(overrides: list[str], max_frames: int = 60) -> MotionGenerator:
    model = untrained(overrides, max_frames)
    model.representation.std.uniform_(0.5, 2)
    model.representation.mean.normal_()
    return model


@pytest.fixture(scope="module")
def diffusion() -> MotionGenerator:
    return build(TINY)


@pytest.fixture(scope="module")
def flow() -> MotionGenerator:
    shared = [override for override in TINY if "num_train_timesteps" not in override]
    return build([*shared, "process=flow_matching", "task.sampler=euler"])


@pytest.fixture(scope="module")
def store(tmp_path_factory) -> Path:
    """Folder of a small prepared synthetic set."""
    root = tmp_path_factory.mktemp("stores")
    write_store(root / f"synthetic-{HumanML().name}", Synthetic(clips=8), HumanML())
    return root


def walk(fps: float, turned: float = 0.0) -> np.ndarray:
    """Joints (F, 22, 3) of two seconds of a smooth motion, turned about the vertical by some radians."""
    joints = synthetic("walk", fps=200, size=20).joints[: 401 : round(200 / fps)]
    s, c = np.sin(turned), np.cos(turned)
    return joints @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]) + [turned, 0, 2 * turned]


@pytest.fixture(scope="module")
def motion(diffusion) -> Motion:
    features = diffusion.representation.encode(torch.from_numpy(walk(20)))
    return decoded(diffusion.representation, features, "a person walks", "walk")


@pytest.mark.parametrize("length", [8, 37])
def test_regions(diffusion, motion, length, subtests):
    part = replace(
        motion,
        joints=motion.joints[:1].repeat(length, 0),
        features=motion.features[:1].repeat(length, 0),
    )
    for region, kept in (
        ("in_between", lambda i: i < int(0.25 * length) or i >= int(0.75 * length)),
        ("prediction", lambda i: i < int(0.25 * length)),
        ("prefix", lambda i: i < int(0.25 * length)),
        ("suffix", lambda i: i >= int(0.75 * length)),
        ("interpolate", lambda i: i % 5 == 0),
        ([2, 5], lambda i: not 2 <= i < 5),
        ([[0, 1], [4, 8]], lambda i: not (i < 1 or 4 <= i < 8)),
    ):
        with subtests.test(region=region):
            keep = edit(diffusion, part, region=region, num_inference_steps=2)[0].keep
            assert keep.tolist() == [[kept(i)] * 263 for i in range(length)], region


def test_frames_and_joints_meet_and_the_upper_body_is_what_mdm_resamples(diffusion, motion):
    seconds = edit(diffusion, motion, region_seconds=[0.52, 1.23])[0]  # frames 10.4 and 24.6
    frames = edit(diffusion, motion, region=[10, 25])[0]
    assert np.array_equal(seconds.keep, frames.keep)
    assert np.array_equal(seconds.features, frames.features)
    both = edit(diffusion, motion, region="in_between", joints=["left_arm", "head"])[0].keep
    frames = edit(diffusion, motion, region="in_between")[0].keep
    joints = edit(diffusion, motion, joints=["left_arm", "head"])[0].keep
    assert np.array_equal(both, frames | joints)
    keep = edit(diffusion, motion, joints="upper_body")[0].keep
    assert (keep == keep[0]).all()
    lower = np.isin(np.arange(22), (0, 1, 2, 4, 5, 7, 8, 10, 11))
    positions, rotations = (np.repeat(lower[1:], size) for size in (3, 6))
    assert (
        keep[0].tolist() == [True] * 4 + [*positions, *rotations, *np.repeat(lower, 3)] + [True] * 4
    )


@pytest.mark.parametrize("skeleton", [SMPL22, SMPL24, KIT21], ids=lambda s: s.name)
def test_parts_of_the_body(skeleton):
    parts = part_names(skeleton)
    assert sorted(parts["upper_body"] + parts["lower_body"]) == list(range(len(skeleton)))
    assert {skeleton.mirrored[joint] for joint in parts["left_arm"]} == set(parts["right_arm"])
    assert {skeleton.mirrored[joint] for joint in parts["left_leg"]} == set(parts["right_leg"])
    assert set(skeleton.feet) <= set(parts["legs"]) == set(parts["lower_body"]) - {0}
    assert {skeleton.joints[j] for j in parts["right_arm"]} >= {
        "right_shoulder",
        "right_elbow",
        "right_wrist",
    }
    expected = sorted([*parts["right_leg"], skeleton.joints.index("left_elbow")])
    assert find_joints(skeleton, ["right_leg", "left_elbow"]) == expected


@pytest.mark.parametrize("representation", [SMPL(), Rot6D()], ids=lambda r: r.name)
def test_features_of_joints_move_these_joints(representation, subtests):
    """A joint's rotation turns what hangs on it, and nothing else; the root's features move all."""
    torch.manual_seed(0)
    features = torch.randn(2, representation.features)
    for joint in range(24):
        with subtests.test(joint=joint):
            below = {joint}
            for child, parent in enumerate(representation.skeleton.parents):
                below |= {child} if parent in below else set()
            mask = representation.joint_features([joint])
            moved = representation.decode(torch.where(mask, torch.randn_like(features), features))
            distance = (moved - representation.decode(features)).norm(dim=-1).amax(0)
            expected = set(range(24)) if joint == 0 else below - {joint}
            assert {i for i, way in enumerate(distance.tolist()) if way > 1e-3} == expected
    owners = torch.stack([representation.joint_features([joint]) for joint in range(24)])
    assert (owners.sum(0) == 1).all()


@pytest.mark.parametrize("method", ["mdm", "flame"])
@pytest.mark.parametrize("options", [{"region": "in_between"}, {"joints": "upper_body"}], ids=str)
def test_exact_methods_keep_exactly(diffusion, motion, method, options, subtests):
    results = edit(diffusion, motion, "a person jumps", method=method, samples=2, **options)
    for number, result in enumerate(results):
        with subtests.test(sample=number):
            assert result.feature_error == 0
            assert np.abs(result.features - motion.features)[result.keep].max() < 1e-5
            assert np.abs(result.features - motion.features)[~result.keep].mean() > 0.05
            if "joints" in options:
                lower = part_names(SMPL22)["lower_body"]
                assert result.joint_error < 1e-5
                assert np.abs(result.joints[:, lower] - motion.joints[:, lower]).max() < 1e-5
    assert not np.array_equal(results[0].features, results[1].features)


def test_other_methods_keep_roughly(diffusion, flow, motion):
    """The last of repeated steps is taken once; flows are rewritten in the first 6 of 25 steps, up to time 0.2."""
    options = {"method": "flame_code", "num_inference_steps": 4, "resample": 3}
    with inputs_of(diffusion.denoiser) as repeated, inputs_of(flow.denoiser) as rewritten:
        rough = edit(diffusion, motion, region="in_between", **options)[0]
        default = edit(flow, motion, region="in_between")[0]
    assert (len(repeated), len(rewritten)) == (3 * 3 + 1, 25)
    off = np.abs(rough.features - motion.features) / diffusion.representation.std.numpy()
    assert rough.feature_error == pytest.approx(off[rough.keep].max(), rel=1e-3)
    assert rough.feature_error > 1e-3
    assert default.feature_error > 1e-3
    six, five = (
        edit(flow, motion, region="in_between", until=time, num_inference_steps=25)[0]
        for time in (0.2, 0.19)
    )
    assert np.array_equal(default.features, six.features)
    assert not np.array_equal(default.features, five.features)
    assert edit(flow, motion, region="in_between", method="mdm")[0].feature_error == 0


@pytest.mark.parametrize(
    ("seconds", "frames"),
    [([None], 60), ([1.29, None], 34), ([1.24, None, None], None), ([3.0], 0)],
)
def test_parts_of_an_edit_share_what_the_durations_leave(seconds, frames):
    """Durations are rounded to the nearest frame: 25.8 becomes 26, and 24.8 becomes 25."""
    parts = [("walks", duration) for duration in seconds]
    if frames is None:
        with pytest.raises(UserError, match="the parts do not add up to the length of the motion"):
            _part_length(parts, 60, 20)
    else:
        assert _part_length(parts, 60, 20) == frames


def test_the_error_of_kept_joints_includes_cleanup(diffusion, motion):
    result = edit(diffusion, motion, region="prediction", cleanup=True)[0]
    kept = int(0.25 * len(motion.joints))
    moved = np.linalg.norm(result.joints - motion.joints, axis=-1)[:kept].max()
    assert moved > 1e-4
    assert result.joint_error == pytest.approx(moved)
    assert result.feature_error == 0


def test_a_part_of_a_motion_begins_and_ends_at_the_nearest_frame(diffusion, motion):
    """At 20 frames per second, 0.52 s is 10.4 frames, and 1.23 s is 24.6 frames."""
    part = part_of(diffusion.representation, motion, [0.52, 1.23])
    np.testing.assert_allclose(part.features[:, 4:67], motion.features[10:25, 4:67], atol=1e-4)
    assert len(part.features) == 15


def test_a_part_may_be_the_entire_motion_but_not_empty_or_longer(diffusion, motion):
    representation, seconds = diffusion.representation, len(motion.features) / 20
    assert len(part_of(representation, motion, [0, seconds]).features) == len(motion.features)
    for cut in ([0.5, 0.51], [0, seconds + 0.05], [-0.05, 1]):
        with one_line_error("is not a range within walk, which lasts 2 seconds"):
            part_of(representation, motion, cut)


def test_mfm_edits_take_their_own_number_of_steps_unless_one_is_chosen(flow):
    mfm = EditRequest(method="mfm")
    for chosen, steps in ((None, MFM_STEPS), (7, 7)):
        _, options = method_options(flow.process, mfm, SamplerOptions(num_inference_steps=chosen))
        assert options.num_inference_steps == steps
    _, options = method_options(flow.process, EditRequest(method="mdm"), SamplerOptions())
    assert options.num_inference_steps is None


def test_a_part_of_a_motion_keeps_its_text_and_its_notes(diffusion, motion):
    source = replace(motion, notes=("resampled",))
    part = part_of(diffusion.representation, source, [0, 1])
    assert (part.text, part.id, part.notes) == ("a person walks", "walk", ("resampled",))


def test_the_last_frame_of_a_read_motion_steps_on_at_the_same_height(diffusion):
    """Features have a row for each pair of frames, so that the last frame is continued over the floor."""
    representation = diffusion.representation
    joints = np.repeat(walk(20)[:1], 12, axis=0)
    joints = joints + np.arange(12)[:, None, None] * np.array([0.01, 0.02, 0.03])
    read = with_features(representation, Motion(joints, 20.0))
    assert len(read.features) == 12
    steps = np.diff(read.joints[:, 0], axis=0)
    np.testing.assert_allclose(np.hypot(steps[:, 0], steps[:, 2]), np.hypot(0.01, 0.03), atol=1e-5)
    velocities = read.features[:, representation.slices["velocities"]].reshape(12, 22, 3)
    np.testing.assert_allclose(velocities[:-1, :, 1], 0.02, atol=1e-5)
    np.testing.assert_allclose(velocities[-1, :, 1], 0, atol=1e-5)
    np.testing.assert_allclose(velocities[-1, :, 2], velocities[-2, :, 2], atol=1e-5)
    np.testing.assert_allclose(read.features[-1, 1:3], read.features[-2, 1:3], atol=1e-5)


def test_world_error_tells_of_a_suffix_that_has_moved(diffusion, motion):
    assert edit(diffusion, motion, region="prediction")[0].joint_error < 1e-5
    suffix = edit(diffusion, motion, region="suffix")[0]
    moved = np.linalg.norm(suffix.joints - motion.joints, axis=-1)[
        int(0.75 * len(motion.joints)) :
    ].max()
    assert suffix.joint_error == pytest.approx(moved)
    assert moved > 0.1


@pytest.mark.parametrize("strength", [0.37, 1.0])
@pytest.mark.parametrize("kind", ["diffusion", "flow"])
def test_a_variation_starts_from_the_noised_motion(kind, strength, motion, request):
    model = request.getfixturevalue(kind)
    with inputs_of(model.denoiser) as seen:
        varied = edit(model, motion, strength=strength, num_inference_steps=10, guidance_scale=1.0)[
            0
        ]
    assert len(seen) == round(10 * strength)
    assert not varied.keep.any()
    assert (varied.feature_error, varied.joint_error) == (0, 0)
    x_t, t = seen[0][:2]
    known = model.representation.normalize(torch.from_numpy(motion.features))[None]
    noise = seeded_noise(["#0"], *known.shape[1:], seed=0, replication=0, like=known)(0)
    time = t / 1000 if kind == "flow" else t
    torch.testing.assert_close(x_t, model.process.corrupt(known, noise, time), rtol=0, atol=1e-4)
    assert (
        edit(model, motion, strength=strength, joints="upper_body", method="mdm")[0].feature_error
        == 0
    )


def test_a_sentence_of_several_actions_stays_the_text_of_one_edited_part(diffusion, motion):
    text = "a person walks forward, then jumps"
    request = SamplingRequest.of("edit", {"texts": text, "region": "suffix"}, editing=True)
    resolved = resolve_edit(request, diffusion, motion).resolved
    (prompt,) = resolved.prompts
    assert (prompt.text, prompt.frames) == (text, (len(motion.joints),))
    assert not resolved.is_sequence


def test_an_edit_depends_on_its_own_seed_alone(diffusion, motion):
    one = flame_mdm.edit(
        diffusion, motion, "a person jumps", region="in_between", samples=1, seed=3
    )[0]
    many = edit(
        diffusion,
        motion,
        ["a person jumps", "a person bows"],
        region="in_between",
        samples=2,
        seed=3,
    )
    np.testing.assert_allclose(one.features, many[0].features, atol=1e-5)
    assert [m.text for m in many] == ["a person jumps"] * 2 + ["a person bows"] * 2
    assert isinstance(one, Edited)
    assert one.original is motion


def test_models_that_attend_to_the_padding_know_it_as_empty(motion):
    """As MDM's and MFM's code: edited at the padded length, where what lies beyond the motion is kept, as zeros."""
    model = build([*TINY, "denoiser.mask_padding=false"])
    with inputs_of(model.denoiser) as seen:
        result = edit(model, motion, region="in_between")[0]
    assert result.feature_error == 0
    assert result.features.shape == motion.features.shape
    assert {x_t.shape[1] for x_t, *_ in seen} == {60}
    beyond = seen[-1][0][:, len(motion.features) :]  # the kept zeros with the noise of step 1
    assert beyond.std() < 0.3 * seen[0][0].std()
    assert beyond.mean().abs() < 0.1


@pytest.mark.parametrize(("fps", "turned"), [(20, 2.0), (50, 0.0), (100, -1.3), (10, 3.0)])
def test_joints_of_any_rate_and_facing(diffusion, motion, tmp_path, fps, turned):
    np.savez(tmp_path / "motion.npz", joints=walk(fps, turned), fps=fps)
    read = read_motion(diffusion.representation, tmp_path / "motion.npz")
    count = len(motion.joints)  # one less than the joints: the last frame has no step to a next one
    assert len(read.features) == count + 1
    # At 10 fps the footsteps themselves are lost between the frames.
    assert np.abs(read.joints[:count] - motion.joints).max() < (0.15 if fps == 10 else 0.01)


def test_bad_edits_are_one_line(diffusion, flow, motion, subtests):
    short, suffix = build(TINY, max_frames=36), {"region": "suffix"}
    cases: list[tuple[MotionGenerator, dict, str]] = [
        (diffusion, {}, r"no part of the motion is kept: choose region.*strength=0\.5"),
        (diffusion, {"region": [0, 40]}, "no part of the motion is kept"),
        (
            diffusion,
            {"region": [5, 5]},
            r"region=\[5, 5\] is not a range within this motion, which has 40 frames \(2 sec",
        ),
        (diffusion, {"region": [[1, 2], 3]}, r"expected \[begin, end\], or sev"),
        (
            diffusion,
            {"region": [1, 2], "region_seconds": [1, 2]},
            "region and region_seconds cannot be combined",
        ),
        (
            diffusion,
            {"region": "inbetween"},
            "region=inbetween is unknown. Did you mean in_between",
        ),
        (
            diffusion,
            {"joints": "uper_body"},
            "no joint or part 'uper_body'. Did you mean upper_body",
        ),
        (
            diffusion,
            suffix | {"method": "mfm"},
            "method=mfm is not supported by GaussianDiffusion; .* mdm, flame",
        ),
        (
            diffusion,
            suffix | {"method": "repaint"},
            "method=repaint is unknown. Use one of mdm, flame, flame_code",
        ),
        (diffusion, suffix | {"until": 0.3}, "until=0.3 applies only to method=mfm, not to mdm"),
        (diffusion, suffix | {"seconds": 3}, "an edit is as long as the motion. Omit seconds"),
        (diffusion, suffix | {"texts": "walks | jumps"}, "an edit changes a single motion"),
        (
            diffusion,
            {"strength": 0.5, "texts": "walks | jumps | sits"},
            "the parts do not add up to the length of the motion",
        ),
        (
            diffusion,
            {"strength": 0.5, "texts": "walks @1.5 | jumps @1"},
            "do not add up .* of the motion, 2 seconds",
        ),
        (diffusion, {"regoin": "suffix"}, "edit has no option regoin. Did you mean region"),
        *(
            (diffusion, {"strength": value}, "strength=.*: expected a number above 0 and at most 1")
            for value in (0.0, np.nan)
        ),
        (
            flow,
            suffix | {"method": "flame"},
            "not supported by FlowMatching; this model supports: mdm, mfm",
        ),
        (
            short,
            suffix,
            r"walk: 40 frames, but .* at most 36 \(1.8 seconds\)\. Select a part with cut=",
        ),
    ]
    for model, options, message in cases:
        with subtests.test(message=message), one_line_error(message):
            edit(model, motion, **options)


def test_the_error_of_kept_features_is_the_largest_one_in_standard_deviations(flow, motion):
    stages: list[Motion] = []
    options: dict[str, Any] = {"joints": "left_arm", "method": "mfm", "num_inference_steps": 3}
    (edited,) = edit(flow, motion, "a person walks", stages=stages, fps=motion.fps, **options)
    off = np.abs(edited.features - motion.features) / flow.representation.std.numpy()
    assert edited.feature_error == pytest.approx(off[edited.keep].max(), rel=1e-3)
    assert edited.feature_error > 10 * off[edited.keep].min()
    assert len(stages) == 4  # three estimates and the motion
    assert np.array_equal(stages[-1].joints, edited.joints)
    with one_line_error("fps=30: this motion has 20 frames per second. Omit fps"):
        edit(flow, motion, "a person walks", fps=30, **options)


def test_only_variations_of_entire_motions_have_targets(diffusion, motion):
    """Targets replace the kept part of an edit, so that both together would lose it."""
    representation, frames = diffusion.representation, len(motion.features)
    features = representation.normalize(torch.from_numpy(motion.features))[None]
    keep = torch.zeros_like(features, dtype=torch.bool)
    options: dict[str, Any] = {
        "frames": frames,
        "targets": {"root": [{"time": 1.0, "position": [0.1, 0.2]}]},
        "num_inference_steps": 2,
    }
    whole = Edit(features, keep, strength=0.5)
    (varied,) = flame_mdm.generate(diffusion, "a person walks", edit=whole, **options)
    assert len(varied.joints) == frames
    part = replace(whole, keep=keep.index_fill(1, torch.tensor([0]), True))
    with one_line_error("an edit changes a single motion: omit .* targets"):
        flame_mdm.generate(diffusion, "a person walks", edit=part, **options)


def test_a_motion_as_long_as_the_longest_training_motion_is_edited(motion):
    model = build(TINY, max_frames=len(motion.features))
    (edited,) = edit(model, motion, region="suffix", num_inference_steps=2)
    assert len(edited.joints) == len(motion.features)


def test_motions_that_cannot_be_read_are_one_line(diffusion, store, tmp_path, subtests):
    joints, file = np.zeros((9, 22, 3)), tmp_path / "motion.npz"
    clean = {"joints": joints, "fps": 20, "representation": "humanml-clean-smpl22"}
    cases: list[tuple[Any, dict[str, Any], str]] = [
        (
            {"joints": joints[:, :21], "fps": 20},
            {},
            r"motion\.npz.* for humanml-clean-smpl22, but found \(9, 21, 3\)",
        ),
        (
            {"joints": joints[..., 0], "fps": 20},
            {},
            r"motion\.npz.* joints have shape \(9, 22\), not",
        ),
        ({"fps": 20}, {}, r"motion\.npz.* contains neither joints nor poses"),
        (
            clean | {"features": joints[..., 0]},
            {},
            r"motion\.npz.* features have shape \(9, 22\), not",
        ),
        (tmp_path / "absent.npz", {}, r"absent\.npz: no such file"),
        ("kit:1", {}, "no prepared data set"),
        ("walk", {}, r"Use a file of type \.npz, \.bvh, .*, or dataset:id"),
        (CLIP[:-2] + "3", {}, r"has no clip .*\. Did you mean synthetic_0_000003"),
        (CLIP, {"cut": [1, 99]}, f"is not a range within {CLIP}, which lasts"),
    ]
    for source, options, message in cases:
        with subtests.test(message=message):
            path = file if isinstance(source, dict) else source
            if isinstance(source, dict):
                np.savez(file, **source)
            with one_line_error(message):
                read_motion(diffusion.representation, path, data_root=store, **options)
    np.savez(file, joints=joints[:, :21], fps=20)
    with one_line_error(
        r"motion.npz: the model needs rotations of SMPL's joints, but these cannot be derived "
        "from kit21"
    ):
        read_motion(SMPL(), file)


@pytest.mark.slow
def test_the_command_writes_the_original_beside_the_edits(trained, store, tmp_path, capsys):
    out = tmp_path / "out"
    words = [f"ckpt={trained}", f"motion={CLIP}", f"data_root={store}", f"out={out}", "samples=2"]
    words += ["text=it's a (jump), $5", "region=in_between", "joints=[left_arm,head]", "seed=4"]
    assert main(["edit", *words, "strength=0.8", "trajectory=true"]) == 0
    assert (out / "trajectory.png").is_file()
    printed = capsys.readouterr().out
    assert "Largest change in the kept part: 0 in normalized features" in printed
    assert (out / "motions.gif").stat().st_size > 1000
    assert (out / "player.html").read_text().count('"frames":') == 3
    with np.load(out / "motion_000.npz") as original, np.load(out / "motion_002.npz") as edited:
        keep = edited["keep"]
        assert str(edited["text"]) == "it's a (jump), $5"
        assert int(edited["seed"]) == 4
        np.testing.assert_allclose(edited["features"][keep], original["features"][keep], atol=1e-5)
        assert not np.allclose(edited["features"][~keep], original["features"][~keep], atol=1e-2)
    # what was written can be edited again
    again = flame_mdm.edit(flame_mdm.load(trained), out / "motion_001.npz", region="in_between")[0]
    assert again.feature_error == 0


READINGS: list[dict[str, Any]] = [
    {"motion": "b.bvh"}, {"cut": [0, 1]}, {"fps": 30.0}, {"unit": 0.01}, {"up": "z"}, {"animation": "walk"},
    {"adapter": ["a.safetensors"]}, {"adapter_strength": 0.5},
]  # fmt: skip


def test_edits_of_a_file_that_is_read_differently_have_different_folders():
    def keys(**changes: Any) -> str:
        settings: dict[str, Any] = {"ckpt": "x", "motion": "a.bvh", **changes}
        return repr(origin(EditSettings(**settings)))

    assert len({keys(), *(keys(**changes) for changes in READINGS)}) == 1 + len(READINGS)
    assert keys(seed=1) == keys(samples=5) == keys()


def test_seconds_are_frames_at_the_rate_of_the_motion():
    representation = HumanML(fps=30.0)
    editing = EditRequest(region_seconds=[[0.5, 1.0], [1.5, 2.0]], joints="left_arm")
    keep, joints = kept_parts(representation, 60, editing)
    new = [frame for frame in range(60) if 15 <= frame < 30 or frame >= 45]
    assert torch.nonzero(~keep.all(1))[:, 0].tolist() == new
    assert torch.nonzero(~joints.all(1))[:, 0].tolist() == new
    arm = find_joints(representation.skeleton, "left_arm")
    assert torch.nonzero(~joints[20])[:, 0].tolist() == sorted(arm)
    refused: list[tuple[dict[str, Any], str]] = [
        ({"region_seconds": [1.5, 2.02]}, "region_seconds=[1.5, 2.02]"),
        ({"region": [30, 61]}, "region=[30, 61]"),
        ({"region": [-1, 4]}, "region=[-1, 4]"),
        ({"region": [4, 4]}, "region=[4, 4]"),
    ]
    for options, shown in refused:
        says = f"{shown} is not a range within this motion, which has 60 frames (2 seconds)"
        with one_line_error(re.escape(says)):
            kept_parts(representation, 60, EditRequest(**options))
    assert _part_length([("walks", 0.5), ("sits", None)], 60, 30.0) == 45
    with one_line_error("the parts do not add up to the length of the motion, 2 seconds"):
        _part_length([("walks", 0.5), ("sits", 1.0)], 60, 30.0)


def test_a_cut_is_in_seconds_at_the_rate_of_the_model():
    representation = HumanML(fps=30.0)
    motion = with_features(representation, Motion(walk(30), 30.0, id="walk"))
    part = part_of(representation, motion, [0.5, 1.52])  # frames 15 and 45.6
    assert (len(part.features), part.fps) == (31, 30.0)
    np.testing.assert_allclose(part.features[:, 3:], motion.features[15:46, 3:], atol=1e-4)
    assert abs(part.joints[0, 0, [0, 2]]).max() < 1e-5
    with one_line_error(f"which lasts {len(motion.features) / 30:g} seconds"):
        part_of(representation, motion, [1.0, 9.0])
    for wrong in ([1.0], [0.0, float("nan")], "01"):
        with one_line_error(re.escape("expected [begin, end], in seconds")):
            part_of(representation, motion, wrong)  # type: ignore[arg-type]


def test_features_are_kept_at_the_rate_of_the_model_and_computed_again_at_another():
    at_30, at_20 = HumanML(fps=30.0), HumanML()
    motion = with_features(at_30, Motion(walk(30), 30.0, text="walks", id="a"))
    assert with_features(at_30, motion) is motion
    other = with_features(at_20, motion)
    assert (other.fps, other.text, other.id) == (20.0, "walks", "a")
    assert len(other.features) == pytest.approx(len(motion.features) * 2 / 3, abs=1)
    damaged = replace(motion, features=motion.features[:, :100])
    says = f"a: features have shape ({len(motion.features)}, 100), not (frames, 263)"
    with one_line_error(re.escape(says)):
        with_features(at_30, damaged)
    infinite = motion.features.copy()
    infinite[3, 7] = np.inf
    with one_line_error("a: features contain NaN or infinite values"):
        with_features(at_30, replace(motion, features=infinite))


@pytest.mark.parametrize(("errors", "lines"), [
    ([(0.0, 0.0), (2e-7, 0.004)],
     ["75% of the features are kept. Largest change in the kept part: 2e-07 in normalized features, "
      "0.004 m in world joint positions"]),
    ([(0.5, 0.0101), (0.25, 0.0)],
     ["75% of the features are kept. Largest change in the kept part: 0.5 in normalized features, "
      "0.0101 m in world joint positions",
      "a kept part that follows a generated part begins where the generated part ends, so its position in the world "
      "may differ from the original"]),
])  # fmt: skip
def test_the_command_states_the_largest_changes_of_all_edits(errors, lines, monkeypatch, capsys):
    keep, original = np.ones((8, 4), bool), Motion(np.zeros((8, 22, 3)), 20.0, id="take", text="")
    keep[:, 0] = False
    edits = [
        SimpleNamespace(text="jumps", keep=keep, feature_error=change, joint_error=moved)
        for change, moved in errors
    ]
    written: list[tuple[Any, ...]] = []
    readings: list[dict[str, Any]] = []
    output = "flame_mdm.sampling.output."
    loaded = SimpleNamespace(model=SimpleNamespace(sha256="c", representation=None), body=None)
    resolved = SimpleNamespace(resolved=SimpleNamespace(warnings=["careful"]))
    monkeypatch.setattr(EditSettings, "load", lambda _: loaded)
    monkeypatch.setattr(
        "flame_mdm.sampling.reading.read_motion",
        lambda *values, **keywords: readings.append(keywords) or original,
    )
    monkeypatch.setattr("flame_mdm.sampling.editing.resolve_edit", lambda *_: resolved)
    monkeypatch.setattr("flame_mdm.sampling.editing.sample_edit", lambda *_, stages: edits)
    monkeypatch.setattr(output + "degenerate_notes", lambda _: [])
    monkeypatch.setattr(output + "write_motions", lambda *values, **_: written.append(values))
    monkeypatch.setattr(output + "summary", lambda *_, mp4: "the summary")
    settings = EditSettings(
        ckpt="x", motion="take.bvh", text="jumps", joints="arms", seed=3, out="folder", fps=10.0, unit=0.5,
        up="z", animation="Walk", cut=[1, 2], data_root="/d",
    )  # fmt: skip
    edit_command.main(settings)
    assert capsys.readouterr().out.splitlines() == ["warning: careful", "the summary", *lines]
    ((folder, motions, facts, stages, mp4, body),) = written
    assert (folder, stages, mp4, body) == (Path("folder"), None, False, None)
    assert [motion.text for motion in motions] == ["original: take", "jumps", "jumps"]
    assert (facts["seed"], facts["checkpoint"]) == (3, "c")
    assert readings == [
        {"fps": 10, "unit": 0.5, "up": "z", "animation": "Walk", "cut": [1, 2], "data_root": "/d"}
    ]
