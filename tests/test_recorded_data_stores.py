"""Results of stores, batches, the user's folders, CMU's recordings and conditions, as recorded."""

import json
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache, partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import torch
from support.asf import write_amc, write_asf
from support.motions import posed
from support.others import amass as amass_arrays
from support.recorded import Case, bodies, cases_of, check, combinations, record
from support.recorded_data import clips_of, folder, outcome, outcomes, plain, projected
from support.stores import OwnClips, line
from torch import Tensor, nn

from flame_mdm.batch import Condition, MotionBatch
from flame_mdm.conditions import Unconditional, prompts, target, vocabulary
from flame_mdm.conditions.action import ActionLabels
from flame_mdm.conditions.text import EncodedCaptions, Pretrained, PretrainedText
from flame_mdm.conditions.tokens import LearnedTokens
from flame_mdm.data import SPLITS, Clip, adaptation, cmu, crops, datamodule, resident, verify
from flame_mdm.data import folder as user_folder
from flame_mdm.data import store as stores
from flame_mdm.data.standing import standing
from flame_mdm.formats import asf, bvh
from flame_mdm.formats.motion import Motion
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.motion272 import Motion272
from flame_mdm.representations.rifke import Rifke
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import KIT21, SMPL22
from flame_mdm.representations.smpl import SMPL

NAME = "data_stores"
CPU = torch.device("cpu")


# Crops and batches ------------------------------------------------------------------------------


def crops_of_all_rules() -> Any:
    rules: list[crops.Crop] = [
        crops.Units(),
        crops.Units(4, 20, 4),
        crops.Units(3, 9, 3),
        crops.Units(1, 5, 1),
        crops.Whole(),
        crops.Whole(2, 17),
        crops.Fixed(),
        crops.Fixed(12, 3),
    ]
    results: dict[str, Any] = {}
    for rule in rules:
        drawn = []
        for frames in (3, 4, 7, 8, 11, 12, 13, 14, 20, 41, 61, 62, 197, 500):
            for seed in (None, 0, 1, 2, 3):
                generator = None if seed is None else np.random.default_rng(seed)
                drawn.append(rule(frames, generator).tolist())
        results[str(rule)] = [rule.longest(), [[len(row), row[:1], row[-1:]] for row in drawn]]
    wrong = ((5, 3, 1), (3, 9, 4), (3, 10, 3), (3, 9, 0), (4, 12, 5), (2, 2, 2))
    results["refused"] = [outcome(lambda rule=rule: crops.Units(*rule)) for rule in wrong]
    return results


def batches_of_streams() -> Any:
    lengths = np.random.default_rng(0).integers(3, 90, 41)
    results: dict[str, Any] = {}
    for options in combinations(
        0, 10, batch_size=(1, 3, 4, 50), seed=(0, 3), first=(0, 5), rank=(0, 1), world=(1, 2)
    ):
        if options["rank"] < options["world"]:
            stream = datamodule.TrainingBatches(lengths, **options)
            results[str(options)] = [
                [index for index, _ in batch] + [batch[0][1]] for batch in islice(stream, 14)
            ]
    few = datamodule.TrainingBatches(lengths[:2], 5, seed=1, first=0, rank=0, world=1)
    results["few"] = list(islice(few, 3))
    results["long"] = datamodule.TrainingBatches(
        lengths, 2, seed=1, first=0, rank=0, world=1
    ).batches(1, 20)
    results["evaluation"] = [
        datamodule.evaluation_batches(lengths, size, rank=rank, world=world)
        for size, rank, world in ((4, 0, 1), (7, 1, 3), (50, 0, 2))
    ]
    rows = [np.array([3, 1, 7]), np.arange(8, 20)]
    streams = [
        datamodule.TrainingBatches(lengths[one], size, seed=2, first=1, rank=0, world=1)
        for one, size in zip(rows, (2, 3), strict=True)
    ]
    results["lesson"] = list(islice(adaptation.LessonBatches(rows, streams), 4))
    return results


# Stores -----------------------------------------------------------------------------------------


def store_clips() -> list[Clip]:
    rng = np.random.default_rng(5)
    licenses = ("MIT", "", "CMU", "MIT")
    clips = []
    for number, (name, motion) in enumerate(islice(bodies(20.0).items(), 0, 72, 6)):
        part = np.ascontiguousarray(motion[: 18 + 5 * (number % 7)])
        split = SPLITS[(0, 1, 0, 2, 0)[number % 5]]
        texts = [f"a person moves like {name}", f"take {number}", "somebody moves"]
        clip = Clip(
            f"m{number}", part, texts[: 1 + number % 3], split, f"s{number}", number % 3,
            {"number": number}, license=licenses[number % 4],
        )  # fmt: skip
        clips.append(clip)
        if number % 4 == 0:
            size = len(part) - 5
            clips.append(replace(clip, id=f"m{number}b", window=(3, size - 4), captions=["part"]))
            clips.append(replace(clip, id=f"m{number}c", window=None, license="CMU"))
        if number == 5:
            clips.append(replace(clip, id="copy", motion=part.copy(), split="val", source="copy"))
        if number % 3 == 1:
            clips[-1] = replace(clips[-1], reference=rng.normal(size=(7 + number, 22, 3)))
    still = np.repeat(bodies(20.0)["walk"][:1], 25, 0)
    still[9, 20] += [0.006, 0.0, 0.006]
    clips.append(Clip("still", still, ["a person stands"], "train", "still", 1))
    nearly = still.copy()
    nearly[9, 20] += [0.006, 0.0, 0.002]
    clips.append(Clip("nearly", nearly, ["a person twitches"], "train", "nearly", None))
    return clips


def own_source(*clips: Clip, **fields: Any) -> Any:
    source: Any = OwnClips(*clips)
    source.actions, source.workers = ("a", "b", "c"), 1
    for name, value in fields.items():
        setattr(source, name, value)
    return source


@cache
def module(**options: Any) -> datamodule.MotionDataModule:
    """A data module of own clips, whose store is prepared."""
    defaults: dict[str, Any] = {"batch_size": 3, "crop": crops.Units(8, 40, 4)}
    data = datamodule.MotionDataModule(
        own_source(*store_clips(), options={"x": 1}),
        HumanML("smpl22"),
        root=str(folder(f"root{len(options)}{sorted(map(str, options))}".replace("/", "_"))),
        name="own clips",
        **(defaults | options),
    )
    data.prepare_data()
    data.setup("fit")
    return data


def contents_of_stores() -> Any:
    data = module()
    store = data.store
    info = {name: value for name, value in store.info.items() if name != "sha256"}
    lines = (store.folder / "clips.jsonl").read_text().splitlines()
    ids = [clip.id for clip in store.clips if clip.id in ("m1", "m4c", "m7", "m10")]
    return {
        "info": info,
        "files": sorted(store.info["sha256"]),
        "lines": lines,
        "mean": [projected(store.mean), projected(store.std)],
        "motions": [projected(store.motion(clip), 2) for clip in store.clips],
        "licenses": store.licenses(),
        "references": [projected(joints) for joints in store.references(["m1", "m7"]) or ()],
        "missing": store.references(["m0", "m1"]),
        "ids": [ids, store.verify()],
        "counts": data.counts(store),
        "captions": data.captions(),
        "actions": data.actions,
        "sizes": [(len(part), part.too_short) for part in (data.train, data.val, data.test)],
        "statistics": [projected(data.representation.mean), projected(data.representation.std)],
    }


def batches_of_data_modules() -> Any:
    results: dict[str, Any] = {}

    def facts(batch: MotionBatch) -> Any:
        action = None if batch.action is None else batch.action.tolist()
        return [projected(batch.x, 2), batch.lengths.tolist(), batch.ids, batch.text, action]

    rules = (crops.Units(8, 40, 4), crops.Whole(19, 30), crops.Fixed(26, 12))
    for number, (rule, is_resident) in enumerate((r, b) for r in rules for b in (True, False)):
        data = module(
            crop=rule, resident=is_resident, pad_multiple=(1, 8, 5, 3)[number % 4], seed=number // 2
        )
        results[f"{rule}, {is_resident}"] = [
            str(data.device),
            type(data.train_dataloader()).__name__,
            [facts(batch) for batch in islice(iter(data.train_dataloader()), 5)],
            [facts(batch) for batch in data.val_dataloader()],
            [len(cast(Any, data.val_dataloader())), len(data.test)],
            data.test.draw(np.arange(len(data.test)), -1),
            data.train.draw([0, 2, 3], 4),
            data.train.draw([1, 2, 5], [3, 4, 3]),
            [data.counts(data.store), data.train.advice],
        ]
    return results


def rotations_on_the_device() -> Any:
    rng = np.random.default_rng(2)
    clips = [
        Clip(f"r{n}", 0.3 * rng.normal(size=(9 + 2 * n, 75)), [f"c{n}"], SPLITS[n > 3], f"r{n}")
        for n in range(6)
    ]
    results: dict[str, Any] = {}
    for representation in (SMPL(), Rot6D()):
        for is_resident in (True, False):
            data = datamodule.MotionDataModule(
                own_source(*clips, actions=()), representation, root=str(folder("rotations")),
                name="r", batch_size=2, crop=crops.Whole(2, 14), resident=is_resident,
            )  # fmt: skip
            data.prepare_data()
            data.setup("fit")
            results[f"{representation.name}, {is_resident}"] = [
                [projected(batch.x, 3), batch.ids, batch.action]
                for batch in islice(iter(data.train_dataloader()), 4)
            ]
        results[f"features of {representation.name}"] = projected(
            resident.resident_features(data.store, representation, CPU)
        )
    return results


def stores_that_are_refused() -> Any:
    root = folder("refused stores")
    clips = store_clips()[:3]
    motion = clips[0].motion

    def written(*clips: Clip, **fields: Any) -> Any:
        shutil.rmtree(root / "store", ignore_errors=True)
        store = stores.write_store(root / "store", own_source(*clips, **fields), HumanML("smpl22"))
        return [store.info["clips"], store.info["shape"], store.fingerprint]

    def changed(name: str, change: Callable[[str], str]) -> Any:
        written(*clips)
        path = root / "store" / name
        path.write_text(change(path.read_text()))
        return stores.Store(root / "store").fingerprint

    def changed_index(**fields: Any) -> Any:
        written(*clips)
        path = root / "store" / "clips.jsonl"
        first, *rest = path.read_text().splitlines()
        path.write_text("\n".join([json.dumps(json.loads(first) | fields), *rest]) + "\n")
        return stores._entries(path, 60, 3)[0]

    def arrays(**values: Any) -> Any:
        written(*clips)
        np.savez(root / "store" / "statistics.npz", **values)
        info = json.loads((root / "store" / "store.json").read_text())
        info["sha256"]["statistics.npz"] = stores.sha256(root / "store" / "statistics.npz")
        (root / "store" / "store.json").write_text(json.dumps(info))
        return stores.Store(root / "store").fingerprint

    def replaced(*names: str) -> Any:
        shutil.rmtree(root / "store", ignore_errors=True)
        (root / "store").mkdir()
        for name in names:
            (root / "store" / name).write_text("{}")
        return stores._replaceable(root / "store")

    def again(extra: str) -> Any:
        written(*clips)
        (root / "store" / extra).write_text("x")
        names = [path.name for path in stores._replaceable(root / "store")]
        stores.write_store(root / "store", own_source(*clips[:2]), HumanML("smpl22"))
        return [names, sorted(path.name for path in (root / "store").iterdir())]

    def encoded(name: str, values: Any, kind: Any = HumanML) -> Any:
        clip = Clip("e", values, [], "train", "e", encoded=name)
        return projected(stores._encode(kind("smpl22"), (clip.id, clip.encoded, clip.motion)))

    name = HumanML("smpl22").name
    nan = np.zeros((5, 263), np.float32)
    nan[3, 7] = np.nan
    walk = clips[0]
    return outcomes(
        plain=lambda: written(*clips),
        version=lambda: written(*clips, version=3),
        statistics=lambda: written(*clips, statistics=lambda: (np.ones(300), np.ones(300) * 2)),
        none=lambda: written(),
        val=lambda: written(replace(walk, split="val")),
        named=lambda: written(replace(walk, split="val"), named_by_recipe=True),
        window=lambda: written(replace(walk, window=(-1, 5))),
        end=lambda: written(replace(walk, window=(3, len(motion)))),
        length=lambda: written(replace(walk, window=(3, 0))),
        splits=lambda: written(walk, replace(walk, id="x", split="test")),
        ids=lambda: written(walk, replace(walk, source="x")),
        short=lambda: written(replace(walk, motion=motion[:1])),
        infinite=lambda: written(replace(walk, motion=motion * np.inf)),
        same=lambda: encoded(name, np.ones((4, 263))),
        other=lambda: encoded("smpl147", np.ones((4, 263))),
        width=lambda: encoded(name, np.ones((4, 262))),
        nan=lambda: encoded(name, nan),
        nowhere=lambda: stores.Store(root / "nothing"),
        info=lambda: changed("store.json", lambda text: text.replace('"format": 1', '"format": 2')),
        print=lambda: changed(
            "store.json", lambda text: text.replace('"fps": 20.0', '"fps": 21.0')
        ),
        shape=lambda: changed("store.json", lambda text: text.replace(" 263\n", " 262\n")),
        hash=lambda: changed("clips.jsonl", lambda text: text + " "),
        start=lambda: changed_index(start=58),
        action=lambda: changed_index(action=3),
        good=lambda: changed_index(action=2, captions=["\u2028x"], license="MIT"),
        negative=lambda: changed_index(start=-1),
        empty=lambda: changed_index(id=""),
        zero=lambda: changed_index(length=0),
        mean=lambda: arrays(mean=np.zeros(263), std=np.ones(262)),
        integers=lambda: arrays(mean=np.zeros(263, int), std=np.ones(263)),
        values=lambda: arrays(mean=np.zeros(263), std=np.ones(263)),
        nothing=lambda: replaced(),
        foreign=lambda: replaced("x.txt"),
        broken=lambda: replaced("store.json"),
        again=lambda: again("verify.json"),
    )


def options_of_data_modules() -> Any:
    def refused(**options: Any) -> Any:
        defaults: dict[str, Any] = {
            "batch_size": 3,
            "crop": crops.Whole(),
            "name": "n",
            "root": "r",
        }
        source = own_source(named_by_recipe=True)
        data = datamodule.MotionDataModule(source, HumanML("kit21"), **(defaults | options))
        return [str(data.folder), source.name, data.pad_multiple, data.resident, data.num_workers]

    wrong: list[dict[str, Any]] = [{}, {"batch_size": 0}, {"batch_size": 1}, {"num_workers": -1}]
    wrong += [{"name": name} for name in ("", ".x", "-x", "a/b", "a b.c-d_e", "ü")]
    wrong += [{"resident": value} for value in (True, False, "auto", "yes", 1)]
    wrong += [{"pad_multiple": value} for value in (0, 1, 100_000, 100_001)]
    wrong += [{"crop": crop} for crop in (crops.Whole(0), crops.Whole(1, 100_001), "x")]
    wrong += [{"crop": crops.Fixed(0)}, {"crop": crops.Whole(1, 100_000)}]
    results = [outcome(partial(refused, **options)) for options in wrong]
    data = module()

    def opened(**fields: Any) -> Any:
        source = own_source(options={"x": 1})
        for name, value in fields.items():
            setattr(source, name, value)
        other = datamodule.MotionDataModule(
            source, HumanML("smpl22"), root=str(data.folder.parent), name="own clips",
            batch_size=2, crop=crops.Whole(fields.get("shortest", 1), 60), seed=1,
        )  # fmt: skip
        other.setup("fit")
        return [
            other.counts(other.store),
            other.actions,
            len(other.train),
            len(other.clips("test")),
        ]

    return [
        results,
        [
            outcome(partial(opened, **fields))
            for fields in (
                {},
                {"options": {"x": 2}},
                {"options": {}},
                {"published_split": True},
                {"version": 2},
                {"name": "other"},
                {"shortest": 28},
                {"shortest": 47},
                {"shortest": 60},
            )
        ],
        resident.adapts_cuts(SMPL()),
        [resident.adapts_cuts(one) for one in (Rot6D(), HumanML("smpl22"), Motion272(), Rifke())],
    ]


def data_modules_without_a_split() -> Any:
    results = []
    for split, published in (("train", True), ("train", False), ("val", True), ("test", True)):
        clips = [
            replace(clip, split="train" if n % 2 else cast(Any, split), captions=[])
            for n, clip in enumerate(store_clips()[:9:3])
        ]
        root = folder("without")
        source = own_source(
            *clips, published_split=published, actions=(), named_by_recipe=not published
        )
        source.own = tuple(replace(clip, action=None) for clip in clips)
        data = datamodule.MotionDataModule(
            source,
            HumanML("smpl22"),
            root=str(root),
            name="w",
            batch_size=2,
            crop=crops.Whole(20, 60),
        )
        data.prepare_data()
        data.setup("fit")
        results.append([data.counts(data.store), len(data.test), len(data.val), data.train.advice])
        results.append([batch.text for batch in islice(iter(data.train_dataloader()), 2)])
    return results


def reports_of_stores() -> Any:
    data = module()
    report = verify.report(data)
    report.pop("files")
    written = json.loads((data.store.folder / "verify.json").read_text())
    text = [row for row in verify.lines(report) if "fingerprint" not in row]
    figures: dict[str, Any] = {}
    for name in (
        "kit",
        "humanact12",
        "humanml3d",
        "bandai",
        "uestc",
        "babel",
        "kit-temos",
        "nothing",
    ):
        store: Any = SimpleNamespace(
            clips=data.store.clips,
            info=data.store.info
            | {"dataset": name, "counts": {"clips": 3, "motions": 3911, "x": 2.5}},
        )
        figures[name] = verify._figures(store)
    parts = {"figures": figures["kit"] | figures["humanact12"] | figures["humanml3d"]}
    return [report, sorted(written), text, figures, verify.deviations(parts)]


def standing_people() -> Any:
    results = []
    for representation in (
        HumanML("smpl22"),
        HumanML("kit21"),
        SMPL(),
        Rot6D(),
        Motion272(),
        Rifke(),
    ):
        for frames in (2, 5):
            motion = standing(representation, frames)
            results.append(
                [
                    projected(motion.joints),
                    projected(motion.features, 2),
                    [
                        motion.fps,
                        motion.text,
                        motion.id,
                        motion.representation,
                        str(motion.skeleton.name),
                    ],
                ]
            )
    return results


# Folders of the user ----------------------------------------------------------------------------


@cache
def user_motions() -> Path:
    """A folder with files of several kinds, a table and text files."""
    path = folder("user")
    (path / "inner").mkdir()
    names = ["walk", "kick", "wave", "jump", "punch", "sit"]
    for number, name in enumerate(names):
        motion = Motion(bodies(20.0)[name][: 20 + 3 * number], (20, 30, 25)[number % 3])
        motion.save(
            path / ("inner" if number == 4 else "") / f"{name}.{('npz', 'bvh', 'json')[number % 3]}"
        )
    np.savez(path / "poses.npz", **amass_arrays(posed(26, heading=np.linspace(2.8, 3.6, 26))))
    rows = ["id,text,action,split,source,license"]
    for number, name in enumerate([*names[:4], "inner/punch", "sit", "poses"]):
        split = ("train", "", "", "val", "", "train", "")[number]
        source = ("", "s", "s", "", "", "t", "")[number]
        license = ("", "MIT", "", "", "CMU", "", "")[number]
        action = ("left", "right", "left", "b", "left", "b", "left")[number]
        rows += [f"{name},the left {name},{action},{split},{source},{license}"] * (number != 5)
        rows += [f"{name},and the right {name},{action},,,"] * (number % 2)
    (path / "captions.csv").write_text("\n".join(rows) + "\n")
    (path / "sit.txt").write_text("sits down#x\n\n a line \n")
    return path


def clips_of_folders() -> Any:
    results: dict[str, Any] = {}
    options: list[dict[str, Any]] = [
        {},
        {"mirror": True, "balance": 9, "license": "CMU"},
        {"mirror": True, "exclude": ["poses", "inner/punch"], "balance": 100},
        {"prefixes": {"young": ["left"], "old": ["b"]}, "balance": 2},
        {"prefixes": {"young": ["nothing"]}},
        {"exclude": ["x"]},
    ]
    for one in options:
        source = user_folder.Folder(str(user_motions()), workers=1, **one)
        results[str(one)] = outcome(lambda source=source: clips_of(source, 20))
        results[f"check {one}"] = [
            plain(row) for row in outcome(lambda source=source: source.check(12.5))
        ]
        results[f"copies {one}"] = outcome(lambda source=source: [source.copies, source.splits])
    for representation in (
        SMPL(),
        Rot6D(),
        Motion272(),
        HumanML("smpl22"),
        HumanML("kit21"),
        Rifke(),
    ):
        for kind in ("smpl", "joints"):
            source = user_folder.Folder(
                str(user_motions()),
                cast(Any, kind),
                kind == "joints",
                ["sit", "jump", "wave"],
                workers=1,
            )

            def suited(source: Any = source, representation: Any = representation) -> Any:
                source.suit(representation)
                motions = [
                    [clip.id, projected(clip.motion, 3)]
                    for clip in source.clips(representation.fps)
                ]
                return [motions, source.findings()]

            results[f"{representation.name}, {kind}"] = outcome(suited)
    source = user_folder.Folder(str(user_motions()), "smpl", workers=1)
    results["smpl"] = outcome(lambda: clips_of(source, 20))
    return results


def folders_that_are_refused() -> Any:
    walk = bodies(20.0)["walk"]

    def of(table: str | None = None, frames: int = 20, **options: Any) -> Any:
        path = folder("own")
        for name in ("a", "b", "c"):
            Motion(walk[: frames if name == "b" else 20], 20).save(path / f"{name}.npz")
        if table is not None:
            (path / "captions.csv").write_text(table)
        source = user_folder.Folder(str(path), workers=1, **options)
        clips = [clip.captions for clip in source.clips(20)]
        return [clips, source.actions, plain(source.failure_lines()), source.excluded]

    def damaged(*names: str, turn: bool = False, up: int = 1) -> Any:
        path = folder("own")
        for name in ("a.npz", "b.npz", "c.npz"):
            joints = walk[:20, :, [0, 2, 1]] if turn else walk[:20]
            np.savez(path / name, joints=joints, fps=20)
        for name in names:
            (path / name).write_bytes(b"x")
        source = user_folder.Folder(str(path), workers=up)
        lines = [clip.id for clip in source.clips(20)]
        return [
            lines,
            plain(source.failure_lines()),
            source.findings(),
            outcome(source.require_all),
        ]

    def newer() -> Any:
        path = folder("own")
        for number, name in enumerate(("a.npz", "b.txt", "s.json", "z.npz")):
            (path / name).write_text("x")
            os.utime(path / name, (1000 + number, 1000 + number))
        source = user_folder.Folder(str(path))
        os.utime(path / "s.json", (1001, 1001))
        return [plain(source.changed(path / "s.json")), plain(source.changed(path / "z.npz"))]

    upright = [[0.9, 0.2, 0.1], [0.9, 0.8], [], [0.49], [0.51], [0.3, 0.9], [0.0], [1.0, 1.0, -1.0]]
    head = "id,text,action,split\n"
    return outcomes(
        plain=lambda: of(),
        texts=lambda: of("id,text\na,one\nb,two\nc,three\na,four\n"),
        some=lambda: of("id,text\na,one\nb,two\n"),
        actions=lambda: of("id,action\na,x\nb,\n"),
        unknown=lambda: of("id,text\nz,one\n"),
        excluded=lambda: of("id,text\na,one\nb,two\nc,three\n", exclude=["c"]),
        split=lambda: of("id,split\na,all\n"),
        splits=lambda: of("id,split\na,train\na,val\n"),
        same=lambda: of("id,split\na,train\na,train\n"),
        empty=lambda: of(head + "a,,x,\nb,,y,\nc,,x,train\n"),
        short=lambda: of(frames=2),
        three=lambda: of(frames=3),
        damaged=lambda: damaged("d.npz", "e.npz"),
        twice=lambda: damaged("a.bvh"),
        lying=lambda: damaged(turn=True),
        newer=newer,
        nothing=lambda: user_folder.Folder(str(folder("own"))).count(),
        nowhere=lambda: user_folder.Folder("/nowhere").count(),
        balance=lambda: user_folder.Folder("x", balance=-1),
        mirror=lambda: user_folder.Folder("x", "smpl", mirror=True),
        upright=lambda: [
            outcome(lambda one=one: user_folder._check_upright(Path("f"), {"l": one}))
            for one in upright
        ],
    )


def lessons() -> Any:
    prior = module().folder
    clips = user_motions()
    results: dict[str, Any] = {}
    for batch_size in (4, 5):
        data = adaptation.LessonData(
            adaptation.Lesson(str(clips), str(prior)), HumanML("smpl22"), root=str(folder("lesson")),
            name="limp", batch_size=batch_size, crop=crops.Units(8, 40, 4), seed=2,
        )  # fmt: skip
        data.prepare_data()
        data.setup("fit")
        batches = data.training_batches(seed=1, first=0, rank=0, world=1)
        results[str(batch_size)] = [
            data.counts(data.store),
            data.halves(),
            list(islice(batches, 5)),
            [[clip.id, clip.split, clip.captions, clip.source] for clip in data.store.clips],
            [projected(data.store.mean), data.source.count(), data.source.options],
        ]
    results["short"] = outcome(
        lambda: replace_crop(data, crops.Units(44, 80, 4)).counts(data.store)
    )
    results["check"] = outcome(lambda: adaptation.check_clips(clips, 20))
    floating = folder("floating")
    for number, height in enumerate((0.0, 0.3)):
        moved = bodies(20.0)["walk"][:50] + [0, height, 0] * (np.arange(50) / 49)[:, None, None]
        Motion(moved, 20).save(floating / f"m{number}.npz")
    return results | {"drift": outcome(lambda: adaptation.check_clips(floating, 20))}


def replace_crop(data: Any, crop: crops.Crop) -> Any:
    data.crop = crop
    data.train = data.clips("train")
    return data


# CMU --------------------------------------------------------------------------------------------


def motionbuilder(tree: bvh.Bvh) -> bvh.Bvh:
    names = {bone: name for name, bone in cmu.FACTS["motionbuilder"].items()}
    lost = ("lowerneck", "lclavicle", "rclavicle", "lhand", "rhand")
    pose = np.concatenate([tree.frames[:1, :3], np.zeros((1, tree.frames.shape[1] - 3))], 1)
    return replace(
        tree,
        joints=tuple(names.get(name, name) for name in tree.joints),
        offsets=np.where(np.isin(tree.joints, lost)[:, None], 0, tree.offsets),
        frames=np.concatenate([pose, tree.frames]),
    )


@cache
def recordings() -> Path:
    """Recordings and a clone of HumanML3D."""
    root = folder("cmu")
    motions, clone = root / "motions", root / "clone"
    for path in (motions / "02", motions / "60", motions / "daz", clone / "HumanML3D" / "texts"):
        path.mkdir(parents=True)
    write_asf(motions / "02" / "02.asf")
    for seed, name in enumerate(("02_01", "02_02", "02_03", "18_01")):
        write_amc(motions / "02" / f"{name}.amc", 360 + 20 * seed, seed)
    tree = motionbuilder(asf.read(motions / "02" / "02_02.amc", 120))
    bvh.write(tree, motions / "60" / "60_01.bvh")
    bvh.write(replace(tree, frames=tree.frames[:300]), motions / "daz" / "60_01.bvh")
    (motions / "60" / "61_01.bvh").write_text("x")
    rows = ["CMU/02/02_01_poses.npy,0,60,000001.npy", "CMU/02/02_02_poses.npy,6,62,000002.npy"]
    rows += ["CMU/9/9_1_poses.npy,0,60,000003.npy", "CMU/60/60_01_poses.npy,20,130,000004.npy"]
    rows += ["KIT/3/x_poses.npy,0,99,000009.npy", "CMU/02/02_03_poses.npy,3,40,000005.npy"]
    rows += ["CMU/02/02_03_poses.npy,3,60,007406.npy", "CMU/61/61_01_poses.npy,3,60,000006.npy"]
    rows += ["CMU/02/02_01_poses.npy,0,55,000007.npy"]
    head = "source_path,start_frame,end_frame,new_name"
    (clone / "index.csv").write_text("\n".join([head, *rows]) + "\n")
    names = [row.split(",")[-1][:6] for row in rows]
    for name in names:
        for mark, side in (("", "left"), ("M", "right")):
            part = line(f"the {side} arm swings", 0.5, 2.65) + "\n"
            text = line(f"a person walks to the {side}") + "\n" + part * (name == "000002")
            (clone / "HumanML3D" / "texts" / f"{mark}{name}.txt").write_text(text)
    listed = {"train": ["000001", "000003", "000004", "007406"], "val": ["000005", "000006"]}
    for split, of_split in (listed | {"test": ["000002"]}).items():
        both = [mark + name for name in of_split for mark in ("", "M")]
        (clone / "HumanML3D" / f"{split}.txt").write_text("\n".join(both))
    sentence = {"duration": 360 / 120, "annotations": [{"text": "Somebody moves."}, {"text": "b"}]}
    sentences = {f"0000{k}": sentence | {"path": f"CMU/02/02_0{k}_poses"} for k in (1, 2, 3, 4)}
    sentences["9"] = sentence | {"path": "KIT/3/x_poses"}
    (clone / "kitml.json").write_text(json.dumps(sentences))
    return root


def clips_of_cmu() -> Any:
    root = recordings()

    def of(where: str | None = "clone", **options: Any) -> Any:
        target = None if where is None else str(root / where)
        source = cmu.CMU(str(root / "motions"), target, workers=1, **options)
        return clips_of(source, 20)

    def of_table(text: str, **options: Any) -> Any:
        (root / "own").mkdir(exist_ok=True)
        (root / "own" / "captions.csv").write_text(text)
        return of("own", **options)

    (root / "test").mkdir(exist_ok=True)
    index = (root / "clone" / "index.csv").read_text()
    (root / "test" / "humanml3d_index_cmu.csv").write_text(index)
    entries = [
        {"base": "000002", "mirrored": False, "segment": None, "captions": ["a", "b"]},
        {"base": "000002", "mirrored": True, "segment": [0.2, 2.6], "captions": ["c"]},
        {"base": "000001", "mirrored": False, "segment": [0, 0], "captions": ["d"]},
    ]
    (root / "test" / "humanml3d_test_captions.json").write_text(json.dumps(entries))
    head = "id,begin,end,text,action,split,source\n"
    table = head + "02_01,,,walks,w,train,\n02_01,,,goes,w,train,\n02_02,0.51,2.9,runs,r,,x\n"
    table += (
        "02_03,0.2,,sits,w,val,\n02_03,,1.5,short,s,val,\n60_01,,2.52,jumps,a,,\n77_01,,,no,w,,\n"
    )
    return outcomes(
        clone=of,
        smpl=lambda: of(motion="smpl", exclude=["02_02", "02_03", "60_01", "61_01"]),
        test=lambda: of("test"),
        nothing=lambda: of(None),
        nowhere=lambda: of("nowhere"),
        table=lambda: of_table(table),
        bare=lambda: of_table("id,text\n02_01,a\n02_02,\n"),
        actions=lambda: of_table("id,action\n02_01,a\n02_02,\n"),
        conflict=lambda: of_table("id,text,split\n02_01,a,train\n02_01,b,val\n"),
        name=lambda: of_table("id,text\n2_01x,a\n"),
        time=lambda: of_table("id,begin,text\n02_01,x,a\n"),
        huge=lambda: of_table("id,begin,text\n02_01,inf,a\n"),
        order=lambda: of_table("id,begin,end,text\n02_01,2,2,a\n"),
        negative=lambda: of_table("id,begin,end,text\n02_01,-1,2,a\n"),
        split=lambda: of_table("id,text,split\n02_01,a,all\n"),
        exclude=lambda: of(exclude=["x"]),
        damaged=lambda: of_table("id,text\n61_01,a\n"),
        empty=lambda: cmu.CMU(str(folder("own"))).count(),
    )


def rates_of_cmu() -> Any:
    results = {}
    for header in (None, 120.0, 60.0, 30.0, 100.0):
        for seconds in (None, 3.0, 6.04, 6.06, 12.0, 3.05):
            results[f"{header}, {seconds}"] = [
                cmu.decide_rate(frames, header, seconds, last, is_sixty)
                for frames in (360, 725)
                for last in (None, 0, 60, 61, 62, 119, 121, 122, 130)
                for is_sixty in (False, True)
            ]
    return {
        key: "".join({60: "s", 120: "d"}.get(int(rate), "o") for rate in row)
        for key, row in results.items()
    }


def skeletons_of_cmu() -> Any:
    original = asf.read(recordings() / "motions" / "02" / "02_03.amc", 120)
    original = replace(original, frames=original.frames[:9])
    converted = motionbuilder(original)
    moved = replace(converted, frames=converted.frames[1:])
    one = replace(converted, frames=converted.frames[:1])
    full = replace(converted, offsets=original.offsets)
    results = {}
    for name, tree in (
        ("original", original), ("converted", converted), ("moved", moved), ("one", one), ("full", full),
    ):  # fmt: skip
        standard, fields = cmu.standardize(tree)
        results[name] = [
            standard.joints,
            standard.parents,
            projected(standard.offsets),
            projected(standard.frames),
            fields,
        ]
    rows = [(name, row) for name, row in cmu.FACTS["daz"].items()]
    names = [name for name, _ in rows if name != "upperback"]
    parents = [-1, *(max(0, number - 1 - number % 3) for number in range(1, len(names)))]
    rng = np.random.default_rng(0)
    channels = ("Xposition", "Yposition", "Zposition", "Zrotation", "Xrotation", "Yrotation")
    for frames in (3, 4, 5, 8):
        values = rng.normal(size=(frames, 6 * len(names)))
        for rested in (True, False):
            if rested:
                values[0, 3:6] = 0
            else:
                values[0, 3:6] = 1
            tree = bvh.Bvh(
                tuple(names), tuple(parents), rng.normal(size=(len(names), 3)),
                (channels,) * len(names), values, 30.0,
            )  # fmt: skip
            standard, fields = cmu.standardize(tree)
            results[f"daz {frames}, {rested}"] = [
                standard.joints, standard.parents, projected(standard.offsets), projected(standard.frames), fields,
            ]  # fmt: skip
    other = replace(original, joints=tuple(f"x{name}" for name in original.joints))
    results["other"] = [cmu.standardize(other)[1], cmu.standardize(other)[0].joints]
    joints = bodies(20.0)["walk"][:42].astype(np.float32) * 0.9
    results["parts"] = [
        projected(cmu._part(joints[:count], mirrored, kind))
        for count in (39, 40, 41)
        for mirrored in (False, True)
        for kind in ("joints", "smpl")
    ]
    results["ranks"] = [
        cmu._rank(Path(name)) for name in ("a.AMC", "a.bvh", "Daz/a.bvh", "daz/a.amc")
    ]
    bad = ("18_01", "19", "106_03", "143_21", "143_20", "02_01")
    return results | {"bad": [cmu._is_in("bad", name) for name in bad]}


# Conditions -------------------------------------------------------------------------------------


def batch_of(
    text: list[str] | None = None, action: list[int] | None = None, size: int = 3
) -> MotionBatch:
    count = len(text or action or [0] * size)
    x = torch.randn(count, 5, 2, generator=torch.Generator().manual_seed(0))
    labels = None if action is None else torch.tensor(action)
    return MotionBatch(x, torch.ones(count, 5, dtype=torch.bool), ["i"] * count, text, labels)


def told(condition: Condition | None) -> Any:
    """All parts of a condition."""
    if condition is None:
        return None
    tokens = condition.tokens.detach()
    mask = None if condition.token_mask is None else condition.token_mask.int().tolist()
    return [projected(condition.pooled.detach()), projected(tokens), mask, told(condition.null)]


def seeded(network: nn.Module, seed: int = 0) -> Any:
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
    return network.double()


CAPTIONS = [
    "a person walks", "", "A man turns slowly, and walks forward!", "a person walks",
    "walking walked hops hopping four waves", "she waves with the left hand and then the right hand",
]  # fmt: skip


def learned_tokens() -> Any:
    results: dict[str, Any] = {}
    for options in combinations(
        0, 6, features=(8, 12), buckets=(50, 7), max_words=(3, 6, 32), heads=(1, 4)
    ):
        encoder = seeded(LearnedTokens(dropout=0.2, **options)).eval()
        for seen in (None, ["walk", "a", "hop", "fours", "wave", "the", "turned"]):
            encoder.seen, encoder._rows = seen, {}
            results[f"{options}, {seen is None}"] = [
                [encoder.rows(caption) for caption in CAPTIONS[:3]],
                told(encoder(batch_of(CAPTIONS))),
                told(encoder(batch_of(CAPTIONS[:1]))),
                [encoder.rows(caption) for caption in CAPTIONS[3:]],
            ]
        counts = torch.tensor([2, 4, 1])
        words = torch.randint(0, 7, (3, 4, 2), generator=torch.Generator().manual_seed(1))
        results[f"graph {options}"] = told(
            encoder.encode(words[:, : options["max_words"]], counts.clamp(max=3))
        )
    training = seeded(LearnedTokens(8, 60, heads=2, dropout=0.5, pretrain_steps=2)).train()
    torch.manual_seed(3)
    results["dropout"] = told(training(batch_of(CAPTIONS)))
    for steps, count in ((2, 5), (0, 5), (3, 1), (1, 80)):
        encoder = (
            seeded(LearnedTokens(8, 60, heads=2, dropout=0.1, pretrain_steps=steps)).float().train()
        )
        groups = [[f"a {n} b", f"c {n} d", f"a {n} b"] for n in range(count)] + [
            ["x", "x"],
            ["y"],
            [],
        ]
        encoder.pretrain(groups, 4)
        results[f"pretrained {steps}, {count}"] = [
            projected(parameter.detach()) for parameter in encoder.parameters()
        ][:4]
    results["refused"] = [
        outcome(lambda name=name: LearnedTokens(**{name: 0}))
        for name in ("features", "buckets", "max_words", "heads")
    ] + [outcome(lambda: training(batch_of()))]
    return results


def labels_and_no_conditions() -> Any:
    encoder = seeded(ActionLabels(6, 5))
    nothing = Unconditional()
    return [
        told(encoder(batch_of(action=[4, 0, 2, 2]))),
        told(nothing(batch_of(size=4))),
        [encoder.reads, nothing.reads, nothing.features, nothing.max_words, nothing.seen],
        outcome(lambda: encoder(batch_of())),
        outcome(lambda: ActionLabels(6, 0)),
        [
            nothing.load_cache([], Path("x")),
            nothing.precompute([], Path("x")),
            nothing.pretrain([], 0),
        ],
    ]


class Tokens(dict[str, Tensor]):
    """The output of a tokenizer."""

    def to(self, device: torch.device) -> "Tokens":
        return self


def tokenizer(
    texts: list[str], padding: str, truncation: bool, max_length: int, **_: Any
) -> Tokens:
    """One number per character of each word, between a start and an end."""
    rows = [[1, *(3 + len(word) % 7 for word in text.split()), 2] for text in texts]
    rows = [
        [*row[: max_length - 1], 2] if truncation and len(row) > max_length else row for row in rows
    ]
    size = max_length if padding == "max_length" else max(map(len, rows))
    ids = torch.tensor([row + [0] * (size - len(row)) for row in rows])
    return Tokens(input_ids=ids, attention_mask=(ids > 0).long())


class Loader:
    """A loader of models that returns what it is asked for."""

    @staticmethod
    def from_pretrained(name: object, **options: Any) -> str:
        if name == "org/y":
            raise OSError
        return f"{name} {sorted(options.items())}"


class Language(nn.Module):
    """A small language model, whose outputs depend on the mask."""

    def __init__(self, width: int = 6, pooled: int = 6):
        super().__init__()
        self.table = nn.Embedding(12, width)
        self.projection = nn.Linear(width, pooled)

    def forward(self, input_ids: Tensor, attention_mask: Tensor) -> Any:
        hidden = self.table(input_ids) + 0.1 * torch.arange(input_ids.shape[1])[:, None]
        hidden = hidden + (hidden * attention_mask[..., None]).mean(1, keepdim=True)
        return SimpleNamespace(last_hidden_state=hidden, text_embeds=self.projection(hidden[:, 1]))


def pretrained(options: dict[str, Any], features: int = 6, pooled: int = 6) -> Any:
    """A text encoder with a small language model."""
    network = seeded(Language(6, pooled)).float()

    class Small(Pretrained):
        tokenizer = staticmethod(tokenizer)  # type: ignore[assignment]

        def load_network(self) -> nn.Module:
            return network

    before, text = Pretrained, cast(Any, __import__("flame_mdm.conditions.text", fromlist=["text"]))
    text.Pretrained = Small
    try:
        return PretrainedText("org/small", features, **options)
    finally:
        text.Pretrained = before


def pretrained_texts() -> Any:
    results: dict[str, Any] = {}
    root = folder("texts")
    for options in combinations(
        2, 26, max_tokens=(5, 9), pooling=("projection", "mean", "pooler"), normalize=(False, True),
        tokens=(False, True), attend_padding=(False, True), encode_null=(False, True), freeze=(True, False),
    ):  # fmt: skip
        encoder = pretrained(options).eval()
        results[str(options)] = [
            told(encoder(batch_of(CAPTIONS))),
            told(encoder(batch_of(CAPTIONS[1:3]))),
        ]
        encoder.precompute(CAPTIONS, root)
        size = encoder.load_cache(CAPTIONS[::-1], root)
        encoder.move_cache(CPU)
        results[str(options)] += [
            size,
            told(encoder(batch_of(CAPTIONS[2:]))),
            told(encoder(batch_of(["another", "a person walks"]))),
            sorted(name for name, _ in [*encoder.named_parameters(), *encoder.named_buffers()]),
        ]
    results["files"] = len(list(root.glob("*")))
    options = {"max_tokens": 5, "pooling": "mean"}
    paths = {
        str(change): pretrained(options | change)._cache_path(CAPTIONS, Path("f")).name
        for change in (
            {}, {"max_tokens": 6}, {"pooling": "pooler"}, {"tokens": True}, {"attend_padding": True},
            {"normalize": True}, {"encode_null": True}, {"revision": "r"}, {"sha256": "s"}, {"package": "p"},
        )
    }  # fmt: skip
    results["paths"] = paths
    results["order"] = pretrained(options)._distinct(["b", "a", "ccc", "b", "dd"])
    projected_pool = {"max_tokens": 5, "pooling": "projection"}
    results |= outcomes(
        captions=lambda: pretrained(options)(batch_of()),
        width=lambda: pretrained(options, features=7)(batch_of(CAPTIONS)),
        pooled=lambda: pretrained(projected_pool, pooled=5)(batch_of(CAPTIONS)),
        missing=lambda: pretrained(options).load_cache(["x"], root / "nothing"),
        revision=lambda: Pretrained("org/x", "abc", None, None).tokenizer,
        none=lambda: Pretrained("org/x", None, None, None).tokenizer,
        package=lambda: Pretrained("org/x", None, "a.b", None).tokenizer,
        local=lambda: plain(Pretrained(str(root), None, None, None)._load(Loader)),
        pinned=lambda: Pretrained("org/x", "0a" * 20, None, None)._load(Loader, dtype="float32"),
        long=lambda: Pretrained("org/x", "0a" * 20 + "0", None, None)._load(Loader),
        offline=lambda: Pretrained("org/y", "0a" * 20, None, None)._load(Loader),
        absent=lambda: Pretrained("org/x", None, "absent_package", None).tokenizer,
        folder=lambda: plain(Pretrained(str(root), None, None, None)._folder()),
        match=lambda: EncodedCaptions(
            ["a"], torch.zeros(2, 3), torch.zeros(4, 3), torch.tensor([0, 4])
        ),
        end=lambda: EncodedCaptions(
            ["a"], torch.zeros(1, 3), torch.zeros(4, 3), torch.tensor([0, 3])
        ),
    )
    many = [f"{'word ' * (number % 5)}{number}" for number in range(70)]
    encoder = pretrained(options | {"tokens": True}).eval()
    results["many"] = told(encoder(batch_of(many[::-1])))[:2]
    return results


def target_conditions() -> Any:
    rng = torch.Generator().manual_seed(0)
    results: dict[str, Any] = {}
    choices = [
        ["left_wrist"],
        ["heading", "pelvis"],
        ["traj", "head", "right_foot"],
        [],
        list(target.SLOTS),
    ]
    for number, options in enumerate(
        combinations(0, 8, weight=(1.0, 2.5), heading_modulo_pi=(False, True), drop_prob=(0.0, 0.4))
    ):
        targets = target.TargetConditions(SMPL22.joints, SMPL22.facing, choices=choices, **options)
        joints = torch.randn(10, 7, 22, 3, generator=rng, dtype=torch.float64)
        other = torch.randn(10, 7, 22, 3, generator=rng, dtype=torch.float64)
        other[::2] = joints[::2] + 0.1
        u = torch.linspace(0, 0.999, 10, dtype=torch.float64)
        lengths = torch.tensor([7, 3, 1, 5, 7, 2, 6, 4, 7, 1]) if number % 2 else None
        drawn = targets.draw(joints, u, lengths)
        facing = joints[:, -1, list(SMPL22.facing)]
        results[str(options)] = [
            projected(targets.locations(joints, lengths)),
            drawn[..., 3].int().tolist(),
            projected(drawn),
            targets.error(other, drawn, lengths).tolist(),
            targets.error(other.flip(0), drawn).tolist(),
            target.heading(facing).tolist(),
            [targets.weight, targets.drop_prob, targets.heading_modulo_pi],
        ]
    default = target.TargetConditions(SMPL22.joints, SMPL22.facing, choices=[["head"]])
    results["default"] = [default.weight, default.drop_prob, default.heading_modulo_pi]

    def refused(joints: Sequence[str] = SMPL22.joints, **options: Any) -> Any:
        defaults: dict[str, Any] = {"choices": [["head"]]}
        return target.TargetConditions(joints, SMPL22.facing, **(defaults | options))

    return results | outcomes(
        skeleton=lambda: refused(KIT21.joints),
        name=lambda: refused(choices=[["head"], ["left_wirst", "x"]]),
        empty=lambda: refused(choices=[]),
        high=lambda: refused(drop_prob=1.01),
        low=lambda: refused(drop_prob=-0.1),
        one=lambda: refused(drop_prob=1).drop_prob,
        mask=lambda: target.COORDINATES.on(CPU),
    )


VERBS = [
    "walks",
    "walk",
    "walking",
    "turns",
    "turn",
    "waves",
    "sits",
    "raises",
    "jumps",
    "jump",
    "runs",
]


def words_of_captions() -> Any:
    texts = ["A man's 3 walks_2!", "", "ÜBER-straße", "a\tb\nc"]
    seen = ["walk", "hop", "waves", "turned", "goes", "four", "dances", "a"]
    forms = [
        "walks",
        "walked",
        "walking",
        "hopping",
        "hopped",
        "wave",
        "waving",
        "turn",
        "going",
        "go",
    ]
    forms += ["fours", "four", "five", "dance", "danced", "as", "walkeds", "hoping", "wakes"]
    captions = [f"caption {number}" for number in range(1005)]
    shared = vocabulary.vocabulary(captions, captions[::-1] + captions)
    few = vocabulary.vocabulary(["A b", "b c", "A b"], ["z", "y", "z"])
    facts: dict[str, Any] = {
        "vocabulary": ["a", "person", "walks", "waves", "hand", "left", "jumps", "the"],
        "captions": ["a person walks", "a person waves the left hand", "a person jumps"],
    }
    prompts_of = ["a person walks", "a persn walks", "a person wakls quickly", "someone strolls", "the of",
                  "a shelf", "zzzz qqqq", "leaps with the hand", "walking waved \\1 lefft", ""]  # fmt: skip
    captions_of = ["a person walks", "walks left", "a person walks left and waves", "the left hand"]
    captions_of += ["left", "he jumps twice over a left and a right box", "jumps twice", "a the of"]
    return {
        "words": [vocabulary.words(text) for text in texts],
        "hashed": [
            vocabulary.hashed(word, size) for word in ("walk", "a", "ü") for size in (7, 4096)
        ],
        "forms": {form: vocabulary.known_form(form, seen) for form in forms},
        "shared": [len(shared["captions"]), shared["captions"][::199], len(shared["vocabulary"])],
        "few": [few, vocabulary.vocabulary(["A b"]), vocabulary.vocabulary([], [])],
        "advice": {
            text: [
                vocabulary.advice(text, facts),
                vocabulary.advice(text, facts, 2),
                vocabulary.advice(text, {}, 3),
                outcome(partial(vocabulary.check_known, text, facts)),
                outcome(partial(vocabulary.check_known, text, {"vocabulary": ["x"]})),
                vocabulary.unknown_words(text, facts),
                vocabulary.nearest(text, facts["captions"]),
                vocabulary.nearest(text, facts["captions"], 1),
            ]
            for text in prompts_of
        },
        "nearest": [
            vocabulary.nearest(text, captions_of, *count)
            for text in (
                "a person walks left",
                "the left hand waves",
                "the a",
                "runs",
                "jumps left twice",
            )
            for count in ((), (1,), (9,))
        ],
        "plain": vocabulary.plainest(["b", "a person x y", "a person z", "aa", "a", "a persona"]),
    }


def sentences_in_parts() -> Any:
    texts = [
        "walks, turns left and waves. Then she sits", "raises both hands and waves", "walks then turns",
        "a person walks, and then jumps in limp style", "first walks; finally sits!", "He walks\nShe sits.",
        "walks slowly, left and right, jumps and runs", "walks and then", "then", "", "a man quickly jumps",
        "walks, the man sits, slowly turns and it jumps afterwards", "sits after that runs, up", "left, right. up",
        "a person walking, turns, walking and waves", "walks. The hand. Sits in proud style", "jump, a b turn",
    ]  # fmt: skip
    return {
        text: [vocabulary.in_parts(text, verbs) for verbs in (VERBS, (), ["walking"])]
        for text in texts
    }


def prompts_as_models_read_them() -> Any:
    captions = [
        f"a person {verb}" for verb in ("walks", "jumps", "waves", "sits", "turns left", "runs")
    ]
    words = sorted(
        {word for caption in captions for word in caption.split()} | {"twice", "left", "slowly"}
    )
    simple: dict[str, Any] = {"vocabulary": words, "captions": captions, "verbs": VERBS}
    actions: dict[str, Any] = simple | {
        "actions": ["walk", "jump", "wave", "sit", "turn", "run", "kick", "punch"]
    }
    actions["vocabulary"] = [
        *words,
        "kicks",
        "punches",
        "with",
        "the",
        "right",
        "leg",
        "and",
        "hand",
        "three",
        "times",
    ]
    sentences = ["walks", "walks happily then jumps", "a person kicks three times", "zzz", "jumps twice and waves",
                 "kick left, then kick right", "someone strolls slowly", "", "sits | walks"]  # fmt: skip
    results: dict[str, Any] = {}
    for number, text in enumerate(sentences):
        for options in (
            {},
            {"splits": True},
            {"check_words": False},
            {"splits": True, "check_words": False},
        ):
            for name, facts in (("simple", simple), ("actions", actions), ("none", {})):
                parts: list[tuple[str, float | None]] = [(text, None)]
                if "splits" not in options and number % 2:
                    parts = [(text, 2.5), ("jumps three times", None), ("walks and then sits", 1.0)]
                words_read = (None, 3)[number % 2]
                results[f"{text}, {options}, {name}"] = outcome(
                    partial(prompts.read_prompt, text, parts, facts, words_read, **options)
                )
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
