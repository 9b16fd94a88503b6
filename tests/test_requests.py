"""Requests: keywords of Python, what a request means for a model, and the best of several candidates."""

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast, get_type_hints
from unittest.mock import patch

import numpy as np
import pytest
import torch
from support.motions import synthetic
from support.refusals import error_of, one_line_error

import flame_mdm
from flame_mdm.__main__ import main
from flame_mdm.batch import Edit
from flame_mdm.commands.edit import EditSettings
from flame_mdm.commands.sample import SampleSettings, _folders
from flame_mdm.conditions import prompts
from flame_mdm.conditions.prompts import ReadPrompt
from flame_mdm.errors import UserError
from flame_mdm.formats.faults import find_faults
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.readers import read
from flame_mdm.processes.guidance import Positions
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling import generation, motion_request, output, resolution
from flame_mdm.sampling.generation import _edit, _rows, _stages, best
from flame_mdm.sampling.keywords import EditKeywords, SamplerKeywords, SamplingKeywords
from flame_mdm.sampling.motion_request import EditRequest, SamplingRequest, path_targets
from flame_mdm.sampling.output import degenerate_notes, refuse_no_condition, summary
from flame_mdm.sampling.resolution import (
    ResolvedPrompt,
    ResolvedRequest,
    _usual_frames,
    resolve,
)
from flame_mdm.sampling.targets import Targets, read_targets

TEXT = "a person walks forward"
FAST: dict[str, Any] = {"seconds": 1.5, "num_inference_steps": 4}


@pytest.fixture(scope="module")
def model() -> flame_mdm.MotionGenerator:
    return flame_mdm.load("quickstart")


def hints(kind: type, without: Sequence[str] = ()) -> dict[str, Any]:
    annotations = get_type_hints(kind, {**vars(motion_request), "Motion": Motion})
    return {
        entry.name: annotations[entry.name] for entry in fields(kind) if entry.name not in without
    }


def test_cleanup_uses_the_contacts_that_the_model_predicts(model, monkeypatch):
    contacts: list[np.ndarray | None] = []

    def cleaned(motion: Motion, predicted: np.ndarray | None = None) -> Motion:
        contacts.append(predicted)
        return motion

    monkeypatch.setattr(generation, "cleaned", cleaned)
    (motion,) = flame_mdm.generate(model, TEXT, cleanup=True, **FAST)
    assert contacts[0] is not None
    np.testing.assert_array_equal(contacts[0], model.representation.contacts(motion.features))
    assert contacts[0].shape == (len(motion.joints), 4)


def test_keywords_of_generate_and_edit_have_the_names_and_types_of_the_fields_of_requests():
    options, editing = hints(SamplerOptions), hints(EditRequest)
    sampling = hints(SamplingRequest, without=["texts", "options", "editing"])
    assert get_type_hints(SamplerKeywords) == options
    assert get_type_hints(SamplingKeywords) == sampling | options
    assert get_type_hints(EditKeywords) == editing | sampling | options


@pytest.mark.parametrize("function", [flame_mdm.generate, flame_mdm.edit], ids=["generate", "edit"])
def test_the_docstring_names_every_keyword(function):
    names = get_type_hints(EditKeywords if function is flame_mdm.edit else SamplingKeywords)
    described = f"{flame_mdm.generate.__doc__} {function.__doc__}"
    assert [name for name in names if f"`{name}`" not in described] == []


def test_keywords_go_to_the_request_that_has_them():
    keywords = {"texts": TEXT, "eta": 0.5, "samples": 2, "joints": "left_arm", "seed": 3}
    request = SamplingRequest.of("edit", keywords, editing=True)
    assert (request.prompts, request.samples, request.seed) == ((TEXT,), 2, 3)
    assert request.options == SamplerOptions(eta=0.5)
    assert request.editing == EditRequest(joints="left_arm")
    with one_line_error("generate has no option joints"):
        SamplingRequest.of("generate", keywords)


def test_settings_of_a_command_pass_on_the_chosen_options_of_the_sampler_alone():
    settings = SampleSettings(ckpt="quickstart", text=TEXT, eta=0.5, num_inference_steps=[0, 5, 9])
    assert settings.chosen() == {"num_inference_steps": [0, 5, 9], "eta": 0.5}
    expected = SamplerOptions(num_inference_steps=(0, 5, 9), eta=0.5)
    assert settings.request(samples=1).options == expected


def test_a_request_is_resolved_once_and_reads_its_targets_once(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.json").write_text('{"root": [{"time": 1, "position": [0.2, 0.6]}]}')
    words = [f"text={TEXT}", "seconds=1.5", "num_inference_steps=2", "samples=1", "targets=t.json"]
    with (
        patch.object(resolution, "read_targets", wraps=read_targets) as read,
        patch.object(
            prompts.Reader, "read", autospec=True, side_effect=prompts.Reader.read
        ) as understood,
    ):
        assert main(["sample", "quickstart", *words]) == 0
    assert (read.call_count, understood.call_count) == (1, 1)


def test_prompts_have_parts_frames_and_unknown_words(model):
    texts = ["a man walks forward, then jumps moonily", "a person bows @2"]
    resolved = resolve(SamplingRequest(texts=texts, seconds=1.5), model)
    sentence, bow = resolved.prompts
    assert sentence.text == "a man walks forward | jumps moonily"
    assert sentence.texts == ("a man walks forward", "jumps moonily")
    assert sentence.conditions == ("a person walks forward", "a person jumps")
    assert (sentence.frames, bow.frames) == ((30, 30), (40,))
    assert (sentence.is_split, bow.is_split, resolved.is_sequence) == (True, False, True)
    assert (sentence.unknown, bow.unknown) == (("moonily",), ())
    (warning,) = resolved.warnings
    assert warning == "'a man walks forward | jumps moonily': not understood: moonily"


@pytest.mark.parametrize(
    ("text", "options", "frames"),
    [
        ("a person kicks once with the left leg", {}, (30,)),
        ("a person jumps twice", {}, (44,)),
        ("a person claps three times", {}, (58,)),
        ("a person jumps", {}, (60,)),
        ("a person jumps twice", {"seconds": 1.5}, (30,)),
        ("jumps twice, then walks", {}, (44, 50)),
        ("jumps twice @1 | kicks once | walks", {}, (20, 30, 50)),
        ("a person waves while walking", {}, (60,)),
    ],
)
def test_a_motion_with_a_count_is_as_long_as_its_repetitions(text, options, frames):
    resolved = resolve(SamplingRequest(texts=text, **options), flame_mdm.load("package"))
    assert resolved.prompts[0].frames == frames


def test_notes_on_the_motion_to_continue_are_warnings(model, tmp_path):
    """Joints that lie, for y is said to be up."""
    joints = synthetic("walk").joints[:, :, [0, 2, 1]] * np.array([1, -1, 1], np.float32)
    np.savez(tmp_path / "lies.npz", joints=joints, fps=20)
    path = str(tmp_path / "lies.npz")
    (warning,) = resolve(SamplingRequest(texts=TEXT, after=path), model).warnings
    assert warning.startswith(f"after={path}: the body is lying down. If it should stand, set up=")


def test_a_path_is_as_long_as_the_motion_whose_sentence_becomes_a_sequence(model):
    """The last waypoint is reached 0.2 seconds before the end of all parts."""
    sentence = "a man walks forward, then turns left"
    request = SamplingRequest(texts=sentence, seconds=2, path=[(0, 1), (0.5, 2)])
    targets = resolve(request, model).targets
    assert targets is not None
    assert int(targets.positions.frames.max()) == 20 * 4 - 4
    with one_line_error("motions of different lengths cannot share a path"):
        resolve(SamplingRequest(texts=[TEXT, TEXT], seconds=[1, 2], path="0,1"), model)


@pytest.mark.parametrize(
    ("time", "frame"), [(0.99, 20), (1.02, 20), (1.03, 21), (0.29, 6), (1.149, 23)]
)
def test_a_target_is_at_the_frame_nearest_to_its_time(model, tmp_path, time, frame):
    """At 20 frames per second, 0.99 s is nearest to frame 20, not to frame 19."""
    flame_mdm.generate(model, TEXT, seconds=1, num_inference_steps=2)[0].save(tmp_path / "walk.npz")
    pose = {"time": time, "file": str(tmp_path / "walk.npz")}
    content = {
        "root": [{"time": time, "position": [0.1, 0.2]}],
        "joints": [{"time": time, "joint": "head", "position": [None, 1.5, None]}],
        "poses": [pose, pose | {"position": [0.1, 0.2]}],
    }
    targets = read_targets(model.representation, content)
    assert set(targets.positions.frames.tolist()) == {frame}
    assert [number for number, _ in targets.poses] == [frame]


def test_the_best_of_several_candidates_is_kept(model):
    groups = list[int]()

    def score(motions: Sequence[Motion]) -> list[float]:
        """How far the root goes."""
        groups.append(len(motions))
        return [float(np.linalg.norm(motion.joints[-1, 0])) for motion in motions]

    several = flame_mdm.generate(model, TEXT, samples=6, **FAST)
    chosen = flame_mdm.generate(model, TEXT, samples=2, candidates=3, score=score, **FAST)
    assert len(chosen) == len(groups) == 2
    for motion, group in zip(chosen, (several[:3], several[3:]), strict=True):
        faultless = [motion for motion in group if not find_faults(motion)] or group
        np.testing.assert_allclose(
            motion.joints, faultless[int(np.argmax(score(faultless)))].joints, atol=1e-4
        )


@pytest.mark.parametrize(
    ("path", "times"),
    [
        # 3.8 seconds at a constant speed, over 1 m and then 5 m
        ([(0.0, 1.0), (3.0, 5.0)], [0.633, 3.8]),
        ([(0.0, 2.0)], [3.8]),
        ([(0.0, 0.0)], [0.0]),
        ([(1.0, 0.0), (1.0, 0.0), (2.0, 0.0)], [1.9, 1.9, 3.8]),
    ],
)
def test_a_path_begins_at_the_origin_and_ends_a_fifth_of_a_second_before_the_motion(path, times):
    targets = path_targets(path, 4.0)
    assert targets.keys() == {"root"}
    assert [entry["time"] for entry in targets["root"]] == times
    assert [tuple(entry["position"]) for entry in targets["root"]] == path


def test_a_variation_with_targets_starts_from_the_motion_with_its_poses(model):
    known = torch.randn(1, 20, 263)
    kept = torch.zeros(1, 20, 263, dtype=torch.bool)
    nothing = torch.zeros(0, dtype=torch.long)
    pose = torch.randn(263)
    targets = Targets(Positions(nothing, nothing, nothing, torch.zeros(0)), ((3, pose),))
    resolved: Any = SimpleNamespace(edit=Edit(known, kept, strength=0.4), targets=targets)
    edit = _edit(model, resolved, torch.zeros(2, 20, 263))
    assert edit is not None
    assert (edit.strength, edit.known.shape, edit.keep.shape) == (0.4, (2, 20, 263), (2, 20, 263))
    body = ~model.representation.joint_features([0])
    assert edit.keep[1].nonzero()[:, 0].unique().tolist() == [3]
    assert torch.equal(edit.keep[0, 3], body)
    expected = known[0].clone()
    expected[3] = torch.where(body, model.representation.normalize(pose), expected[3])
    torch.testing.assert_close(edit.known[1], expected)


def test_stages_are_those_of_the_first_motion_and_batches_change_nothing(model, monkeypatch):
    options: dict[str, Any] = {"samples": 3, "frames": 20, "num_inference_steps": 2}
    stages: list[Motion] = []
    whole = flame_mdm.generate(model, TEXT, **options)
    monkeypatch.setattr(generation, "BATCH", 2)
    motions = flame_mdm.generate(model, TEXT, stages=stages, **options)
    assert [stage.text for stage in stages] == [
        "estimate after 0% of the sampling",
        "estimate after 50% of the sampling",
        f"result: {TEXT}",
    ]
    for one, other in zip(motions, whole, strict=True):
        np.testing.assert_allclose(one.joints, other.joints, atol=1e-4)
    assert np.array_equal(stages[-1].joints, motions[0].joints)


def test_stages_are_ten_estimates_at_equal_intervals(model):
    motion = flame_mdm.generate(model, TEXT, frames=5, num_inference_steps=2)[0]
    trajectory = [torch.full((1, 8, 263), float(call)) for call in range(25)]
    joints = [
        model.representation.to_joints(trajectory[call][0, :5]).numpy()
        for call in (0, 2, 5, 7, 10, 12, 15, 17, 20, 22)
    ]
    stages = _stages(model, trajectory, motion)
    assert len(stages) == 11
    for stage, expected in zip(stages, joints, strict=False):
        np.testing.assert_array_equal(stage.joints, expected)
    assert stages[2].text == "estimate after 20% of the sampling"


def test_frames_without_rotations_are_counted_over_all_motions():
    motions = [
        Motion(np.zeros((frames, 22, 3)), 20.0, degenerate=count)
        for frames, count in ((10, 2), (5, 0), (7, 1))
    ]
    (note,) = degenerate_notes(motions)
    assert note.startswith("warning: 3 of 22 frames have degenerate rotations")
    assert degenerate_notes(motions[1:2]) == []


LIMITS: list[tuple[type, str, list[Any], list[Any]]] = [
    (SamplerOptions, "eta", [0, 1], [-0.01, 1.01, math.nan]),
    (SamplerOptions, "guidance_scale", [0, -1, 100], [math.inf, "2"]),
    (
        SamplerOptions,
        "num_inference_steps",
        [1, 100_000, [0, 100_000]],
        [0, 100_001, [-1, 2], True],
    ),
    (SamplerOptions, "spacing", ["linspace", "stride"], ["even"]),
    (EditRequest, "strength", [0.01, 1], [0, 1.01]),
    (EditRequest, "resample", [1, 10], [0, 1.5]),
    (SamplingRequest, "samples", [1, 10_000], [0, 10_001, 1.5]),
    (SamplingRequest, "candidates", [1, 10_000], [0, 10_001]),
    (SamplingRequest, "texts", ["a" * 2000, "a @0.01"], ["a" * 2001, " ", "a @0", "a |"]),
]


@pytest.mark.parametrize(("kind", "name", "valid", "invalid"), LIMITS)
def test_limits_of_options_belong_to_what_is_valid(kind, name, valid, invalid, subtests):
    for value in valid:
        with subtests.test(value=str(value)[:20]):
            kind(**{name: value})
    for value in invalid:
        with subtests.test(value=str(value)[:20]), pytest.raises(UserError):
            kind(**{name: value})


def test_without_a_score_the_fewest_faulty_frames_decide():
    worse, better = synthetic(), synthetic()
    worse.joints[[5, 9], 3, 0] += 5
    better.joints[5, 3, 0] += 5
    assert best([worse, better]) is better
    assert best([worse, better], lambda motions: [2.0, 1.0]) is worse


def test_a_faultless_candidate_is_kept_even_if_a_faulty_one_has_a_higher_score():
    faulty, faultless = synthetic(), synthetic()
    faulty.joints[5, 3, 0] += 5
    assert not find_faults(faultless)
    assert (
        best([faulty, faultless], lambda motions: [float(motion is faulty) for motion in motions])
        is faultless
    )


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"candidates": 0}, "candidates=0: expected a whole number from 1 to"),
        ({"candidates": 2, "stages": []}, "single motion"),
        (
            {"samples": 5_000, "candidates": 3},
            "samples times candidates=15000 for each text: a request may contain at most 10,000 motions",
        ),
    ],
    ids=str,
)
def test_bad_numbers_of_candidates_are_one_line(model, options, message):
    with one_line_error(message):
        flame_mdm.generate(model, TEXT, **options)


@pytest.mark.slow
def test_the_command_chooses_by_a_motion_clip(tmp_path, monkeypatch, capsys, subtests):
    monkeypatch.chdir(tmp_path)
    words = [f"text={TEXT}", "seconds=1.5", "num_inference_steps=4", "samples=1"]
    assert main(["sample", "quickstart", *words, "samples=4", "out=all"]) == 0
    assert (
        main(
            [
                "sample",
                "quickstart",
                *words,
                "candidates=4",
                "scorer=motion_clip_synthetic",
                "out=best",
            ]
        )
        == 0
    )
    (chosen,) = Path("best").glob("*.npz")
    joints = np.load(chosen)["joints"]
    candidates = [np.load(file)["joints"] for file in sorted(Path("all").glob("*.npz"))]
    assert sum(np.allclose(joints, candidate, atol=1e-4) for candidate in candidates) == 1
    for options, message in (
        (
            ["scorer=quickstart"],
            "scorer=quickstart chooses among several motions for a text. Add text=... and candidates=8",
        ),
        (["scorer=none.ckpt", "candidates=2"], "scorer: none.ckpt: no such checkpoint. Use a run"),
        (["scorer=quickstart", "candidates=2"], "contains a motion generator, not a motion-CLIP"),
    ):
        with subtests.test(options=options, message=message):
            assert message in error_of(capsys, "sample", "quickstart", *words, *options)


def test_edit_takes_a_part_of_any_motion(model, tmp_path, subtests):
    """A motion, its joints and its file are cut in the same way; without cut, the error says so."""
    motion = flame_mdm.generate(model, f"{TEXT} @4", num_inference_steps=2)[0]
    motion.save(tmp_path / "walk.npz")
    options: dict[str, Any] = {"region": "prefix", "num_inference_steps": 2}
    sources: list[tuple[Any, dict[str, Any]]] = [
        (motion, {}),
        (motion.joints, {"fps": 20}),
        (tmp_path / "walk.npz", {}),
    ]
    for source, file_options in sources:
        with subtests.test(source=type(source).__name__):
            with pytest.raises(
                UserError, match=r"at most 60 \(3 seconds\)\. Select a part with cut=\[begin, end\]"
            ):
                flame_mdm.edit(model, source, TEXT, **options, **file_options)
            edited = flame_mdm.edit(model, source, TEXT, cut=[1, 2.5], **options, **file_options)[0]
            assert len(edited.joints) == 30
            np.testing.assert_allclose(edited.original.joints[0, 0, [0, 2]], 0, atol=1e-5)
            pose = motion.joints[20] - motion.joints[20, 0]
            np.testing.assert_allclose(
                edited.original.joints[0, :, 1], pose[:, 1] + motion.joints[20, 0, 1], atol=0.02
            )
    with one_line_error(r"cut=\[3, 9\] is not a range within .*, which lasts 4 seconds"):
        flame_mdm.edit(model, motion, TEXT, cut=[3, 9], **options)


def test_a_sample_is_written_as_a_motion_file(tmp_path, monkeypatch, capsys):
    """One motion by default; further ones have numbers in their names."""
    monkeypatch.chdir(tmp_path)
    words = [f"text={TEXT}", "seconds=1.5", "num_inference_steps=2"]
    assert (
        main(
            [
                "sample",
                "quickstart",
                "walk.fbx",
                *words,
                "rig=unreal",
                "root_motion=true",
                "resample=30",
            ]
        )
        == 0
    )
    assert [path.name for path in tmp_path.iterdir()] == ["walk.fbx"]
    assert "walk.fbx: 44 frames at 30 per second, centimeters" in capsys.readouterr().out
    motion = read("walk.fbx")
    expected = flame_mdm.generate(
        flame_mdm.load("quickstart"), TEXT, seconds=1.5, num_inference_steps=2
    )[0]
    lift = motion.joints[0, 0, 1] - expected.joints[0, 0, 1]
    assert 0.02 < lift < 0.03
    assert np.abs(motion.joints[::3] - [0, lift, 0] - expected.joints[::2]).max() < 0.02

    assert main(["sample", "quickstart", "out/walk.vrma", *words, "samples=2"]) == 0
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == [
        "walk.vrma",
        "walk_2.vrma",
    ]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["rig=unreal"],
            "rig=unreal applies only to a single file, not to a folder. Set an output file, such as out=walk.fbx",
        ),
        (
            ["walk.glb", "mp4=true"],
            "mp4=true: walk.glb is a single motion file. Use a folder, or omit out",
        ),
        (
            ["walk.fbx", "root_motion=true"],
            "root_motion applies only to .glb, .fbx and USD files with rig=unreal",
        ),
    ],
)
def test_keys_that_do_not_fit_the_output_are_refused(words, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    options = [word for word in words if "=" in word]
    out = [f"out={word}" for word in words if "=" not in word]
    request = [f"text={TEXT}", "seconds=1", "num_inference_steps=2"]
    assert message in error_of(capsys, "sample", "quickstart", *request, *options, *out)
    assert list(tmp_path.iterdir()) == []


def test_a_frame_with_two_faults_counts_once_when_candidates_are_compared(monkeypatch):
    faults = {"overlapping": [(0, 10), (2, 12)], "long": [(0, 14)], "apart": [(0, 8), (20, 28)]}
    monkeypatch.setattr(
        "flame_mdm.sampling.generation.find_faults",
        lambda name: [SimpleNamespace(start=start, end=end) for start, end in faults[name]],
    )
    assert best(cast(Any, ["long", "apart", "overlapping"])) == "overlapping"


@pytest.mark.parametrize(
    ("name", "valid", "invalid"),
    [
        ("eta", (0, 0.5, 1), (-0.01, 1.01, float("nan"))),
        ("guidance_scale", (-1, 0, 7.5), (float("inf"), "2")),
        ("num_inference_steps", (1, 100_000, [0], [0, 99_999], [100_000]), (0, True, 2.0, 100_001)),
        ("num_inference_steps", ((0, 5), []), ([-1, 3], [100_001], [0.5], "10")),
        ("spacing", ("linspace", "stride"), ("even",)),
        ("sampler", ("ddim", None), (3,)),
    ],
)
def test_options_of_samplers_are_accepted_up_to_their_limits(name, valid, invalid):
    for value in valid:
        chosen = SamplerOptions(**{name: value}).chosen()
        assert chosen.get(name) == (list(value) if isinstance(value, tuple) else value)
    for value in invalid:
        with pytest.raises(UserError, match=f"^{name}="):
            SamplerOptions(**{name: value})


def test_an_option_that_is_zero_replaces_the_value_of_the_recipe():
    recipe = SamplerOptions(guidance_scale=2.5, sampler="ddim", eta=0.7)
    chosen = SamplerOptions(guidance_scale=0, eta=0).over(recipe).chosen()
    assert chosen == {"guidance_scale": 0, "sampler": "ddim", "eta": 0}


def test_samples_of_a_text_that_is_listed_twice_are_numbered_on():
    request = SamplingRequest(texts=["walks", "sits", "walks"], samples=2, candidates=2)
    prompts = tuple(ResolvedPrompt(text, False, (text,), (20,)) for text in request.prompts)
    names = [row.id for row in _rows(ResolvedRequest(request, prompts, False))]
    walking, sitting = ([f"{text}#{n}" for n in range(8)] for text in ("walks", "sits"))
    assert names == [*walking[:4], *sitting[:4], *walking[4:]]


@pytest.mark.parametrize(
    ("texts", "samples", "candidates", "is_valid"),
    [
        (100, 100, 1, True),
        (100, 101, 1, False),
        (101, 100, 1, False),
        (50, 20, 10, True),
        (50, 20, 11, False),
    ],
)
def test_a_request_has_at_most_ten_thousand_motions(texts, samples, candidates, is_valid):
    def request() -> SamplingRequest:
        return SamplingRequest(texts=["walks"] * texts, samples=samples, candidates=candidates)

    if is_valid:
        assert len(request().prompts) == texts
    else:
        with pytest.raises(UserError, match=r"may contain at most 10,000 motions"):
            request()


@pytest.mark.parametrize(
    ("fitting", "requested", "longest", "frames"),
    [
        ((3.6, None, 1.5), None, 196, [60, None, 30]),
        ((3.6, None, 1.5), None, 50, [50, None, 30]),
        ((3.6, None, 1.5), 25.0, 196, [25, 25, 25]),
        ((), None, 196, [None, None, None]),
        ((), 25.0, 196, [25, 25, 25]),
    ],
)
def test_repetitions_last_three_seconds_or_as_long_as_training_motions_at_most(
    fitting, requested, longest, frames
):
    prompt = ReadPrompt([(text, None) for text in ("kicks", "walks", "claps")], ("",) * 3)
    sized: Any = SimpleNamespace(
        representation=SimpleNamespace(fps=20.0), facts={"max_frames": longest}
    )
    assert _usual_frames(replace(prompt, fitting=fitting), requested, sized) == frames


@pytest.mark.parametrize(("frames", "is_long"), [(10, True), (9, False)])
def test_a_motion_to_continue_is_as_long_as_the_overlap_of_windows(model, frames, is_long):
    walk = flame_mdm.generate(model, TEXT, frames=frames, num_inference_steps=2)[0]
    request = SamplingRequest(texts=TEXT, after=walk, seconds=2)
    if not is_long:
        with pytest.raises(
            UserError, match=r"the motion has 9 frames\. Use a motion of at least 10"
        ):
            resolve(request, model)
        return
    resolved = resolve(request, model)
    assert resolved.prompts[0].frames == (10 + 40,)
    assert resolved.before is not None
    assert resolved.edit is not None
    np.testing.assert_array_equal(resolved.before.numpy(), walk.features)
    expected = model.representation.normalize(resolved.before)[None]
    torch.testing.assert_close(resolved.edit.known, expected)
    assert resolved.edit.keep.all()


def test_the_summary_counts_the_motions_and_names_the_files_that_are_written():
    motions = [Motion(np.zeros((40, 22, 3)), 20.0)] * 3
    folder = Path("out")
    page = folder / "player.html"
    assert summary(folder, motions, mp4=True) == (
        f"3 motions of 40 frames: {page}, motions.gif, motions.mp4"
    )
    assert summary(folder, motions[:1], mp4=False) == f"1 motion of 40 frames: {page}, motions.gif"


@pytest.mark.parametrize(
    ("options", "samples"),
    [
        ({}, 3),
        ({"out": "folder"}, 3),
        ({"out": "walk.fbx"}, 1),
        ({"out": "walk.fbx", "samples": 2}, 2),
        ({"samples": 1}, 1),
    ],
)
def test_a_command_samples_three_motions_for_a_folder_and_one_for_a_file_by_default(
    options, samples
):
    settings = SampleSettings(ckpt="quickstart", text=TEXT, **options)
    assert settings.request_for(None).samples == samples
    edit = EditSettings(ckpt="quickstart", motion="walk.npz", joints="arms", text=TEXT)
    assert edit.request().samples == 3
    assert SamplingRequest(texts=TEXT).samples == 1


def test_samples_of_different_requests_are_written_to_different_folders(model, monkeypatch):
    def folder(**changed: Any) -> Path:
        options: dict[str, Any] = {"text": TEXT} | changed
        settings = SampleSettings(ckpt="quickstart", **options)
        resolved = resolve(settings.request_for(None), model)
        (only,) = _folders(settings, resolved, model, [])
        return only

    changes: list[dict[str, Any]] = [
        {"text": "a person jumps"},
        {"seconds": 2.0},
        {"seed": 1},
        {"guidance_scale": 2.0},
        {"spacing": "stride"},
        {"candidates": 2},
        {"candidates": 2, "scorer": "claims"},
        {"split": False},
        {"loop": True},
        {"path": "0,1"},
        {"path": "0,1.5"},
        {"shared_noise": True},
        {"cleanup": True},
        {"adapter": ["a"]},
        {"adapter": ["b"]},
        {"adapter_strength": 0.5},
    ]
    first = folder()
    assert len({first, *(folder(**change) for change in changes)}) == len(changes) + 1
    for same in ({"samples": 5}, {"frames": 60}, {"mp4": True}, {"trajectory": True}):
        assert folder(**same) == first
    monkeypatch.setattr(model, "sha256", "f00d")
    assert folder() != first


@pytest.mark.parametrize(
    ("options", "fps", "lengths"),
    [
        ({"seconds": 0.5}, 30.0, [15.0, 15.0]),
        ({"seconds": (0.5, 2)}, 12.5, [6.25, 25.0]),
        ({"seconds": np.array([1.0, 3.0])}, 20.0, [20.0, 60.0]),
        ({"seconds": 0.0}, 20.0, [0.0, 0.0]),
        ({"frames": (3, 40)}, 30.0, [3.0, 40.0]),
        ({"frames": np.int64(7)}, 30.0, [7.0, 7.0]),
        ({}, 30.0, [None, None]),
    ],
    ids=str,
)
def test_lengths_are_requested_in_frames_or_in_seconds_at_the_rate_of_the_model(
    options, fps: float, lengths
):
    assert SamplingRequest(texts=["walks", "jumps"], **options).lengths(fps) == lengths


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("walks@2", [("walks", 2.0)]),
        ("walks @ 2.5s | sits", [("walks", 2.5), ("sits", None)]),
        ("mails a@b @3", [("mails a@b", 3.0)]),
        ("a | b|c @1e0", [("a", None), ("b", None), ("c", 1.0)]),
    ],
)
def test_a_part_ends_with_its_seconds(text: str, parts):
    assert motion_request.read_parts(text) == parts


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("walks | | sits", "'walks | | sits': part 2 is empty"),
        ("walks |", "'walks |': part 2 is empty"),
        ("@3", "'@3': part 1 is empty"),
        ("walks | sits @0", "'sits @0': the duration of a part must be a number of seconds above 0"),
        ("walks @inf", "'walks @inf': the duration of a part"),
        ("walks @-1", "'walks @-1': the duration of a part"),
        ("walks @x", "'walks @x': the duration of a part"),
    ],
)  # fmt: skip
def test_a_part_that_is_empty_or_has_no_duration_is_named(text: str, message: str):
    with pytest.raises(UserError) as error:
        motion_request.read_parts(text)
    assert str(error.value).startswith(message)


def test_options_of_editing_methods_are_those_of_the_papers():
    edit = EditRequest(strength=0.5)
    shared = {"resample": 1, "strength": 0.5}
    assert edit.method_options("mdm") == {"mode": "x0", **shared}
    assert edit.method_options("flame") == {"mode": "x_t", "blend": "after", **shared}
    assert edit.method_options("flame_code") == {"mode": "x_t", "blend": "before", **shared}
    assert edit.method_options("mfm") == {"mode": "trajectory", "until": 0.2, **shared}
    assert EditRequest(until=0.0).method_options("mfm")["until"] == 0
    assert EditRequest(resample=4).method_options("flame")["resample"] == 4
    refused: list[tuple[dict[str, Any], str]] = [({"until": 0.0}, "mdm"), ({"resample": 2}, "mfm")]
    for options, method in refused:
        with pytest.raises(UserError, match=rf"applies only to method=.*, not to {method}"):
            EditRequest(**options, method=method)


def test_a_pair_is_one_range_and_a_list_of_pairs_is_several():
    assert EditRequest(region=[2, 5]).ranges == [(2, 5)]
    assert EditRequest(region=[(2, 5)], joints="arms").ranges == [(2, 5)]
    assert EditRequest(region_seconds=[[0, 0.5], [1, 2]]).ranges == [(0, 0.5), (1, 2)]
    assert EditRequest(region="prefix").ranges is None
    assert EditRequest(strength=1).ranges is None
    for wrong in ([], [1], [1, 2, 3], [[0, 1], 2], [0, math.inf], "0,1"):
        with pytest.raises(UserError, match=r"^region_seconds="):
            EditRequest(region_seconds=cast(Any, wrong))


def test_warnings_name_the_text_if_there_are_several(model):
    texts = ["a person walks moonily", "a person kicks four times", "a person bows"]
    assert resolve(SamplingRequest(texts=texts), model).warnings == (
        "'a person walks moonily': not understood: moonily",
        "'a person kicks twice | a person kicks twice': four times is sampled as 2 + 2",
    )
    assert resolve(SamplingRequest(texts=texts[0]), model).warnings == ("not understood: moonily",)
    parts = resolve(SamplingRequest(texts="walks moonily @1 | jumps @1"), model)
    assert parts.warnings == ("not understood: moonily",)
    assert (parts.is_sequence, parts.prompts[0].is_split) == (True, False)
    split = resolve(SamplingRequest(texts=texts[1], seconds=1.5), model).prompts[0]
    assert (split.is_split, split.frames) == (True, (30, 30))


def test_a_prompt_that_is_refused_leaves_the_others(model):
    refused: dict[int, UserError] = {}
    texts = ["xyzzy", "a person walks @0.1", "a person jumps twice", "a person waves @1"]
    resolved = resolve(SamplingRequest(texts=texts), model, refused)
    assert sorted(refused) == [0, 1]
    assert [prompt.text for prompt in resolved.prompts] == texts[2:]
    assert [prompt.frames for prompt in resolved.prompts] == [(44,), (20,)]
    assert "0.1 seconds is too short" in str(refused[1])


def test_examples_are_spread_over_the_captions_or_actions_of_the_model():
    captions = [f"caption {number}" for number in range(23)]
    facts = {"captions": captions, "actions": ["walk", "run"]}
    text = 'text="a person walks"'
    spread = "; ".join(captions[number] for number in (0, 4, 8, 12, 16))
    for kind, known, says in (
        ("text", facts, f"{text}. Examples: {spread}"),
        ("action", facts, "action=NAME. Examples: walk; run"),
        ("text", {"captions": captions[:3]}, f"{text}. Examples: {'; '.join(captions[:3])}"),
        ("none", {}, "unconditioned=true"),
    ):
        untold: Any = SimpleNamespace(conditioned_on=kind, facts=known)
        with pytest.raises(UserError) as error:
            refuse_no_condition(untold)
        assert str(error.value) == f"nothing to sample. Set {says}"


@pytest.mark.parametrize("texts", [["walks"] * 9, ["walks", ""] + ["jumps"] * 7])
def test_a_folder_has_all_motions_and_pictures_of_eight(texts: list[str], tmp_path, monkeypatch):
    shown: dict[str, Any] = {}

    def picture(path: Path, motions: Sequence[Motion], *titles: str, body: Any = None) -> None:
        shown[path.name] = [motion.text for motion in motions], *titles
        path.write_text("picture")

    for name in ("write_player", "write_gif", "write_mp4", "contact_sheet"):
        monkeypatch.setattr(output, name, picture)
    folder = tmp_path / "out"
    folder.mkdir()
    for name in ("motion_009.npz", "motion_0010.npz", "motions.mp4", "trajectory.png", "notes.npz"):
        (folder / name).write_text("earlier")
    motions = [
        Motion(np.full((3, 22, 3), number, np.float32), 20.0, text=text)
        for number, text in enumerate(texts)
    ]
    output.write_motions(folder, motions, {"seed": 5}, body=None)
    titles = [text or "unconditioned" for text in texts]
    assert shown == {
        "player.html": (titles, "walks" if texts[1] else "Motions"),
        "motions.gif": (titles[:8],),
        "motions.png": (titles[:8],),
    }
    files = [f"motion_{number:03d}.npz" for number in range(9)]
    pictures = ["motions.gif", "motions.png", "player.html"]
    kept = {*files, *pictures, "notes.npz"}
    assert {path.name for path in folder.iterdir()} == kept
    with np.load(folder / "motion_008.npz") as file:
        assert file["joints"].max() == 8
        assert int(file["seed"]) == 5
    output.write_motions(folder, motions[:1], {}, motions[:2], mp4=True)
    assert shown["trajectory.png"] == (texts[:2],)
    assert sorted(path.name for path in folder.iterdir()) == sorted(
        [files[0], *pictures, "notes.npz", "motions.mp4", "trajectory.png"]
    )
