"""Trainings of a benchmark side by side."""

from copy import deepcopy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
import torch
from support.fixtures import recipe
from support.runs import TINY

from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.commands import benchmark, trainings
from flame_mdm.commands.benchmark import BenchmarkSettings, check, main
from flame_mdm.commands.distill import DistillSettings, student_recipe
from flame_mdm.commands.trainings import Training, plan, run_trainings
from flame_mdm.config import EXPERIMENTS
from flame_mdm.errors import UserError
from flame_mdm.reporting.tables.format import Cell, Line, Part, Table
from flame_mdm.safe_io import read_yaml


class Process:
    """A training that ends after some looks at it."""

    started: ClassVar[list["Process"]] = []
    at_once: ClassVar[list[set[str]]] = []  # names of the running trainings, at each start
    codes: ClassVar[dict[str, int]] = {}

    def __init__(self, command: list[str], **options: Any):
        self.name, self.options = command[4], options
        self.looks, self.returncode, self.terminated = 0, None, False
        running = {p.name for p in self.started if p.returncode is None}
        self.started.append(self)
        self.at_once.append(running | {self.name})

    def poll(self) -> int | None:
        self.looks += 1
        if self.looks > 2:
            self.returncode = self.codes.get(self.name, 0)
        return self.returncode

    def terminate(self) -> None:
        self.terminated = True

    def wait(self) -> None:
        self.returncode = 143


def test_a_parallel_run_needs_two_gibibytes_of_free_memory(monkeypatch):
    for free, is_enough in ((2 * 2**30, True), (2 * 2**30 - 1, False)):
        monkeypatch.setattr("flame_mdm.data.resident.free_memory", lambda device, free=free: free)
        assert trainings._has_memory() == is_enough


@pytest.fixture
def processes(monkeypatch) -> type[Process]:
    Process.started, Process.at_once, Process.codes = [], [], {}
    monkeypatch.setattr(trainings.subprocess, "Popen", Process)
    monkeypatch.setattr(trainings, "POLL", 0)
    monkeypatch.setattr(trainings, "_has_memory", lambda: True)
    monkeypatch.setattr(trainings, "cores", lambda: 8)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    return Process


NAMES = ["extractor", "teacher", "other", "student"]


def jobs() -> list[Training]:
    """Four trainings, of which the last one reads the run of the second one."""
    return [Training([name], name, {1} if name == "student" else set()) for name in NAMES]


@pytest.mark.parametrize("count", [1, 2, 4])
def test_so_many_trainings_run_at_once_and_none_before_what_it_needs(processes, tmp_path, count):
    run_trainings(jobs(), count, tmp_path)
    assert sorted(process.name for process in processes.started) == sorted(NAMES)
    assert max(map(len, processes.at_once)) == min(count, 3)
    assert not any({"teacher", "student"} <= running for running in processes.at_once)
    threads = {process.options["env"].get("OMP_NUM_THREADS") for process in processes.started}
    assert threads == {None if count == 1 else str(8 // count)}
    logs = sorted(path.name for path in tmp_path.iterdir())
    expected = [f"{number}_{name}.log" for number, name in enumerate(NAMES, 1)]
    assert logs == ([] if count == 1 else expected)


def test_no_training_starts_beside_others_without_memory(processes, tmp_path, monkeypatch):
    monkeypatch.setattr(trainings, "_has_memory", lambda: False)
    run_trainings(jobs(), 4, tmp_path)
    assert [process.name for process in processes.started] == NAMES
    assert max(map(len, processes.at_once)) == 1


@pytest.mark.parametrize(("code", "error"), [(1, UserError), (143, SystemExit), (-9, SystemExit)])
def test_a_training_that_ends_badly_stops_the_others(processes, tmp_path, code, error):
    processes.codes["extractor"] = code
    with pytest.raises(error, match=r"training of extractor failed|143|137"):
        run_trainings(jobs(), 2, tmp_path)
    assert [(process.name, process.terminated) for process in processes.started] == [
        ("extractor", False),
        ("teacher", True),
    ]


@pytest.mark.parametrize("kind", ["link", "hard link"])
def test_outputs_of_trainings_are_written_to_no_file_elsewhere(processes, tmp_path, kind):
    victim, logs = tmp_path / "victim", tmp_path / "logs"
    victim.write_text("the only copy\n")
    logs.mkdir()
    log = logs / "1_extractor.log"
    log.symlink_to(victim) if kind == "link" else log.hardlink_to(victim)
    with pytest.raises(
        UserError, match=r"1_extractor\.log: this is a (link|file with a second name)"
    ):
        run_trainings(jobs(), 2, logs)
    assert processes.started == []
    assert victim.read_text() == "the only copy\n"


def test_a_training_needs_the_earlier_ones_whose_runs_it_names():
    entries = read_yaml(EXPERIMENTS / "benchmark" / "few_steps.yaml")["train"]
    planned = plan(entries, "some/root")
    assert [training.needs for training in planned] == [set(), set(), {1}, set()]
    assert all(training.words[-1] == "data_root=some/root" for training in planned)


def test_the_number_of_trainings_at_once_is_checked(tmp_path):
    settings = BenchmarkSettings(exp="synthetic", out=str(tmp_path), jobs=0)
    with pytest.raises(UserError, match=r"^jobs=0: expected the number of models .*, at least 1"):
        main(settings)


@pytest.mark.robustness
def test_trainings_side_by_side_give_the_same_weights(data_root, tmp_path, monkeypatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    states = []
    for count in (1, 2):
        words = [*TINY, "trainer.max_steps=3", "callbacks.samples=null", "logger=csv"]
        folders = [tmp_path / f"{count}_{seed}" for seed in (0, 1)]
        entries = [
            ["quickstart", *words, f"seed={seed}", f"run.dir={folder}"]
            for seed, folder in enumerate(folders)
        ]
        run_trainings(plan(entries, str(data_root)), count, tmp_path)
        paths: list[Path] = [folder / "checkpoints" / "last.ckpt" for folder in folders]
        states.append([read_checkpoint(path)["state_dict"] for path in paths])
    for alone, beside in zip(*states, strict=True):
        assert all(torch.equal(value, beside[name]) for name, value in alone.items())


@pytest.mark.parametrize(("value", "right"), [
    (0.1, True), (0.3, True), (0.2, True), (0.0999, False), (0.3001, False), (None, False)
])  # fmt: skip
def test_values_of_a_benchmark_are_within_their_ranges(value: float | None, right: bool):
    cells = [Cell("", 5.0), None if value is None else Cell("", value)]
    lines = [Line("MDM", "reported", [Cell("", 0.2)] * 2), Line("MDM", "measured", cells)]
    lines.append(Line("MFM", "measured", [Cell("", 0.2)] * 2, state="no checkpoint"))
    table = Table("t", "T", [Part("P", {"Top 1": "higher", "FID": "lower"}, lines)])
    ranges = {"FID": (0.1, 0.3)}
    (of_mdm, is_within), (of_mfm, unmeasured) = check(table, {"P": {"MDM": ranges, "MFM": ranges}})
    measured = "not measured" if value is None else f"{value:.3g}"
    assert of_mdm == f"MDM: FID {measured}, expected 0.1 to 0.3"
    assert of_mfm == "MFM: FID not measured, expected 0.1 to 0.3"
    assert (is_within, unmeasured) == (right, False)


@pytest.mark.parametrize(("trained", "steps", "interval"), [(1003, 201, 50), (12, 2, 2), (2, 1, 1)])
def test_a_student_trains_a_fifth_of_the_steps_at_a_tenth_of_the_rate(
    trained: int, steps: int, interval: int, monkeypatch, tmp_path
):
    config = deepcopy(recipe("quickstart"))
    config["trainer"]["val_check_interval"], config["optimizer"]["lr"] = 50, 0.003
    config["callbacks"]["samples"]["every_n_steps"] = 70
    teacher = SimpleNamespace(config=config, steps=trained)
    monkeypatch.setattr("flame_mdm.training.distillation.read_teacher", lambda file: teacher)
    monkeypatch.setenv("FLAME_MDM_DATA", "elsewhere")
    (tmp_path / "last.ckpt").touch()
    student: Any = student_recipe(DistillSettings(ckpt=str(tmp_path / "last.ckpt")))
    trainer = student["trainer"]
    assert (trainer["max_steps"], trainer["val_check_interval"]) == (steps, interval)
    assert student["optimizer"]["lr"] == pytest.approx(0.0003)
    assert student["callbacks"]["samples"]["every_n_steps"] == min(70, steps)
    name = f"{config['experiment']}_distilled"
    assert (student["experiment"], student["run"]["dir"]) == (name, f"runs/{name}/default")
    assert (student["data_root"], student["data"]["root"]) == ("elsewhere", "elsewhere")
    assert student["distillation"]["teacher"] == str(tmp_path / "last.ckpt")


@pytest.mark.parametrize(
    ("count", "stated", "threads"), [(4, None, "1"), (2, None, "1"), (2, "7", "7"), (1, "7", "7")]
)
def test_each_training_has_at_least_one_thread_or_as_many_as_the_user_states(
    processes, tmp_path, monkeypatch, count, stated, threads
):
    monkeypatch.setattr(trainings, "cores", lambda: 3)
    if stated:
        monkeypatch.setenv("OMP_NUM_THREADS", stated)
    run_trainings(jobs(), count, tmp_path)
    used = {process.options["env"].get("OMP_NUM_THREADS") for process in processes.started}
    assert used == {threads}


def test_runs_with_similar_names_do_not_depend_on_each_other(monkeypatch):
    folders = {"a": "runs/a", "b": "runs/ab", "c": "runs/c", "d": "runs/d"}
    texts = {"a": "", "b": "runs/abc", "c": "runs/a", "d": "runs/ab/checkpoints/last.ckpt"}
    monkeypatch.setattr(
        trainings, "compose",
        lambda name, overrides: {"run": {"dir": folders[name]}, "path": texts[name], "words": overrides},
    )  # fmt: skip
    planned = plan([[name, "seed=1"] for name in "abcd"], "")
    assert [training.needs for training in planned] == [set(), set(), {0}, {1}]
    assert [training.title for training in planned] == [f"{name} seed=1" for name in "abcd"]


@pytest.mark.parametrize(
    ("code", "exit_code"), [(128, 128), (130, 130), (-15, 143), (127, None), (1, None), (0, 0)]
)
def test_a_signal_is_the_exit_code_and_other_codes_are_errors(code: int, exit_code: int | None):
    training = Training(["quickstart", "seed=1"], "runs/x")
    if exit_code == 0:
        trainings._check(training, code)
    elif exit_code is None:
        with pytest.raises(UserError, match="training of quickstart seed=1 failed"):
            trainings._check(training, code)
    else:
        with pytest.raises(SystemExit) as error:
            trainings._check(training, code)
        assert error.value.code == exit_code


def test_a_benchmark_passes_its_keys_on_and_fails_if_a_value_is_not_as_expected(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    calls: dict[str, Any] = {}
    table = Table(
        "t", "T", [Part("P", {"FID": "lower"}, [Line("MDM", "measured", [Cell("", 0.5)])])]
    )
    described = {
        "train": [["a"]],
        "table": "synthetic",
        "expected": {"P": {"MDM": {"FID": [0.1, 0.4]}}},
    }
    stubs = {
        "read_package_yaml": lambda path: described,
        "plan": lambda entries, root: calls.update(plan=(entries, root)) or ["planned"],
        "run_trainings": lambda *values: calls.update(run=values),
        "evaluate_missing": lambda *values: calls.update(evaluate=values) or [],
        "build": lambda *values: calls.update(build=values) or table,
        "write": lambda _, out: calls.update(write=out),
    }
    for name, stub in stubs.items():
        monkeypatch.setattr(benchmark, name, stub)
    settings = BenchmarkSettings(
        exp="synthetic", jobs=3, device="cpu", batch_size=16, data_root="/d"
    )
    with pytest.raises(UserError, match=r"^MDM: FID 0\.5, expected 0\.1 to 0\.4$"):
        main(settings)
    out = Path("runs/benchmark/synthetic")
    assert out.is_dir()
    assert calls["plan"] == ([["a"]], "/d")
    assert calls["run"] == (["planned"], 3, out)
    specs, results, options = calls["evaluate"]
    assert (list(specs), results) == (["synthetic"], Path("runs/results"))
    assert (options.device, options.batch_size, options.data_root) == ("cpu", 16, "/d")
    assert calls["build"][0] == "synthetic"
    assert calls["build"][2] == results
    assert calls["write"] == out
    assert "NOT AS EXPECTED: MDM: FID 0.5, expected 0.1 to 0.4" in capsys.readouterr().out
    described["expected"]["P"]["MDM"]["FID"] = [0.5, 0.5]
    main(BenchmarkSettings(exp="synthetic", out="elsewhere"))
    assert calls["write"] == Path("elsewhere")
    assert "as expected: MDM: FID 0.5, expected 0.5 to 0.5" in capsys.readouterr().out
    monkeypatch.setattr(benchmark, "evaluate_missing", lambda *values: ["MFM: out of memory"])
    with pytest.raises(UserError, match=r"^MFM: out of memory$"):
        main(settings)
