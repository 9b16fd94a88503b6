"""Streams, targets, files and sets of motions, as recorded."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.outcomes import temporary_folder, without
from support.recorded import Case, cases_of, check, outcome, record, some_bodies
from support.runs import TINY, untrained
from support.sampled import (
    FEW,
    WALK,
    WAVE,
    diffusion,
    dip,
    facts,
    labeled,
    shown,
    shown_targets,
    walk,
    with_usual_motions,
)

from flame_mdm.data.store import write_store
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.formats import gaits
from flame_mdm.formats.gaits import Clip
from flame_mdm.formats.grounding import grounded
from flame_mdm.formats.motion import Motion
from flame_mdm.processes.guidance import Positions
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.skeleton import KIT21
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling import motion_sets, output, streams, waypoints
from flame_mdm.sampling.generation import generate
from flame_mdm.sampling.placement import Placement, step_after
from flame_mdm.sampling.prompt_file import PromptFile
from flame_mdm.sampling.reading import decoded, part_of, read_motion, with_features
from flame_mdm.sampling.streams import Schedule, Streams, in_world, root_target
from flame_mdm.sampling.targets import Targets, errors, read_targets

NAME = "sampling_streams"

# Streams ---------------------------------------------------------------------------------------


def blocks_of(running: Iterator[Motion], count: int) -> Any:
    return [
        (block.text, block.cleanup, block.joints.astype(float)) for block in islice(running, count)
    ]


def streams_of_texts() -> Any:
    results: list[Any] = []
    for start, block, cleanup, seed in (
        (None, None, False, 0), (None, 8, False, 3), (walk(), 12, True, 1), (walk(), 30, False, 0),
        (None, 1, False, 0), (None, 15, True, 2),
    ):  # fmt: skip
        running = streams.stream(dip(), WALK, start, seed, block=block, cleanup=cleanup, **FEW)
        results.append(blocks_of(running, 2))
        running.change(WAVE, at=running.frames / 20 + 0.35)
        running.change("wlak")
        results.append(running.text)
        results.append(blocks_of(running, 4))
        results.append((running.frames, running.text, running.reached))
        if cleanup:
            results.append(outcome(lambda running=running: running.go_back(1.0)))
            continue
        back = running.frames - min(9, 2 * running._streams.block)
        running.go_back(back / 20)
        results.append((running.frames, running.text))
        running.lead([(0.4, 0.1), (1.0, 1.0)])
        results.append(blocks_of(running, 2))
        running.go_back(running.frames / 20)
        running.lead([])
        results.append(blocks_of(running, 1))
        results += [
            outcome(lambda at=at, running=running: running.go_back(at)) for at in (-0.05, 99.0)
        ]
        results.append(outcome(lambda running=running: running.change(WALK, at=0.2)))
    return results


def refusals_of_streams() -> Any:
    short = replace(walk(), joints=walk().joints[:9], features=walk().features[:9])
    calls: list[Callable[[], Any]] = [
        lambda: streams.stream(diffusion(), WALK), lambda: streams.stream(dip(), ""),
        lambda: streams.stream(dip(), "xyzzy"), lambda: streams.stream(dip(), "x" * 2001),
        lambda: streams.stream(dip(), WALK, short), lambda: streams.stream(dip(), WALK, block=31),
        lambda: streams.stream(dip(), WALK, replace(short, id="")),
        lambda: streams.stream(dip(), WALK, block=0), lambda: streams.read_text(labeled(), WALK),
        lambda: streams.read_text(dip(), "crouch"), lambda: streams.read_text(dip(), "  "),
        lambda: streams.stream(dip(), WALK, sampler="none"), lambda: waypoints.Route([(1, 2, 3)]),
        lambda: waypoints.Route([(1e4, -1e4), (1e4 + 1, 0)]), lambda: waypoints.Route([(True, 1)]),
        lambda: waypoints.Route([(float("nan"), 1)]), lambda: waypoints.Route([(1, 2)]).points,
    ]  # fmt: skip
    return [
        str(outcome(call))[:300] if number != 16 else call() for number, call in enumerate(calls)
    ]


def several_streams() -> Any:
    results: list[Any] = []
    prefix, _ = streams.starting_point(dip(), None)
    second, placed = streams.starting_point(dip(), walk())
    assert placed is not None
    results.append((prefix, second, placed.turn, placed.shift))
    both = torch.cat([prefix, second])
    placement = Placement(torch.tensor([0.0, 2.9]).double(), torch.randn(2, 3, generator=torch.
                          Generator().manual_seed(1)).double() * torch.tensor([1.0, 0, 1]))  # fmt: skip
    for kind, conditions, block in (("text", [WALK, WAVE], 11), ("none", ["", ""], None)):
        running = Streams(
            dip(), ["x#0", "y#1"], conditions, both, placement, SamplerOptions(**FEW), kind=kind,
            seed=4, block=block,
        )  # fmt: skip
        running.schedules[0].add(7, WAVE if kind == "text" else "")
        for _ in range(2):
            results.append([(one.text, one.joints.astype(float)) for one in next(running)])
        results.append([x.double() for x in running.take([13, 40])])
        results.append((running.frames, running.placement.turn, running.placement.shift))
    return results


def schedules() -> Any:
    schedule = Schedule.of_parts(["a", "b", "c"], [5, 7, 9])
    schedule.add(20, "d")
    schedule.add(5, "e")
    rows: list[Any] = [
        (schedule.at(frame), schedule.until_change(frame))
        for frame in (0, 4, 5, 6, 11, 12, 19, 20, 99)
    ]
    for frame in (13, 12, 5, 1, 0):
        schedule.drop(frame)
        rows.append(list(schedule.changes))
    return rows, Schedule("z").changes, Schedule.of_parts(["q"], [4]).changes


def placements() -> Any:
    rng = np.random.default_rng(6)
    local = torch.from_numpy(rng.normal(size=(3, 22, 3)))
    turns = torch.tensor([0.4, 3.0, -2.2]).double()
    shift = torch.from_numpy(rng.normal(size=(3, 3)) * [4.0, 0.0, 4.0])
    placement = Placement(turns, shift)
    world = placement.apply(local)
    fitted = Placement.fit(local, world)
    noisy = Placement.fit(local, world + torch.from_numpy(rng.normal(0, 0.1, (3, 22, 3))))
    several = torch.from_numpy(rng.normal(size=(3, 5, 22, 3)))
    representation = diffusion().representation
    features = torch.from_numpy(walk().features[[3, 9, 20]])
    after = step_after(representation, features, world)
    origin = Placement.origin(2, torch.device("cpu"))
    normalized = representation.normalize(torch.from_numpy(walk().features))[None]
    return (
        world, fitted.turn, fitted.shift, noisy.turn, noisy.shift, placement.apply(several),
        placement.undo(several), placement.undo(local[:, 0]), after.turn, after.shift, origin.shift,
        in_world(representation, placement, normalized),
    )  # fmt: skip


def paths_that_bend_to_waypoints() -> Any:
    rng = np.random.default_rng(8)
    results: list[Any] = []
    for number in range(12):
        frames, fps = int(rng.integers(20, 90)), (20.0, 30.0, 12.5)[number % 3]
        turns = rng.normal(0, 0.03, frames).tolist()
        steps = (
            rng.normal(0, 0.01, (frames, 2))
            + np.array([0.005, (0.0, 0.04, 0.15, 0.09)[number % 4]])
        ).tolist()
        points = [tuple(row) for row in rng.normal(0, 2.0, (number % 4, 2)).tolist()]
        heading, position = float(rng.uniform(-4, 4)), tuple(rng.normal(0, 1, 2).tolist())
        added = waypoints.bends(turns, steps, heading, position, points, fps)
        results.append((np.array(added), len(added)))
    for goal in (
        (0.5, 0.1),
        (-0.6, 0.0),
        (3.0, 1.0),
        (-3.0, -1.0),
        (0.02, 2.0),
        (0.9, 0.9),
        (0.7, 0.0),
    ):
        for length in (0.0, 0.02, 0.2):
            results.append(waypoints._bend(0.2, length, (0.1, -0.1), goal, 20.0))
            results.append(waypoints._bend(3.0, length, (0.0, 0.0), goal, 30.0))
    representation: Any = dip().representation
    guide = waypoints.RouteGuide(
        representation, Placement(torch.tensor([0.7]).double(), torch.tensor([[1.0, 0, 2.0]]).double()),
        [(2.0, 5.0), (5.0, 5.0)],
    )  # fmt: skip
    x = representation.normalize(torch.from_numpy(walk().features))[None]
    results += [guide.reach(x) - x, guide.steer(lambda y: y, x)]
    route = waypoints.Route([(0, 1), (0.1, 1.1), (3, 3)])
    roots = np.stack([np.linspace(0, 3, 30), np.ones(30), np.linspace(0, 3.1, 30)], -1)
    route.follow(5, np.array([[0.0, 1, 0.69], [0.0, 1, 0.71], [0.1, 1, 0.9], [2.0, 0, 2.0]]))
    results += [list(route.reached), list(route.left)]
    route.follow(40, roots)
    results.append(list(route.reached))
    for frame in (60, route.reached[-1], 7, 6):
        route.go_back(frame)
        results.append((list(route.reached), len(route.left)))
    return results


# Targets ---------------------------------------------------------------------------------------


TARGETS: list[dict[str, Any]] = [
    {}, {"root": [{"time": 1.02, "position": [0.5, 1]}, {"time": 2, "position": [None, 2]}]},
    {"root": [{"time": 0.1, "position": [9, 1]}]}, {"root": [{"time": 1, "position": [7, 7.6]}]},
    {"root": [{"time": 2, "position": [1, 1]}, {"time": 2.1, "position": [6, 4]}]},
    {"joints": [{"time": 1, "joint": "head", "position": [0.1, 2.5, None]}]},
    {"joints": [{"time": 1, "joint": "head", "position": [0.1, 2.51, None]}]},
    {"joints": [{"time": 1, "joint": "left_foot", "position": [None, -0.1, None]}]},
    {"joints": [{"time": 1, "joint": "left_foot", "position": [None, -0.11, None]}]},
    {"joints": [{"time": 1, "joint": "hed", "position": [0, 1, 0]}]}, {"root": [{"time": -1}]},
    {"joints": [{"time": 0.5, "joint": "right_wrist", "position": [0.4, 1.2, 0.6]},
                {"time": 0.24, "joint": "pelvis", "position": [0.1, None, 0.1]}],
     "root": [{"time": 1.9, "position": [0.5, 1.2]}]},
    {"root": [{"time": 30.0, "position": [1e4, 1]}]}, {"roots": []},
    {"root": [{"time": 1, "position": [1, 2, 3]}]},
]  # fmt: skip


def targets_and_refusals() -> Any:
    representation = diffusion().representation
    results: list[Any] = [
        outcome(lambda one=one: shown_targets(read_targets(representation, one))) for one in TARGETS
    ]
    many = [{"time": 60.0 + k, "position": [k * 0.1, 2.0]} for k in range(301)]
    results += [
        outcome(lambda rows=rows: shown_targets(read_targets(representation, {"root": rows})))
        for rows in (many[:300], many)
    ]
    with temporary_folder() as folder:
        walk().save(folder / "pose.npz")
        pose: dict[str, Any] = {"time": 0.6, "file": "pose.npz"}
        for extra in (
            {}, {"frame": 7}, {"frame": 36, "heading": 200}, {"frame": 3, "position": [0.4, None]},
            {"frame": 11, "position": [0.4, 0.2], "heading": -75.0}, {"frame": 37}, {"heading": 30.0},
        ):  # fmt: skip
            (folder / "t.json").write_text(json.dumps({"poses": [{**pose, **extra}]}))
            results.append(
                without(
                    folder,
                    outcome(
                        lambda folder=folder: shown_targets(
                            read_targets(representation, folder / "t.json")
                        )
                    ),
                )
            )
    return results


def windows_of_targets() -> Any:
    representation = diffusion().representation
    targets = read_targets(representation, {
        "root": [{"time": 0.35, "position": [0.2, 0.5]}, {"time": 1.2, "position": [None, 1.3]},
                 {"time": 2.0, "position": [0.9, 1.9]}, {"time": 3.4, "position": [1.1, None]}],
        "joints": [{"time": 0.8, "joint": "left_wrist", "position": [0.4, 1.1, 0.9]},
                   {"time": 2.45, "joint": "head", "position": [None, 1.4, None]}],
    })  # fmt: skip
    posed = replace(targets, poses=((5, torch.arange(263.0)), (31, torch.ones(263))))
    results: list[Any] = []
    for begin, frames, here in (
        (0, 20, (0.0, 0.0)), (8, 20, (0.3, 0.4)), (24, 17, (0.5, 1.4)), (25, 16, (0.5, 1.4)),
        (41, 30, (0.2, 0.1)), (70, 10, (1.0, 2.0)), (0, 8, (-0.1, 0.2)), (30, 2, (0.5, 0.5)),
    ):  # fmt: skip
        window = posed.window(begin, frames, here)
        results.append(shown_targets(window))
        placement = Placement(
            torch.tensor([0.8]).double(), torch.tensor([[1.0, 0.0, -2.0]]).double()
        )
        results.append(root_target(window, frames, placement))
    results += [outcome(lambda n=n: posed.check_end(n, 20.0)) for n in (68, 69, 20)]
    results.append(
        outcome(lambda: Targets(targets.positions, ((99, torch.ones(3)),)).check_end(80, 30.0))
    )
    empty = Targets(Positions(*(x[:0] for x in vars(targets.positions).values())), posed.poses)
    for one in (posed, targets, empty):
        change = one.edit(representation, 90, torch.device("cpu"))
        guide: Any = change.guide
        results.append((change.known, change.keep.sum((0, 1)), guide is None))
        if guide is not None:
            results.append((guide.bones, guide.fps, guide.positions.values))
            x = representation.normalize(torch.from_numpy(walk().features[np.arange(93) % 37]))[
                None
            ]
            results.append(guide.reach(x))
    joints = some_bodies(2, 20.0, 5)
    for motion in joints.values():
        long = motion[np.arange(90) % len(motion)].astype(np.float32)
        results.append(errors(Motion(long, 20.0), targets))
    return results


# Files and outputs -----------------------------------------------------------------------------


def prompt_files() -> Any:
    results: list[Any] = []
    contents = (
        "walks\n\n  waves  \nsits @0\n" + "x" * 2001 + "\na | \nbows @2", "\ufeffwalks\r\nruns", "\n \n",
        "walk\0", "", "one",
    )  # fmt: skip
    with temporary_folder() as folder:
        for content in contents:
            path = folder / "prompts.txt"
            path.write_text(content, encoding="utf-8")
            file = outcome(lambda path=path: PromptFile.read(str(path)))
            if isinstance(file, str):
                results.append(without(folder, file))
                continue
            results.append((file.lines, sorted(file.refused), file.accepted))
            file.refuse({0: UserError("not\nthis")})
            results.append((file.accepted, without(folder, file.report())))
            results += [
                outcome(lambda file=file, lengths=lengths: file.lengths("seconds", lengths))
                for lengths in (None, 3, list(range(len(file.lines))), [1, 2, 3])
            ]
    return results


def outputs_of_commands() -> Any:
    results: list[Any] = []
    models = [diffusion(), labeled(), dip()]
    for model in models:
        results.append(outcome(lambda model=model: output.refuse_no_condition(model)))
    for title, rest in (
        ("A person walks!", ()),
        ("a person walks!", (1, "x")),
        ("_" * 60, (2,)),
        ("", ()),
    ):
        results.append(str(output.default_folder(diffusion(), title, *rest)))
    evil: Any = SimpleNamespace(config={"experiment": "../..//a b/.c-d"})
    results.append(str(output.default_folder(evil, "ä/b " * 20)))
    motions = generate(diffusion(), [WALK, WAVE], frames=[20, 22], **FEW)
    turned = replace(motions[0], degenerate=3, joints=motions[0].joints)
    results.append(output.degenerate_notes([turned, replace(motions[1], degenerate=2)]))
    results.append(output.degenerate_notes(motions))
    for listed in (motions, motions[:1]):
        results += [output.summary(Path("a/b"), listed, mp4=mp4) for mp4 in (False, True)]
    with temporary_folder() as folder:
        for listed, stages in ((motions, motions[:1]), ([replace(motions[1], text="")], None)):
            output.write_motions(folder / "out", listed, {"seed": 3}, stages)
            files = sorted(path.name for path in (folder / "out").iterdir())
            page = (folder / "out" / "player.html").read_text()
            with np.load(folder / "out" / "motion_000.npz") as arrays:
                saved = {
                    key: arrays[key] for key in sorted(arrays) if arrays[key].dtype.kind != "U"
                }
                texts = {key: str(arrays[key]) for key in arrays if arrays[key].dtype.kind == "U"}
            results.append((files, page[page.index("<title>") :][:60], saved, texts))
            (folder / "out" / "motion_007.npz").write_bytes(b"")
            (folder / "out" / "motions.mp4").write_bytes(b"")
            (folder / "out" / "mine.npz").write_bytes(b"")
    return results


@cache
def stored() -> TemporaryDirectory[str]:
    """Folder of a small prepared synthetic set."""
    folder = TemporaryDirectory()
    representation = HumanML()
    write_store(
        Path(folder.name) / f"synthetic-{representation.name}", Synthetic(clips=5), representation
    )
    return folder


def motions_that_are_read() -> Any:
    representation = diffusion().representation
    root = Path(stored().name)
    results: list[Any] = []
    names = ("synthetic:synthetic_0_000003", "synthetic:synthetic_0_000030", "nothing", "a.txt")
    for name in names:
        results.append(
            without(
                root,
                outcome(lambda name=name: shown(read_motion(representation, name, data_root=root))),
            )
        )
    slow = SimpleNamespace(name=representation.name, fps=12.5)
    other: Any = slow
    results.append(without(root, outcome(lambda: read_motion(other, names[0], data_root=root))))
    cuts: list[Any] = [[0.2, 1.4], [0, 1.85], [0, 1.9], [1, 1], [-0.1, 1], "ab", [1, 2, 3]]
    for cut in cuts:
        results.append(outcome(lambda cut=cut: shown(part_of(representation, walk(), cut))))
    unnamed = replace(walk(), id="")
    results.append(outcome(lambda: part_of(representation, unnamed, [0, 99])))
    with temporary_folder() as folder:
        walk().save(folder / "walk.bvh")
        walk().save(folder / "walk.npz")
        files: list[tuple[str, dict[str, Any]]] = [
            ("walk.bvh", {}),
            ("walk.npz", {"cut": [0.3, 1.2]}),
            ("walk.bvh", {"fps": 30.0}),
        ]
        for name, extra in files:
            motion = read_motion(representation, folder / name, **extra)
            results.append(
                (without(folder, motion.id), len(motion.joints), motion.notes, motion.features)
            )
    for fps in (20.0, 30.0, 59.94, 12.5):
        joints = next(iter(some_bodies(1, 20.0, 9).values()))
        motion = Motion(joints.astype(np.float32), fps, text="t", id="m", notes=("note",))
        results.append(shown(with_features(representation, motion)))
    wrong = [
        replace(walk(), features=walk().features[:, :200]),
        replace(walk(), features=np.where(walk().features > 1, np.nan, walk().features), id=""),
        Motion(walk().joints * 100, 20.0, id="big"), Motion(walk().joints[:, :21], 20.0, KIT21),
        Motion(walk().joints[:1], 20.0), Motion(walk().joints[:2], 20.0), Motion(walk().joints * 0.4, 20.0),
    ]  # fmt: skip
    for motion in wrong:
        results.append(outcome(lambda motion=motion: shown(with_features(representation, motion))))
    features = torch.from_numpy(walk().features).clone()
    features[3:7, 70:80] = 0
    results.append(shown(decoded(representation, features, "x", "y")))
    return results


# Sets of motions -------------------------------------------------------------------------------


SET = """
stand: Idle
fps: 30
candidates: 2
prefix: Hero_
motions:
  Idle: {kind: loop, text: a person stands, seconds: 1.5}
  Walk: {kind: gait, text: a person walks forward, seconds: 2}
  Turn: {kind: turn, text: a person turns, degrees: 90}
"""


def sets_and_refusals() -> Any:
    results: list[Any] = []
    with temporary_folder() as folder:
        path = folder / "set.yaml"
        for old, new in (
            ("", ""), ("stand: Idle", "stand: Walk"), ("stand: Idle", "stand: None"), (", degrees: 90", ""),
            ("fps: 30", "fps: 9"), ("fps: 30", "rig: mixamoo"), ("Hero_", "a/b"), ("Walk:", "'W k':"),
            ("seconds: 2", "seconds: 61"), ("fps: 30", "format: bvh"), ("candidates: 2", "candidate: 2"),
            ("fps: 30", "rig: null"),
        ):  # fmt: skip
            path.write_text(SET.replace(old, new) if old else SET)
            results.append(
                without(
                    folder, outcome(lambda path=path: motion_sets.read_set(str(path)).model_dump())
                )
            )
        path.write_text(SET)
        content = motion_sets.read_set(str(path))
    changes: list[dict[str, Any]] = [
        {"rig": "mixamo"}, {"rig": None, "fps": 60}, {"format": "glb"}, {"fps": 5}, {"rig": "none"},
        {"format": "obj"},
    ]  # fmt: skip
    for values in changes:
        results.append(
            outcome(lambda values=values: motion_sets.changed(content, **values).model_dump())
        )
    results += [
        outcome(lambda name=name: str(motion_sets.read_set(name)))
        for name in ("locomotio", "a.json")
    ]
    results.append(motion_sets.read_set("locomotion").model_dump())
    return results


def clips_of_sets() -> Any:
    from flame_mdm.data.synthetic import Attributes, example

    attributes: dict[str, Attributes] = {
        "walk": {"action": "walk", "direction": "forward", "speed": "fast"},
        "turn": {"action": "turn", "direction": "left", "amount": "quarter"},
        "wave": {"action": "wave"},
        "stand": {"action": "stand"},
    }
    rng = np.random.default_rng(0)
    takes = {
        name: grounded(
            np.cumsum(rng.normal(0, 0.0005, (60, 22, 3)), 0)[: len(joints)] + joints, 20.0
        )
        for name, joints in ((name, example(one)[:60]) for name, one in attributes.items())
    }
    stand = takes["stand"].local[0]
    results: list[Any] = []
    clips: list[Clip] = []
    for kind, degrees in (
        ("loop", 0.0),
        ("gait", 0.0),
        ("gait", 90.0),
        ("turn", 90.0),
        ("turn", -90.0),
    ):
        motion = motion_sets.SetMotion(text="x", kind=kind, degrees=degrees)  # type: ignore[arg-type]
        results.append(motion_sets._missing(motion))
        for name, take in takes.items():
            version = motion_sets._clips("X", motion, take, stand)
            if version is None:
                results.append(f"{name} {kind} {degrees}: none")
                continue
            results.append(
                (name, round(version[0], 1),
                 [(one.name, one.kind, len(one.motion), one.motion.path[-1]) for one in version[1]])
            )  # fmt: skip
            if (name, kind) in (("walk", "gait"), ("turn", "turn"), ("stand", "loop")):
                clips += version[1]
    clips = clips[:5]
    rigged = motion_sets.rig_clips(clips, "mixamo")
    for clip, still in zip(clips, rigged, strict=True):
        motion = motion_sets.motion_of(clip)
        entry = motion_sets._entry(clip, still, {"a": "b"})
        results.append((entry, motion_sets.closure(still), motion.id, motion.text, motion.joints))
    results.append(len(gaits.with_neighbors(clips, 20)[0]))
    with temporary_folder() as folder:
        content = motion_sets.MotionSet(
            stand="X", motions={"X": motion_sets.SetMotion(text="x", kind="loop")}, prefix="P_",
            format="glb", rig="mixamo", fps=20.0,
        )  # fmt: skip
        made_set = motion_sets.MadeSet(clips[:2], {"Y": "why"})
        results.append(motion_sets.write_set(folder / "s", made_set, content, {"seed": 1}, None))
        results.append(json.loads((folder / "s" / "set.json").read_text()))
    return results


def sets_of_a_model() -> Any:
    content = motion_sets.MotionSet.model_validate(
        {
            "stand": "I", "fps": 30.0, "candidates": 2, "rig": None,
            "motions": {"W": {"kind": "gait", "text": WALK, "seconds": 2.0},
                        "I": {"kind": "loop", "text": "a person stands", "seconds": 1.5},
                        "T": {"kind": "turn", "text": "a person turns", "degrees": 90.0}},
        }
    )  # fmt: skip
    still = with_usual_motions(untrained(TINY, 60), 0.002)
    still.add_facts(facts())
    one = motion_sets.make_set(still, content, 3, **FEW)
    takes = motion_sets._takes(still, content.motions["I"], content, 3, FEW)
    return (
        [(clip.name, clip.kind, clip.text, len(clip.motion)) for clip in one.clips], one.left_out,
        [(len(take), take.fps, take.local) for take in takes],
    )  # fmt: skip


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
