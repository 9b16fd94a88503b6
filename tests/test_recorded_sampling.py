"""Requests, what models make of them, and sampled and edited motions, as recorded."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.outcomes import temporary_folder, without
from support.recorded import Case, cases_of, check, combinations, outcome, record
from support.sampled import (
    FEW,
    MODELS,
    WALK,
    WAVE,
    diffusion,
    dip,
    flow,
    labeled,
    shown,
    shown_targets,
    walk,
)

from flame_mdm.batch import Edit
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling import generation, sequences
from flame_mdm.sampling.editing import (
    _part_length,
    edit,
    kept_parts,
    method_options,
    resolve_edit,
)
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.motion_request import (
    EditRequest,
    SamplingRequest,
    check_length,
    is_range,
    path_targets,
    read_parts,
    read_path,
)
from flame_mdm.sampling.resolution import resolve

NAME = "sampling"

# Requests --------------------------------------------------------------------------------------


REQUESTS: list[dict[str, Any]] = [
    {}, {"texts": "a"}, {"texts": ["a", "b | c @2"]}, {"actions": "walk @1.5s | kick"},
    {"texts": ["x", "y", "z"], "seconds": [1, 2.5, 3]}, {"texts": "x", "frames": 30},
    {"texts": ["x", "y"], "frames": np.array([20, 31])}, {"texts": "x", "seconds": np.float64(1.5)},
    {"texts": ["x", "y"], "seconds": [1]}, {"texts": "x", "frames": 2.5}, {"texts": "x", "frames": 2.0},
    {"texts": "x", "seconds": "3"}, {"texts": "x", "seconds": 1e9}, {"texts": "x", "seconds": -3},
    {"texts": "x", "seconds": float("nan")}, {"texts": "x", "seconds": True},
    {"texts": "x", "seconds": 1, "frames": 20}, {"texts": "x", "actions": "walk"},
    {"texts": ""}, {"texts": ["x", "  "]}, {"texts": [3]}, {"actions": [None]}, {"texts": "x" * 2001},
    {"texts": "x" * 2000}, {"texts": "x", "samples": 0}, {"texts": "x", "samples": 10_000},
    {"texts": "x", "samples": 10_001}, {"texts": ["x", "y"], "samples": 5001},
    {"texts": "x", "samples": 101, "candidates": 100}, {"texts": "x", "candidates": 1.5},
    {"texts": "x", "samples": 100, "candidates": 100}, {"texts": "x", "seed": 1.0}, {"seed": np.int64(4)},
    {"texts": "x | ", "samples": 2}, {"texts": "x @0"}, {"texts": "x @-1"}, {"texts": "x @inf"},
    {"texts": "x @two"}, {"texts": "@3"}, {"texts": "a@b@3s "}, {"texts": "x @ 2 s"},
    {"texts": "x", "path": "0,1 2,3"}, {"texts": "x", "path": [(1, 2)], "targets": {}},
    {"texts": "x", "path": ""}, {"texts": "x", "path": "1,2,3"}, {"texts": "x", "path": "a,b"},
    {"texts": "x", "loop": True}, {"texts": "x", "after": "a.npz"},
    {"texts": "x", "after": "a.npz", "loop": True}, {"texts": "x", "after": "a", "path": "1,2"},
    {"texts": "x", "after": "a", "targets": {}}, {"texts": "x", "sampels": 1}, {"texts": "x", "region": 1},
    {"texts": "x", "eta": 0.5, "guidance_scale": 2.0, "split": False, "cleanup": True},
    {"texts": (), "samples": 3}, {"actions": ["a", "b", "b"], "shared_noise": True},
]  # fmt: skip


def described(request: SamplingRequest) -> Any:
    values = {
        name: value
        for name, value in vars(request).items()
        if name not in ("after", "parts") and value not in (None, False, 1)
    }
    return (
        values, request.kind, request.has_targets, request.prompts, request.parts,
        request.is_sequence, request.lengths(20.0), request.lengths(12.5),
    )  # fmt: skip


def requests_and_refusals() -> Any:
    requests = [
        outcome(lambda one=one: described(SamplingRequest.of("generate", one))) for one in REQUESTS
    ]
    extras: list[dict[str, Any]] = [{}, {"loop": True}, {"path": "0,1"}]
    motion = [
        outcome(lambda extra=extra: SamplingRequest(texts="x", after=walk(), **extra).is_sequence)
        for extra in extras
    ]
    return requests, motion


EDITS: list[dict[str, Any]] = [
    {}, {"region": "in_between"}, {"region": "prediction"}, {"region": "prefix"}, {"region": "suffix"},
    {"region": "interpolate"}, {"region": "suffx"}, {"region": [0, 5]}, {"region": [[3, 9], [12, 20]]},
    {"region": [0.4, 7.5]}, {"region": [5, 5]}, {"region": [0, 38]}, {"region": [-1, 3]}, {"region": []},
    {"region": [0, 37]}, {"region": 5}, {"region": [[1, 2], 3]}, {"region": [1, float("inf")]},
    {"region_seconds": [0.5, 1.2]}, {"region_seconds": [[0, 0.3], [1, 1.85]]}, {"region_seconds": [0, 2]},
    {"region_seconds": "prefix"}, {"region": "prefix", "region_seconds": [0, 1]},
    {"joints": "left_arm"}, {"joints": ["legs", "head"]}, {"joints": []}, {"joints": "wing"},
    {"joints": "upper_body", "region": "suffix"}, {"joints": "right_leg", "region": [[2, 9]]},
    {"method": "mdm", "joints": "arms"}, {"method": "flame", "joints": "arms", "resample": 2},
    {"method": "flame_code", "joints": "arms"}, {"method": "mfm", "joints": "arms", "until": 0.4},
    {"method": "mfm", "joints": "arms"}, {"method": "mdm", "resample": 2}, {"method": "flame", "until": 0.1},
    {"method": "mfm", "resample": 3}, {"method": "mcm"}, {"resample": 0}, {"resample": 1.0},
    {"strength": 0.5}, {"strength": 1.0}, {"strength": 0}, {"strength": 1.01}, {"until": 0.3},
    {"resample": 2, "joints": "legs"}, {"strength": 0.4, "region": "suffix"},
]  # fmt: skip


def edits_and_what_they_keep() -> Any:
    results: list[Any] = []
    for values in EDITS:
        request = outcome(lambda values=values: EditRequest(**values))
        if isinstance(request, str):
            results.append(request)
            continue
        row: list[Any] = [request.ranges]
        for length in (37, 8):
            row.append(
                outcome(
                    lambda request=request, length=length: [
                        part.double().numpy()
                        for part in kept_parts(diffusion().representation, length, request)
                    ]
                )
            )
        for model in (diffusion(), flow()):
            for options in (SamplerOptions(), SamplerOptions(num_inference_steps=3)):
                row.append(
                    outcome(
                        lambda model=model, options=options, request=request: method_options(
                            model.process, request, options
                        )
                    )
                )
        results.append(row)
    return results


def keywords_of_edits() -> Any:
    listed: list[dict[str, Any]] = [
        {"joints": "arms", "seconds": 2}, {"strength": 0.5, "texts": "a | b"}, {"frames": 3},
        {"joints": "arms", "texts": "a | b"}, {"region": "suffix", "loop": True},
        {"strength": 0.5, "loop": True}, {"strength": 0.5, "path": "1,2"}, {"path": "1,2"},
        {"strength": 0.5, "after": "a"}, {"strength": 0.5, "region": "suffix", "targets": {}},
        {"joint": "arms"}, {"strength": 0.5, "joints": "arms", "texts": "a @2"}, {"resample": 2},
    ]  # fmt: skip
    return [
        outcome(lambda one=one: described(SamplingRequest.of("edit", one, editing=True)))
        for one in listed
    ]


def parts_paths_and_ranges() -> Any:
    lengths = [
        outcome(lambda one=one: _part_length(read_parts(one[0]), one[1], 20.0))
        for one in (("a", 37), ("a @1 | b", 50), ("a | b | c", 50), ("a | b | c", 51), ("a @1", 20),
                    ("a @1", 21), ("a @2 | b @1.2 | c | d", 70), ("a @2 | b", 40), ("a@1|b|c", 23))
    ]  # fmt: skip
    written: list[Any] = ["0,1 0.5,-2", " 1e1,2 ", "1;2", [(1, 2), (3.5, 4)], [], [(1,)], "1,2 3"]
    paths = [outcome(lambda one=one: read_path(one)) for one in [*written, "x" * 900]]
    targets = [
        path_targets(path, seconds)
        for path in ([(0.0, 1.0), (2.0, 1.0), (2.0, -3.0)], [(0.0, 0.0)], [(1.0, 1.0), (1.0, 1.0)])
        for seconds in (3.0, 1.37)
    ]
    pairs = [[0, 1], (1.5, 2), [1], [1, 2, 3], ["a", 1], [0, float("nan")], "ab", None, [1, [2]]]
    return (
        lengths, paths, targets, [is_range(pair) for pair in pairs],
        [outcome(lambda size=size: check_length("ab " * size)) for size in (666, 667)],
    )  # fmt: skip


# Resolution and lengths ------------------------------------------------------------------------


RESOLVED: list[dict[str, Any]] = [
    {}, {"texts": WALK}, {"texts": [WALK, WAVE]}, {"texts": "a person walks, then sits down"},
    {"texts": "a person walks, then sits down", "split": False}, {"texts": "walks @2 | waves"},
    {"texts": "kicks twice"}, {"texts": "a person kicks three times"}, {"texts": "kicks once"},
    {"texts": "kicks twice", "seconds": 1.3}, {"texts": "waves frobnically"}, {"texts": "xyzzy"},
    {"texts": [WALK, "xyzzy", "walks @99"]}, {"texts": [WALK, "waves frobnically"]},
    {"texts": [WALK, "kicks and jumps nervously"], "frames": [25, 40]}, {"texts": WALK, "frames": 1},
    {"texts": WALK, "frames": 61}, {"texts": WALK, "seconds": 2.226}, {"texts": WALK, "loop": True},
    {"texts": "a | b | c", "loop": True}, {"texts": "walks @0.2 | waves"}, {"texts": "walks @700"},
    {"texts": "walks @0.01 | waves"}, {"texts": "walks | waves", "frames": 30}, {"texts": "walks @9"},
    {"actions": "walk"}, {"actions": "walk | bow @1"}, {"actions": "fly"}, {"actions": ["kick", "fly"]},
    {"texts": WALK, "path": "0,1 1,1"}, {"texts": [WALK, WAVE], "path": "0,1", "frames": [20, 30]},
    {"texts": [WALK, "waves"], "path": "0,1 0.4,0.5", "frames": 22}, {"texts": WALK, "frames": 20, "targets":
     {"root": [{"time": 1, "position": [0, 1]}]}}, {"texts": WALK, "frames": 21, "targets":
     {"root": [{"time": 1, "position": [0, None]}], "joints": [
         {"time": 0.5, "joint": "head", "position": [0.1, 1.4, 0.3]}]}},
    {"texts": "a person walks slowly and waves while jumping 4 times"}, {"texts": "walk in limp style"},
]  # fmt: skip


def resolved_requests() -> Any:
    results: dict[str, Any] = {}
    for number, values in enumerate(RESOLVED):
        for place, (name, built) in enumerate(MODELS.items()):
            after = walk() if (number + place) % 4 == 0 and not {"loop", "path", "targets"} & {
                *values
            } else None  # fmt: skip
            for collects in (False, True):
                refused: dict[int, UserError] = {}

                def call(
                    values: dict[str, Any] = values,
                    after: Any = after,
                    built: Any = built,
                    collected: Any = refused if collects else None,
                    number: int = number,
                ) -> Any:
                    request = SamplingRequest.of("x", {**values, "after": after})
                    one = resolve(request, built(), collected, check_words=number % 5 != 3)
                    before = None if one.before is None else one.before.numpy()
                    kept = one.edit and one.edit.known.double().numpy()
                    return (
                        [vars(prompt) for prompt in one.prompts], one.is_sequence, before, kept,
                        shown_targets(one.targets), one.warnings,
                    )  # fmt: skip

                if collects and not isinstance(values.get("texts", values.get("actions")), list):
                    continue
                answer = outcome(call)
                results[f"{name} {number} {collects}"] = (
                    answer, [f"{key}: {error}" for key, error in refused.items()]
                )  # fmt: skip
    return results


def motions_to_continue() -> Any:
    short = replace(walk(), joints=walk().joints[:5], features=walk().features[:5])
    results = []
    with temporary_folder() as folder:
        walk().save(folder / "walk.npz")
        request = SamplingRequest(texts=WALK, after=folder / "walk.npz")
        for built in (diffusion, flow, dip):
            one = resolve(request, built())
            results.append(
                (one.before, one.edit and one.edit.known, without(folder, list(one.warnings)))
            )
            results.append(
                outcome(
                    lambda built=built: (
                        resolve(SamplingRequest(texts=WALK, after=short), built()).is_sequence
                    )
                )
            )
    return results


def lengths_and_windows() -> Any:
    results: list[Any] = []
    for fps, longest, context in (
        (20.0, 60, 0), (30.0, 196, 0), (12.5, 20, 0), (20.0, 13, 0), (20.0, 40, 10), (59.94, 100, 0)
    ):  # fmt: skip
        model: Any = SimpleNamespace(
            representation=SimpleNamespace(fps=fps),
            facts={"max_frames": longest, "actions": ["a", "b"]},
            denoiser=SimpleNamespace(context_frames=context, mask_padding=longest != 60),
            device=torch.device("cpu"),
        )
        shared = sequences.overlap(model)
        results.append(shared)
        for text in ("a", "a @1", "a | b", "a @2.03 | b | c @0.9", "a @0.04", "a @0.4 | b", "a@600.1",
                     "a @300 | b @300"):  # fmt: skip
            parts = read_parts(text)
            for loop in (False, True):
                for usual in (None, 30.4, 1.2, 61.0, float(longest)):
                    is_sequence = loop or len(parts) > 1 or parts[0][1] is not None

                    def call(
                        model: Any = model, text: str = text, parts: Any = parts,
                        usual: Any = usual, loop: bool = loop, is_sequence: bool = is_sequence,
                    ) -> Any:  # fmt: skip
                        return sequences.part_frames(
                            model,
                            text,
                            parts,
                            [usual] * len(parts),
                            is_sequence=is_sequence,
                            loop=loop,
                        )

                    results.append(outcome(call))
        if context:
            continue
        for loop in (False, True):
            for kind in ("texts", "actions"):
                request = SamplingRequest.of("x", {kind: ["a | b", "b"], "loop": loop})
                covered = sequences.windows(
                    model,
                    request,
                    [("a", "b"), ("b",)],
                    [(longest, 2 * longest + 3), (shared + 4,)],
                )
                batch = covered.batch
                results.append(
                    [batch.text, batch.action, batch.mask.sum(1), batch.mask.shape]
                    + [x for x in vars(covered).values() if isinstance(x, torch.Tensor)]
                )
    return results


# Sampled motions -------------------------------------------------------------------------------


def sampled_motions() -> Any:
    target = {
        "root": [{"time": 0.9, "position": [0.3, 0.6]}],
        "joints": [{"time": 0.5, "joint": "left_wrist", "position": [0.3, 1.2, None]}],
    }
    results: dict[str, Any] = {}
    of_texts: list[dict[str, Any]] = [
        {"texts": [WALK, WAVE, WALK], "frames": [20, 33, 26], "samples": 2},
        {"texts": WALK, "frames": 22, "candidates": 3, "seed": 5},
        {"texts": [WALK, WAVE], "frames": 20, "shared_noise": True, "samples": 2},
        {"texts": f"{WALK} @1.5 | {WAVE} | a person bows @2", "seed": 2},
        {"texts": WALK, "loop": True, "frames": 40},
        {"texts": [WALK, f"{WAVE} | {WALK}"], "after": walk(), "frames": 24},
        {"texts": WALK, "frames": 24, "targets": target},
        {"texts": [WALK, WAVE], "frames": 24, "path": "0,0.4 0.3,0.6"},
        {"texts": WALK, "frames": 24, "cleanup": True, "guidance_scale": 1.0},
        {"frames": [21], "samples": 2, "guidance_scale": 4.0},
    ]
    for number, values in enumerate(of_texts):
        for name in ("diffusion", "flow", "dip"):
            if name == "flow" and number % 2:
                continue
            results[f"{name} {number}"] = outcome(
                lambda values=values, name=name: [
                    shown(motion) for motion in generate(MODELS[name](), **{**values, **FEW})
                ]
            )
    of_actions: list[dict[str, Any]] = (
        [
            {"actions": ["walk", "bow"], "frames": [12, 22], "samples": 2}, {"actions": "walk | kick"},
            {"actions": "bow", "loop": True, "frames": 25}, {"frames": 10},
        ]
    )  # fmt: skip
    for number, values in enumerate(of_actions):
        results[f"labeled {number}"] = [
            shown(motion) for motion in generate(labeled(), **{**values, **FEW})
        ]
    return results


def stages_scores_and_candidates() -> Any:
    stages: list[Motion] = []
    first = generate(
        diffusion(), [WALK, WAVE], frames=[20, 25], num_inference_steps=3, stages=stages
    )
    numbers = [first[0].joints[-1, 0, 0].item(), len(first), len(stages)]
    rng = np.random.default_rng(2)
    candidates = [
        Motion(
            (walk().joints + rng.normal(0, size, (37, 22, 3))).astype(np.float32), 20.0, id=str(k)
        )
        for k, size in enumerate((0.03, 0.004, 0.0, 0.05, 0.004))
    ]
    faulty = [generation._faulty_frames(motion) for motion in candidates]
    chosen = [
        generation.best(listed, score).id
        for listed in (
            candidates,
            candidates[::-1],
            candidates[:1],
            candidates[3:4] + candidates[:1],
        )
        for score in (None, lambda some: [float(len(m.id) + int(m.id) % 3) for m in some])
    ]
    scored = generate(
        diffusion(), [WALK, WAVE], frames=20, candidates=2, samples=2, **FEW,
        score=lambda motions: [float(motion.joints[-1, 3, 0]) for motion in motions],
    )  # fmt: skip
    refused = [
        outcome(lambda: generate(dip(), WALK, frames=20, stages=[])),
        outcome(lambda: generate(diffusion(), WALK, frames=20, stages=[], candidates=2)),
    ]
    return (
        numbers, [(motion.text, motion.joints.astype(float)) for motion in stages], faulty, chosen,
        [motion.id for motion in scored], refused,
    )  # fmt: skip


def edits_given_to_generate() -> Any:
    known = diffusion().representation.normalize(torch.from_numpy(walk().features))[None]
    keep = torch.zeros_like(known, dtype=torch.bool)
    keep[:, :9] = True
    results = []
    listed: list[tuple[dict[str, Any], Edit]] = [
        ({"texts": [WALK, WAVE], "frames": [37, 30]}, Edit(known, keep)),
        ({"texts": f"{WALK} | {WAVE}", "frames": 37}, Edit(known, keep)),
        ({"texts": WALK, "frames": 37}, Edit(known, keep & False, strength=0.5)),
        ({"texts": f"{WALK} | {WAVE}", "frames": 20}, Edit(known, keep & False, strength=0.5)),
        ({"texts": WALK, "frames": 37, "path": "0,0.3"}, Edit(known, keep & False, strength=0.5)),
    ]
    for values, one in listed:
        results.append(
            outcome(
                lambda values=values, one=one: [
                    shown(motion) for motion in generate(diffusion(), **values, **FEW, edit=one)
                ]
            )
        )
    results.append(outcome(lambda: generate(dip(), WALK, frames=20, edit=Edit(known, keep))))
    return results


def edited_motions() -> Any:
    results: list[Any] = []
    listed = combinations(
        4,
        14,
        model=(diffusion, flow),
        part=({"region": "in_between"}, {"joints": "left_arm"}, {"region": [[3, 9], [20, 30]]},
              {"joints": "legs", "region_seconds": [0.5, 1.5]}, {"strength": 0.6},
              {"region": "interpolate"}),
        texts=(None, WAVE, [WALK, WAVE]),
        cleanup=(False, True),
        samples=(1, 2),
    )  # fmt: skip
    for options in listed:
        stages: list[Motion] = []
        motions = edit(
            options["model"](), walk(), options["texts"], cleanup=options["cleanup"],
            samples=options["samples"], **options["part"], **FEW, stages=stages,
        )  # fmt: skip
        results.append(
            [
                (motion.text, motion.joints.astype(float), motion.keep.sum(0), motion.joint_error,
                 round(motion.feature_error, 3), motion.original.id)
                for motion in motions
            ]
        )  # fmt: skip
        results.append(len(stages))
    return results


def edits_of_other_inputs_and_refusals() -> Any:
    array = walk().joints
    text = f"{WALK} @0.8 | {WAVE}"
    calls: list[Callable[[], Any]] = [
        lambda: edit(diffusion(), array, WAVE, fps=20.0, joints="arms", **FEW),
        lambda: edit(diffusion(), array, WAVE, fps=30.0, joints="arms", **FEW),
        lambda: edit(diffusion(), torch.from_numpy(array), fps=20.0, cut=[0.5, 1.5], strength=0.5, **FEW),
        lambda: edit(diffusion(), walk(), text, strength=0.4, **FEW),
        lambda: edit(diffusion(), walk(), text, strength=0.4, loop=True, **FEW),
        lambda: edit(diffusion(), walk(), WALK, strength=0.4, path="0,0.2", **FEW),
        lambda: edit(diffusion(), walk(), WALK, method="flame", resample=2, joints="head", **FEW),
        lambda: edit(diffusion(), walk(), WALK, method="flame_code", joints="head", **FEW),
        lambda: edit(flow(), walk(), WALK, until=0.6, region="suffix", **FEW),
        lambda: edit(flow(), walk(), WALK, method="mdm", region="suffix", **FEW),
        lambda: edit(labeled(), walk(), cut=[0, 1], actions="bow", region="prefix", **FEW),
        lambda: edit(diffusion(), walk(), WALK, fps=25.0, joints="head"),
        lambda: edit(diffusion(), walk(), WALK),
        lambda: edit(diffusion(), walk(), WALK, region="whole"),
        lambda: edit(labeled(), walk(), actions="bow", region="prefix"),
        lambda: edit(labeled(), replace(walk(), id=""), actions="walk | bow", strength=0.5, **FEW),
        lambda: edit(dip(), walk(), WALK, joints="head"),
        lambda: edit(diffusion(), array, WALK, joints="head"),
        lambda: edit(diffusion(), walk(), WALK, cut=[1, 9], joints="head"),
        lambda: edit(diffusion(), walk(), "a @9 | b", strength=0.5),
        lambda: edit(flow(), walk(), WALK, method="flame", joints="head"),
    ]  # fmt: skip
    results: list[Any] = [
        outcome(lambda call=call: [(shown(one)[:2], one.joints.astype(float)) for one in call()])
        for call in calls
    ]
    request = SamplingRequest.of("edit", {"texts": "a walk | waves", "strength": 1.0}, editing=True)
    one = resolve_edit(request, diffusion(), walk(), cut=(0.1, 1.7))
    results.append((one.resolved.request.frames, one.resolved.request.split, one.keep.sum().item()))
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
