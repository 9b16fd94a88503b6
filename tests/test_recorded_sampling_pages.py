"""Pages about runs, and the parts of the demo that need no browser, as recorded."""

import hashlib
import math
from collections.abc import Callable
from ipaddress import IPv4Address
from pathlib import Path
from tempfile import TemporaryDirectory
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support.outcomes import without
from support.pages import a_run, data_of, motions, put, result
from support.recorded import Case, cases_of, check, outcome, record
from support.sampled import diffusion, dip, facts, labeled, walk

from flame_mdm.commands import (
    above_zero,
    body_name,
    compare,
    convert,
    device_name,
    existing,
    motion_file,
    sample,
)
from flame_mdm.commands.trainings import Training, _check
from flame_mdm.data.store import Entry
from flame_mdm.demo import app, connections, guard, studio
from flame_mdm.demo.live import LiveStreams
from flame_mdm.demo.request import checked, parse_query, query_pairs
from flame_mdm.demo.studio_page import _buttons, _examples, _links, _note, _verdicts, _vocabulary
from flame_mdm.errors import UserError
from flame_mdm.records import AuditCard, Data, Result, Value
from flame_mdm.reporting import audit_cards, browse, plots, report, study
from flame_mdm.reporting import compare as comparing
from flame_mdm.reporting.page import filled, interval, number, short
from flame_mdm.runs import read_run
from flame_mdm.sampling.targets import read_targets
from flame_mdm.schemas import check_shape

NAME = "sampling_pages"


def digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def numbers_on_pages() -> Any:
    values = [
        None,
        0.0,
        1e-3,
        9.99e-4,
        -5e-4,
        12345.6,
        9999.6,
        10_000,
        -10_001.0,
        3,
        math.inf,
        1.23456,
    ]
    steps = [0, 999, 1000, 1500, 999_999, 1e6, -2500, 12_345_678, 0.5]
    rows = [["a", "–", "1", ""], ["b", "–", "", "–"], ["c", "2", "–", ""]]
    return (
        [number(value) for value in values],
        [short(step) for step in steps],
        [interval(mean, half) for mean, half in ((1.0, 0.125), (None, 1.0), (2.0, None))],
        filled(["", "x", "y", "z"], rows),
        [plots._tick(value) for value in (0, 1e-13, 5e-4, 2e-12, 1234567, 0.1)],
        [study.wilson(*pair) for pair in ((0, 0), (0, 5), (5, 5), (3, 7), (40, 61))],
    )


def axes_and_plots() -> Any:
    spans = [
        (0, 1),
        (2.0, 2.0),
        (0, 0),
        (-3, 17),
        (1e-310, 5),
        (0.013, 0.0172),
        (100, 2999),
        (-5, -5),
    ]
    results: list[Any] = [
        vars(plots._linear_axis(low, high, to_ticks))
        for low, high in spans
        for to_ticks in (True, False)
    ]
    results += [
        vars(plots._log_axis(low, high))
        for low, high in ((1, 1), (0.3, 7e5), (0, 4), (2, 90), (1e-9, 3e8))
    ]
    rng = np.random.default_rng(2)
    long = [(k, float(y)) for k, y in enumerate(rng.normal(3, 1, 1234))]
    results += [
        (len(plots._thinned(long)), plots._thinned(long)[7:9]),
        len(plots._thinned(long[:600])),
        len(plots._thinned(long[:601])),
    ]
    few = [(1.0, 2.0), (3.0, 40.0), (10.0, 3.5)]
    for kind in ("line", "dots", "dashed"):
        for log_x in (False, True):
            for from_zero in (False, True):
                for levels, spread in (((), {}), ((1.0, 60.0), {3.0: 5.0, 1.0: 0.5})):
                    one = plots.Series("a", few, spread, kind)
                    other = plots.Series("b", [(0.0, 1.0), (5.0, 9.0)])
                    panel = plots.Panel(
                        [one, other],
                        "x" if log_x else "",
                        "y",
                        log_x,
                        from_zero,
                        levels,
                        not levels,
                    )
                    results.append(digest(str(plots._drawn(panel))))
    bars = plots.Panel(plots.Histogram(10, [3, 0, 7]), "x")
    results += [
        plots._drawn(bars),
        plots._drawn(plots.Panel([])),
        plots.svg("t", [plots.Panel([])]),
    ]
    drawn = plots.chart("t", {"a": {3: 1.0, 1: math.nan, 2: 4.0}, "b": {}}, {"a": {2: -0.5}})
    results += [str(drawn), digest(plots.svg_file(drawn))]
    return results


def results_of_runs() -> Any:
    value = {"mean": 1.0, "ci": 0.2, "replications": 3, "n": 64}
    values = {
        "fid": {**value, "per_replication": [1.0, 1.5, 0.5], "unit": "m"},
        "b": {**value, "per_replication": [2.0, 2.1, 2.2]},
        "c": {**value, "replications": 1, "per_replication": [3.0]},
        "d": None,
        "e": {**value, "resampled": [1.0, 2.0, 1.5]},
    }
    other = {
        "fid": {**value, "per_replication": [1.3, 1.1, 0.9]},
        "b": {**value, "per_replication": [1.0, 1.1, 1.25]},
        "c": {**value, "replications": 1, "per_replication": [2.5]},
        "e": {**value, "n": 65},
    }
    listed = [
        result(),
        result(values=values),
        result(values=other),
        result(values=other, seed=1),
        result(invalid_because=["x", "y"], quick=True, changed={"a": 1}),
        result(changed={"a": 1, "b": "c"}),
        result(checkpoint=None, baseline="real", audit="a.html"),
        result(checkpoint=None, cost=None),
        result(
            audit="a.html", audit_motions=7, cost={"seconds_per_sample": 0.01234, "batch_size": 16}
        ),
        result(extractor={"sha256": "ab" * 32, "name": "x"}),
    ]
    read = [check_shape(one, Result) for one in listed]
    rows: list[Any] = [
        (
            report._evaluation(one),
            report.marks(one),
            report.sampling(one),
            report.evaluation_title(one),
        )
        for one in read
    ]
    rows += [
        comparing.differences(read[first], read[second])
        for first, second in ((1, 2), (2, 1), (1, 3), (0, 4), (0, 1), (6, 7))
    ]
    rows.append(
        [
            comparing.paired_difference(a, b)
            for a, b in (([1, 2, 3], [2, 2.5, 5]), ([1, 2], [1, 2]), ([1, 4, 2, 8], [0, 3, 2, 5.5]))
        ]
    )
    rows += [report.printed(None), report.labeled("x", None)]
    rows.append(comparing._difference("x", None, check_shape({**value}, Value)))
    curves = [
        "train/loss",
        "val/loss",
        "val/x/fid",
        "val/x/fid/ci",
        "samples/a",
        "train/lr",
        "val/lr",
        "train/epochs",
        "train",
        "train/grad_norm",
        "val/x/fid/real",
        "train/zeta",
        "train/alpha",
    ]
    rows.append(report.charted(curves))
    rows += [report.last({}), report.last({3: 1.0, 2: 5.0})]
    return rows


def pages_of_runs() -> Any:
    results: list[Any] = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        first = a_run(folder / "a", name="one", optimizer={"lr": 0.1, "same": 1})
        second = a_run(folder / "b", name="two", optimizer={"lr": 0.2, "same": 1}, extra="<em>")
        motions(first / "samples" / "step_0000009")
        motions(second / "samples" / "step_0000009", ("a person jumps", "a person bows"), 1.0)
        plain_motions = motions(folder / "c", ("a person jumps", "a person jumps"), 2.0)
        put(first)
        put(
            second, values={"fid": {"mean": 7.5, "ci": 0.5, "replications": 2, "n": 64}}, quick=True
        )
        put(second, "y", split="val")
        for folders in ([first, second], [first, plain_motions], [second, first, plain_motions]):
            compared = comparing.find(folders)
            shown = [
                comparing.read_motions(
                    one.run.samples if one.run and one.run.samples else one.folder
                )
                for one in compared
            ]
            results.append(
                [(one.label, list(some)) for one, some in zip(compared, shown, strict=True)]
            )
            results.append(comparing.in_all(shown))
            runs = comparing.only_runs(compared)
            results += without(
                folder,
                [
                    list(map(str, comparing._facts(runs))),
                    comparing._differences(runs),
                    comparing.in_common(runs),
                    list(comparing.grouped(runs)),
                    compare._tested(runs),
                ],
            )
            page = comparing.comparison(compared, shown).replace(str(folder), "FOLDER")
            results.append((page.count("<td>"), page.count("<svg"), page.count("srcdoc")))
            for seed in (0, 1):
                rating = outcome(
                    lambda compared=compared, shown=shown, seed=seed: study.rating_page(
                        compared, shown, seed
                    )
                )
                shown_items = (
                    [
                        {key: item[key] for key in ("prompt", "a", "b", "left")}
                        for item in data_of(rating)["items"]
                    ]
                    if "items" in rating
                    else rating
                )
                results.append(shown_items)
        run = read_run(first)
        results += [
            report._facts(run),
            bool(report._player(run, None)),
            report.write_report(first).name,
        ]
        results += without(
            folder,
            [
                outcome(lambda: comparing.find([first])),
                outcome(lambda: comparing.find([first, first])),
            ],
        )
        ratings = [
            ("a", "b", "a"),
            ("b", "a", "a"),
            ("a", "c", "b"),
            ("c", "a", "b"),
            ("a", "b", "b"),
        ]
        for rater, rows in (
            ("r", ratings),
            ("s", ratings[:3]),
            ("r", ratings),
            ("t", [("a", "a", "a")]),
        ):
            path = folder / f"{rater}{len(rows)}.json"
            path.write_text(
                Answers(
                    study="x",
                    rater=rater,
                    ratings=[Rating(a=a, b=b, choice=cast(Any, c)) for a, b, c in rows],
                ).model_dump_json()
            )
        files = [folder / "r5.json", folder / "s3.json"]
        results += [
            without(
                folder, outcome(lambda some=some: [pair.model_dump() for pair in study.tally(some)])
            )
            for some in (files, files[::-1], files[:1] * 2, [folder / "t1.json"], [])
        ]
        results.append([pair.share for pair in study.tally(files)])
    return results


Answers, Rating = study.Answers, study.Rating


def cards_of_audits() -> Any:
    def graded(grade: float, fid: list[Any], jitter: list[Any], other: list[Any]) -> dict[str, Any]:
        return {"grade": grade, "values": {"fid": fid, "jitter": jitter, "top": other}}

    rows = [
        graded(1.0, [1.1, 0.3, 0.1, 0.2], [8.9, 5.0, -0.1, 0.01], [0.5, 0.1, 0.0, 0.1]),
        graded(2.0, [1.5, 0.3, 0.5, 0.2], [8.5, 5.0, -0.5, 0.01], [0.4, 0.1, -0.2, 0.1]),
        graded(5.0, [3.0, 0.3, 2.0, 0.2], [7.0, 5.0, -2.0, 0.01], [0.45, 0.1, -0.05, 0.02]),
    ]
    noise = {"group": "joints", "about": "noise <b>", "unit": "mm"}
    meaning = {"group": "meaning", "about": "texts", "unit": ""}
    content: dict[str, Any] = {
        "format": 1,
        "split": "test",
        "motions": 40,
        "seed": 0,
        "resamples": 10,
        "packages": {"torch": "2"},
        "extractor": {"sha256": "ab" * 32, "name": "motion_clip/x"},
        "protocol": {"name": "t", "version": 1},
        "data": {"dataset": "x", "fingerprint": "f", "frames": [24, 60]},
        "metrics": {"fid": False, "jitter": None, "top": True},
        "facts": {"fid": {"depends_on_count": True, "sees_meaning": True, "sums_up": True}},
        "real": {"fid": [1.0, 0.9], "jitter": [9.0, 5.0], "top": [0.5, 0.02]},
        "perturbations": [
            {"name": "noise", "grades": rows, **noise},
            {"name": "swap", "grades": rows[::-1], **meaning},
            {
                "name": "still",
                "grades": [graded(1.0, [1.0, 0.9, 0, 0], [None] * 4, [0.9, 0.1, 0.4, 0.1])],
                **noise,
            },
            {
                "name": "still:x",
                "grades": [graded(3.0, [1.0, 0.9, 0, 0], [9.0, 1, 0, 0], [0.5, 0.1, 0, 0.1])],
                **noise,
            },
            {
                "name": "fewer",
                "grades": [
                    *rows[:2],
                    graded(9.0, [2.0, None, None, None], [9.0, 1, 0, 0], [0.5, 0.1, 0, 0]),
                ],
                "group": "sets",
                "about": "n",
                "unit": "",
            },
            {
                "name": "frozen",
                "grades": [graded(3.0, [1.0, 0.9, 0, 0], [9.0, 1, 0, 0], [0.5, 0.1, 0, 0.1])],
                **noise,
            },
        ],
        "not_computed": {"kid": "few"},
        "truth": {"fid": {"auc": 0.9, "correlation": -0.5}},
    }
    card = check_shape(content, AuditCard)
    bare = check_shape(
        {
            **content,
            "extractor": None,
            "motions": 41,
            "real": {**content["real"], "fid": [None, None]},
        },
        AuditCard,
    )
    results: list[Any] = []
    for one in (card, bare):
        results += [
            (
                audit_cards.seen(one, row, metric),
                audit_cards._cell(one, row, metric),
                audit_cards._curve(one, row, metric),
            )
            for row in one.perturbations
            for metric in one.metrics
        ]
        results += [
            audit_cards.findings(one),
            audit_cards._facts(one),
            audit_cards.card_name(one),
            audit_cards._evaluator(one),
        ]
        results += [
            audit_cards._cell(one, None, "fid"),
            audit_cards._cell(one, one.perturbations[0], "kid"),
        ]
    with TemporaryDirectory() as name:
        for cards, title in (([card], ""), ([card, bare], ""), ([bare], "z")):
            paths = audit_cards.write_card(cards, Path(name), title)
            results.append([(path.name, digest(path.read_text())) for path in paths])
    one = check_shape({"dataset": "x", "fingerprint": "f", "frames": [24, 60]}, Data)
    cited = audit_cards.CitedCard(Path("a/b.html"), 40, "test", one)
    results += [
        cited.strength(one),
        cited.strength(one.model_copy(update={"fingerprint": "g"})),
        str(cited),
    ]
    results += [audit_cards._metric_text(text) for text in ("a/b.c-d", "a_b*", "x y")]
    return results


def clips_that_are_found() -> Any:
    def clip(name: str, split: str, *captions: str) -> Any:
        return SimpleNamespace(id=name, split=split, captions=captions)

    clips: list[Entry] = [
        clip("M1", "train", "Walks LEFT"),
        clip("1", "train", "walks right"),
        clip("2", "val", "Waves", "left hand"),
        clip("M7", "test", "jumps"),
        clip("M2", "val", "waves"),
        clip("3", "train"),
        clip("Max", "train", "left walks"),
    ]
    results: list[Any] = []
    for split in (None, "train", "val"):
        for search in ("", "left", "walks left", "WAVES hand", "m", "zz"):
            families = browse.find(clips, split, search)
            results.append([[one.id for one in family] for family in families])
            if families:
                results.append(
                    [
                        [[one.id for one in row] for row in browse.choose(families, most)]
                        for most in (0, 1, 2, 3, 4, 9)
                    ]
                )
    return results


LINKS = [
    "",
    "text=walk&seconds=2.5&seed=3",
    "text=walk&text=run",
    "txt=walk",
    "text=a&__theme=dark",
    "samples=5",
    "samples=4",
    "seconds=31",
    "seconds=0",
    "path=0,1 2,3&text=w",
    "path=0,21",
    "path=x",
    "edit={}",
    "edit={",
    "seed=-1",
    "cleanup=false",
    'edit={"strength":0.5}&text=a | b @2&samples=2',
    'edit={"joints":["arms"],"text":"x","motion":1}&path=1,1&split=false',
    "sampler=ddim&num_inference_steps=9&guidance_scale=nan",
    "num_inference_steps=1001",
    "text=" + "x" * 301,
    "text= a ",
    'edit={"region_seconds":[0,1],"seed":4}&edit={"strength":0.4,"text":"t"}&guidance_scale=2&text=w&model=m + a',
    "sampler=a%00",
]


def links_of_the_demo() -> Any:
    results: list[Any] = []
    for link in LINKS:
        request = outcome(lambda link=link: parse_query(query_pairs(link)))
        results.append(str(request) if isinstance(request, str) else request.query())
        if isinstance(request, str):
            continue
        for kind in ("text", "action", "none"):
            results.append([(source, str(keywords)) for source, keywords in request.steps(kind)])
            results.append(request.targets(kind) if request.path else None)
        results += [request.python("text", device) for device in ("cpu", "cuda:1")]
        results.append(outcome(lambda request=request: studio.check_length(request)))
        for model in (diffusion(), labeled()):
            results.append(
                outcome(lambda model=model, request=request: str(studio._plan(model, request)))
            )
    long = [
        checked({"text": text, "seconds": seconds})
        for text in ("a @15 | b", "a | b")
        for seconds in (None, 15, 15.01)
    ]
    results += [outcome(lambda one=one: studio.check_length(one)) for one in long]
    results += [
        outcome(lambda count=count: len(query_pairs("&".join(["a=1"] * count))))
        for count in (50, 51)
    ]
    results.append([outcome(lambda n=n: studio._numbered([walk()], n).id) for n in (0, 1)])
    return results


def parts_of_the_page() -> Any:
    models: list[Any] = [
        SimpleNamespace(conditioned_on=kind, facts=values)
        for kind in ("text", "action", "none")
        for values in (
            facts(),
            {**facts(), "verbs": []},
            {"actions": ["<a>"] * 3, "captions": [f"c{k}" for k in range(20)]},
            {"actions": []},
        )
    ]
    examples = [outcome(lambda model=model: list(_examples(model))) for model in models]
    pages = [
        _buttons({"a<b": "", "c": "data:x"}),
        _links([("a?b", "N"), ("c", "M")]),
        *(_note(kind, "unknown 'x'. Did you mean 'a <b>'?") for kind in ("error", "warning")),
        _note("warning", "x\ny"),
        _verdicts("Motion 1", walk()),
        _verdicts("", walk_with_text("a person walks and kicks")),
    ]
    return examples, [_vocabulary(model) for model in models], pages


def walk_with_text(text: str) -> Any:
    from dataclasses import replace

    return replace(walk(), text=text)


def addresses_and_limits() -> Any:
    names = ["1.2.3.4", "::ffff:1.2.3.4", "2001:db8::1%eth0", "2001:db8:0:0:5::7", "fe80::1"]
    results: list[Any] = [str(connections._network(name)) for name in names]
    results.append(connections._network(names[0]) == IPv4Address("1.2.3.4"))
    hosts = [
        "//a:80",
        "//LOCALHOST:7860",
        "//[::1]:80",
        "http://x.org/p",
        "http://[bad",
        "",
        "//1.2.3.4",
    ]
    results.append(
        [
            (guard._host_name(one), guard._network_location(one), guard._is_address(one[2:]))
            for one in hosts
        ]
    )
    paths = [
        "/",
        "/theme.css",
        "/assets/a-b.js",
        "/assets/../x",
        "/static/x.y/z",
        "/motion.glb",
        "/motion.glbx",
        "/live.bvh",
        "/live.npz",
        "/gradio_api/heartbeat/" + "a" * 41,
        "/gradio_api/queue/data",
        "/assets/",
    ]
    results.append([bool(guard.READ.fullmatch(path)) for path in paths])
    results += [vars(app.connection_limits(one)) for one in ([], ["a.org"])]
    writers = app.Writers()
    for waiting in (0, app.WAITING_FILES - 1, app.WAITING_FILES):
        writers.waiting = waiting
        results.append(writers.is_full)
    return results


def live_streams() -> Any:
    time = [0.0]
    live = LiveStreams(dip(), lambda: time[0])
    results: list[Any] = [live.can_lead]
    name = live.block("", "a person walks forward", 0)["stream"]
    for begin, text, path, seconds in (
        (30, "a person walks forward", (), 0.1),
        (45, "a person waves", (), 0.1),
        (75, "a person waves", ((0.5, 0.5),), 0.3),
        (80, "xyzzy", (), 0.1),
        (105, "a person waves", (), 0.1),
        (135, "wave", (), 0),
        (165, "wave", (), 0),
        (195, "wave", (), 0),
        (225, "wave", (), 0),
        (255, "wave", (), 0),
        (225, "wave", (), 120.0),
        (999, "wave", (), 2.0),
        (-1, "wave", (), 2.0),
        (255, "wave", (), 120.1),
    ):
        time[0] += seconds
        block = outcome(
            lambda begin=begin, text=text, path=path: live.block(name, text, begin, path)
        )
        if isinstance(block, str):
            results.append(block)
            continue
        kept = live._streams[name]
        results.append(
            (
                block["from"],
                block["frames"],
                block["reached"],
                kept.allowance,
                kept.text,
                kept.joints.astype(float),
            )
        )
    results += [outcome(lambda end=end: live.file("x", end)) for end in (".exe", ".bvh")]
    return results


def checks_of_commands() -> Any:
    calls: list[tuple[Callable[..., Any], Any]] = [
        (existing, "/none"),
        (motion_file, "a.txt"),
        (motion_file, "a:b"),
        (motion_file, "/none.bvh"),
        (motion_file, "a.c3d"),
        (body_name, "mannequin"),
        (body_name, "anny age=1"),
        (body_name, "any"),
        (body_name, ""),
        (device_name, "cuda:12"),
        (device_name, "cuda:"),
        (device_name, "gpu"),
        (device_name, "mps"),
        (above_zero, 0),
        (above_zero, 1),
        (above_zero, -2),
    ]
    results: list[Any] = []
    for call, value in calls:
        try:
            results.append(call("key", value))
        except (UserError, FileNotFoundError) as error:
            results.append(str(error))
    training = Training(["quickstart", "a=1"], "runs/x")
    results.append(training.title)
    for code in (0, 1, 127, 128, 130, -15):
        try:
            results.append(_check(training, code))
        except (UserError, SystemExit) as error:
            results.append(f"{type(error).__name__} {error}")
    targets = read_targets(
        diffusion().representation,
        {"root": [{"time": 0.5, "position": [0.3, 1.0]}, {"time": 1.4, "position": [None, 1.5]}]},
    )
    results.append(sample._distance(targets, [walk(), walk_with_text("x")]))
    with TemporaryDirectory() as name:
        folder = Path(name)
        for file in ("a.bvh", "b/a.npz", "b/a.glb", "c.txt"):
            (folder / file).parent.mkdir(exist_ok=True)
            (folder / file).write_bytes(b"")
        for ending, character in (("glb", None), (None, None), (None, "x.BVH"), ("npz", "x.glb")):
            settings: Any = SimpleNamespace(format=ending, character=character)
            results.append(
                without(
                    folder,
                    outcome(
                        lambda settings=settings: str(
                            convert._targets(settings, folder, Path("out"))
                        )
                    ),
                )
            )
        (folder / "b" / "a.glb").unlink()
        for ending, character in (("glb", None), (None, "x.BVH")):
            settings = SimpleNamespace(format=ending, character=character)
            results.append(without(folder, str(convert._targets(settings, folder, Path("out")))))
    return results


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
