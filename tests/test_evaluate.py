"""Evaluation by protocol: what the result says, what is kept and shared, and what is refused."""

import json
import multiprocessing
import os
import shutil
import signal
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.runs import TINY

from evaluators.callback import Evaluate
from evaluators.evaluation import Evaluation
from evaluators.evaluation_request import EvaluationRequest
from evaluators.evaluator import Evaluator, Motions, Rows
from evaluators.extractors import MotionCLIPExtractor
from evaluators.plan import Plan, sampling_options
from evaluators.protocol import (
    FOLDER,
    DrawnClip,
    default_protocol,
    load_protocol,
    protocol_config,
    protocol_names,
)
from evaluators.results import _overlaps
from evaluators.sources import (
    Baseline,
    Generator,
    SampleFolder,
    Samples,
    read_samples,
    real_motions,
)
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.locating import SHIPPED
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.data.synthetic import Synthetic
from flame_mdm.errors import UserError
from flame_mdm.generator import MotionGenerator
from flame_mdm.records import Measured, read_result
from flame_mdm.representations.humanml import HumanML
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import find_joints
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.sampling.motion_request import EditRequest
from flame_mdm.seeds import key

pytestmark = pytest.mark.slow

DATA = ("data=synthetic", "data.source.clips=400")
GENERATOR = [
    "data.source.clips=400",
    *TINY[1:],
    "callbacks.samples=null",
    "trainer.val_check_interval=2",
]
CLIP = [
    *("data.source.clips=400", "data.batch_size=16", "condition=learned", "condition.features=16"),
    *(
        f"task.network.{size}"
        for size in ("latent_dim=16", "ff_size=16", "num_layers=1", "num_heads=2")
    ),
    *(
        "task.network.embedding_dim=4",
        "trainer.accelerator=cpu",
        "trainer.enable_progress_bar=false",
    ),
    "trainer.val_check_interval=2",
]


class Runs:
    """A tiny model and a tiny motion-CLIP on the same 400 clips."""

    def __init__(self, folder: Path):
        self.root = folder / "data"
        data = [f"data_root={self.root}", "trainer.max_steps=2"]
        assert main(["train", "quickstart", *GENERATOR, *data, f"run.dir={folder / 'model'}"]) == 0
        assert (
            main(["train", "motion_clip/synthetic", *CLIP, *data, f"run.dir={folder / 'clip'}"])
            == 0
        )
        self.model, self.clip = (
            folder / name / "checkpoints" / "last.ckpt" for name in ("model", "clip")
        )

    def copy(self, folder: Path) -> Path:
        """The model in another folder; its motions are kept there, so that no test sees the motions of another one."""
        return (
            Path(
                shutil.copytree(
                    self.model.parent, folder / "model" / "checkpoints", dirs_exist_ok=True
                )
            )
            / "last.ckpt"
        )

    def evaluate(self, out: Path, *words: str, model: Path | None = None) -> Any:
        model = model or self.copy(out.parent)
        assert (
            main(
                [
                    "evaluate",
                    f"ckpt={model}",
                    f"extractor={self.clip}",
                    f"out={out}",
                    "device=cpu",
                    *words,
                ]
            )
            == 0
        )
        return read_result(out)

    def of_others(self, out: Path, *words: str, root: Path | None = None) -> Any:
        data = [
            *DATA,
            f"data_root={root or self.root}",
            "protocol=synthetic",
            f"extractor={self.clip}",
        ]
        assert main(["evaluate", *data, f"out={out}", "device=cpu", *words]) == 0
        return read_result(out)

    def data(self) -> MotionDataModule:
        config = read_checkpoint(self.model)["config"]
        data = instantiate(config["data"], representation=instantiate(config["representation"]))
        data.setup("test")
        return data

    def evaluation(self, name: str = "synthetic", features: bool = False, **size) -> Evaluation:
        """A protocol on the test split, by default with one replication, without multimodality and features."""
        data = self.data()
        protocol = load_protocol(name, data.representation)
        protocol, _ = protocol.resized(
            len(data.test), **{"replications": 1, "multimodality": False} | size
        )
        extractor = MotionCLIPExtractor(str(self.clip)) if features else None
        return Evaluation(protocol, data.test, extractor, data.representation)

    def generator(self, evaluation: Evaluation, folder: Path | None = None, **editing):
        model, protocol = load(self.model), evaluation.protocol
        options = sampling_options(protocol, model, editing=EditRequest(**editing))
        cached: dict[str, Any] = {"seed": 0, "batch_size": 8, "folder": folder, "progress": False}
        return Generator(model, protocol, evaluation.clips, *options, **cached)


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Runs:
    return Runs(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def full(runs, tmp_path_factory) -> tuple[Any, Path]:
    out = tmp_path_factory.mktemp("full") / "result.json"
    return runs.evaluate(out, "replications=2"), out


def means(measured: Measured) -> dict[str, Any]:
    values = {"real": measured.ground_truth or {}, "generated": measured.values or {}}
    return {
        f"{kind} {name}": v and v.mean
        for kind, named in values.items()
        for name, v in named.items()
    }


def changed(evaluation: Evaluation, **options) -> Evaluation:
    return replace(evaluation, protocol=evaluation.protocol.model_copy(update=options))


def motions(out: Path) -> Path:
    return next((out.parent / "model" / "evaluation").glob("*/*"))


def test_a_result_says_what_it_is_and_where_it_comes_from(runs, full, subtests):
    result, out = full
    assert json.loads(out.read_text()) == result.model_dump(), "nothing is written that is not read"
    protocol: Any = load_protocol("synthetic", load(runs.model).representation)
    data = runs.data()
    assert {name.split("/")[0] for name in result.values} == {
        *protocol.metrics,
        *protocol.multimodality.metrics,
    }
    assert {name.split("/")[0] for name in result.ground_truth} == set(protocol.metrics)
    for name, value in result.values.items():
        with subtests.test(name=name):
            assert (value.replications, value.n) == (
                2,
                len(data.test) if name != "multimodality" else 20 * 20,
            )
            assert value.mean is None or value.mean == pytest.approx(sum(value.per_replication) / 2)
    assert result.values["attributes/action"].ci is not None
    assert result.values["diversity"].mean is None, "not 0"
    assert "300" in result.not_computed["diversity"]
    assert result.protocol.model_dump() == {
        "name": "synthetic",
        "version": 2,
        "sha256": protocol.sha256,
    }
    assert (result.split, result.quick, result.seed, result.invalid_because) == (
        "test",
        False,
        0,
        [],
    )
    assert (result.changed, len(set(result.seeds)), result.data.excluded) == (
        {"replications": 2},
        2,
        {},
    )
    assert result.data.fingerprint == data.store.fingerprint == result.extractor.data
    checkpoint = result.checkpoint
    assert {
        len(digest)
        for digest in (checkpoint.sha256, checkpoint.config_sha256, result.extractor.sha256)
    } == {64}
    assert (checkpoint.averaged_weights, checkpoint.selected_by) == (True, "none: last")
    assert "denoiser.latent_dim=" in " ".join(checkpoint.recipe_changes)
    assert (checkpoint.guidance_scale, checkpoint.num_inference_steps, result.cost.nfe) == (
        1.5,
        5,
        5,
    )
    assert (result.device, result.environment["packages"]["torch"]) == ("cpu", torch.__version__)
    value = means(result)
    assert value["real attributes/all"] > 0.95 > 0.5 > value["generated attributes/all"]
    assert value["generated fid"] > 5 * value["real fid"] > 0
    assert value["generated multimodality"] > 0


def test_quick_results_few_motions_and_clips_left_out_are_marked(runs, tmp_path, capsys, subtests):
    root = Path(shutil.copytree(runs.root, tmp_path / "data"))
    (path,) = root.glob("*/store.json")
    path.write_text(
        json.dumps(json.loads(path.read_text()) | {"excluded": {"motions of HumanAct12": 1191}})
    )
    words = [
        "baseline=real",
        "data.crop.min_frames=50",
        "quick=true",
        "samples=7",
        "replications=1",
    ]
    result = runs.of_others(tmp_path / "result.json", *words, root=root)
    test = [clip.length for clip in runs.data().store.clips if clip.split == "test"]
    long = sum(length >= 50 for length in test)
    assert 0 < long < len(test)
    excluded = {
        "motions of HumanAct12": 1191,
        "test clips shorter than 50 frames": len(test) - long,
    }
    assert (result.quick, result.changed, result.data.excluded) == (
        True,
        {"replications": 1, "samples": 7},
        excluded,
    )
    biased, unequal = result.warnings
    assert biased == "fid: biased upward, because 7 motions are fewer than twice the 4 features"
    assert unequal.startswith(f"fid: 7 generated and {long} real motions.")
    out = capsys.readouterr().out
    for words in (
        "excluded from the data set: 1191 motions of HumanAct12",
        "QUICK RUN, NOT FOR PUBLICATION",
        biased,
    ):
        with subtests.test(words=words):
            assert words in out


def test_clips_that_may_have_been_seen_in_training_are_marked(subtests):
    differ = "and evaluated data here differ: splits may overlap"
    cases: list[tuple[str, str, Any, list[str]]] = [
        ("other", "here", "test", [f"training data other {differ}"]),
        ("here", "other", "test", [f"training data of the extractor other {differ}"]),
        ("here", "here", "train", ["the extractor was trained on the evaluated split, train"]),
        ("here", "here", "test", []),
    ]
    for model, extractor, split, reasons in cases:
        with subtests.test(model=model, extractor=extractor, split=split):
            plan: Any = SimpleNamespace(
                data=SimpleNamespace(store=SimpleNamespace(fingerprint="here"))
            )
            plan.model = SimpleNamespace(facts={"fingerprint": model})
            plan.extractor = SimpleNamespace(fingerprint=extractor)
            assert _overlaps(EvaluationRequest(ckpt="a", split=split), plan) == reasons


def killed(words: list[str]) -> None:
    """The command, killed while it writes the motions of the second replication."""
    write = np.savez

    def half(file: Path, **content: Any) -> None:
        if "rep_1" in file.name:
            file.write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)
        write(file, **content)

    np.savez = half
    main(["evaluate", *words])


def test_a_killed_evaluation_goes_on_to_the_same_result(runs, tmp_path, monkeypatch):
    words = [
        "ckpt=model/checkpoints/last.ckpt",
        f"extractor={runs.clip}",
        "replications=2",
        "samples=12",
    ]
    words += ["multimodality=false", "out=result.json", "device=cpu"]
    results = []
    for name in ("killed", "undisturbed"):
        runs.copy(tmp_path / name)
        monkeypatch.chdir(tmp_path / name)
        if name == "killed":
            process = multiprocessing.get_context("fork").Process(target=killed, args=(words,))
            process.start()
            process.join()
            assert process.exitcode == -signal.SIGKILL
            kept = motions(Path("result.json"))
            partial, whole = sorted(path.name for path in kept.iterdir())
            assert (partial[:7], whole, Path("result.json").exists()) == (
                ".rep_1.",
                "rep_0.npz",
                False,
            )
            stamp = (kept / whole).stat().st_mtime_ns
        assert main(["evaluate", *words]) == 0
        results.append(json.loads(Path("result.json").read_text()))
        del results[-1]["cost"]["seconds_per_sample"], results[-1]["environment"]
    assert (tmp_path / "killed" / kept / whole).stat().st_mtime_ns == stamp
    assert results[0] == results[1]


def test_other_metrics_need_no_new_motions(runs, full, tmp_path, monkeypatch, subtests):
    monkeypatch.setattr(Generator, "_generate", lambda *_: pytest.fail("sampled again"))
    model = full[1].parent / "model" / "checkpoints" / "last.ckpt"
    result = runs.evaluate(
        tmp_path / "result.json", "replications=2", "extractor=none", model=model
    )
    assert "extractor" in result.not_computed
    of_joints = ("attributes", "foot_skating", "penetration", "floating", "jitter", "static_share")
    for name, value in result.values.items():
        with subtests.test(name=name):
            assert value.mean == (
                full[0].values[name].mean if name.startswith(of_joints) else None
            ), name


def again(rows: Rows, indices: np.ndarray) -> Rows:
    """The motions with these numbers, as if they were different ones."""
    taken = {
        name: values[indices] if isinstance(values, torch.Tensor) else [values[i] for i in indices]
        for name, values in rows.items()
    }
    return taken | {"keys": torch.arange(len(indices))}


def test_a_bootstrap_measures_each_motion_as_often_as_it_is_drawn(runs, subtests):
    evaluation = runs.evaluation(features=True)
    # Ill-conditioned metrics are left out of the exact comparison.
    metrics = {
        name: metric for name, metric in evaluation.protocol.metrics.items() if name != "mid"
    }
    evaluator = Evaluator(evaluation.extractor, metrics, evaluation.representation)
    rows = [evaluation.protocol.rows(evaluation.clips, 0, replication) for replication in range(2)]
    first, second = (evaluation._paired(drawn) for drawn in rows)
    drawn = evaluator.resample(first, first, second, 3, 2)
    generator = np.random.default_rng(key("bootstrap", 3))
    count = len(first["keys"])
    for number in range(2):
        with subtests.test(draw=number):
            own, others = (generator.integers(count, size=count) for _ in range(2))
            values, _ = evaluator.score(
                again(first, own), again(first, own), again(second, others), 3
            )
            assert values.keys() == drawn.keys()
            for name, value in values.items():
                assert drawn[name][number] == (
                    None if value is None else pytest.approx(value, rel=1e-5)
                ), name
    assert drawn["fid"][0] != drawn["fid"][1]


def test_a_single_replication_has_no_interval_but_the_one_over_motions(
    runs, tmp_path, capsys, subtests
):
    words = ["baseline=noisy", "extractor=none", "replications=1", "resamples=100"]
    result = runs.of_others(tmp_path / "result.json", *words)
    jitter = result.values["jitter"]
    assert (jitter.ci, jitter.replications, len(jitter.resampled), jitter.unit) == (
        None,
        1,
        100,
        "m/s^3",
    )
    assert 0 < jitter.half < jitter.mean
    assert result.ground_truth["jitter"].half is None
    out = capsys.readouterr().out
    count = len(runs.data().test)
    for words in (
        f"1 x {count}; +-: 95 % interval over motions",
        "jitter (m/s^3)",
        "replications=1",
        "synthetic test",
    ):
        with subtests.test(words=words):
            assert words in out


def test_each_number_carries_its_own_number_of_motions(runs, full, tmp_path):
    folder, out = tmp_path / "samples", tmp_path / "result.json"
    folder.mkdir()
    for number, path in enumerate(sorted(motions(full[1]).glob("rep_*.npz"))):
        content = read_samples(path)
        kept = len(content["ids"]) - 30 * number
        frames = int(content["lengths"][:kept].sum())
        parts: dict[str, Any] = {"ids": content["ids"][:kept], "lengths": content["lengths"][:kept]}
        np.savez(folder / path.name, **parts, features=content["features"][:frames])
    result = runs.of_others(out, f"from_samples={folder}")
    count = len(runs.data().test)
    fid = result.values["fid"]
    assert (fid.n, fid.n_per_replication, fid.n_real) == (None, [count, count - 30], count)
    assert fid.counts == result.counts == f"{count} + {count - 30}"
    assert result.ground_truth["fid"].n == count
    assert any(
        f"different numbers of motions ({count}, {count - 30})" in line for line in result.warnings
    )


def test_more_motions_than_clips_are_said_to_repeat_clips(runs):
    evaluation = runs.evaluation(samples=500)
    assert evaluation._conditions() == [
        f"500 motions from {len(evaluation.clips)} clips: clips are repeated, which changes the distances between sets"
    ]
    assert runs.evaluation(samples=5)._conditions() == []


def shares(runs: Runs, samples: int, folder: Path | None) -> Any:
    evaluation = runs.evaluation(features=True, samples=samples, multimodality=True)
    assert evaluation.protocol.multimodality is not None
    several = evaluation.protocol.multimodality.model_copy(update={"prompts": 1})
    evaluation = changed(evaluation, multimodality=several)
    return evaluation.run(runs.generator(evaluation, folder))


def of_baseline(runs: Runs) -> tuple[Any, int]:
    """The result of a baseline as one of several processes gets it, and the number of feature passes."""
    passes, extract = [], Evaluator.extract

    def counted(self: Evaluator, motions: Motions) -> Rows:
        passes.append(len(motions))
        return extract(self, motions)

    evaluation = runs.evaluation(features=True, replications=2, samples=33)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Evaluator, "extract", counted)
        return evaluation.run(Baseline("real", evaluation.clips, "text", 0)), len(passes)


def stopped(runs: Runs) -> str:
    bounds = {"synthetic": {"attributes/all": [0.1, 0.05]}}
    evaluation = changed(runs.evaluation(samples=4), expected=bounds, resized_samples=False)
    with pytest.raises((UserError, SystemExit)) as error:
        evaluation.run(runs.generator(evaluation))
    return error.type.__name__


def test_processes_share_the_work_and_get_one_result(runs, tmp_path, pool, subtests):
    """Shares of unequal sizes, and shares of nothing: batches are dealt as wholes, so nothing depends on the number."""
    both, single = (pool.run(shares, *((runs, *size),) * 2) for size in ((33, tmp_path), (1, None)))
    baselines, ends = (pool.run(function, *((runs,),) * 2) for function in (of_baseline, stopped))
    assert both[0] == both[1]
    assert shares(runs, 33, tmp_path) == both[0], (
        "the same motions have the same values, to the last bit"
    )
    assert {path.name for path in tmp_path.iterdir()} == {"rep_0.npz", "multimodality_0.npz"}
    assert means(shares(runs, 33, tmp_path / "alone")) == means(both[0])
    for file in (tmp_path / "alone").iterdir():
        with subtests.test(file=file.name):
            one, two = read_samples(file), read_samples(tmp_path / file.name)
            assert all(
                np.array_equal(one[name], two[name]) for name in ("ids", "features", "captions")
            )
    assert single[0] == single[1]
    assert (single[0].values["jitter"].n, single[0].cost.nfe) == (1, 5)
    assert means(shares(runs, 1, None)) == means(single[0])
    alone, passes = of_baseline(runs)
    assert passes == 2 * 3, (
        "real, real again for comparisons of sets, and measured; in each replication"
    )
    assert baselines == [(alone, passes)] * 2
    assert ends == ["UserError", "SystemExit"], "one says why"


def test_motions_of_others_are_measured_alike(runs, full, tmp_path, subtests):
    folder, out = tmp_path / "samples", tmp_path / "result.json"
    folder.mkdir()
    for path in motions(full[1]).glob("rep_*.npz"):
        content = read_samples(path)
        order = np.random.default_rng(0).permutation(len(content["ids"]))
        parts = np.split(content["features"], np.cumsum(content["lengths"])[:-1])
        features = np.concatenate([parts[i] for i in order])
        np.savez(
            folder / path.name,
            ids=content["ids"][order],
            lengths=content["lengths"][order],
            features=features,
        )
    measure = partial(runs.of_others, out, f"from_samples={folder}")
    result = measure()
    assert result.checkpoint is None
    assert len(result.samples_sha256) == 64
    for name, value in result.values.items():
        with subtests.test(name=name):
            assert (
                value == full[0].values[name] if name != "multimodality" else value.mean is None
            ), name

    path, data = folder / "rep_0.npz", runs.data()
    (folder / "rep_1.npz").unlink()
    decode = data.representation.decode
    shown = [
        decode(torch.from_numpy(data.store.motion(clip).copy())).numpy() for clip in data.test.clips
    ]
    motion = {"lengths": [len(x) for x in shown], "joints": np.concatenate(shown)}
    np.savez(path, ids=[clip.id for clip in data.test.clips], **motion)
    assert means(measure("extractor=none"))["generated attributes/all"] > 0.95, "joints are encoded"
    np.savez(path, ids=[f"other{number}" for number in range(len(shown))], **motion)
    rows = load_protocol("synthetic", HumanML()).rows(data.test, 0, 0)
    with pytest.raises(UserError, match="clips that are not in the split, such as other"):
        SampleFolder(folder, data.representation)("rep_0", rows, 0)


def test_every_protocol_can_be_read_and_one_is_the_default_for_condition_and_data(subtests):
    nothing = {"keys": torch.zeros(0, dtype=torch.long)}
    for name in protocol_names():
        with subtests.test(name=name):
            protocol = load_protocol(name, HumanML())
            assert (protocol.name, protocol.version >= 1) == (name, True)
            values, reasons = Evaluator(None, protocol.metrics, HumanML()).score(
                nothing, nothing, nothing, 0
            )
            assert (set(values.values()), reasons) == ({None} if protocol.metrics else set(), {}), (
                name
            )
            assert all(set(table) <= set(values) for table in protocol.expected.values()), name
    for model, name in {
        **{"none humanact12": "unconditioned", "action humanact12": "action_to_motion"},
        **{"action uestc": "action_to_motion_uestc", "action bandai": "action_to_motion_own"},
        **{"text synthetic": "synthetic", "text humanml3d": "text_to_motion"},
    }.items():
        with subtests.test(model=model, name=name):
            condition, dataset = model.split()
            trained: Any = SimpleNamespace(conditioned_on=condition, facts={"dataset": dataset})
            assert default_protocol(trained) == name


def test_variants_replace_options_of_their_file(tmp_path):
    names = set(protocol_names())
    assert names & {"editing", "editing_prediction", "reconstruction_kit"} == {
        "editing_prediction",
        "reconstruction_kit",
    }
    with pytest.raises(UserError, match=r"has variants\. Choose one of editing_in_between, "):
        protocol_config("editing")
    with pytest.raises(UserError, match=r"editing_predicton.*Did you mean editing_prediction"):
        protocol_config("editing_predicton")
    plain, flame = (protocol_config(name) for name in ("text_to_motion", "text_to_motion_flame"))
    assert flame == plain | {"name": "text_to_motion_flame", "smoothing": 1.0}

    (tmp_path / "mine.yaml").write_text((FOLDER / "editing.yaml").read_text())
    assert protocol_config(str(tmp_path / "mine_upper_body.yaml"))["edit"] == {
        "joints": "upper_body"
    }


def test_other_sampling_options_have_other_folders_of_motions(runs):
    folders = []
    base: dict[str, Any] = {
        "sampler": "ddim",
        "num_inference_steps": 3,
        "eta": 0.0,
        "spacing": "linspace",
    }
    changed: list[dict[str, Any]] = [
        {},
        {"eta": 0.5},
        {"spacing": "stride"},
        {"num_inference_steps": 4},
        {"guidance_scale": 2.0},
    ]
    for changes in changed:
        options = SamplerOptions(**base | changes)
        request = EvaluationRequest(ckpt=str(runs.model), extractor="none", options=options)
        source = Plan(request, "cpu").source
        assert isinstance(source, Generator)
        folders.append(source.folder)
    assert len(set(folders)) == len(folders)


def test_captions_crops_and_second_draws_are_functions_of_seed_replication_and_id(runs, subtests):
    data = runs.data()
    protocol = load_protocol("synthetic", data.representation)
    rows = {row.id: row for row in protocol.rows(data.test, 0, 1)}
    for row in protocol.model_copy(update={"samples": 10}).rows(data.test, 0, 1):
        with subtests.test(clip=row.id):
            assert (row.caption, row.frames.tolist()) == (
                rows[row.id].caption,
                rows[row.id].frames.tolist(),
            )
    for replication, seed, purpose in ((1, 1, {}), (0, 2, {}), (0, 1, {"purpose": "real"})):
        with subtests.test(replication=replication, seed=seed, purpose=purpose):
            others = protocol.rows(data.test, replication, seed, **purpose)
            assert any(row.caption != rows[row.id].caption for row in others)
    many = protocol.model_copy(update={"samples": len(data.test) + 5, "real_samples": 12})
    assert len({row.id for row in many.rows(data.test, 0, 1)}) == len(data.test) + 5
    assert len(many.rows(data.test, 0, 0, purpose="real")) == 12


def unused(name: str, rows: list[DrawnClip], replication: int) -> Samples:
    raise AssertionError("sampled before all was checked")


def test_unexpected_values_of_real_motions_stop_before_anything_is_generated(runs):
    evaluation = changed(runs.evaluation(), expected={"synthetic": {"attributes/all": [0.5, 0.05]}})
    source = Baseline("real", evaluation.clips, "text", 0)
    measured = evaluation.run(source, force=True)
    assert measured.forced
    assert "expected 0.5" in measured.invalid_because[0]
    right = changed(evaluation, expected={"synthetic": {"attributes/all": [1.0, 0.05]}}).run(
        source, force=True
    )
    assert (right.forced, right.invalid_because) == (False, [])
    with pytest.raises(
        UserError, match=r"real motions have attributes/all .*, expected 0\.5 \+- 0\.05.*force=true"
    ):
        evaluation.run(unused)
    resized = runs.evaluation(samples=8)
    resized = changed(resized, expected={"synthetic": {"attributes/all": [0.5, 0.05]}})
    measured = resized.run(Baseline("real", evaluation.clips, "text", 0))
    assert measured.invalid_because == [], "bounds hold for the number of motions of the protocol"
    assert "the expected values of real motions were not checked" in measured.warnings[0]
    uncomputed = changed(
        runs.evaluation(features=True), expected={"synthetic": {"diversity": [4.0, 0.5]}}
    )
    assert uncomputed.run(None).invalid_because == [
        "diversity of real motions could not be computed (expected: 4)"
    ]
    others = replace(evaluation, clips=runs.data().clips("val"))
    assert others.run(None).invalid_because == [], "nothing is expected of other splits"
    others.clips.store.info["clips"]["test"] = 0  # HumanAct12 is tested on its training clips
    assert others.run(None).invalid_because


def own(folder: Path, old: str, new: str) -> str:
    """The path of the protocol `synthetic` with one replacement."""
    text = (FOLDER / "synthetic.yaml").read_text()
    assert old in text
    (folder / "mine.yaml").write_text(text.replace(old, new))
    return str(folder / "mine.yaml")


def test_what_does_not_fit_is_refused(runs, tmp_path, subtests):
    for message, keys in (
        ("resamples=20: expected 0, or at least 100", {"resamples": 20}),
        ("needs a feature extractor", {"extractor": None, "protocol": "text_to_motion"}),
        ("contains a motion generator, not a motion-CLIP", {"extractor": str(runs.model)}),
        ("Did you mean synthetic", {"protocol": "synthetical"}),
        ("condition text", {"protocol": "action_to_motion"}),
        ("does not edit motions", {"method": "mdm"}),
        ("only to method=mfm", {"protocol": "editing_prediction", "until": 0.3}),
        ("use exactly one of", {"baseline": "real"}),
        ("needs a protocol", {"ckpt": None, "baseline": "real", "data": {"name": "synthetic"}}),
    ):
        with subtests.test(message=message, keys=keys):
            values: Any = {"ckpt": str(runs.model), "extractor": "none"} | keys
            with pytest.raises((UserError, FileNotFoundError)) as refusal:
                Plan(EvaluationRequest(**values), "cpu")
            assert message in str(refusal.value)
    for old, new, message in (
        (
            "normalize: true",
            "normalise: true",
            r"Did you mean metrics\.motions_for_text\.normalize\?",
        ),
        ("  prompts: 20", "  promts: 20", "Did you mean prompts"),
        ("condition: text", "condition: music", "condition"),
        ("replications: 5", "replications: many", "not a whole number"),
        (
            "replications: 5",
            "replications: 5\nexpected: {x: {fidd: [0, 1]}}",
            "unknown value fidd. Did you mean fid",
        ),
    ):
        with (
            subtests.test(old=old, new=new, message=message),
            pytest.raises(UserError, match=message),
        ):
            load_protocol(own(tmp_path, old, new), HumanML())
    accuracy, drift = "accuracy.ActionAccuracy", "reconstruction.KeptDrift"
    clip = "extractor: {_target_: evaluators.extractors.MotionCLIPExtractor, path: motion_clip_synthetic}"
    for old, new, features, message in (
        (
            "diversity.Diversity, pairs: 300, replace: false",
            accuracy,
            True,
            r"diversity \(ActionAccuracy\)",
        ),
        (
            "diversity.TextMultimodality, samples: 20, pairs: 10",
            accuracy,
            True,
            "missing input: logits",
        ),
        ("physics.Floating", drift, True, r"metric floating \(KeptDrift\): missing input: kept"),
        (clip, "extractor: null", False, "missing input: generated"),
    ):
        with subtests.test(old=old, new=new, features=features, message=message):
            evaluation = runs.evaluation(own(tmp_path, old, new), features, multimodality=True)
            with pytest.raises(UserError, match=message):
                evaluation.run(unused)
    for representation, dataset in ((HumanML(variant="clean"), "bandai"), (Rot6D(), "synthetic")):
        with subtests.test(dataset=dataset), pytest.raises(UserError, match="the motions are"):
            MotionCLIPExtractor(str(runs.clip)).check(representation, dataset)


def test_metrics_of_2026(runs):
    values = means(runs.evaluation("text_to_motion_2026", features=True).run(None))
    minilm, equal = "real multi_positive_minilm", "real multi_positive_equal"
    assert values[f"{minilm}/positives"] >= values[f"{equal}/positives"] >= 1
    assert values[f"{equal}/single_top3"] == values["real motions_for_text/top3"]
    assert values["real tmr/threshold_t2m_top10"] >= values["real tmr/all_t2m_top10"] > 0
    assert 0 < values["real kimodo/contact_consistency"] <= 1, (
        "the contacts are read from the features"
    )
    assert values["real edge/pfc"] is None, "defined at 30 frames per second"
    assert values["real claims/all"] > 0.9
    assert values["real claims/captions"] > 0.3
    evaluation = runs.evaluation("editing_in_between_2026")
    values = means(evaluation.run(runs.generator(evaluation)))
    assert values["generated flowmdm/windows"] > 0
    drift = values["generated kept_drift/mean"]
    assert values["generated kimodo/fullbody_keyframe"] == pytest.approx(drift, abs=0.01)


def test_smoothing_takes_each_motion_for_itself(runs):
    rough, smooth = (
        runs.evaluation("text_to_motion", samples=8),
        runs.evaluation("text_to_motion_flame", samples=8),
    )
    one, other = (evaluation.run(runs.generator(evaluation)) for evaluation in (rough, smooth))
    assert other.values["jitter"].mean < 0.5 * one.values["jitter"].mean
    assert other.ground_truth == one.ground_truth
    step = np.repeat([[0.0], [1.0]], 20, axis=0)
    (smoothed,) = smooth._generated(
        Samples(smooth.protocol.rows(smooth.clips, 0, 0)[:1], [step])
    ).features
    assert smoothed[[0, 39], 0] == pytest.approx([0, 1], abs=1e-9)
    assert smoothed[19:21].mean() == pytest.approx(0.5)
    assert 0.25 < smoothed[19, 0] < 0.35, "a normal distribution with a deviation of one frame"


def test_latency_is_that_of_one_motion_at_a_time_after_a_first_one(runs, tmp_path, monkeypatch):
    sizes = []
    generate = MotionGenerator.generate

    def counted(self, batch, *args, **options):
        sizes.append(len(batch))
        return generate(self, batch, *args, **options)

    monkeypatch.setattr(MotionGenerator, "generate", counted)
    result = runs.evaluate(tmp_path / "one.json", "protocol=latency", "extractor=none")
    assert (result.cost.batch_size, result.changed, result.checkpoint.prediction) == (1, {}, "x0")
    assert result.checkpoint.training_hours * result.checkpoint.training_memory_gib > 0
    result = runs.evaluate(
        tmp_path / "eight.json", "protocol=latency", "extractor=none", "batch_size=8"
    )
    assert (result.cost.batch_size, result.changed) == (8, {"batch_size": 8})
    assert sizes == [1] * 17 + [8] * 3, (
        "the first batches are not timed; motions of batches of 1 are not read"
    )


@pytest.mark.parametrize("name", ["prediction", "interpolation", "upper_body"])
def test_edits_keep_what_they_are_to_keep(runs, tmp_path, name, subtests):
    evaluation = runs.evaluation(f"editing_{name}", samples=9)
    source = runs.generator(evaluation, tmp_path)
    assert source.edit == {"mode": "x0", "resample": 1, "strength": None}
    assert runs.generator(evaluation, method="flame").edit["mode"] == "x_t"
    values = means(evaluation.run(source))
    assert values["generated displacement/ade"] > 0.01
    in_place = name in ("prediction", "upper_body")
    assert (values["generated kept_drift/largest"] < 1e-4) is in_place, (
        "behind a new part, kept frames start elsewhere"
    )
    assert values["real kept_drift/largest"] == 0
    rows, representation = (
        evaluation.protocol.rows(evaluation.clips, 0, 0),
        evaluation.representation,
    )
    content = read_samples(tmp_path / "rep_0.npz")
    generated = np.split(content["features"], np.cumsum(content["lengths"])[:-1])
    upper = representation.joint_features(find_joints(representation.skeleton, "upper_body"))
    lower = (representation.joint_features(range(22)) & ~upper).numpy()
    for row, motion, real in zip(
        rows, generated, real_motions(evaluation.clips, rows), strict=True
    ):
        with subtests.test(clip=row.id):
            assert len(row.frames) == len(motion)
            kept = np.zeros_like(real, bool) | lower
            if name != "upper_body":
                kept[:] = False
                kept[: len(real) // 4] = name == "prediction"
                kept[::5] |= name == "interpolation"
            np.testing.assert_allclose(motion[kept], real[kept], atol=1e-4)
            assert np.abs(motion - real)[~kept].max() > 0.1


def test_shuffled_motions_are_all_there_and_belong_to_what_others_ask_for(runs, subtests):
    clips = runs.data().test
    rows = load_protocol("synthetic", clips.representation).rows(clips, 0, 0)
    real = [motion.tobytes() for motion in real_motions(clips, rows)]
    for condition in ("text", "action"):
        with subtests.test(condition=condition):
            requests = [row.text if condition == "text" else row.clip.action for row in rows]
            requested = dict(zip(real, requests, strict=True))
            shuffled = [
                x.tobytes()
                for x in Baseline("shuffled", clips, condition, 0)("rep_0", rows, 0).features
            ]
            assert sorted(shuffled) == sorted(real)
            assert all(
                requested[motion] != request
                for request, motion in zip(requests, shuffled, strict=True)
            )
            with pytest.raises(UserError, match="2 of 3 motions have the same caption or label"):
                Baseline("shuffled", clips, condition, 0)("rep_0", [rows[0], rows[0], rows[1]], 0)
    with pytest.raises(UserError, match="real, shuffled, noisy, static"):
        Baseline("shufled", clips, "text", 0)
    with pytest.raises(UserError, match="without text or labels cannot be shuffled"):
        Baseline("shuffled", clips, "none", 0)


@pytest.mark.parametrize(
    "extractor", ["none", None, "motion_clip_synthetic", "clip", "clip/checkpoints/last.ckpt"]
)
def test_an_evaluation_in_training_takes_the_extractors_that_evaluate_takes(runs, extractor):
    source = (
        str(runs.clip.parents[2] / extractor) if (extractor or "").startswith("clip") else extractor
    )
    callback = Evaluate("synthetic", source, every_n_steps=1)
    assert callback.path == source


def test_a_missing_extractor_of_the_selection_stops_before_training(
    runs, tmp_path, capsys, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    words = [*GENERATOR, f"data_root={runs.root}", "run.dir=run", "trainer.max_steps=2"]
    assert main(["train", "quickstart", *words, "selection=babel"]) == 1
    error = capsys.readouterr().err
    assert (
        "callbacks.evaluate.extractor=runs/motion_clip/babel/default/checkpoints/last.ckpt: no such file"
        in error
    )
    assert (
        "(make train EXP=motion_clip/babel), or choose the checkpoint by the validation loss"
        in error
    )
    assert not Path("run").exists()
    assert main(["train", "quickstart", *words, "selection=t2m"]) == 1
    assert (
        'assets/t2m/synthetic is missing; see "Extractors" in docs/evaluation.md'
        in capsys.readouterr().err
    )


def test_the_evaluator_in_the_package_finds_texts_with_the_attributes_of_real_motions(runs):
    plan = Plan(EvaluationRequest(ckpt=str(runs.model), data_root=str(runs.root)), "cpu")
    assert isinstance(plan.extractor, MotionCLIPExtractor)
    assert plan.extractor.path == SHIPPED["motion_clip_synthetic"]
    assert plan.extractor.path.stat().st_size < 3e6
    clips = [
        clip
        for number in range(400)
        if (clip := Synthetic(clips=4000).clip(number, 20)).split == "test"
    ]
    lines = [plan.representation.encode(torch.from_numpy(clip.motion)) for clip in clips]
    motions = torch.cat(
        [plan.extractor.task(x[None], torch.ones(1, len(x), dtype=torch.bool)) for x in lines]
    )
    texts = plan.extractor.task.text([clip.captions[0] for clip in clips])
    nearest = torch.cdist(motions, texts).argmin(1).tolist()
    right = [
        clips[other].attributes == clip.attributes
        for clip, other in zip(clips, nearest, strict=True)
    ]
    assert (len(right) > 30, np.mean(right) > 0.9) == (True, True)


def test_results_of_other_sizes_have_other_files(runs):
    config = read_checkpoint(runs.model)["config"]
    shared: dict[str, Any] = {name: config[name] for name in ("data", "representation")}
    shared |= {"protocol": "synthetic", "baseline": "real", "extractor": "none"}
    shared["data_root"] = str(runs.root)
    sizes: list[dict[str, Any]] = [{}, {"quick": True}, {"replications": 3}]
    sizes += [{"samples": 20}, {"seed": 1}, {"seed": 2, "samples": 20}]
    plans = [Plan(EvaluationRequest(**shared, **size), "cpu") for size in sizes]
    assert len({plan.path for plan in plans}) == len(sizes)
