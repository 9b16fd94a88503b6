"""Evaluation by protocol: what stands in the result, what is kept, what is refused."""

import json
import math
import os
import pickle
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from support.distributed import GlooPool
from support.runs import TINY

from evaluators.evaluation import load_protocol
from evaluators.evaluator import Evaluator, Extracted, Motions
from evaluators.extractors import ClassifierExtractor, MotionCLIPExtractor, T2MExtractor
from evaluators.extractors.action_gru import ActionGRU
from evaluators.extractors.stgcn import UESTC, Unconstrained
from evaluators.extractors.t2m import T2MEvaluator
from evaluators.sources import Baseline, Generator, read_samples, real_motions
from flame_mdm.__main__ import main
from flame_mdm.batch import length_mask
from flame_mdm.checkpoints.loading import load
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import EXPERIMENTS, compose, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.errors import UserError
from flame_mdm.representations.rot6d import Rot6D
from flame_mdm.representations.skeleton import find_joints
from flame_mdm.schemas import read_result
from flame_mdm.seeds import key
from flame_mdm.task import MotionGeneration

pytestmark = pytest.mark.slow

DATA = ("data=synthetic", "data.source.clips=400")
GENERATOR = ["data.source.clips=400", *TINY[1:], "callbacks.samples=null", "trainer.val_check_interval=2"]
CLIP = [
    "data.source.clips=400",
    "data.batch_size=16",
    "condition=learned",
    "condition.features=16",
    *(f"task.network.{size}" for size in ("latent_dim=16", "ff_size=16", "num_layers=1", "num_heads=2")),
    "task.network.embedding_dim=4",
    "trainer.accelerator=cpu",
    "trainer.enable_progress_bar=false",
    "trainer.val_check_interval=2",
]


class Runs:
    """A tiny model and a tiny motion-CLIP on the same 400 clips."""

    def __init__(self, folder: Path):
        self.folder = folder
        data = [f"data_root={folder / 'data'}", "trainer.max_steps=2"]
        assert main(["train", "quickstart", *GENERATOR, *data, f"run.dir={folder / 'model'}"]) == 0
        assert main(["train", "motion_clip/synthetic", *CLIP, *data, f"run.dir={folder / 'clip'}"]) == 0
        self.model, self.clip = (folder / name / "checkpoints" / "last.ckpt" for name in ("model", "clip"))

    def evaluate(self, out: Path, *words: str, model: Path | None = None) -> int:
        """The exit code of the command; the model is copied beside `out`, so that no test sees another's motions."""
        if model is None:
            model = out.parent / "model" / "checkpoints" / "last.ckpt"
            model.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(self.model, model)
        extractor = [] if any(word.startswith("extractor=") for word in words) else [f"extractor={self.clip}"]
        return main(["evaluate", f"ckpt={model}", *extractor, f"out={out}", "device=cpu", *words])

    def result(self, out: Path, *words: str) -> dict:
        assert self.evaluate(out, *words) == 0
        return json.loads(out.read_text())

    def data(self) -> MotionDataModule:
        config = read_checkpoint(self.model)["config"]
        representation = instantiate(config["representation"])
        data = instantiate(config["data"], representation=representation)
        data.setup("test")
        return data


@pytest.fixture(scope="module")
def runs(tmp_path_factory) -> Runs:
    return Runs(tmp_path_factory.mktemp("runs"))


@pytest.fixture(scope="module")
def full(runs, tmp_path_factory) -> tuple[dict, Path]:
    """The result of an evaluation that was not disturbed, and where it stands."""
    out = tmp_path_factory.mktemp("full") / "result.json"
    return runs.result(out, "replications=2"), out


def motions(out: Path) -> Path:
    """Where the motions of a result are kept."""
    (folder,) = (out.parent / "model" / "evaluation").glob("*/*")
    return folder


def test_a_result_says_what_it_is_and_where_it_comes_from(runs, full):
    result, out = full
    protocol = load_protocol("synthetic", load(runs.model).representation)
    assert protocol.multimodality is not None
    names = {*protocol.metrics, *protocol.multimodality["metrics"]}
    assert {name.split("/")[0] for name in result["values"]} == names
    assert {name.split("/")[0] for name in result["ground_truth"]} == set(protocol.metrics)
    count = len(runs.data().test)
    for name, value in result["values"].items():
        assert value["replications"] == 2
        assert value["n"] == (count if name != "multimodality" else 20 * 20)
        assert value["mean"] is None or value["mean"] == pytest.approx(sum(value["each"]) / 2)
    assert result["values"]["attributes/action"]["ci"] is not None
    sha256 = protocol.sha256
    assert result["protocol"] == {"name": "synthetic", "version": 1, "sha256": sha256, "length_source": "ground truth"}
    assert len(sha256) == 64
    assert len(set(result["seeds"])) == 2
    assert result["baseline"] is result["samples_sha256"] is None
    assert result["precision"].startswith("float32")
    assert result["checkpoint"]["parameters"] > 0
    assert (result["split"], result["published_split"], result["quick"], result["seed"]) == ("test", False, False, 0)
    assert result["changed"] == {"replications": 2}
    assert result["valid"]
    assert result["data"]["excluded"] == {}
    assert result["data"]["fingerprint"] == runs.data().store.fingerprint == result["extractor"]["data"]
    checkpoint = result["checkpoint"]
    assert len(checkpoint["sha256"]) == len(checkpoint["config_sha256"]) == len(result["extractor"]["sha256"]) == 64
    assert checkpoint["averaged_weights"]
    assert checkpoint["selected_by"] == "none: last"
    assert (checkpoint["guidance_scale"], checkpoint["num_inference_steps"]) == (2.5, 5)
    assert result["cost"]["nfe"] == 5
    assert result["cost"]["seconds_per_sample"] > 0
    assert result["environment"]["packages"]["torch"] == torch.__version__
    assert result["device"] == "cpu"
    assert not list(out.parent.rglob("*.partial"))


def test_a_result_counts_the_clips_that_were_left_out(runs, full, tmp_path, capsys):
    root = Path(shutil.copytree(runs.folder / "data", tmp_path / "data"))
    (path,) = root.glob("*/store.json")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"excluded": {"motions of HumanAct12": 1191}}))
    out = tmp_path / "result.json"
    words = ["baseline=real", *DATA, "data.crop.min_frames=50", f"data_root={root}", "protocol=synthetic", "quick=true"]
    assert main(["evaluate", *words, "extractor=none", f"out={out}", "device=cpu"]) == 0
    short = sum(clip.split == "test" and clip.length < 50 for clip in runs.data().store.clips)
    excluded = {"motions of HumanAct12": 1191, "test clips shorter than 50 frames": short}
    assert json.loads(out.read_text())["data"]["excluded"] == excluded
    assert short > 0
    assert "excluded from the data set: 1191 motions of HumanAct12" in capsys.readouterr().out
    assert read_result(out).data.excluded == excluded


def test_real_motions_show_what_was_asked_and_an_untrained_model_does_not(full):
    result, _ = full
    assert result["ground_truth"]["attributes/all"]["mean"] > 0.95
    assert result["values"]["attributes/all"]["mean"] < 0.5
    assert result["values"]["fid"]["mean"] > 5 * result["ground_truth"]["fid"]["mean"] > 0
    assert result["values"]["multimodality"]["mean"] > 0


KILLED = """
import os, signal, sys
import numpy
from flame_mdm.__main__ import main
write = numpy.savez
def half(file, **content):
    if "rep_1" in file.name:
        file.write_bytes(b"half")
        os.kill(os.getpid(), signal.SIGKILL)
    write(file, **content)
numpy.savez = half
main(["evaluate", *sys.argv[1:]])
"""
"""The command, ended by the operating system while it writes the motions of the second replication."""


def test_a_killed_evaluation_goes_on_to_the_same_result(runs, tmp_path, monkeypatch):
    words = ["ckpt=model/last.ckpt", f"extractor={runs.clip}", "replications=2", "out=result.json", "device=cpu"]
    folders = [tmp_path / "undisturbed", tmp_path / "killed"]
    for folder in folders:
        (folder / "model").mkdir(parents=True)
        shutil.copy(runs.model, folder / "model" / "last.ckpt")
    monkeypatch.chdir(folders[0])
    assert main(["evaluate", *words]) == 0
    monkeypatch.chdir(folders[1])
    killed = subprocess.run([sys.executable, "-c", KILLED, *words], capture_output=True, check=False)
    assert killed.returncode == -signal.SIGKILL, killed.stderr
    (kept,) = (folders[1] / "model" / "evaluation").glob("*/*")
    partial, whole = sorted(path.name for path in kept.iterdir())
    assert partial.startswith(".rep_1.")
    assert whole == "rep_0.npz"
    assert not (folders[1] / "result.json").exists()
    stamp = (kept / "rep_0.npz").stat().st_mtime_ns
    assert main(["evaluate", *words]) == 0
    results = [written(folder / "result.json") for folder in folders]
    assert (kept / "rep_0.npz").stat().st_mtime_ns == stamp
    assert main(["evaluate", *words]) == 0
    assert written(tmp_path / "killed" / "result.json") == results[1], "the time of sampling is kept with the motions"
    undisturbed, gone_on = (json.loads(result) for result in results)
    for result in (undisturbed, gone_on):
        del result["cost"]["seconds_per_sample"]
    assert json.dumps(undisturbed) == json.dumps(gone_on)


def written(path: Path) -> str:
    """A result as it is written, without the state of the working tree, which others may change meanwhile."""
    result = json.loads(path.read_text())
    del result["environment"]["changed"], result["environment"]["commit"]
    return json.dumps(result)


def test_other_metrics_need_no_new_motions(runs, full, tmp_path, monkeypatch):
    monkeypatch.setattr(Generator, "_generate", lambda *_: pytest.fail("sampled again"))
    model = full[1].parent / "model" / "checkpoints" / "last.ckpt"
    out = tmp_path / "result.json"
    assert runs.evaluate(out, "replications=2", "extractor=none", "resamples=100", model=model) == 0
    result = json.loads(out.read_text())
    assert {len(value.pop("resampled", [])) for value in result["values"].values()} == {0, 100}  # not of multimodality
    of_joints = ("attributes", "foot_skating", "penetration", "floating", "jitter", "static_share")
    for name, value in result["values"].items():
        if name.startswith(of_joints):
            assert value == full[0]["values"][name]
        else:
            assert (value["mean"], value["ci"]) == (None, None), name
    assert "extractor" in result["not_computed"]


def test_the_batch_size_does_not_matter(runs, full, tmp_path):
    result = runs.result(tmp_path / "result.json", "replications=2", "batch_size=7")
    for kind in ("ground_truth", "values"):
        for name, value in result[kind].items():
            expected = full[0][kind][name]["mean"]
            # Shares may move by one sample in 40 where two distances are all but equal.
            assert value["mean"] == (expected and pytest.approx(expected, rel=2e-3, abs=0.03)), name


def test_what_cannot_be_computed_is_null_with_its_reason(full):
    result, _ = full
    assert result["values"]["diversity"]["mean"] is None
    assert "300" in result["not_computed"]["diversity"]


def test_quick_results_are_marked(runs, tmp_path, capsys):
    result = runs.result(tmp_path / "result.json", "quick=true", "samples=33")
    assert result["quick"]
    assert result["changed"] == {"replications": 2, "samples": 33}
    assert result["values"]["multimodality"]["mean"] is None
    assert "QUICK RUN, NOT FOR PUBLICATION" in capsys.readouterr().out


def test_motions_of_others_are_measured_alike(runs, full, tmp_path):
    given, out = tmp_path / "given", tmp_path / "result.json"
    given.mkdir()
    for path in motions(full[1]).glob("rep_*.npz"):
        content = read_samples(path)
        order = np.random.default_rng(0).permutation(len(content["ids"]))
        parts = np.split(content["features"], np.cumsum(content["lengths"])[:-1])
        features = np.concatenate([parts[i] for i in order])
        np.savez(given / path.name, ids=content["ids"][order], lengths=content["lengths"][order], features=features)
    words = [f"from_samples={given}", *DATA, f"data_root={runs.folder / 'data'}", "protocol=synthetic"]
    assert main(["evaluate", *words, f"extractor={runs.clip}", f"out={out}"]) == 0
    result = json.loads(out.read_text())
    assert result["checkpoint"] is None
    assert len(result["samples_sha256"]) == 64
    for name, value in result["values"].items():
        if name != "multimodality":
            assert value == full[0]["values"][name], name
    assert result["values"]["multimodality"]["mean"] is None

    path = given / "rep_0.npz"
    content = read_samples(path)
    ids = [f"other{number}" for number in range(len(content["ids"]))]
    np.savez(path, ids=ids, lengths=content["lengths"], features=content["features"])
    assert main(["evaluate", *words, f"extractor={runs.clip}", f"out={out}"]) == 1


def test_joints_of_others_are_encoded(runs, tmp_path):
    data = runs.data()
    clips, given = data.test, tmp_path / "given"
    given.mkdir()
    shown = [data.representation.decode(torch.from_numpy(data.store.motion(c).copy())).numpy() for c in clips.clips]
    ids, lengths = [clip.id for clip in clips.clips], [len(x) for x in shown]
    np.savez(given / "a.npz", ids=ids, lengths=lengths, joints=np.concatenate(shown))
    words = [f"from_samples={given}", *DATA, f"data_root={runs.folder / 'data'}", "protocol=synthetic"]
    assert main(["evaluate", *words, "extractor=none", f"out={tmp_path / 'result.json'}"]) == 0
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["values"]["attributes/all"]["mean"] > 0.95


def test_the_same_features_give_the_same_bits_in_any_order(runs, monkeypatch):
    data = runs.data()
    protocol = load_protocol("synthetic", data.representation)
    rows = protocol.rows(data.test, 0, 0)
    extractor = protocol.open_extractor(str(runs.clip), data.representation, "synthetic")
    evaluator = Evaluator(extractor, protocol.metrics, data.representation)
    one = evaluator.extract(protocol.motions(rows, real_motions(data.test, rows)))
    values, _ = evaluator.score(one, one, one, 3)

    def shuffled(extracted: Extracted) -> Extracted:
        order = torch.randperm(len(extracted), generator=torch.Generator().manual_seed(1)).tolist()
        picked = {
            n: v[order] if isinstance(v, torch.Tensor) else [v[i] for i in order] for n, v in extracted.rows.items()
        }
        return Extracted(picked, [extracted.joints[i] for i in order])

    monkeypatch.setattr("evaluators.evaluator.CHUNK", 7)
    again, _ = evaluator.score(shuffled(one), shuffled(one), one, 3)
    assert again == values
    other, _ = evaluator.score(one, one, one, 4)
    assert other != values, "pools are drawn from the seed"


def test_a_bootstrap_measures_each_motion_as_often_as_it_is_drawn(runs):
    data = runs.data()
    protocol = load_protocol("synthetic", data.representation)
    extractor = protocol.open_extractor(str(runs.clip), data.representation, "synthetic")
    metrics = {name: config for name, config in protocol.metrics.items() if name != "mid"}  # ill-conditioned
    evaluator = Evaluator(extractor, metrics, data.representation)
    first, second = (
        evaluator.extract(protocol.motions(rows, real_motions(data.test, rows)))
        for rows in (protocol.rows(data.test, 0, replication) for replication in range(2))
    )

    def taken(extracted: Extracted, indices: np.ndarray) -> Extracted:
        rows = {
            name: values[indices] if isinstance(values, torch.Tensor) else [values[i] for i in indices]
            for name, values in extracted.rows.items()
        }
        return Extracted(rows | {"keys": torch.arange(len(indices))}, [extracted.joints[i] for i in indices])

    drawn = evaluator.resample(first, first, second, 3, 2)
    generator = np.random.default_rng(key("bootstrap", 3))
    for number in range(2):
        own, others = (generator.integers(len(first), size=len(first)) for _ in range(2))
        values, _ = evaluator.score(taken(first, own), taken(first, own), taken(second, others), 3)
        assert values.keys() == drawn.keys()
        for name, value in values.items():
            assert drawn[name][number] == (None if value is None else pytest.approx(value, rel=1e-5)), name
    assert drawn["fid"][0] != drawn["fid"][1]


def test_captions_crops_and_second_draws_are_functions_of_seed_replication_and_id(runs):
    data = runs.data()
    protocol = load_protocol("synthetic", data.representation)
    rows = {row.id: row for row in protocol.rows(data.test, 0, 1)}
    protocol.samples = 10
    few = protocol.rows(data.test, 0, 1)
    assert [row.caption for row in few] == [rows[row.id].caption for row in few]
    assert all((row.frames == rows[row.id].frames).all() for row in few)
    protocol.samples = None
    for other in (
        protocol.rows(data.test, 1, 1),
        protocol.rows(data.test, 0, 2),
        protocol.rows(data.test, 0, 1, purpose="real"),
    ):
        assert any(row.caption != rows[row.id].caption for row in other)
    protocol.samples = len(data.test) + 5
    many = protocol.rows(data.test, 0, 1)
    assert len({row.id for row in many}) == len(many) == len(data.test) + 5


@pytest.fixture
def off(tmp_path) -> str:
    """A protocol that expects what real motions do not have."""
    text = (EXPERIMENTS / "evaluation" / "synthetic.yaml").read_text()
    (tmp_path / "off.yaml").write_text(f"{text}expected:\n  synthetic:\n    attributes/all: [0.5, 0.05]\n")
    return f"protocol={tmp_path / 'off.yaml'}"


def test_off_ground_truth_stops_before_anything_is_generated(runs, off, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Generator, "_generate", lambda *_: pytest.fail("sampled before the ground truth was checked"))
    line = refused(runs, capsys, tmp_path, off, "replications=2", "extractor=none")
    assert "nothing was generated, because real motions have attributes/all" in line
    assert "expected 0.5 +- 0.05" in line
    assert "force=true" in line
    assert not (tmp_path / "result.json").exists()
    assert not list(tmp_path.rglob("rep_*.npz"))


def test_a_forced_result_says_so(runs, off, tmp_path):
    words = ["replications=1", "extractor=none", "multimodality=false"]
    result = runs.result(tmp_path / "result.json", off, *words, "force=true")
    assert (result["valid"], result["forced"]) == (False, True)
    assert "expected 0.5" in result["invalid_because"][0]
    (tmp_path / "right.yaml").write_text((tmp_path / "off.yaml").read_text().replace("[0.5,", "[1.0,"))
    result = runs.result(tmp_path / "result.json", f"protocol={tmp_path / 'right.yaml'}", *words, "force=true")
    assert (result["valid"], result["forced"], result["invalid_because"]) == (True, False, [])


def refused(runs: Runs, capsys, tmp_path: Path, *words: str) -> str:
    assert runs.evaluate(tmp_path / "result.json", *words) == 1
    lines = [line for line in capsys.readouterr().err.splitlines() if "error:" in line]
    assert len(lines) == 1
    return lines[0]


def test_what_does_not_fit_is_refused_in_one_line(runs, capsys, tmp_path):
    assert "resamples=20: give 0, or 100 or more" in refused(runs, capsys, tmp_path, "resamples=20")
    assert "needs a feature extractor" in refused(runs, capsys, tmp_path, "extractor=null")
    assert "holds a motion generator, not a motion-CLIP" in refused(runs, capsys, tmp_path, f"extractor={runs.model}")
    assert "no such checkpoint" in refused(runs, capsys, tmp_path, f"extractor={tmp_path / 'none.ckpt'}")
    assert "synthetic" in refused(runs, capsys, tmp_path, "protocol=synthetical")
    assert "condition text" in refused(runs, capsys, tmp_path, "protocol=action_to_motion")
    assert "at least 1" in refused(runs, capsys, tmp_path, "samples=0")
    assert "batch_size" in refused(runs, capsys, tmp_path, "batch_size=many")
    assert "at least 1" in refused(runs, capsys, tmp_path, "batch_size=0")
    broken = tmp_path / "broken.ckpt"
    broken.write_bytes(runs.model.read_bytes()[:1000])
    assert runs.evaluate(tmp_path / "result.json", model=broken) == 1
    assert "damaged" in capsys.readouterr().err
    assert main(["evaluate", "protocol=synthetic"]) == 1
    assert not (tmp_path / "result.json").exists()


def protocol_file(folder: Path, old: str, new: str) -> str:
    """The words that evaluate by the protocol `synthetic` with one replacement."""
    text = (EXPERIMENTS / "evaluation" / "synthetic.yaml").read_text()
    assert old in text
    (folder / "mine.yaml").write_text(text.replace(old, new))
    return f"protocol={folder / 'mine.yaml'}"


def test_misspelt_options_of_metrics_are_refused_before_anything_is_generated(runs, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(Generator, "_generate", lambda *_: pytest.fail("sampled"))
    for old, new, message in (
        ("normalize: true", "normalise: true", "Did you mean metrics.motions_for_text.normalize?"),
        ("FrechetMotionDistance", "FrechetMotionDistance, epz: 1", "unknown config key 'metrics.fid.epz'"),
        ("samples: 20, pairs: 10", "samples: 20, pair: 10", "multimodality.pairs?"),
        ("  prompts: 20", "  promts: 20", "promts"),
    ):
        assert message in refused(runs, capsys, tmp_path, protocol_file(tmp_path, old, new))


def test_missing_inputs_of_metrics_are_refused_before_anything_is_generated(runs, capsys, tmp_path, monkeypatch):
    monkeypatch.setattr(Generator, "_generate", lambda *_: pytest.fail("sampled"))
    metrics = "evaluators.metrics"
    for old, new, message in (
        ("diversity.Diversity, pairs: 300, replace: false", "accuracy.ActionAccuracy", "diversity (ActionAccuracy)"),
        ("diversity.TextMultimodality, samples: 20, pairs: 10", "accuracy.ActionAccuracy", "missing input: logits"),
        ("physics.Floating", "reconstruction.KeptDrift", "metric floating (KeptDrift): missing input: kept"),
    ):
        words = protocol_file(tmp_path, f"{metrics}.{old}", f"{metrics}.{new}")
        assert message in refused(runs, capsys, tmp_path, words, "quick=false")
    words = protocol_file(
        tmp_path, "extractor: {_target_: evaluators.extractors.MotionCLIPExtractor}", "extractor: null"
    )
    assert "missing input: generated" in refused(runs, capsys, tmp_path, words)
    words = protocol_file(tmp_path, f"{metrics}.physics.Floating", f"{metrics}.reconstruction.KeptDrift")
    assert "missing input: kept" in refused(runs, capsys, tmp_path, words, "extractor=none")


def test_damaged_motions_are_named(runs, capsys, tmp_path):
    out = tmp_path / "result.json"
    runs.result(out, "quick=true")
    path = motions(out) / "rep_1.npz"
    path.write_bytes(path.read_bytes()[:500])
    assert f"{path}: damaged" in refused(runs, capsys, tmp_path, "quick=true")


def test_an_extractor_of_other_motions_is_refused(runs):
    data, extractor = runs.data(), MotionCLIPExtractor(str(runs.clip))
    extractor.check(data.representation, "synthetic")
    with pytest.raises(UserError, match="data set synthetic"):
        extractor.check(data.representation, "bandai")
    data.representation.name = "other"
    with pytest.raises(UserError, match="other"):
        extractor.check(data.representation, "synthetic")


def test_released_classifiers_give_features_and_scores_of_their_data_alone(tmp_path):
    representation = Rot6D()
    x = torch.randn(3, 20, 150)
    joints, mask = representation.decode(x), torch.ones(3, 20, dtype=torch.bool)
    made = {"humanact12": ({"model": ActionGRU().state_dict()}, 12), "uestc": (UESTC().state_dict(), 40)}
    made["humanact12_unconstrained"] = (Unconstrained().state_dict(), 12)
    for kind, (content, actions) in made.items():
        torch.save(content, tmp_path / kind)
        extractor = ClassifierExtractor(kind, str(tmp_path / kind))
        extractor.check(representation, extractor.made_for[1])
        with torch.no_grad():
            found = extractor.motions(x, joints, mask)
        assert found["logits"].shape == (3, actions)
        assert found["features"].shape[0] == 3
        assert extractor.texts(["walk"], [None]) is None
        with pytest.raises(UserError, match="bandai"):
            extractor.check(representation, "bandai")


def test_the_t2m_evaluator_is_read_from_a_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"lacks finest\.tar, mean\.npy"):
        T2MExtractor(str(tmp_path))
    network = T2MEvaluator(torch.zeros(251), torch.ones(251))
    parts = ("movement_encoder", "text_encoder", "motion_encoder")
    torch.save({part: network.get_submodule(part).state_dict() for part in parts}, tmp_path / "finest.tar")
    np.save(tmp_path / "mean.npy", np.zeros(251, np.float32))
    np.save(tmp_path / "std.npy", np.ones(251, np.float32))
    np.save(tmp_path / "our_vab_data.npy", np.random.default_rng(0).normal(size=(4, 300)))
    words = {word: row for row, word in enumerate(("sos", "eos", "unk", "walk"))}
    (tmp_path / "our_vab_idx.pkl").write_bytes(pickle.dumps(words))
    extractor = T2MExtractor(str(tmp_path))
    kit = instantiate(compose("kit/mdm")["representation"])
    with torch.no_grad():
        mask = length_mask(torch.tensor([40, 24]))
        assert extractor.motions(torch.randn(2, 40, 251), torch.zeros(0), mask)["features"].shape == (2, 512)
        texts = extractor.texts(["walk", "run"], [["walk/VERB"], ["run/VERB"]])
    assert texts.shape == (2, 512)
    assert not torch.allclose(texts[0], texts[1])
    legacy = T2MExtractor(str(tmp_path), full_length=True)
    with torch.no_grad():
        full = legacy.texts(["walk", "far"], [["walk/VERB"], ["walk/VERB"] * 20])
        own = extractor.texts(["walk", "far"], [["walk/VERB"], ["walk/VERB"] * 20])
    assert not torch.allclose(full[0], own[0], atol=1e-3), "the slots behind the caption are read, too"
    torch.testing.assert_close(full[1], own[1])
    with pytest.raises(UserError, match="tagged words"):
        extractor.texts(["walk"], [None])
    extractor.check(kit, "kit")
    with pytest.raises(UserError, match="bandai"):
        extractor.check(kit, "bandai")


@pytest.mark.slow
def test_metrics_of_2026(runs, tmp_path):
    options = ["protocol=text_to_motion_2026", f"extractor={runs.clip}", "replications=1"]
    values = {k: v["mean"] for k, v in runs.result(tmp_path / "text.json", *options)["values"].items()}
    assert values["multi_positive_minilm/positives"] >= values["multi_positive_equal/positives"] >= 1
    assert values["multi_positive_equal/single_top3"] == values["motions_for_text/top3"]
    assert values["tmr/threshold_t2m_top10"] >= values["tmr/all_t2m_top10"] > 0
    assert 0 < values["kimodo/contact_consistency"] <= 1, "the contacts are read from the features"
    assert values["edge/pfc"] is None, "defined at 30 frames per second"
    options = ["protocol=editing_in_between_2026", "replications=1"]
    values = {k: v["mean"] for k, v in runs.result(tmp_path / "edit.json", *options)["values"].items()}
    assert values["flowmdm/windows"] > 0
    assert values["kimodo/fullbody_keyframe"] == pytest.approx(values["kept_drift/mean"], abs=0.01)


@pytest.mark.parametrize(("condition", "protocol"), [("action", "action_to_motion_own"), ("none", "unconditioned")])
def test_models_without_text_are_measured_by_protocols_of_their_own(runs, tmp_path, condition, protocol):
    words = [w for w in GENERATOR if not w.startswith("condition")]
    words += [f"condition={condition}", *(["condition.features=16"] if condition == "action" else [])]
    folder = [f"data_root={runs.folder / 'data'}", f"run.dir={tmp_path / 'run'}", "trainer.max_steps=1"]
    assert main(["train", "quickstart", *words, *folder]) == 0
    model, out = tmp_path / "run" / "checkpoints" / "last.ckpt", tmp_path / "result.json"
    options = ["quick=true", "num_inference_steps=2", "extractor=none"]
    assert runs.evaluate(out, *options, model=model) == 0
    result = json.loads(out.read_text())
    assert result["protocol"]["name"] == protocol
    assert {value["mean"] for value in result["values"].values()} >= {None}
    assert (tmp_path / "run" / "evaluation" / f"{protocol}-1").is_dir()
    assert runs.evaluate(out, *options, "protocol=text_to_motion", model=model) == 1


def test_a_model_of_other_data_is_marked(runs, tmp_path):
    config, other = read_checkpoint(runs.model)["config"], tmp_path / "data"
    config["data"] |= {"root": str(other), "source": config["data"]["source"] | {"clips": 60}}
    instantiate(config["data"], representation=instantiate(config["representation"])).prepare_data()
    out = tmp_path / "result.json"
    data = ["data=synthetic", "data.source.clips=60", f"data_root={other}"]
    result = runs.result(out, *data, "quick=true", "extractor=none")
    assert not result["valid"]
    assert "splits may overlap" in result["invalid_because"][0]


def test_an_extractor_that_may_have_seen_the_clips_is_marked(runs, tmp_path):
    config, other = read_checkpoint(runs.model)["config"], tmp_path / "data"
    config["data"] |= {"root": str(other), "source": config["data"]["source"] | {"clips": 240}}
    instantiate(config["data"], representation=instantiate(config["representation"])).prepare_data()
    quick = ["baseline=static", "data=synthetic", "protocol=synthetic", f"extractor={runs.clip}", "quick=true"]

    def reasons(*words: str) -> list[str]:
        out = tmp_path / "result.json"
        assert main(["evaluate", *quick, f"out={out}", "device=cpu", *words]) == 0
        result = json.loads(out.read_text())
        assert result["valid"] == (not result["invalid_because"])
        return result["invalid_because"]

    (reason,) = reasons("data.source.clips=240", f"data_root={other}")
    assert re.fullmatch(r"training data of the extractor \w+ and evaluated data \w+ differ: splits may overlap", reason)
    same = ["data.source.clips=400", f"data_root={runs.folder / 'data'}"]
    assert reasons(*same) == []
    assert reasons(*same, "split=train") == ["the extractor was trained on the evaluated split, train"]


@pytest.mark.parametrize("name", sorted(path.stem for path in (EXPERIMENTS / "evaluation").glob("*.yaml")))
def test_every_protocol_can_be_read(runs, name):
    protocol = load_protocol(name, runs.data().representation)
    assert name == protocol.name + (f"_version_{protocol.version}" if protocol.version > 1 else "")
    assert protocol.version >= 1
    evaluator = Evaluator(None, protocol.metrics, runs.data().representation)
    nothing = Extracted({"keys": torch.zeros(0, dtype=torch.long)}, [])
    values, reasons = evaluator.score(nothing, nothing, nothing, 0)
    assert set(values.values()) == ({None} if protocol.metrics else set())
    assert not reasons
    for table in protocol.expected.values():
        assert set(table) <= set(values)


def test_training_logs_the_values_of_the_validation_split(runs, tmp_path):
    recipe = tmp_path / "mine.yaml"
    recipe.write_text(
        "# @package _global_\ndefaults:\n  - /quickstart\n  - override /logger: csv\n  - _self_\ncallbacks:\n"
        "  evaluate: {_target_: evaluators.callback.Evaluate, protocol: synthetic, "
        f"extractor: {runs.clip}, every_n_steps: 4, samples: 33}}\n"
    )
    words = [*GENERATOR, f"data_root={runs.folder / 'data'}", f"run.dir={tmp_path / 'run'}", "trainer.max_steps=8"]
    assert main(["train", str(recipe), *words, "callbacks.best.monitor=val/synthetic/fid"]) == 0
    lines = [line.split(",") for line in (tmp_path / "run" / "csv" / "metrics.csv").read_text().splitlines()]
    rows = [dict(zip(lines[0], line, strict=True)) for line in lines[1:]]
    logged = [int(row["step"]) for row in rows if row["val/synthetic/fid"]]
    assert logged == [1, 3, 7], "at the first validation, and after every 4 steps, the last ones included"
    assert "val/synthetic/attributes/all" in rows[0]
    assert "val/synthetic/diversity" not in rows[0], "too few motions"
    assert (tmp_path / "run" / "checkpoints" / "best.ckpt").exists()


def test_a_missing_extractor_of_the_selection_stops_before_training(runs, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = [*GENERATOR, f"data_root={runs.folder / 'data'}", "run.dir=run", "trainer.max_steps=2"]
    assert main(["train", "quickstart", *words, "selection=babel"]) == 1
    error = capsys.readouterr().err
    assert "callbacks.evaluate.extractor=runs/motion_clip/babel/default/checkpoints/last.ckpt: no such file" in error
    assert "make train EXP=motion_clip/babel" in error
    assert "selection=loss" in error
    assert not Path("run").exists()
    assert main(["train", "quickstart", *words, "selection=t2m"]) == 1
    assert 'assets/t2m/synthetic is missing; see "Extractors" in docs/evaluation.md' in capsys.readouterr().err
    assert main(["train", "quickstart", *words, "selection=loss"]) == 0
    best = "ckpt=run/checkpoints/best.ckpt"
    assert main(["evaluate", best, "extractor=none", "quick=true", "samples=4", "out=a.json", "device=cpu"]) == 0
    assert json.loads(Path("a.json").read_text())["checkpoint"]["selected_by"] == "best val/loss"


def test_latency_is_that_of_one_motion_at_a_time_after_a_first_one(runs, tmp_path, monkeypatch):
    sizes = []
    generate = MotionGeneration.generate

    def counted(self, batch, **options):
        sizes.append(len(batch))
        return generate(self, batch, **options)

    monkeypatch.setattr(MotionGeneration, "generate", counted)
    result = runs.result(tmp_path / "one.json", "protocol=latency")
    assert sizes == [1] * 17, "the first one is not timed"
    assert (result["cost"]["batch_size"], result["changed"]) == (1, {})
    assert result["checkpoint"]["prediction"] == "x0"
    assert result["checkpoint"]["training_hours"] > 0
    assert result["checkpoint"]["training_memory_gib"] > 0
    sizes.clear()
    result = runs.result(tmp_path / "eight.json", "protocol=latency", "batch_size=8")
    assert sizes == [8] * 3, "sampled again, not read from the motions of batches of 1"
    assert (result["cost"]["batch_size"], result["changed"]) == (8, {"batch_size": 8})


def shares(rank: int, world: int, runs: Runs, samples: int, kept: Path | None) -> dict:
    """The result as one of several processes gets it."""
    model, data = load(runs.model), runs.data()
    protocol = load_protocol("synthetic", model.representation)
    protocol.change(replications=1, samples=samples, quick=False, clips=len(data.test))
    assert protocol.multimodality is not None
    protocol.multimodality |= {"prompts": 1}
    extractor = protocol.open_extractor(str(runs.clip), model.representation, "synthetic")
    source = protocol.generator(model, kept, {"seed": 0}, clips=data.test, batch_size=8, world=world, progress=False)
    return protocol.evaluate(source, data.test, extractor, model.representation, rank=rank, world=world)


def means(result: dict) -> dict[str, float | None]:
    return {f"{kind} {name}": v["mean"] for kind in ("ground_truth", "values") for name, v in result[kind].items()}


def test_processes_share_the_sampling_and_get_one_result(runs, tmp_path):
    """Shares of unequal sizes, and shares of nothing: batches are dealt as wholes, so nothing depends on the number."""
    with GlooPool(2) as pool:
        both = pool.run(shares, *((rank, 2, runs, 33, tmp_path) for rank in range(2)))
        again = pool.run(shares, *((rank, 2, runs, 33, tmp_path) for rank in range(2)))
        single = pool.run(shares, *((rank, 2, runs, 1, None) for rank in range(2)))
    assert both[0] == both[1] == again[0] == again[1]
    assert shares(0, 1, runs, 33, tmp_path) == both[0], "the same motions have the same values, to the last bit"
    assert {path.name for path in tmp_path.iterdir()} == {"rep_0.npz", "multimodality_0.npz"}
    assert single[0] == single[1]
    assert single[0]["values"]["jitter"]["n"] == 1
    assert both[0]["cost"]["nfe"] == 5
    alone = shares(0, 1, runs, 33, tmp_path / "alone")
    assert means(alone) == means(both[0]), "motions sampled by one process are the same, to the last bit"
    for file in (tmp_path / "alone").iterdir():
        one, two = read_samples(file), read_samples(tmp_path / file.name)
        assert all(np.array_equal(one[name], two[name]) for name in ("ids", "features", "captions"))
    assert means(shares(0, 1, runs, 1, None)) == means(single[0])


def of_baseline(rank: int, world: int, runs: Runs) -> tuple[dict, int]:
    """The result of a baseline as one of several processes gets it, and the number of feature passes."""
    data, passes = runs.data(), []
    extract = Evaluator.extract

    def counted(self: Evaluator, motions: Motions) -> Extracted:
        passes.append(len(motions))
        return extract(self, motions)

    Evaluator.extract = counted
    try:
        protocol = load_protocol("synthetic", data.representation)
        protocol.change(replications=2, samples=33, quick=False, clips=len(data.test), multimodality=False)
        extractor = protocol.open_extractor(str(runs.clip), data.representation, "synthetic")
        source = protocol.baseline("real", data.test, 0)
        result = protocol.evaluate(
            source, data.test, extractor, data.representation, batch_size=8, rank=rank, world=world
        )
    finally:
        Evaluator.extract = extract
    return result, len(passes)


def test_real_motions_are_extracted_once_and_processes_share_any_source(runs):
    with GlooPool(2) as pool:
        both = pool.run(of_baseline, *((rank, 2, runs) for rank in range(2)))
    alone, passes = of_baseline(0, 1, runs)
    assert passes == 2 * 3, "real, real again for comparisons of sets, and measured; in each replication"
    assert both == [(alone, passes)] * 2


LEAVES_NO_THREADS = """
import sys
from pathlib import Path

from flame_mdm.__main__ import main

code = main(sys.argv[1:])
names = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
sys.exit(code or ", ".join(name for name in names if "gloo" in name) or 0)
"""


def stopped(rank: int, world: int, runs: Runs) -> str:
    """How the evaluation ends on one of several processes where the ground truth is off."""
    model, data = load(runs.model), runs.data()
    protocol = load_protocol("synthetic", model.representation)
    protocol.change(replications=1, samples=4, quick=False, clips=len(data.test))
    protocol.expected = {"synthetic": {"attributes/all": [0.1, 0.05]}}
    source = protocol.generator(model, None, {"seed": 0}, clips=data.test, batch_size=8, world=world, progress=False)
    try:
        protocol.evaluate(source, data.test, None, model.representation, rank=rank, world=world)
    except (UserError, SystemExit) as error:
        return type(error).__name__
    return "generated"


def test_off_ground_truth_stops_all_processes_and_one_says_why(runs):
    with GlooPool(2) as pool:
        assert pool.run(stopped, *((rank, 2, runs) for rank in range(2))) == ["UserError", "SystemExit"]


def test_torchrun_writes_one_result(runs, tmp_path):
    """And no thread of gloo is left, which could abort the process while Python shuts down."""
    script = tmp_path / "evaluate.py"
    script.write_text(LEAVES_NO_THREADS)
    out = tmp_path / "result.json"
    model = tmp_path / "model" / "checkpoints" / "last.ckpt"
    model.parent.mkdir(parents=True)
    shutil.copy(runs.model, model)
    words = [f"ckpt={model}", "extractor=none", f"out={out}", "device=cpu", "samples=5", "replications=1", "quick=true"]
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [*torchrun, str(script), "evaluate", *words], capture_output=True, text=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("written:") == 1
    result = json.loads(out.read_text())
    assert result["values"]["jitter"]["n"] == 5
    assert [path.name for path in motions(out).iterdir()] == ["rep_0.npz"]


# Baselines, edits and what old code does ------------------------------------------------------------------------------


def baseline(runs: Runs, folder: Path, kind: str, *words: str) -> int:
    place = [*DATA, f"data_root={runs.folder / 'data'}", "protocol=synthetic", "device=cpu"]
    out = f"out={folder / f'{kind}.json'}"
    return main(["evaluate", f"baseline={kind}", *place, f"extractor={runs.clip}", "replications=1", out, *words])


def test_training_motions_are_their_own_nearest(runs, tmp_path):
    protocol = tmp_path / "copies.yaml"
    protocol.write_text(
        "_target_: evaluators.protocol.Protocol\n_recursive_: false\nname: copies\nversion: 1\ncondition: text\n"
        "extractor: {_target_: evaluators.extractors.MotionCLIPExtractor}\nreplications: 1\nsamples: 30\n"
        "metrics: {nearest: {_target_: evaluators.metrics.memorization.NearestTraining}}\n"
    )
    found = {}
    for split in ("train", "test"):
        assert baseline(runs, tmp_path, "real", f"protocol={protocol}", f"split={split}") == 0
        found[split] = read_result(tmp_path / "real.json")
    distance = {split: result.values["nearest/joints"].mean for split, result in found.items()}
    assert distance["train"] == 0
    assert distance["test"] > 0.001
    assert found["train"].nearest == {"generated": [0.0] * 30, "real": [0.0] * 30}
    assert found["test"].nearest["real"] == sorted(found["test"].nearest["real"])


def test_baselines_show_what_each_metric_sees(runs, tmp_path):
    found, truth = {}, {}
    for kind in Baseline.KINDS:
        assert baseline(runs, tmp_path, kind) == 0
        result = json.loads((tmp_path / f"{kind}.json").read_text())
        assert result["baseline"] == kind
        assert result["checkpoint"] is None
        found[kind] = {name: value["mean"] for name, value in result["values"].items()}
        truth = {name: value["mean"] for name, value in result["ground_truth"].items()}
    assert found["real"]["attributes/all"] > 0.95
    assert found["real"]["fid"] < 2 * truth["fid"] + 0.1
    assert found["shuffled"]["fid"] == pytest.approx(truth["fid"], rel=1e-3), "the same motions"
    assert found["shuffled"]["attributes/all"] < 0.5
    assert found["noisy"]["jitter"] > 5 * truth["jitter"]
    assert found["noisy"]["foot_skating"] > 5 * truth["foot_skating"]
    assert found["static"]["static_share"] == 1
    assert found["static"]["jitter"] < 0.1
    assert found["static"]["fid"] > 10 * truth["fid"]


def test_baselines_that_make_no_sense_are_refused(runs, tmp_path, capsys):
    assert baseline(runs, tmp_path, "shufled") == 1
    assert "real, shuffled, noisy, static" in capsys.readouterr().err
    assert baseline(runs, tmp_path, "shuffled", "protocol=unconditioned") == 1
    assert "without text or labels cannot be shuffled" in capsys.readouterr().err
    assert baseline(runs, tmp_path, "real", f"ckpt={runs.model}") == 1
    assert "give exactly one of" in capsys.readouterr().err
    assert baseline(runs, tmp_path, "real", "protocol=null") == 1
    assert "needs a protocol" in capsys.readouterr().err


@pytest.mark.parametrize("condition", ["text", "action"])
def test_shuffled_motions_are_all_there_and_belong_to_what_others_ask_for(runs, condition):
    clips = runs.data().test
    protocol = load_protocol("synthetic", clips.representation)
    rows = protocol.rows(clips, 0, 0)
    samples = Baseline("shuffled", clips, condition, 0)("rep_0", rows, 0)
    assert samples is not None
    own = [motion.tobytes() for motion in real_motions(clips, rows)]
    asked = dict(zip(own, (row.text if condition == "text" else row.clip.action for row in rows), strict=True))
    given = [motion.tobytes() for motion in samples.features]
    assert sorted(given) == sorted(own)
    for row, motion in zip(rows, given, strict=True):
        assert asked[motion] != (row.text if condition == "text" else row.clip.action)
    with pytest.raises(UserError, match="2 of 3 motions have the same caption or label"):
        Baseline("shuffled", clips, condition, 0)("rep_0", [rows[0], rows[0], rows[1]], 0)


def test_static_motions_of_poses_hold_the_first_frame(runs):
    clips = runs.data().test
    rows = load_protocol("synthetic", clips.representation).rows(clips, 0, 0)[:3]
    clips.representation = Rot6D()
    clips.store.motion = lambda clip: np.random.default_rng(0).normal(size=(clip.length, 150))
    samples = Baseline("static", clips, "text", 0)("rep_0", rows, 0)
    assert samples is not None
    for motion in samples.features:
        assert (motion == motion[0]).all()


EDITS = {
    "prediction": lambda length: [frame < length // 4 for frame in range(length)],
    "in_between": lambda length: [not length // 4 <= frame < int(0.75 * length) for frame in range(length)],
    "interpolation": lambda length: [frame % 5 == 0 for frame in range(length)],
}


@pytest.mark.parametrize("name", ["prediction", "in_between", "upper_body", "interpolation"])
def test_edits_keep_what_they_are_to_keep(runs, tmp_path, name):
    out = tmp_path / "result.json"
    result = runs.result(out, f"protocol=editing_{name}", "extractor=none", "quick=true", "samples=9")
    assert result["checkpoint"]["edit"] == {"mode": "x0", "resample": 1}
    values = {metric: value["mean"] for metric, value in result["values"].items()}
    assert values["displacement/ade"] > 0.01
    in_place = name in ("prediction", "upper_body")
    assert (values["kept_drift/largest"] < 1e-4) is in_place, "behind a new part, kept frames start elsewhere"
    assert result["ground_truth"]["kept_drift/largest"]["mean"] == 0
    data = runs.data()
    protocol = load_protocol(f"editing_{name}", data.representation)
    protocol.samples = 9
    rows = protocol.rows(data.test, 0, 0)
    content = read_samples(motions(out) / "rep_0.npz")
    made = np.split(content["features"], np.cumsum(content["lengths"])[:-1])
    lower = data.representation.joint_features(range(22)) & ~data.representation.joint_features(
        find_joints(data.representation.skeleton, "upper_body")
    )
    for row, motion, real in zip(rows, made, real_motions(data.test, rows), strict=True):
        assert len(row.frames) == len(motion)
        kept = np.ones_like(real, bool) & (
            lower.numpy() if name == "upper_body" else np.array(EDITS[name](len(real)))[:, None]
        )
        np.testing.assert_allclose(motion[kept], real[kept], atol=1e-4)
        assert np.abs(motion - real)[~kept].max() > 0.1


def test_methods_of_editing_are_chosen_and_checked(runs, tmp_path, capsys):
    words = ("protocol=editing_prediction", "extractor=none", "quick=true", "samples=2", "replications=1")
    result = runs.result(tmp_path / "flame" / "result.json", *words, "method=flame")
    assert result["checkpoint"]["edit"]["mode"] == "x_t"
    assert "option of method=mfm" in refused(runs, capsys, tmp_path, *words, "until=0.3")
    assert "does not edit motions" in refused(runs, capsys, tmp_path, "method=mdm")


def test_smoothing_takes_each_motion_for_itself(runs, tmp_path):
    text = (EXPERIMENTS / "evaluation" / "text_to_motion_flame.yaml").read_text()
    words = ("extractor=none", "quick=true", "replications=1", "samples=8")
    rough = runs.result(tmp_path / "rough.json", "protocol=text_to_motion", *words)
    smooth = runs.result(tmp_path / "smooth.json", "protocol=text_to_motion_flame", *words)
    assert smooth["values"]["jitter"]["mean"] < 0.5 * rough["values"]["jitter"]["mean"]
    assert smooth["ground_truth"] == rough["ground_truth"]
    assert "smoothing: 1.0" in text
    protocol = load_protocol("text_to_motion_flame", runs.data().representation)
    step = np.repeat([[0.0], [1.0]], 20, axis=0)
    (smoothed,) = protocol._smoothed([step])
    expected = 0.5 * (1 + 2 * math.exp(-0.5) + 2 * math.exp(-2)) / (1 + 2 * math.exp(-0.5) + 2 * math.exp(-2))
    assert smoothed[0, 0] == pytest.approx(0, abs=1e-9)
    assert smoothed[19:21].mean() == pytest.approx(expected)
    assert 0.25 < smoothed[19, 0] < 0.35


def test_the_best_of_several_is_no_worse_than_all(runs, tmp_path, monkeypatch):
    text = (EXPERIMENTS / "evaluation" / "reconstruction_best_of_10.yaml").read_text()
    file = tmp_path / "mine.yaml"
    file.write_text(text.replace("prompts: 500", "prompts: 3").replace("samples: 10", "samples: 4"))
    result = runs.result(tmp_path / "result.json", f"protocol={file}", "samples=6")
    values = {name: value["mean"] for name, value in result["values"].items()}
    assert values["flame_of_10/best_ape_root"] < values["flame_of_10/worst_ape_root"]
    assert result["values"]["flame_of_10/best_ape_root"]["n"] == 12


def test_few_samples_are_warned_of(runs, tmp_path, capsys):
    result = runs.result(tmp_path / "result.json", "quick=true", "samples=7", "replications=1", "protocol=synthetic")
    count = len(runs.data().test)
    assert result["warnings"] == [
        "fid: biased upwards: 7 motions are fewer than twice the 4 features",
        f"fid: 7 generated and {count} real motions. Compare it only with values for the same two numbers",
    ]
    assert result["warnings"][0] in capsys.readouterr().out


def test_real_motions_of_a_set_without_test_clips_are_checked(runs, tmp_path, monkeypatch):
    """HumanAct12 is tested on its training clips; its gate holds all the same."""
    data = runs.data()
    clips = data.clips("train")
    protocol = load_protocol("synthetic", data.representation)
    protocol.change(replications=1, samples=40, quick=False, clips=len(clips))
    protocol.expected = {"synthetic": {"attributes/all": [0.1, 0.05]}}
    assert protocol.evaluate(None, clips, None, data.representation)["valid"]
    data.store.info["clips"]["test"] = 0
    assert not protocol.evaluate(None, clips, None, data.representation)["valid"]


def test_as_many_real_motions_as_asked_for(runs):
    data = runs.data()
    protocol = load_protocol("synthetic", data.representation)
    protocol.real_samples = 12
    real = protocol.rows(data.test, 0, 0, purpose="real")
    assert len(real) == 12
    assert {row.id for row in real} != {row.id for row in protocol.rows(data.test, 0, 0)[:12]}, "a draw of their own"


def test_the_classifier_of_old_code_starts_at_random_but_the_same_in_any_batch(tmp_path):
    torch.save({"model": ActionGRU().state_dict()}, tmp_path / "gru")
    plain, legacy = (
        ClassifierExtractor("humanact12", str(tmp_path / "gru"), random_start=start) for start in (False, True)
    )
    x = torch.randn(3, 20, 150)
    joints, mask = Rot6D().decode(x), length_mask(torch.tensor([20, 9, 20]))
    with torch.no_grad():
        found, again = legacy.motions(x, joints, mask), legacy.motions(x.flip(0), joints.flip(0), mask.flip(0))
        alone = legacy.motions(x[1:2, :9], joints[1:2, :9], mask[1:2, :9])
        start = plain.motions(x, joints, mask)
    for name in ("features", "logits"):
        torch.testing.assert_close(found[name], again[name].flip(0))
        torch.testing.assert_close(found[name][1:2], alone[name])
        assert not torch.allclose(found[name], start[name], atol=1e-3)
    assert not torch.allclose(legacy.network.linear2(found["features"]), found["logits"], atol=1e-3), "two draws"
    torch.save(UESTC().state_dict(), tmp_path / "uestc")
    with pytest.raises(ValueError, match="not recurrent"):
        ClassifierExtractor("uestc", str(tmp_path / "uestc"), random_start=True)


def test_old_protocols_differ_from_the_present_ones_by_their_quirk(runs):
    representation = runs.data().representation
    for name, quirk in (
        ("text_to_motion_t2m", lambda p: p.extractor["full_length"]),
        ("action_to_motion", lambda p: p.extractor["random_start"]),
        ("unconditioned_humanact12", lambda p: p.metrics["kid"]["replace"]),
    ):
        assert quirk(load_protocol(f"{name}_legacy", representation)) is True
        with pytest.raises(KeyError):
            quirk(load_protocol(name, representation))
