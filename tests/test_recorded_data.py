"""Results of the readers of data sets, as recorded."""

import bz2
import gzip
import io
import json
import lzma
import pickle
import shutil
import tarfile
import zipfile
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from support.motions import posed
from support.recorded import Case, cases_of, check, record
from support.recorded_data import (
    clips_of,
    described,
    folder,
    outcome,
    outcomes,
    plain,
    projected,
    temporary,
)
from support.stores import (
    BONES,
    RECORDINGS,
    TAKES,
    OwnClips,
    amass_file,
    label,
    line,
    sequence,
    synthetic_take,
    write_amass,
    write_babel,
    write_body,
    write_downloads,
    write_folder,
    write_humanact12,
    write_mmm,
    write_uestc,
    written,
)

from flame_mdm import data as data_sets
from flame_mdm.data import (
    SPLITS,
    Clip,
    Split,
    adaptation,
    amass,
    archives,
    babel,
    bandai,
    body_model,
    captions,
    humanact12,
    humanml3d,
    kit,
    mixture,
    parallel,
    restricted_pickle,
    t2m,
    uestc,
)
from flame_mdm.formats import bvh

NAME = "data"


# Helpers of all data sets -----------------------------------------------------------------------


def names_and_hashes() -> Any:
    names = [f"motion {number}" for number in range(40)]
    return {
        "some": [data_sets.some(names[:count]) for count in (0, 1, 4, 5, 6, 7, 40)],
        "hashes": [str(data_sets.name_hash(name)) for name in names[:3]],
        "splits": [
            [data_sets.hashed_split(name, val, test) for name in names]
            for val, test in ((5, 10), (20, 30), (0, 50), (80, 20), (0, 0), (30, 0))
        ],
        "blocks": [
            data_sets.split_blocks(f"set {clips}", clips, size, val=val, test=test)
            for clips, size in ((37, 10), (40, 10), (41, 5), (1, 5), (3, 1), (99, 3))
            for val, test in ((0.1, 0.2), (0.05, 0.1), (0.3, 0.34))
        ],
    }


def mirrored_texts_and_clips() -> Any:
    texts = [
        "the Left hand, RIGHT foot",
        "leftover bright lefts",
        "turn clockwise",
        "Anticlockwise",
    ]
    texts += ["a counterclockwise left", "raise-up-right-hand", "kick_left", "left1", "uprightleft"]
    motion = np.random.default_rng(0).normal(size=(3, 22, 3))
    clip = Clip("a", motion, texts[:2], "val", "b", 1, {"side": "left", "count": 2}, license="MIT")
    actions = ["kick left", "kick right", "wave right", "stand"]
    others = [Clip("c", motion, [], "train", "c", action) for action in (None, 0, 2, 3)]
    return {
        "texts": [data_sets.swap_sides(text) for text in texts],
        "clips": [described(data_sets.mirrored(one, -motion, actions)) for one in (clip, *others)],
    }


def defaults_of_sources() -> Any:
    source = OwnClips(*(Clip(name, np.zeros(3), [], "train", name) for name in "abc"))
    source.exclude = ("b",)
    source.leave_out("nothing", 0)
    source.leave_out("one")
    source.leave_out("three", 3)
    kept = source.not_excluded({"a": 1, "b": 2, "c": 3}, Path("x"))
    source.exclude = ("z", "y", "a")
    named: Any = OwnClips()
    named.named_by_recipe = True
    return outcomes(
        kept=lambda: [kept, dict(source.excluded)],
        unknown=lambda: source.not_excluded({"a": 1}, Path("x")),
        check=lambda: source.check(20),
        fps=lambda: source.check_fps(12.5, 20),
        same=lambda: source.check_fps(12.5, 12.5),
        share=lambda: [source.may_share_captions(name) for name in ("", "MIT")],
        rest=lambda: [source.counts(), source.findings(), source.changed(Path("x"))],
        more=lambda: [source.licenses(), source.statistics(), source.failure_lines()],
        advice=lambda: [data_sets.advice_on_splits(source), data_sets.advice_on_splits(named)],
        required=lambda: data_sets.required(Path("/nowhere/x"), "get it"),
        fingerprints=lambda: [source.version, source.workers, source.options, source.verbs],
    )


def results_in_order() -> Any:
    def numbers(count: int) -> Iterable[int]:
        yield from range(count)

    return {
        f"{count}, {workers}": list(parallel.in_order(str, numbers(count), workers))
        for count in (0, 1, 7)
        for workers in (0, 1)
    }


# Caption tables ---------------------------------------------------------------------------------


def rows_of_tables() -> Any:
    path = folder("tables") / "captions.csv"
    texts = {
        "plain": 'id,text,split\na,one,train\nb, two ,\n\nc,"x, y",val\n',
        "marked": "\ufeffid,action\r\na,walk\r\n",
        "twice": "id,id\na,b\n",
        "lacks": "name,text\na,b\n",
        "unknown": "id,colour\na,b\n",
        "more": "id,text\na,b,c\n",
        "fewer": "id,text\na\n",
        "quotes": 'id,text\na,"b\n',
        "empty": "",
        "all": "id,text,action,split,source,license\n1,2,3,4,5,6\n",
        "lines": 'id,text\na,"b\nc"\nd,e,f\n',
    }

    def read(text: str, columns: Any) -> Any:
        path.write_text(text)
        read = captions.table_rows(path, columns) if columns else captions.table_rows(path)
        return [(plain(where), row) for where, row in read]

    return {
        f"{name}, {columns}": outcome(partial(read, text, columns))
        for name, text in texts.items()
        for columns in (None, ("id", "text"))
    } | {
        name: outcome(partial(captions.known_split, name)) for name in ("train", "val", "Test", "")
    }


def splits_that_are_drawn() -> Any:
    results = []
    rng = np.random.default_rng(0)
    for count in (1, 2, 3, 5, 9, 10, 11, 14, 30):
        for groups in (2, 4, count):
            for share in (0.0, 0.3, 0.8):
                sources = {f"m{n}": f"s{count}-{n % groups}" for n in range(count)}
                drawn = rng.random(count) < share
                stated: dict[str, Split | None] = {
                    name: cast(Split, str(rng.choice(SPLITS))) if is_drawn else None
                    for name, is_drawn in zip(sources, drawn, strict=True)
                }
                results.append(
                    "".join(s[0:2] for s in captions.drawn_splits(sources, stated).values())
                )
    return results


# Text data sets ---------------------------------------------------------------------------------


def descriptions_of_text_files() -> Any:
    texts = [
        line("a person walks"),
        line("it # runs", 1.25, 3.5),
        f"  {line('waves', 'nan', 'nan')}  \n\n{line('sits', 0, 2)}",
        f"{line('a')}\nb#c#0.0",
        "a#b/X#one#2",
        "",
    ]
    return [outcome(partial(t2m.parse, text, "file.txt")) for text in texts]


def cuts_of_motions() -> Any:
    tags = [(0, 0), (0.5, 2.6), (0.5, 2.6), (1, 2), (0, 3.01), (2.05, 9.0), (1.3, 12.5), (0, 0)]
    tags += [(0.25, 0), (4, 3), (0.55, 2.55)]
    described_parts = [t2m.Description(f"d{n}", ["t"], *tag) for n, tag in enumerate(tags)]
    return {
        f"{frames}, {shortest}, {count}": t2m.cuts(
            "m", frames, described_parts[first:count], shortest
        )
        for frames in (23, 24, 40, 41, 59, 61, 120, 199, 200, 260)
        for shortest in (24, 40)
        for first, count in ((0, 11), (1, 7), (0, 1))
    }


def clips_of_cuts() -> Any:
    motion = np.random.default_rng(0).normal(size=(50, 4))
    with_tokens = [t2m.Description("a", ["x"]), t2m.Description("b", ["y", "z"])]
    without = [*with_tokens, t2m.Description("c", [])]
    return (
        [
            described(t2m.Cut("n", 3, 41, texts).clip(motion, "val", "s", *encoded, **facts))
            for texts in (with_tokens, without)
            for encoded, facts in (((), {}), (("kit",), {"recording": "r"}))
        ]
        + [t2m.frame_tokens([f"w{n}" for n in range(count)]) for count in (0, 1, 19, 20, 21, 30)]
        + [t2m.words_of(text) for text in ("A man's (left) hand_2 —Ünder 3x!", "", "__")]
    )


def text_motions(width: int, mirror: bool = True) -> Path:
    """A folder with motions of all kinds of lengths and captions."""
    path = folder(f"text-{width}-{mirror}")
    motions = {
        "000000": (61, [line("a person walks"), line("somebody waves twice", 0.25, 2.5)]),
        "000001": (39, [line("too short for one set")]),
        "000002": (200, [line("too long")]),
        "000003": (199, [line("long"), line("long part", 0, 9.9), line("short part", 0, 1)]),
        "000004": (80, []),
        "000005": (81, [line("only a short part", 1, 2)]),
        "000006": (24, [line("a person's 3 jumps")]),
        "000007": (23, [line("short")]),
        "000008": (47, [line("a test walks"), line("a walk tests", 0.1, 2.3)]),
    }
    splits = {
        "train": ["000000", "000001", "000002", "000003"],
        "val": ["000004", "000005", "000006"],
        "test": ["000007", "000008"],
    }
    write_folder(path / "set", motions, splits, width, mirror)
    (path / "set" / "texts" / "orphan.txt").write_text(line("no motion") + "\n")
    (path / "set" / "new_joint_vecs" / ".half.npy").write_text("")
    return path / "set"


def processed_folders() -> Any:
    results: dict[str, Any] = {}
    for mirror in (True, False):
        for exclude in ((), ("000003",)):
            sources: list[tuple[Any, float]] = [
                (humanml3d.HumanML3D(str(text_motions(263, mirror)), exclude), 20.0),
                (kit.KIT(str(text_motions(251, mirror)), exclude), 12.5),
            ]
            for source, fps in sources:
                name = f"{source.name}, {mirror}, {exclude}"
                results[name] = clips_of(source, fps)
                results[name] |= {"mean": source.statistics()[0], "std": source.statistics()[1]}
                results[name] |= {"check": source.check(fps), "names": source.names}
    return results


def processed_folders_that_are_damaged() -> Any:
    def changed(change: Callable[[Path], object], width: int = 251) -> Any:
        path = text_motions(width)
        change(path)
        source = kit.KIT(str(path), ["000002"])
        return [source.count(), [clip.id for clip in source.clips(12.5)], dict(source.excluded)]

    def zipped(path: Path) -> None:
        with zipfile.ZipFile(path / "texts.zip", "w") as archive:
            for file in (path / "texts").glob("*.txt"):
                archive.write(file, f"texts/{file.name}")
        shutil.rmtree(path / "texts")

    def saved(name: str, values: Any) -> Callable[[Path], object]:
        return lambda path: np.save(path / name, values)

    ramp = np.linspace(-1, 1, 251)
    return {
        name: outcome(partial(changed, change))
        for name, change in {
            "zip": zipped,
            "no texts": lambda path: shutil.rmtree(path / "texts"),
            "no split": lambda path: (path / "val.txt").unlink(),
            "two splits": lambda path: (path / "val.txt").write_text("000000\n"),
            "no motion": lambda path: (path / "new_joint_vecs" / "000001.npy").unlink(),
            "no text": lambda path: (path / "texts" / "M000001.txt").unlink(),
            "no mean": lambda path: (path / "Mean.npy").unlink(),
            "shape": saved("Mean.npy", ramp[:250]),
            "zero": saved("Std.npy", np.abs(ramp)),
            "zeros": saved("Std.npy", ramp * 0),
            "nan": saved("Mean.npy", ramp * np.nan),
            "dimensions": saved("new_joint_vecs/000000.npy", ramp),
            "text": saved("new_joint_vecs/000000.npy", np.array([["a"]])),
            "line": lambda path: (path / "texts" / "000001.txt").write_text("a#b"),
        }.items()
    } | {
        "fps": outcome(lambda: next(iter(kit.KIT(str(text_motions(251))).clips(20)))),
        "exclude": outcome(lambda: kit.KIT(str(text_motions(251)), ["x", "y"]).count()),
        "folder": outcome(lambda: kit.KIT("/nowhere").count()),
    }


# KIT-ML as TEMOS reads it -----------------------------------------------------------------------


def kit_as_in_temos() -> Any:
    root = folder("temos")
    path = write_mmm(root)

    def source(**options: Any) -> kit.KITTemos:
        return kit.KITTemos(str(path), str(root / "kit-splits"), workers=1, **options)

    results: dict[str, Any] = {
        "all": clips_of(source(), 12.5),
        "some": clips_of(source(exclude=["00002", "00004"]), 12.5),
        "frames": source().frames,
        "joints": [
            projected(kit.read_joints(path / "00002_fke.csv", *step)) for step in ((), (3,))
        ],
        "fps": outcome(lambda: next(iter(source().clips(20)))),
    }
    (root / "kit-splits" / "ghosh-test").unlink()
    results["no list"] = [source().ghosh_test, source().counts()]

    def changed(name: str, text: str) -> Any:
        before = (path / name).read_text()
        (path / name).write_text(text)
        result = outcome(lambda: len(list(source().clips(12.5))))
        (path / name).write_text(before)
        return result

    row = ",".join(["1.5"] * 64)
    return (
        results
        | {
            f"{name}, {number}": changed(name, text)
            for number, (name, text) in enumerate(
                [
                    ("00001_annotations.json", '["a"]'),
                    ("00001_annotations.json", '["a", 3]'),
                    ("00001_annotations.json", '{"a": 1, "b": 2}'),
                    ("00001_meta.json", "[2]"),
                    ("00007_fke.csv", "head\n"),
                    ("00007_fke.csv", f"head\n{row},1\n"),
                    ("00007_fke.csv", f"head\n{row.replace('1.5', 'nan', 1)}\n"),
                    ("00007_fke.csv", f"head\n{row.replace('1.5', 'x')}\n"),
                    ("00007_fke.csv", f"head\n{row}\n"),
                ]
            )
        }
        | {"no folder": outcome(lambda: kit.KITTemos("/nowhere", str(root / "kit-splits")).count())}
    )


# Action data sets -------------------------------------------------------------------------------


def clips_of_humanact12() -> Any:
    path = write_humanact12(folder("act12") / "raw", 130).parent
    results: dict[str, Any] = {
        str(published): clips_of(humanact12.HumanAct12(str(path), published), 20.0)
        for published in (False, True)
    }
    for result in results.values():
        clips = result["clips"]
        result["clips"] = clips[::19]
        result["splits"] = [(clip["id"], clip["split"], clip["source"]) for clip in clips]
    return results | {"fps": outcome(lambda: next(humanact12.HumanAct12(str(path)).clips(30)))}


def action_files_that_are_damaged() -> Any:
    root = folder("damaged")
    pose, joints = np.zeros((3, 72)), np.zeros((3, 24, 3))

    def of(**content: Any) -> Any:
        path = written(root / "humanact12poses.pkl", content)
        return humanact12.HumanAct12(str(path)).count()

    struct = root / "struct.npy"

    def unconstrained(shape: Sequence[int], kind: Any = float) -> Any:
        np.save(struct, np.random.default_rng(0).normal(size=shape).astype(kind))
        return projected(humanact12.read_unconstrained(struct))

    return outcomes(
        good=lambda: of(poses=[pose], joints3D=[joints], y=[11]),
        tuple=lambda: of(poses=(pose,), joints3D=np.array([joints]), y=[0]),
        label=lambda: of(poses=[pose], joints3D=[joints], y=[12]),
        negative=lambda: of(poses=[pose], joints3D=[joints], y=[-1]),
        shape=lambda: of(poses=[pose[:, :66]], joints3D=[joints], y=[1]),
        frames=lambda: of(poses=[pose], joints3D=[joints[:2]], y=[1]),
        empty=lambda: of(poses=[pose[:0]], joints3D=[joints[:0]], y=[1]),
        text=lambda: of(poses=["a"], joints3D=[joints], y=[1]),
        unequal=lambda: of(poses=[pose], joints3D=[joints], y=[1, 2]),
        number=lambda: of(poses=[pose], joints3D=[joints], y=3),
        lacks=lambda: of(poses=[pose], y=[1]),
        no_dict=lambda: humanact12.HumanAct12(str(written(root / "list.pkl", [1]))).count(),
        missing=lambda: humanact12.HumanAct12("/nowhere").count(),
        struct=lambda: unconstrained((2, 16, 3, 5)),
        fifteen=lambda: unconstrained((3, 15, 3, 2), np.float32),
        fourteen=lambda: unconstrained((3, 14, 3, 2)),
        axes=lambda: unconstrained((3, 15, 2, 2)),
        dimensions=lambda: unconstrained((3, 15, 3)),
        bools=lambda: unconstrained((3, 15, 3, 2), bool),
    )


def clips_of_uestc() -> Any:
    path = write_uestc(folder("uestc") / "raw")
    results: dict[str, Any] = {}
    for published in (False, True):
        result = clips_of(uestc.UESTC(str(path), published), 20.0)
        clips = result["clips"]
        result["clips"] = [*clips[::17], *clips[-7:]]
        result["splits"] = [(clip["id"], clip["split"]) for clip in clips]
        results[str(published)] = result

    def changed(name: str, change: Callable[[str], str]) -> Any:
        file = path / "info" / name
        before = file.read_text()
        file.write_text(change(before))
        result = outcome(lambda: [c.id for c in uestc.UESTC(str(path)).clips(20)][-9:])
        file.write_text(before)
        return result

    numbers = (path / "info" / "num_frames_min.txt").read_text().splitlines()
    short = [0, 44, 45, 46, 1] * 20
    limits = "\n".join(map(str, [*short[: len(numbers) - 1], 0])) + "\n"
    return results | {
        "limits": changed("num_frames_min.txt", lambda _: limits),
        "fewer": changed("num_frames_min.txt", lambda text: text.partition("\n")[2]),
        "numbers": changed("num_frames_min.txt", lambda text: "x" + text),
        "name": changed("names.txt", lambda text: text.replace("_d0_", "_e0_", 1)),
        "action": changed("action_classes.txt", lambda _: "a\nb\n"),
        "suffix": changed("names.txt", lambda text: text.replace("_color.avi", "")),
        "fps": outcome(lambda: next(uestc.UESTC(str(path)).clips(30))),
    }


def front_views() -> Any:
    rng = np.random.default_rng(3)
    pose, root = rng.normal(size=(6, 72)), rng.normal(size=(6, 3))
    camera = rng.normal(size=(6, 4)) * [0.5, 0.5, 1, 1] + [0.1, 0, 0, 0]
    return [
        uestc.front_view(pose, root, camera, uestc.Video(0, "a", 1, view, 2, side))
        for side in (1, 2)
        for view in range(8)
    ]


# AMASS ------------------------------------------------------------------------------------------


def keys_of_amass() -> Any:
    paths = [
        "BMLrub/rub001/0000_x_poses.npz",
        "./pose_data/BioMotionLab_NTroje/rub001/A b_poses.npy",
    ]
    paths += ["KIT/3/Kick High_stageii.npz", "x/y.npz", "CMU.npz", "CMU/CMU/80/80_63_poses.npz"]
    paths += [
        "Eyes_Japan_Dataset/a.b/pose-06.npz",
        "eyes japan dataset/hamada/p.npz",
        "DFaust_67/x/y",
    ]
    paths += ["MPI_HDM05/dg/x.npz", "MPIHDM05/dg/x.npz", "SSM_synced/x/y.npz", "ACCAD/KIT/b/c.npz"]
    return [(path, amass.key_of(path)) for path in paths] + [sorted(amass.SUBSETS)]


def recordings_of_amass() -> Any:
    root = folder("amass")

    def read(fps: float, **changed: Any) -> Any:
        content: dict[str, Any] = amass_file(1, 31, fps, "female") | changed
        np.savez(root / "x.npz", **{k: v for k, v in content.items() if v is not None})
        file = root / "x.npz"
        recording = amass.read(file.read_bytes() if fps == 100 else file, "x.npz")
        parts = [recording.every(rate) for rate in (12.5, 20)] + [recording.cut(slice(2, 9))]
        return [
            [recording.gender, recording.fps],
            [projected(part.parameters()) for part in [recording, *parts]],
        ]

    poses = amass_file(1, 31, 60, "female")["poses"]
    damaged = poses.copy()
    damaged[3, 5] = np.inf
    return {
        str(rate): outcome(partial(read, rate))
        for rate in (12.5, 19.99, 20, 30, 59.94, 100, 120, 250)
    } | outcomes(
        bytes=lambda: read(60, gender=np.array(b"male")),
        neutral=lambda: read(60, gender=np.array(["neutral"])),
        genders=lambda: read(60, gender=np.array(["a", "b"])),
        lacks=lambda: read(60, betas=None),
        shape=lambda: read(60, poses=poses[:, :150]),
        frames=lambda: read(60, trans=np.zeros((30, 3))),
        betas=lambda: read(60, betas=np.zeros((2, 8))),
        infinite=lambda: read(60, poses=damaged),
        text=lambda: read(60, betas=np.array(["a"])),
        integers=lambda: read(60, betas=np.arange(10)),
        rate=lambda: read(60, mocap_framerate=np.array(-3.0)),
        empty=lambda: read(60, poses=poses[:0], trans=np.zeros((0, 3))),
    )


def facts_of(argument: Any, recording: amass.Recording) -> Any:
    """A function of recordings, to be mapped."""
    return [argument, recording.fps, projected(recording.parameters(), 2)]


def folders_of_amass() -> Any:
    root = folder("unpacked")
    for name, content in RECORDINGS.items():
        path = root / f"{name}.npz"
        path.parent.mkdir(parents=True, exist_ok=True)
        np.savez(path, **content)  # type: ignore[arg-type]
    (root / "nothing.npz").write_bytes(b"")
    with tarfile.open(root / "BMLrub.tar.gz", "w:gz", compresslevel=1) as archive:
        for name in ("ACCAD", "KIT"):
            archive.add(root / "KIT" / "3", f"{name}/x")
        archive.add(root / "BMLrub")
    shutil.rmtree(root / "BMLrub")
    with tarfile.open(root / "ACCAD.tar", "w") as archive:
        archive.add(root / "CMU" / "80" / "80_63_poses.npz", "ACCAD/s/one_poses.npz")
        archive.add(root / "CMU" / "80" / "80_63_poses.npz", "ACCAD/s/two_poses.npz")
    data = amass.Amass(root)
    rub = amass.key_of("BMLrub/rub001/0000_treadmill_norm_poses")
    keys = [*data.files, "ACCAD/s/two_poses", "ACCAD/s/one_poses", str(rub)]
    mapped = dict(zip(keys, range(len(keys)), strict=True))
    return outcomes(
        files=lambda: {key: plain(path) for key, path in sorted(data.files.items())},
        archives=lambda: {key: plain(path) for key, path in sorted(data.archives.items())},
        all=lambda: list(data.map(mapped, facts_of, 1)),
        one=lambda: list(data.map({"ACCAD/s/one_poses": "x"}, facts_of, 1)),
        lost=lambda: list(data.map({"ACCAD/s/a": 1, "ACCAD/s/b": 2}, facts_of, 1)),
        missing=lambda: data.missing([*keys, "KIT/3/b", "KIT/3/a", "SSM_synced/x/y", "CMU/1/1"]),
        check=lambda: data.check(["SSM_synced/x/y", "ACCAD/z", "KIT/4/c"]),
        nowhere=lambda: amass.Amass(Path("/nowhere")).check(["KIT/a/b"]),
    )


def models_of_bodies() -> Any:
    root = folder("bodies")
    write_body(root / "male" / "model.npz", 0)
    write_body(root / "smplh" / "female" / "model.npz", 1)
    shutil.copy(root / "male" / "model.npz", root / "SMPLH_NEUTRAL.npz")
    recordings = [
        amass.Recording(content["poses"], content["trans"], content["betas"][:betas], "male", 60)
        for content in (amass_file(4, 12, 60, "male"),)
        for betas in (0, 3, 10, 16)
    ]
    rng = np.random.default_rng(5)
    parents = [2**32 - 1, *body_model.SMPL24.parents[1:]]
    model: dict[str, Any] = {
        "J_regressor": rng.random((24, 30)),
        "v_template": rng.normal(size=(30, 3)),
        "kintree_table": np.array([parents, range(24)]),
        "shapedirs": np.zeros((30, 3, 4)),
    }

    def offsets(**changed: Any) -> Any:
        np.savez(root / "smpl.npz", **(model | changed))
        written(root / "smpl.pkl", model | changed)
        return [body_model.load_offsets(root / name) for name in ("smpl.npz", "smpl.pkl")]

    def joints(gender: str) -> Any:
        body = body_model.load_body(root, gender)
        return [projected(body.joints(recording)) for recording in recordings]

    wrong = np.array(parents)
    wrong[5] = 1
    return outcomes(
        male=lambda: joints("male"),
        female=lambda: joints("female"),
        neutral=lambda: joints("neutral"),
        missing=lambda: joints("other"),
        offsets=offsets,
        vertices=lambda: offsets(v_template=model["v_template"][:29]),
        axes=lambda: offsets(v_template=model["v_template"][:, :2]),
        tree=lambda: offsets(kintree_table=np.array([wrong, range(24)])),
        infinite=lambda: offsets(v_template=model["v_template"] * np.nan),
        joints=lambda: offsets(J_regressor=model["J_regressor"][:23]),
    )


# HumanML3D from AMASS ---------------------------------------------------------------------------


def clips_of_an_index() -> Any:
    root = folder("index")
    rows = "source_path,start_frame,end_frame,new_name\n"

    def read(text: str) -> Any:
        (root / "index.csv").write_text(text)
        listed = humanml3d.read_index(root / "index.csv")
        grouped = {key: len(of_key) for key, of_key in humanml3d.by_recording(listed).items()}
        return [
            [
                (row, row.humanact12, [str(row.frames(count)) for count in (0, 30, 200)])
                for row in listed
            ],
            grouped,
        ]

    subsets = ["KIT", "ACCAD", "BMLrub", "Eyes_Japan_Dataset", "MPI_HDM05", "TotalCapture"]
    subsets += [
        "MPI_Limits",
        "MPI_mosh",
        "CMU",
        "HumanEva",
        "SFU",
        "Transitions_mocap",
        "SSM_synced",
    ]
    many = "".join(
        f"./pose_data/{name}/s/a.npy,{n},{60 + n},{n:06d}.npy\n" for n, name in enumerate(subsets)
    )
    act = "./pose_data/humanact12/humanact12/P11.npy,3,-1,000077.npy\n"
    return outcomes(
        many=lambda: read(rows + many + act + many),
        end=lambda: read(rows + "./pose_data/KIT/s/a.npy,5,-1,1.npy\n"),
        unknown=lambda: read(rows + "./pose_data/Nothing/s/a.npy,5,9,1.npy\n"),
        number=lambda: read(rows + "./pose_data/KIT/s/a.npy,x,9,1.npy\n"),
        header=lambda: read("a,b\n1,2\n"),
        missing=lambda: humanml3d.read_index(root / "nothing.csv"),
    )


def humanml3d_that_is_created() -> Any:
    root = write_downloads(folder("created") / "x")
    path = root / "HumanML3D" / "HumanML3D"
    options: dict[str, Any] = {"amass": str(root / "amass"), "workers": 1}
    options["body_models"] = str(root / "bodies")

    def source(**more: Any) -> Any:
        return humanml3d.HumanML3D(str(path), **(options | more))

    results: dict[str, Any] = outcomes(
        check=lambda: source().check(20),
        without=lambda: source(body_models=None).check(20),
        no_bodies=lambda: source(body_models=None).count(),
        excluded=lambda: source(exclude=["000003", "M000001"]).check(20),
        read=lambda: source(amass=None).check(20),
        count=lambda: source().count(),
    )
    files = sorted((path / "new_joint_vecs").glob("*.npy"))
    results["files"] = {file.name: projected(np.load(file)) for file in files}
    results["statistics"] = [projected(np.load(path / f"{name}.npy")) for name in ("Mean", "Std")]
    results["after"] = [outcome(lambda: source().check(20)), clips_of(source(), 20)["excluded"]]
    (path / "new_joint_vecs" / "M000003.npy").unlink()
    lengths = np.linspace(0.1, 0.5, 22).tolist()
    results["again"] = [source().check(20), source(bone_lengths=lengths).count()]
    results["changed"] = {
        file.name: projected(np.load(file), 2) for file in files if "3" in file.name
    }
    results["options"] = source(bone_lengths=lengths, exclude=["000001"]).options
    (path / "Mean.npy").unlink()
    np.save(path / "new_joint_vecs" / "000001.npy", np.zeros((44, 3)))
    results["wrong"] = outcome(lambda: source().count())
    (path / "new_joint_vecs" / "000000.npy").unlink()
    shutil.rmtree(root / "amass" / "KIT")
    results["lost"] = [source().check(20), outcome(lambda: source().count())]
    for shape, kind in (
        ((5, 21, 3), float),
        ((5, 22, 3), float),
        ((4, 24, 3), str),
        ((4, 24), int),
    ):
        np.save(root / "joints.npy", np.ones(shape).astype(kind))
        results[f"{shape}"] = outcome(
            lambda: projected(humanml3d._read_joints(root / "joints.npy"))
        )
    return results


def humanml3d_as_smpl() -> Any:
    root = write_downloads(folder("smpl") / "x")
    path = root / "HumanML3D" / "HumanML3D"
    rng = np.random.default_rng(8)
    entry = {"poses": rng.normal(size=(45, 72)), "joints3D": rng.normal(size=(45, 24, 3))}

    def source(content: Any = None, **options: Any) -> Any:
        file = None if content is None else str(written(root / "act.pkl", content))
        return humanml3d.HumanML3DSMPL(str(path), str(root / "amass"), file, workers=1, **options)

    name = "P11G01R02F1812T1847A0402"
    results = {
        "plain": clips_of(source(), 20),
        "act": clips_of(source({name: entry}, published_split=True), 20),
        "npy": clips_of(source({f"{name}.npy": entry}, exclude=["000001", "000004"]), 20)["clips"],
        "lacks": clips_of(source({"x": entry}), 20)["excluded"],
    }
    no_joints = {name: {"poses": entry["poses"]}}
    results |= outcomes(
        wrong=lambda: clips_of(source(no_joints), 20),
        listed=lambda: clips_of(source([1]), 20)["excluded"],
        fps=lambda: clips_of(source(), 30),
        counts=lambda: source(exclude=["000000", "M000000"]).count(),
    )
    (path / "train.txt").write_text("000000\n000001\nM000001\n000007\n")
    (path / "texts" / "000000.txt").write_text("")
    (path / "texts" / "000001.txt").write_text("")
    results["texts"] = outcome(lambda: source().count())
    (path / "texts" / "000000.txt").write_text(line("somebody runs.") + "\n")
    (path / "texts" / "000001.txt").write_text(line("somebody walks.") + "\n")
    return results | {"lists": clips_of(source(), 20)}


# BABEL ------------------------------------------------------------------------------------------


def starts_of_labels() -> Any:
    def starts(text: str, start: float | None, end: float | None, frames: int) -> Any:
        windows, reason = babel._starts(babel.Label("m", text, start, end, "words"), frames)
        return [str(windows), reason]

    times = [(0, 8), (0.3, 6.76), (0.31, 6.8), (0.35, 6.85), (0, 6.45), (0, 6.5), (0, 6.55), (2, 4)]
    times += [(4, 3), (None, 2), (2, None), (-0.01, 3), (3, 3.06), (3, 3.11), (3, 3), (1.55, 9.99)]
    times += [(8.55, 9), (8.6, 9), (8.65, 9), (8.7, 9), (5, 15), (5, 15.05), (5, 15.1), (0.05, 1)]
    return {
        str(frames): [starts("walk", start, end, frames) for start, end in times]
        for frames in (300, 301, 130)
    } | {"transition": starts("transition", 0, 9, 300), "short": starts("x", 0, 1, 128)}


def labels() -> list[dict]:
    return [
        label("walk", ["walk", "move"], 0.0, 8.0),
        label("walk", ["walk"], 0.0, 8.0),
        label("transition", ["transition"], 0.0, 2.0),
        label("", ["step"], 1.0, 3.0),
        label("wave", None, 2.0, 4.0),
        label("backwards", ["mislabeled"], 4.0, 3.0),
        label("nowhen", None, None, None),
        label("late", None, 12.0, 14.9),
        label("lost", [], 2.0, 4.0),
    ]


def clips_of_babel() -> Any:
    root = folder("babel")
    names = [f"CMU/{k:02d}/{k:02d}_01_poses.npz" for k in (0, 1, 2, 3, 27, 5)]
    for seed, name in enumerate(names):
        write_amass(root / "amass" / name, 700 + 100 * seed, 60.0 if seed % 2 else 59.94, seed)
    parts: dict[str, dict[str, dict]] = {
        "train": {"0": sequence(names[0], None, False), "1": sequence(names[1], labels(), False)},
        "extra_train": {
            "2": sequence(names[2], labels()[:1], True),
            "9": sequence(names[2], None, True),
        },
        "val": {
            "3": sequence(names[3], labels(), False),
            "4": sequence(names[4], labels()[::-1], False),
            "5": sequence(names[1], labels()[:5], False),
        },
        "extra_val": {"6": sequence(names[5], labels()[2:6], True)},
    }
    parts["extra_train"]["8"] = sequence(names[3], [], True) | {"frame_anns": []}
    path = write_babel(root / "babel", parts)

    def source(**options: Any) -> babel.Babel:
        return babel.Babel(str(path), str(root / "amass"), workers=1, **options)

    def changed(**content: Any) -> Any:
        entry = sequence(names[1], [label("a", None, 0.0, 2.0) | content], False)
        (path / "train.json").write_text(json.dumps({"1": entry}))
        return len(source().labels("train"))

    results: dict[str, Any] = {}
    for published in (False, True):
        result = clips_of(source(published_split=published), 20)
        clips = result["clips"]
        result["clips"] = clips[::6]
        result["rest"] = [
            (c["id"], c["split"], c["source"], c["window"], c["captions"]) for c in clips
        ]
        results[str(published)] = result
    results["labels"] = {part: source().labels(part) for part in ("train", "val")}
    results |= outcomes(
        fps=lambda: next(source().clips(30)),
        number=lambda: changed(proc_label=3),
        category=lambda: changed(act_cat=["a", 2]),
        none=lambda: changed(proc_label=None),
        huge=lambda: changed(start_t=1e6),
        low=lambda: changed(end_t=-1e6),
        text=lambda: changed(end_t="x"),
        nowhere=lambda: babel.Babel("/nowhere", str(root / "amass")).counts(),
    )
    wrong = sequence("Nothing/a/b.npz", labels()[:1], False)
    (path / "train.json").write_text(json.dumps({"1": wrong}))
    return results | {"unknown": outcome(lambda: source().labels("train"))}


# Bandai-Namco -----------------------------------------------------------------------------------


@cache
def takes() -> Path:
    root = folder("takes")
    extra = {"dataset-2_walk_elderly_004": 24, "dataset-1_dash_masculinity_001": 20}
    extra |= {"dataset-2_walk-turn-left_masculine_007": 21}
    for seed, (name, frames) in enumerate((TAKES | extra).items()):
        inner = root / name[8]
        inner.mkdir(exist_ok=True)
        bvh.write(synthetic_take(seed, frames), inner / f"{name}.bvh")
    return root


def clips_of_bandai() -> Any:
    results: dict[str, Any] = {}
    happy = "dataset-1_walk_happy_001"
    for options in (
        {},
        {"motion": "smpl", "exclude": [happy]},
        {"mirror": False, "split": "compositional"},
        {"motion": "smpl", "mirror": True, "split": "compositional"},
    ):
        source = bandai.Bandai(str(takes()), workers=1, **cast(Any, options))
        results[str(options)] = clips_of(source, 20 if options else 30)
    return results


def splits_and_captions_of_bandai() -> Any:
    one = [(1, content, style, 1) for content in bandai.CONTENTS_1 for style in bandai.STYLES_1]
    two = [
        (2, content, style, number)
        for content, counts in bandai.TAKES_2.items()
        for style, count in zip(bandai.STYLES_2, counts, strict=True)
        for number in (*range(1, count, 4), count)
    ]
    splits = {
        rule: "".join(bandai.split_of(*take, rule)[1] for take in one + two)
        for rule in ("takes", "compositional")
    }
    sides = {content: bandai.side_of(content) for content in bandai.Bandai.actions}
    texts = {
        f"{content}, {style}": bandai.captions(content, style, side)
        for number, (content, side) in enumerate(sides.items())
        for style in (*bandai.STYLES_1, *bandai.STYLES_2)[number % 5 :: 7]
    }
    default = [bandai.split_of(*take) for take in two[::9]]
    return [splits, sides, texts, default, bandai.prompts(), sorted(map(str, bandai.HELD_OUT))]


def bandai_motions() -> Any:
    rng = np.random.default_rng(4)
    joints = rng.normal(size=(4, 22, 3))
    return {
        "mirrored": [
            projected(bandai.mirror(motion))
            for motion in (joints, joints.astype(np.float32), rng.normal(size=(5, 75)))
        ],
        "axes": {name: axes.ravel().tolist() for name, axes in bandai.REST.items()},
        "joints": bandai.JOINTS,
        "converted": [
            projected(bandai.convert(file, fps, *kind))
            for file in sorted(takes().rglob("*.bvh"))[2:4]
            for fps in (12.5, 20, 30)
            for kind in ((), ("smpl",))
        ],
        "pelvis": list(BONES),
    }


def takes_that_are_refused() -> Any:
    root = folder("refused")
    source = next(iter(sorted(takes().rglob("dataset-1*.bvh"))))

    def of(*names: str) -> Any:
        path = folder("refused")
        for name in names:
            (path / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(source, path / name)
        return [take[1:] for take in bandai.Bandai(str(path)).takes]

    def renamed() -> Any:
        path = folder("refused") / "dataset-1_walk_happy_001.bvh"
        path.write_text(source.read_text().replace("Neck", "Nacken"))
        return bandai.convert(path, 20)

    return outcomes(
        twice=lambda: of("a/dataset-1_walk_old_001.bvh", "b/dataset-1_walk_old_001.bvh"),
        content=lambda: of("dataset-1_fly_old_001.bvh"),
        style=lambda: of("dataset-2_walk_old_001.bvh"),
        others=lambda: of("dataset-3_walk_old_001.bvh", "dataset-1_walk_old.bvh"),
        some=lambda: of(
            "dataset-1_walk_old_001.bvh", "dataset-3_x.bvh", "dataset-2_run_normal_30.bvh"
        ),
        nowhere=lambda: bandai.Bandai(str(root / "nothing")).takes,
        skeleton=renamed,
        exclude=lambda: bandai.Bandai(str(takes()), exclude=["x"]).takes,
        counts=lambda: bandai.Bandai(str(takes())).counts(),
    )


# Archives and pickles ---------------------------------------------------------------------------


def contents_of_archives() -> Any:
    root = folder("archives")
    files = {"set/a.txt": b"one", "set/b.bin": b"two", "set/inner/c.txt": b"three" * 50}

    def zipped(names: Mapping[str, bytes]) -> Path:
        with zipfile.ZipFile(root / "a.zip", "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("set/", b"")
            for name, content in names.items():
                archive.writestr(name, content)
        return root / "a.zip"

    def tarred(names: Mapping[str, bytes], kind: str = "", link: bool = False) -> Path:
        stream = io.BytesIO()
        with tarfile.open(fileobj=stream, mode="w") as archive:
            for name, content in names.items():
                info = tarfile.TarInfo(name)
                info.size = len(content)
                archive.addfile(info, io.BytesIO(content))
            if link:
                info = tarfile.TarInfo("set/link.txt")
                info.type, info.linkname = tarfile.SYMTYPE, "a.txt"
                archive.addfile(info)
        pack = {"gz": gzip.compress, "bz2": bz2.compress, "xz": lzma.compress}.get(kind, bytes)
        (root / f"a.tar{kind}").write_bytes(pack(stream.getvalue()))
        return root / f"a.tar{kind}"

    def unpacked(path: Path, ending: str = ".txt") -> Any:
        inside = archives.as_folder(path, temporary(), lambda name: name.endswith(ending))
        listed = {
            str(file.relative_to(inside)): file.read_text()[:9]
            for file in sorted(inside.rglob("*"))
            if file.is_file()
        }
        members = [name for name, _ in archives.members(path, lambda name: name.endswith(ending))]
        return [inside.name, listed, members]

    def cut(path: Path, size: int) -> Path:
        path.write_bytes(path.read_bytes()[:size])
        return path

    def reads(content: bytes, count: int) -> Any:
        bounded = archives._Bounded(io.BytesIO(content), 9)
        return [bounded.read(4) for _ in range(count)], bounded.total

    outside = {"../x.txt": b"a"}
    with pytest.raises(EOFError, match="it ends too early"):
        reads(b"abcdefg", 5)
    (root / "text.zip").write_text("no archive at all")
    return outcomes(
        zip=lambda: unpacked(zipped(files)),
        bin=lambda: unpacked(zipped(files), "bin"),
        mac=lambda: unpacked(zipped(files | {"__MACOSX/set/._a.txt": b"x"})),
        outside=lambda: unpacked(zipped(outside)),
        absolute=lambda: unpacked(tarred({"/tmp/x.txt": b"a"})),
        tar=lambda: unpacked(tarred(files)),
        gz=lambda: unpacked(tarred(files, "gz")),
        bz2=lambda: unpacked(tarred(files, "bz2")),
        xz=lambda: unpacked(tarred(files, "xz")),
        link=lambda: unpacked(tarred(files, link=True)),
        unwanted=lambda: unpacked(tarred(files, link=True), ".bin"),
        short=lambda: str(outcome(lambda: unpacked(cut(tarred(files, "gz"), 60))))[:60],
        text=lambda: str(outcome(lambda: unpacked(root / "text.zip")))[:70],
        reads=lambda: reads(b"abcdefg", 4),
        folder=lambda: plain(archives.as_folder(root, temporary(), bool)),
    )


class Opaque:
    """An object whose pickle is refused, or replaced by its state."""

    def __init__(self) -> None:
        self.x = np.arange(3.0)


def contents_of_pickles() -> Any:
    path = folder("pickles") / "x.pkl"
    rng = np.random.default_rng(1)
    values = {
        "text": "a",
        "numbers": [1, 2.5, True, None, b"bytes"],
        "tuple": (1, (2, "x")),
        "float32": rng.normal(size=(2, 3)).astype(np.float32),
        "fortran": np.asfortranarray(rng.normal(size=(3, 4))),
        "big": rng.normal(size=4).astype(">f8"),
        "objects": np.array([np.zeros(2), "a", None], object),
        "scalar": np.float64(2.5),
        "strings": np.array(["ab", "c"]),
        "bytes": np.array([b"ab", b"c"]),
        "complex": np.array([1 + 2j]),
        "bytearray": bytearray(b"xy"),
        "nested": {"a": {"b": [np.int16(3), np.bool_(True)]}},
    }

    def read(content: Any, protocol: int, *opaque: Any) -> Any:
        path.write_bytes(content if isinstance(content, bytes) else pickle.dumps(content, protocol))
        return repr(restricted_pickle.read(path, *opaque))[:400]

    dates = np.array(["2020-01-01"], "datetime64[D]")
    opaque = (f"{Opaque.__module__.rpartition('.')[0]}",)
    return {
        f"{protocol}, {name}": outcome(partial(read, value, protocol))
        for protocol in (0, 1, 2, 3, 4, 5)
        for name, value in values.items()
    } | outcomes(
        keys=lambda: read({1: 2}, 4),
        set=lambda: read({"a": {1}}, 4),
        frozen=lambda: read(frozenset("a"), 4),
        function=lambda: read([print], 4),
        path=lambda: read(Path("a"), 2),
        dates=lambda: read(dates, 4),
        ends=lambda: read(pickle.dumps("abc" * 30, 4)[:20], 4),
        empty=lambda: read(b"", 4),
        marked=lambda: read(b"(X\x01\x00\x00\x00aK\x01X\x01\x00\x00\x00bK\x02d.", 2),
        counter=lambda: read(Counter("aab"), 4),
        ordered=lambda: read(Counter("aab"), 4, ("collections.",)),
        fraction=lambda: read(complex(1, 2), 4, ("builtins.",)),
        opaque=lambda: len(str(outcome(lambda: read(Opaque(), 4, opaque)))) > 0,
    )


# Mixtures, adaptation ---------------------------------------------------------------------------


def mixtures() -> Any:
    rng = np.random.default_rng(0)

    def part(license: str, *actions: str, clip_license: str = "") -> Any:
        clips = [
            Clip(f"{license}{n}", rng.normal(size=(3, 2)), [], "train", "s", action, license=mine)
            for n, action in enumerate((*range(len(actions)), None))
            for mine in (clip_license if n else "",)
        ]
        source: Any = OwnClips(*clips)
        source.license, source.actions, source.verbs = (
            license,
            actions,
            (f"walk{len(actions)}", "a"),
        )
        source.failures, source.options = [f"bad {license}"], {"license": license}
        source.excluded["x"] += len(actions)
        return source

    def mixed(use: Any, **parts: Any) -> Any:
        source = mixture.Mixture(parts, *use)
        licenses = ("MIT", "CMU", "CC-BY-NC-4.0", "", "?")
        shared = [source.may_share_captions(license) for license in licenses]
        more = [source.check(20), source.failures, source.changed(Path("x")), source.verbs]
        return [clips_of(source, 20), shared, more]

    several = part("MIT", "walk")
    several.licenses = lambda: ["MIT", "z", "CC-BY-NC-4.0", "CMU"]
    return outcomes(
        free=lambda: mixed((), a=part("MIT", "walk", "run"), b=part("CMU", "jump", "walk")),
        clip=lambda: mixed((), a=part("MIT", "walk", clip_license="CMU")),
        unknown=lambda: mixed((), a=part("MIT", "walk"), b=part("", "walk")),
        research=lambda: mixed((), a=part("CC-BY-NC-4.0", "walk")),
        allowed=lambda: mixed(("research",), a=part("CC-BY-NC-4.0", "run"), b=part("", "walk")),
        use=lambda: mixed(("all",), a=part("MIT")),
        several=lambda: mixed((), a=several),
        empty=lambda: mixed(()),
        licenses=mixture.known_licenses,
    )


def faults_of_clips() -> Any:
    t = np.arange(90)
    walk = posed(90).joints
    results = []
    for fps in (20, 30, 12.5):
        for rise in (0, 0.02, 0.049, 0.051, 0.2, -0.3):
            results.append(adaptation.fault_of(walk + [0, rise, 0] * (t / 89)[:, None, None], fps))
        for height in (0.05, 0.099, 0.101, 0.4):
            moved = walk.copy()
            moved[:35, :, 1] += height * np.sin(np.pi * t[:35] / 34)[:, None]
            results.append(adaptation.fault_of(moved, fps))
            moved = walk + np.where((t > 40) & (t < 85), height, 0)[:, None, None] * [0, 1, 0]
            results.append(adaptation.fault_of(moved, fps))
            moved = walk + np.where((t > 22) & (t < 66), height, 0)[:, None, None] * [0, 1, 0]
            results.append(adaptation.fault_of(moved, fps))
    texts = ["a person walks", "a person walks. ", " x ..", "..", ""]
    return [results, [adaptation.styled(text, "limp") for text in texts]]


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
