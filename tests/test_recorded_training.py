"""Results of training callbacks, checkpoints, model files and imports, as recorded."""

import copy
import errno
import json
import math
import os
import pickle
import zipfile
from collections import Counter, OrderedDict
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np
import pytest
import torch
from lightning import Callback, LightningModule
from support.outcomes import printed, without, workspace
from support.recorded import Case, cases_of, check, combinations, outcome, record
from torch import Tensor, nn
from torchmetrics import MeanMetric

from flame_mdm.checkpoints import (
    adapters,
    hub,
    loading,
    locating,
    model_files,
    onnx_export,
    released,
    released_options,
    released_weights,
    runner,
    torch_files,
)
from flame_mdm.config import instantiate
from flame_mdm.generator import MotionGenerator
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.training import (
    adaptation,
    averaging,
    callbacks,
    checkpointing,
    fit,
    guards,
    loggers,
    memory,
    overhead,
    provenance,
    speed,
    start,
)

NAME = "training"


def drawn(*shape: int, seed: int = 0, dtype: torch.dtype = torch.float64) -> Tensor:
    """Normal random numbers."""
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


class Trainer(SimpleNamespace):
    """The attributes of a trainer that callbacks read."""

    def __init__(self, **changes: Any):
        usual: dict[str, Any] = {
            "global_step": 0,
            "world_size": 1,
            "global_rank": 0,
            "is_global_zero": True,
            "log_every_n_steps": 2,
            "max_steps": 10,
            "should_stop": False,
            "accumulate_grad_batches": 1,
            "current_epoch": 0,
            "loggers": [],
            "callback_metrics": {},
            "logged_metrics": {},
            "precision": "32-true",
            "saved": [],
        }
        super().__init__(**usual | changes)

    def save_checkpoint(self, path: Path) -> None:
        self.saved.append([self.global_step, path.name])


# Training callbacks ------------------------------------------------------------------------------


def averages_of_weights() -> Any:
    rows: list[Any] = []
    for options in combinations(
        0,
        22,
        decay=(0.0, 0.75, 0.9, 1.0),
        every=(None, 1, 2, 3),
        starting=(None, 0, 1, 4),
        initial=(None, False, True),
        first=(0, 6),
        updates=(0, 2),
    ):
        names = {
            "every": "update_every_n_steps",
            "starting": "update_starting_at_step",
            "initial": "from_initial_weights",
        }
        chosen = {names[k]: v for k, v in options.items() if k in names and v is not None}
        average = averaging.MovingAverage(options["decay"], **chosen)
        net: Any = nn.BatchNorm1d(3).double()
        copy = nn.BatchNorm1d(3).double()
        average._average_model = SimpleNamespace(
            module=copy, n_averaged=torch.tensor(options["updates"])
        )  # type: ignore[assignment]
        trainer: Any = Trainer(global_step=options["first"])
        with torch.no_grad():
            net.weight.copy_(drawn(3, seed=1))
            average.on_train_start(trainer, net)  # type: ignore[arg-type]
            trace = []
            for step in range(1, 9):
                average.on_train_batch_start(trainer, net)  # type: ignore[arg-type]
                net.weight += drawn(3, seed=step + 2)
                if step != 3:  # gradients are accumulated in this step
                    trainer.global_step += 1
                average.on_train_batch_end(trainer, net)  # type: ignore[arg-type]
                trace.append(copy.weight.tolist())
        is_shared = copy.running_mean is net.running_mean
        rows.append(
            [options, np.array(trace), copy.bias, average.updates, average.begun, is_shared]
        )
    rows += [outcome(averaging.MovingAverage, decay) for decay in (-0.1, 1.1, 2)]
    return rows


def schedules_of_checkpoints() -> Any:
    rows: list[Any] = [outcome(callbacks.Checkpoints, "f", every) for every in (0, -1)]
    for options in combinations(
        1,
        24,
        every=(1, 2, 3),
        keep=(None, 2, 4),
        most=(-1, 5, 6),
        signal=(None, 3),
        stop=(None, 4),
        first=(0, 2),
    ):
        callback = callbacks.Checkpoints(
            "f", options["every"], *([options["keep"]] if options["keep"] else [])
        )
        trainer: Any = Trainer(max_steps=options["most"], global_step=options["first"])
        task: Any = SimpleNamespace(device=torch.device("cpu"))
        callback.stop = SimpleNamespace(signum=0, install=lambda: None, restore=lambda: None)  # type: ignore[assignment]
        callback.on_train_start(trainer, task)
        end: Any = None
        for call in range(9):
            trainer.global_step += call % 3 != 1
            if trainer.global_step == options["signal"]:
                callback.stop.signum = 15
            trainer.should_stop = trainer.global_step == options["stop"]
            try:
                callback.on_train_batch_end(trainer, task)
            except callbacks.Interrupted as interruption:
                end = str(interruption)
                break
        rows.append([options, trainer.saved, end])
    stop = callbacks.Interrupted(2, 7)
    return rows, str(stop), stop.signum, stop.step


def checks_of_losses() -> Any:
    rows: list[Any] = []
    with workspace() as folder:
        streams = {
            "usual": [1.0, 2.0, 3.0, 4.0, 5.0, 6.0],
            "nan": [1.0, 2.0, math.nan, 1.0],
            "jump": [1.0, 3.0, 2.0, 2000.0, 2.0],
            "below": [1.0, 3.0, 0.5, 999.0, 2.0],
            "inf": [math.inf],
            "first": [5000.0, 1.0, 2.0, 3.0],
            "negative": [-1.0, -2.0, 5.0],
            "two": [1.0, 2.0, math.inf, math.nan],
            "edge": [1.0, 1.0, 1000.0, 1001.0],
        }
        for (name, values), factor in ((n, f) for n in streams.items() for f in (None, 2.0)):
            Path(name).mkdir(exist_ok=True)
            bad = guards.BadLoss(name, *([factor] if factor else []))
            trainer: Any = Trainer(log_every_n_steps=2)
            end: Any = None
            for number, value in enumerate(values):
                trainer.global_step = number + 1
                loss: Any = torch.tensor(value)
                batch: Any = SimpleNamespace(ids=[f"clip{number}", "other"])
                outputs = {"loss": loss} if number % 2 else loss
                end = outcome(bad.on_train_batch_end, trainer, None, outputs, batch, number)  # type: ignore[arg-type]
                if end:
                    break
            if not end:
                end = outcome(bad.on_save_checkpoint, trainer, None, {})  # type: ignore[arg-type]
            file = Path(name, "bad_batch.json")
            rows.append(
                [
                    name,
                    factor,
                    end,
                    bad.usual,
                    len(bad.seen),
                    file.read_text() if file.exists() else None,
                ]
            )
            file.unlink(missing_ok=True)
        return without(folder, rows)


def explained_failures() -> Any:
    caused = RuntimeError("write failed")
    caused.__cause__ = RuntimeError("DataLoader worker (pid(s) 3, 4) exited unexpectedly")
    rows = [
        str(guards.lost_worker(error))
        for error in (
            RuntimeError("DataLoader worker (pid 7) is killed by signal: Killed."),
            caused,
            RuntimeError("x"),
            EOFError(),
            ConnectionResetError("x"),
            OSError("x"),
            BrokenPipeError(),
            RuntimeError("DataLoader worker (pid 7) is alive"),
        )
    ]
    for error in (
        torch.OutOfMemoryError("x"),
        RuntimeError("can't allocate memory: y"),
        RuntimeError("x"),
        MemoryError(),
    ):
        rows.append(str(guards.out_of_memory(error, 12)))
    return rows


def single_runs() -> Any:
    def run(folder: str, config: bool, fault: Exception | None = None) -> Any:
        with guards.only_run(Path(folder)):
            inside = sorted(str(path) for path in Path(folder).rglob("*"))
            if config:
                Path(folder, "config.yaml").write_text("")
            if fault:
                raise fault
            return inside

    with workspace() as folder:
        rows: list[Any] = []
        Path("old").mkdir()
        Path("old/run.lock").write_text("process 1 on h\n")
        Path("old/checkpoints").mkdir()
        Path(f"old/checkpoints/.last.{'0' * 8}-5-{'a' * 16}.ckpt").write_text("")
        Path("links").mkdir()
        Path("links/x").symlink_to("/usr")
        for name, config, fault in (
            ("new", False, None),
            ("new", True, None),
            ("new", False, None),
            ("failed", False, ValueError("x")),
            ("failed2", True, ValueError("x")),
            ("old", False, None),
            ("links", False, None),
            ("deep/er", False, None),
        ):
            rows.append(
                [name, printed(run, name, config, fault), sorted(str(p) for p in Path().rglob("*"))]
            )
        with mock.patch("fcntl.lockf", side_effect=OSError(errno.EAGAIN, "x")):
            Path("busy").mkdir()
            rows.append(outcome(run, "busy", False))
            Path("busy/run.lock").write_text("process 9 on q\n")
            rows.append(outcome(run, "busy", False))
        return without(folder, rows)


def logged_values() -> Any:
    class Recorder:
        def __init__(self) -> None:
            self.lines: list[Any] = []

        def log_metrics(self, values: Any, step: int) -> None:
            self.lines.append([dict(values), step])

        def save(self) -> None:
            self.lines.append("saved")

    rows: list[Any] = []
    for values in (
        {},
        {"a": 1.5},
        {"a": torch.tensor(2.5), "b": 3, "c": torch.tensor(1, dtype=torch.int64)},
    ):
        logger = Recorder()
        trainer: Any = Trainer(global_step=7, current_epoch=2, loggers=[logger])
        callbacks.log_values(trainer, values)
        rows.append([logger.lines, trainer.callback_metrics, list(trainer.logged_metrics)])
    return rows


def histories_of_resumed_runs() -> Any:
    rows: list[Any] = []
    with workspace():
        for step in (None, 0, 2, 3, 9):
            Path("metrics.jsonl").write_text(
                "".join(json.dumps({"step": k, "a": k / 2}) + "\n" for k in (0, 2, 1, 3)) + '{"st'
            )
            history = loggers.History(".", *([] if step is None else [step]))
            history.log_metrics({"b": 1.5, "epoch": 0}, 4)
            history.log_metrics({"b": 2.5}, 5)
            history.log_hyperparams({})
            rows.append([step, history.name, history.version, Path("metrics.jsonl").read_text()])
    return rows


def measured_values() -> Any:
    rows: list[Any] = []
    for options in combinations(
        2, 12, first=(0, 3), every=(1, 2), world=(1, 3), accumulate=(1, 4), validates=(None, 5)
    ):
        trainer: Any = Trainer(
            global_step=options["first"],
            log_every_n_steps=options["every"],
            world_size=options["world"],
            accumulate_grad_batches=options["accumulate"],
            datamodule=SimpleNamespace(batch_size=8, train=range(48)),
        )
        task: Any = mock.Mock(spec=callbacks.Task)
        task.device, task.reported, task.config, task.facts = torch.device("cpu"), {}, {}, {}
        weight = nn.Parameter(torch.ones(3))
        weight.grad = torch.tensor([3.0, 4.0, 12.0])
        task.parameters = lambda weight=weight: [weight, nn.Parameter(torch.ones(2))]
        measurements = callbacks.Measurements()
        trace = []
        with mock.patch("time.perf_counter", side_effect=[float(k * k) for k in range(99)]):
            measurements.on_train_start(trainer, task)
            for number in range(6):
                trainer.global_step += 1
                task.is_reported = number % 2 == 0
                task.report.reset_mock()
                measurements.on_before_optimizer_step(
                    trainer, task, torch.optim.SGD([weight], lr=0.25)
                )
                trace.append(
                    [float(v) for call in task.report.call_args_list for v in call.args[0].values()]
                )
                task.reported["train/loss"] = torch.tensor(number + 0.5)
                measurements.on_train_batch_end(trainer, task)
                measurements.on_train_batch_end(trainer, task)
                trace.append([dict(trainer.callback_metrics), len(task.reported)])
                if trainer.global_step == options["validates"]:
                    measurements.on_validation_end(trainer, task)
        rows.append([options, trace])
    return rows


def totals_in_checkpoints() -> Any:
    rows: list[Any] = []
    for earlier, config in (
        ({}, {}),
        ({"training": {"hours": 2.0, "memory_gib": 999.0}}, {"run": {"speed": "fast"}}),
        ({"training": {}}, {"run": {}}),
    ):
        measurements = callbacks.Measurements()
        task: Any = mock.Mock(spec=callbacks.Task)
        task.device, task.config, task.facts = torch.device("cpu"), config, {}
        trainer: Any = Trainer(
            strategy=SimpleNamespace(root_device=torch.device("cpu")),
            world_size=2,
            precision="bf16",
        )
        measurements.on_load_checkpoint(trainer, task, {"facts": earlier})
        with mock.patch("time.perf_counter", return_value=7200.0):
            measurements.on_save_checkpoint(trainer, task, {})
        facts = task.facts["training"]
        rows.append(
            [
                facts["hours"],
                facts["memory_gib"] == 999.0,
                0 < facts["memory_gib"] < 1000,
                facts["processes"],
                facts["speed"],
                facts["precision"],
                facts["device"][:4],
            ]
        )
    return rows


def explained_metrics() -> Any:
    class Higher(MeanMetric):
        """The first line of a metric.

        More.
        """

        higher_is_better = True

    class Lower(MeanMetric):
        """Another one."""

        higher_is_better = False

    metrics: Any = {"high": Higher(), "low": Lower(), "mean": MeanMetric(), "unused": Lower()}
    values = {"high": 0.5, "low/a": 1.25, "low/b": 1234.5, "mean": 3e-5, "high_x": 1.0}
    rows = [
        callbacks.explain_metrics(values, real, metrics)
        for real in ({}, {"high": 0.75, "low/b": 2.0})
    ]
    return [
        [line for line in lines if not line.startswith("mean: ")] for lines in rows
    ], callbacks.explain_metrics({}, {}, metrics)


def _motion(joints: np.ndarray) -> Any:
    return SimpleNamespace(joints=joints)


def same_motions() -> Any:
    rng = np.random.default_rng(0)
    base = rng.normal(size=(9, 22, 3))
    rows = []
    for shift in (0.0, 0.0099, 0.0101, 0.5):
        other = base.copy()
        other[4, 3, 1] += shift
        rows.append(
            [
                callbacks.are_same([_motion(base), _motion(other[:count]), _motion(base[:7])])
                for count in (4, 5, 9)
            ]
        )
        rows.append(callbacks.are_same([_motion(base + shift), _motion(base)]))
    return rows, callbacks.are_same([]), callbacks.are_same([_motion(base)])


class Spans(MeanMetric):
    """A metric of the joints and of what was requested."""

    def update(self, joints: Tensor, mask: Tensor, requested: Any, keys: Tensor) -> None:  # type: ignore[override]
        super().update(joints.sum() + 10 * mask.sum() + len(requested[0]) + 100 * keys[0])


class Parts(MeanMetric):
    """A metric of two parts."""

    def update(self, joints: Tensor) -> None:  # type: ignore[override]
        super().update(joints.mean())

    def compute(self) -> Any:
        return {"a": super().compute(), "none": None}


def measured_samples() -> Any:
    def callback(prompts: Any, **options: Any) -> callbacks.SampleMotions:
        return callbacks.SampleMotions("s", 5, prompts, 1.5, **options)

    prompts: Any = ["plain", ("walk", {"speed": 1.0, "arms": 2}), ("jump", {"speed": 2.0})]
    samples = callback(prompts, metrics={"spans": Spans(), "parts": Parts()})
    motions = [drawn(n, 4, 3, seed=n).float() for n in (5, 7, 3)]
    rows: list[Any] = [samples.texts, samples.prompts, samples.next, samples.written[0]]
    for _ in range(2):
        rows.append(samples.measure(motions, [r for _, r in samples.prompts]))
    rows += [
        outcome(callback, None).texts,
        outcome(callbacks.SampleMotions, "s", 5, [], 0),
        outcome(callbacks.SampleMotions, "s", 5, [], -1.0),
    ]

    class Clips:
        def __init__(self, count: int):
            labels: list[dict[str, Any]] = [
                {},
                {"speed": 1.0},
                {"arms": 2, "speed": 3.0},
                {"arms": 1},
            ]
            self.clips = [SimpleNamespace(attributes=labels[k % 4]) for k in range(count)]

        def __getitem__(self, draw: tuple[int, int]) -> Any:
            return None, drawn(4 + draw[0] % 3, 12, seed=draw[0])

    task: Any = mock.Mock(spec=callbacks.GeneratorTask)
    task.generator = SimpleNamespace(
        representation=SimpleNamespace(
            mean=torch.zeros(1), to_joints=lambda x: x.reshape(*x.shape[:2], 4, 3)
        )
    )
    for some in (prompts, prompts[1:], prompts[:1], [], prompts[1:2], [("x", {"none": 1})]):
        for count in (7, 300):
            of_some = callback(some, metrics={"spans": Spans(), "parts": Parts()})
            rows.append(of_some._measure_real(Clips(count), task))  # type: ignore[arg-type]
    return rows


def schedules_of_samples() -> Any:
    rows: list[Any] = []
    for options in combinations(
        3, 10, first=(0, 4), every=(2, 3, 5), validates=(True, False), final=(9, 10)
    ):
        samples = callbacks.SampleMotions("s", options["every"], ["x"], 1.0)
        steps: list[int] = []
        samples.write = lambda trainer, task, steps=steps: steps.append(trainer.global_step)  # type: ignore[method-assign]
        task: Any = mock.Mock(spec=callbacks.GeneratorTask)
        task.facts, task.generator = {"actions": []}, SimpleNamespace(condition=None)
        trainer: Any = Trainer(
            global_step=options["first"], datamodule=SimpleNamespace(val=[1] * options["validates"])
        )
        samples.on_train_start(trainer, task)
        for step in range(options["first"] + 1, options["final"]):
            trainer.global_step = step
            samples.on_train_batch_end(trainer, task)
            if step % 4 == 0:
                samples.on_validation_epoch_start(trainer, task)
        samples.written = (options["final"] - 1 - options["every"] % 2, Path("s/x"), {})
        lines = printed(samples.on_fit_end, trainer, task)
        rows.append([options, steps, samples.next, lines])
    return rows


def replaced_prompts() -> Any:
    rows: list[Any] = []
    action = torch.nn.Module.__new__(callbacks.ActionLabels)
    for prompts, actions, condition in (
        (["a", "b"], ["x", "y", "z"], action),
        (["a", "x"], ["x", "y"], action),
        (["a"], ["x"], None),
        ([], ["x"], action),
        (["a"] * 3, ["x"], action),
    ):
        samples = callbacks.SampleMotions("s", 5, prompts, 1.0)
        task: Any = mock.Mock(spec=callbacks.GeneratorTask)
        task.facts, task.generator = {"actions": actions}, SimpleNamespace(condition=condition)
        trainer: Any = Trainer()
        samples.on_train_start(trainer, task)
        rows.append(samples.prompts)
    return rows


def last_lines_of_training() -> Any:
    rows: list[Any] = []
    for kind, facts, metrics, zero in (
        (
            "text",
            {"captions": ["a person runs", "b"]},
            {"train/loss": 1.23456, "val/loss": 0.5},
            True,
        ),
        ("text", {}, {}, True),
        ("action", {"actions": ["jump it", "x"]}, {"val/loss": 2.0}, True),
        ("action", {"actions": []}, {"x": 1.0}, True),
        ("none", {}, {}, True),
        ("none", {}, {}, False),
        ("text", {"captions": ["c"], "dataset": "synthetic"}, {}, True),
        ("none", {"dataset": "synthetic"}, {}, True),
    ):
        task: Any = mock.Mock(spec=callbacks.GeneratorTask)
        task.facts = {"actions": [], **facts}
        task.config, task.generator = {}, SimpleNamespace(conditioned_on=kind)
        trainer: Any = Trainer(callback_metrics=metrics, is_global_zero=zero, global_step=7)
        with mock.patch.object(callbacks, "write_report", lambda folder: f"{folder}/r.html"):
            rows.append(printed(callbacks.Report(Path("run x")).on_fit_end, trainer, task))
            rows.append(
                printed(
                    callbacks.Report(Path("q")).on_fit_end, trainer, mock.Mock(spec=callbacks.Task)
                )
            )
    trained = callbacks.read_model_file(locating.SHIPPED["motion_clip_synthetic"])["config"][
        "representation"
    ]
    extractor = callbacks.__dict__["_extractor_in_package"]
    for config, facts in (
        ({"representation": trained}, {"dataset": "synthetic", "captions": []}),
        ({"representation": trained}, {"dataset": "synthetic"}),
        ({"representation": {}}, {"dataset": "synthetic", "captions": []}),
        ({"representation": trained}, {"dataset": "bandai", "captions": []}),
        ({}, {}),
    ):
        rows.append(extractor(config, facts))
    return rows


def progress_of_runs() -> Any:
    rows: list[Any] = []
    for first, most, zero in ((0, 10, True), (4, -1, True), (2, 6, False)):
        trainer: Any = Trainer(
            global_step=first,
            max_steps=most,
            is_global_zero=zero,
            callback_metrics={"train/loss": 1.23456, "x": 2.0},
        )
        progress = callbacks.Progress()
        progress.on_train_end()
        with mock.patch.object(callbacks, "ProgressBar") as kind:
            bar = kind.return_value
            bar.n, bar.disable = first, not zero
            progress.on_train_start(trainer, None)  # type: ignore[arg-type]
            for step in (1, 0, 2):
                trainer.global_step += step
                progress.on_train_batch_end(trainer, None)  # type: ignore[arg-type]
            progress.on_exception()
            rows.append(
                [
                    kind.call_args.kwargs,
                    [[name, args, options] for name, args, options in bar.method_calls],
                ]
            )
    return rows


def skipped_hooks() -> Any:
    class Some(Callback):
        def on_train_batch_end(self, *_: Any) -> None: ...

    class Module(LightningModule):
        def on_after_backward(self) -> None: ...

    callback, module, loop = Some(), Module(), SimpleNamespace(epoch_loop=SimpleNamespace())
    trainer: Any = SimpleNamespace(callbacks=[callback], fit_loop=loop)
    overhead.skip_empty_hooks(trainer, module)
    overhead.skip_exchange_of_signals(trainer)
    rows = [
        [name for name in overhead.STEP_HOOKS if getattr(owner, name) is None]
        for owner in (callback, module)
    ]
    with overhead.NoProfiler().profile("x"):
        return rows, loop.epoch_loop._broadcast_sigterm_tensor()


# Saving and resuming -----------------------------------------------------------------------------


def _checkpoint(step: Any = 3, **changes: Any) -> dict[str, Any]:
    usual = {
        "config": {
            "experiment": "e",
            "task": {"_target_": "t"},
            "representation": {"_target_": "r"},
        },
        "facts": {"actions": [], "max_frames": 5},
        "state_dict": {"w": torch.arange(6.0).reshape(2, 3)},
        "global_step": step,
        "pytorch-lightning_version": "2.6.0",
    }
    return {k: v for k, v in (usual | changes).items() if v is not ...}


def newest_checkpoints() -> Any:
    rows: list[Any] = []
    versions = ("2.5.9", "2.6", "3.0.1", "x", None, "2.6.0.dev1")
    variants: list[dict[str, Any]] = [
        {},
        {"step": -1},
        {"step": 0},
        {"step": True},
        {"step": 2.0},
        {"step": None},
        {"facts": ...},
        {"extra": [torch.zeros(9000)[:1].expand(9000)]},
    ]
    variants += [{"pytorch-lightning_version": version} for version in versions]
    with workspace() as folder:
        rows.append(checkpointing.newest(Path("none")))
        for number, variant in enumerate(variants):
            for previous in (False, True):
                path = Path(f"r{number}{previous}/checkpoints")
                io = checkpointing.AtomicCheckpoints(path)
                if previous:
                    io.save_checkpoint(_checkpoint(1), path / "last.ckpt")
                io.save_checkpoint(_checkpoint(**variant), path / "last.ckpt")
                resumed, out, _ = printed(checkpointing.newest, path)
                names = sorted(p.name for p in path.iterdir())
                rows.append(
                    [
                        resumed
                        if isinstance(resumed, str)
                        else [str(resumed.path), resumed.step, sorted(resumed.content)],
                        out,
                        names,
                    ]
                )
        io = checkpointing.AtomicCheckpoints(
            Path("k/checkpoints"), checkpointing.Resumed(Path("p"), 3, {"a": 1})
        )
        rows += [io.load_checkpoint("x"), io.resumed is None]
        for name in ("last.ckpt", "last.ckpt", "step=1.ckpt", "step=1.ckpt"):
            io.save_checkpoint(_checkpoint(), Path("k/checkpoints", name))
        Path("k/other").write_text("")
        Path("k/checkpoints/d").mkdir()
        for name in (
            "k/other",
            "k/checkpoints/d",
            "k/checkpoints/../other",
            "k/checkpoints/step=1.ckpt",
            "k/checkpoints/gone",
        ):
            io.remove_checkpoint(name)
        rows.append(sorted(str(p) for p in Path("k").rglob("*")))
        Path("k/away").symlink_to("/usr")
        rows.append(outcome(io.save_checkpoint, _checkpoint(), "k/away/x.ckpt"))
        failed = RuntimeError("torch")
        failed.__context__ = OSError(errno.ENOENT, "gone")
        for error in (OSError(errno.EROFS, "read-only"), RuntimeError("x"), failed):
            with mock.patch("torch.save", side_effect=error):
                rows.append(outcome(io.save_checkpoint, _checkpoint(), "k/checkpoints/last.ckpt"))
        rows.append(sorted(p.name for p in Path("k/checkpoints").iterdir()))
        return without(folder, rows)


def states_of_optimizers() -> Any:
    weights = [nn.Parameter(drawn(3, 2)), nn.Parameter(drawn(4)), nn.Parameter(drawn(2))]
    rows: list[Any] = []
    for optimizer in (
        torch.optim.AdamW(weights, lr=0.1, fused=True),
        torch.optim.SGD(weights, lr=0.1, momentum=0.5),
    ):
        for changes in (
            {},
            {"lr": "x"},
            {"lr": True},
            {"lr": 1},
            {"lr": math.inf},
            {"betas": (0.5,)},
            {"betas": [0.5, "x"]},
            {"betas": [0.5, 1]},
            {"amsgrad": 1},
            {"amsgrad": None},
            {"foreach": 3},
            {"nesterov": True},
            {"new": 3},
            {"new": "s"},
            {"params": "x"},
            {"maximize": "no"},
        ):
            group = {k: v for k, v in optimizer.param_groups[0].items() if k != "params"}
            content: dict[str, Any] = {
                "optimizer_states": [{"param_groups": [group | changes], "state": {}}]
            }
            rows.append(
                [
                    changes,
                    outcome(
                        checkpointing.check_optimizers,
                        checkpointing.Resumed(Path("c"), 1, content),
                        optimizer,
                    ),
                ]
            )
        for state in (
            {0: {"m": torch.zeros(3, 2), "step": torch.tensor(1.0)}},
            {0: {"m": torch.zeros(7)}},
            {1: {"m": torch.zeros(5)}},
            {1: {"m": torch.zeros(4)}},
            {3: {"m": 1}},
            {2: {"m": torch.zeros(3)}},
            {2: {"m": torch.zeros(2)}},
            {0: {"m": "x"}},
            {0: {"m": torch.zeros(2, dtype=torch.complex64)}},
            {0: {"m": None}},
            {0: {"m": 2.5}},
            {0: 3},
        ):
            content = {"optimizer_states": [{"param_groups": [], "state": state}]}
            text = str(
                outcome(
                    checkpointing.check_optimizers,
                    checkpointing.Resumed(Path("c"), 1, content),
                    optimizer,
                )
            )
            rows.append(text.replace("\n", " ")[:120])
    for schedule in (
        {"base_lrs": [0.1]},
        {"base_lrs": ["x"]},
        {"_last_lr": {"a": [None]}},
        {"last_epoch": (1, 2.5)},
        {"_step_count": "3"},
        {"other": "x"},
        {},
    ):
        rows.append(
            outcome(
                checkpointing.check_optimizers,
                checkpointing.Resumed(Path("c"), 1, {"lr_schedulers": [schedule]}),
                optimizer,
            )
        )
    rows.append(
        outcome(
            checkpointing.check_optimizers,
            checkpointing.Resumed(Path("c"), 1, {"optimizer_states": None, "lr_schedulers": None}),
            optimizer,
        )
    )
    tensors = checkpointing.__dict__["_tensors"]
    rows.append(
        [
            name
            for name, _ in tensors(
                {"a": [torch.ones(1), {"b": torch.ones(2)}], "c": (3, torch.ones(1))}, ""
            )
        ]
    )
    return rows


# Devices, speed and memory -----------------------------------------------------------------------


def devices_of_trainers() -> Any:
    rows: list[Any] = []
    for gpus, mps, options in (
        (g, m, o)
        for g in (0, 1, 4)
        for m in (False, True)
        for o in combinations(
            g + 3,
            14,
            accelerator=(None, "auto", "cpu", "gpu", "cuda", "mps"),
            devices=(None, 1, 2, 5, 7, "auto", [0, 1]),
        )
    ):
        chosen = {k: v for k, v in options.items() if v is not None}
        with (
            mock.patch("torch.cuda.device_count", return_value=gpus),
            mock.patch("os.cpu_count", return_value=5),
            mock.patch("torch.backends.mps.is_available", return_value=mps),
            mock.patch.object(fit, "NO_GPU", "no GPU"),
        ):
            rows.append([gpus, mps, chosen, outcome(fit.check_devices, chosen)])
    for strategy in (
        "ddp",
        "auto",
        "fsdp",
        "FSDP_x",
        "deep_speed_2",
        {"_target_": "l.ModelParallelStrategy"},
        {"_target_": "DDP"},
        {},
        "model_parallel",
    ):
        rows.append(outcome(fit.check_devices, {"strategy": strategy, "accelerator": "cpu"}))
    return rows


def fast_attention_and_dropout() -> Any:
    rows: list[Any] = []
    for dtype, masked in (
        (t, m) for t in (torch.float64, torch.float32, torch.bfloat16) for m in (False, True)
    ):
        q, k, v = (drawn(2, 3, n, 4, seed=n, dtype=torch.float64).to(dtype) for n in (5, 7, 7))
        mask = (
            torch.rand(2, 1, 5, 7, generator=torch.Generator().manual_seed(3)) > 0.4
            if masked
            else None
        )
        result = speed.attention(q, k, v + 0.5, mask, dropout_p=0.5)
        rows.append(
            [str(result.dtype), result.double().round(decimals=1 if dtype == torch.bfloat16 else 4)]
        )
    for p in (0.0, 0.1, 0.3, 0.5, 0.9):
        dropout = speed.CheapDropout(p)
        for shape in ((3, 5), (7, 33, 9)):
            torch.manual_seed(5)
            x = drawn(*shape, seed=2) + 3
            y = dropout.train()(x)
            rows.append([p, speed._threshold(p), y, (y == 0).double().mean(), dropout.eval()(x)])
    torch.manual_seed(1)
    rows += [speed._random_integers(count) for count in (1, 31, 32, 33, 100)]
    net = nn.Sequential(nn.Linear(2, 2), nn.Dropout(0.25), nn.Sequential(nn.Dropout(0.5).eval()))
    speed.__dict__["_simplify"](net)
    return rows, [(type(m).__name__, getattr(m, "p", None), m.training) for m in net.modules()]


def precision_of_fast_training() -> Any:
    rows: list[Any] = []

    class Recurrent(nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.gru = nn.GRU(2, 2, bidirectional=True)

    for options in combinations(
        4,
        40,
        accelerator=("cpu", "auto", "gpu", "cuda", "mps"),
        precision=("32-true", "16-mixed"),
        bf16=({}, {"avx512_bf16": True}, {"amx_bf16": True}),
        cuda=(False, True),
        mps=(False, True),
        steps=(4999, 5000),
        masks=(True, False),
        multiple=(4, 64),
        generator=(True, False),
        recurs=(False, True),
    ):
        task: Any = mock.Mock(spec=speed.GeneratorTask if options["generator"] else speed.Task)
        net = nn.Sequential(nn.Dropout(0.5), Recurrent() if options["recurs"] else nn.Linear(1, 1))
        task.modules, task.generator = net.modules, mock.Mock()
        task.generator.denoiser.mask_padding = options["masks"]
        data: Any = SimpleNamespace(pad_multiple=options["multiple"])
        trainer = {
            "accelerator": options["accelerator"],
            "precision": options["precision"],
            "max_steps": options["steps"],
        }
        with (
            mock.patch("torch.cuda.is_available", return_value=options["cuda"]),
            mock.patch("torch.backends.mps.is_available", return_value=options["mps"]),
            mock.patch("torch.cuda.is_bf16_supported", return_value=options["masks"]),
            mock.patch("torch.cpu.get_capabilities", return_value=options["bf16"]),
            mock.patch.object(torch._dynamo.config, "recompile_limit", 8),
        ):
            result = printed(speed.accelerate, task, data, {"trainer": trainer})
            limit = torch._dynamo.config.recompile_limit
        calls = [str(call) for call in task.generator.denoiser.mock_calls]
        rows.append(
            [options, result, data.pad_multiple, limit, calls, [type(m).__name__ for m in net]]
        )
    return rows


def memory_of_recipes() -> Any:
    from support.fixtures import recipe

    rows = []
    smaller = {"data": recipe("quickstart")["data"] | {"batch_size": 3}}
    for name, changes in (
        ("quickstart", {}),
        ("quickstart", {"ema": None}),
        ("quickstart", smaller),
        ("synthetic/mdm_gru", {}),
        ("synthetic/dip", {}),
    ):
        rows.append([name, memory.training_memory(recipe(name) | changes)])
    return rows


def facts_about_machines() -> Any:
    rows: list[Any] = []
    for threads, capabilities, world in ((1, {}, 1), (4, {"cpu_name": "Chip"}, 2)):
        trainer: Any = Trainer(
            strategy=SimpleNamespace(root_device=torch.device("cpu")), world_size=world
        )
        with (
            mock.patch("torch.get_num_threads", return_value=threads),
            mock.patch("platform.machine", return_value="box"),
            mock.patch("torch.cpu.get_capabilities", return_value=capabilities),
        ):
            rows.append(provenance.device_name(trainer))
    git = provenance.__dict__["_git"]
    for code in (0, 1):
        with mock.patch(
            "subprocess.run", return_value=SimpleNamespace(returncode=code, stdout=" x \n")
        ):
            rows.append(git("a"))
    with mock.patch("subprocess.run", side_effect=FileNotFoundError):
        rows.append(git("a"))
    return rows, sorted(provenance.environment()), sorted(provenance.environment()["packages"])


def provenance_of_runs() -> Any:
    rows: list[Any] = []
    facts = {
        "command": ["x"],
        "commit": "c1",
        "changed": "",
        "python": "3",
        "machine": "m",
        "packages": {"torch": "2"},
    }
    with workspace(), mock.patch.object(provenance, "device_name", return_value="1 x box"):
        for number, (before, now, step) in enumerate(
            (
                ({}, {}, 0),
                ({}, {}, 4),
                ({"commit": "c0"}, {}, 4),
                ({"commit": "c0", "changed": "M", "packages": {}}, {}, 4),
                ({"commit": "c0"}, {}, 0),
                (None, {}, 4),
            )
        ):
            config = {
                "run": {"dir": f"r{number}", **({"speed": "fast"} if number % 2 else {})},
                "experiment": "e",
                "path": f"r{number}/x",
                "data": {"batch_size": 8},
                "optimizer": {"lr": 0.5} if number < 3 else {},
            }
            Path(f"r{number}").mkdir()
            task: Any = mock.Mock(spec=provenance.Task)
            task.facts = {
                "vocabulary": [1],
                "verbs": [],
                "captions": [],
                "dataset": "d",
                "max_frames": 5,
            }
            task.parameters.side_effect = lambda: [
                nn.Parameter(torch.ones(5)),
                nn.Parameter(torch.ones(9999), requires_grad=False),
            ]
            task.describe.return_value = "Net"
            data = SimpleNamespace(
                store=SimpleNamespace(info={"dataset": "d", "representation": "p", "hours": 2.5}),
                counts=lambda store: ["3 clips"],
                train=range(48),
            )
            trainer: Any = Trainer(
                global_step=step,
                datamodule=data,
                world_size=1 + number % 3,
                accumulate_grad_batches=1 + number // 3,
            )
            if before is not None:
                content = facts | before | {"data": {}, "device": "old", "parameters": 1}
                Path(f"r{number}/provenance.json").write_text(json.dumps(content))
            with mock.patch.object(provenance, "environment", return_value=facts | now):
                rows.append(
                    printed(provenance.WriteProvenance(config).on_train_start, trainer, task)
                )
            rows.append(
                [
                    Path(f"r{number}", name).read_text()
                    for name in ("provenance.json", "config.yaml")
                ]
            )
        other: Any = Trainer(is_global_zero=False)
        start: Any = provenance.WriteProvenance({}).on_train_start
        rows.append(start(other, task))
    return rows


def changes_of_recipes() -> Any:
    from support.fixtures import recipe

    rows: list[Any] = []
    base = recipe("quickstart")
    for changes in (
        {},
        {"seed": 3},
        {"experiment": "mine"},
        {"lr_decay": 0.5, "lr_warmup": 7},
        {"data_root": "/x"},
        {"optimizer": base["optimizer"] | {"lr": 0.5}},
        {"denoiser": {"_target_": "flame_mdm.denoisers.gru.MDMGRU", "latent_dim": 1}},
        {"trainer": base["trainer"] | {"max_steps": 3, "precision": "bf16-mixed"}},
        {"callbacks": {}},
        {"logger": None},
        {"losses": {"joints": 2.0}},
        {"my": "y" * 99},
        {"data": base["data"] | {"num_workers": 9, "batch_size": 9}},
    ):
        rows.append(start.recipe_changes(base | changes))
        with workspace() as folder:
            saved = start.movable(base)
            Path("config.yaml").write_text(json.dumps(saved))
            rows.append(
                without(folder, outcome(start.__dict__["_check_same"], Path(), base | changes))
            )
    return rows


# Files of weights --------------------------------------------------------------------------------


def _facts(**changes: Any) -> dict[str, Any]:
    return {
        "actions": [],
        "max_frames": 40,
        "dataset": "synthetic",
        "fingerprint": "f00d",
        **changes,
    }


@cache
def _model(condition: str = "learned", layers: int = 3) -> MotionGenerator:
    from support.fixtures import recipe

    config = json.loads(json.dumps(recipe("quickstart")))
    config["denoiser"] |= {"latent_dim": 8, "ff_size": 12, "num_layers": layers, "num_heads": 2}
    config["condition"] |= {"features": 8, "buckets": 50} if condition == "learned" else {}
    if condition == "none":
        config["condition"] = {"_target_": "flame_mdm.conditions.Unconditional"}
    torch.manual_seed(3)
    facts = {
        "actions": [],
        "max_frames": 40,
        "dataset": "synthetic",
        "fingerprint": "f",
        "vocabulary": ["a", "walks"],
        "captions": ["a walks"],
    }
    return MotionGenerator.build(config, instantiate(config["representation"]), facts=facts).eval()


def _about(**changes: Any) -> Any:
    return {
        "name": "limp",
        "action": False,
        "rank": 2,
        "words": ["limp"],
        "rows": [3, 7],
        "captions": ["x limp"],
        "base": "",
        **changes,
    }


def checked_weights_and_content() -> Any:
    with workspace():
        Path("w").write_bytes(b"0" * 50)
        rows: list[Any] = []
        for value in (
            torch.ones(3),
            torch.ones(25),
            torch.ones(26),
            torch.ones(3, dtype=torch.complex64),
            "x",
            3,
            torch.ones(2).to_sparse(),
            torch.ones(3, dtype=torch.bool),
            torch.ones(3, dtype=torch.float16),
            torch.ones(1, device="meta"),
            torch.ones(3, dtype=torch.uint8),
            torch.ones(2, dtype=torch.float8_e4m3fn),
            None,
        ):
            rows.append(outcome(model_files.check_weights, {"a": value}, Path("w")))
        rows.append(outcome(model_files.check_weights, {3: torch.ones(1)}, Path("w")))
        for changes in (
            {},
            {"config": ...},
            {"state_dict": [1]},
            {"global_step": "x"},
            {"facts": {"actions": []}},
            {"facts": {"actions": [], "max_frames": 0}},
            {"facts": {"actions": [], "max_frames": 100_001}},
            {"facts": _facts(licenses=[{"license": "x"}])},
            {"origin": {"a": [1]}},
            {"origin": {"a": 1.5, "b": None}},
            {"config": {"experiment": "${x}"}},
            {"facts": _facts(training={"hours": "x"})},
            {"facts": _facts(vocabulary=[1])},
        ):
            content = outcome(model_files.checked, Path("w"), _checkpoint(**changes))
            rows.append(content if isinstance(content, str) else sorted(content))
        rows += [outcome(model_files.checked, Path("w"), [1])]
        rows += [
            outcome(model_files.check_format, Path("w"), number)
            for number in (None, 0, 1, 2, 3, "2", "y" * 50)
        ]
        return rows


def written_model_files() -> Any:
    rows: list[Any] = []
    with workspace():
        state = {
            "b": drawn(2, 3).T,
            "a": torch.arange(4),
            "h": drawn(3, dtype=torch.float32).half(),
        }
        config = {
            "experiment": "e",
            "task": {"_target_": "flame_mdm.task.MotionGeneration"},
            "representation": {"_target_": "r"},
        }
        for out in ("x.safetensors", "folder", Path("deep/y.safetensors"), "z.ckpt"):
            path = model_files.write_model_file(
                out, state, config=config, facts=_facts(), origin={"made": "m"}
            )
            model = model_files.read_checkpoint(path)
            rows.append(
                [
                    path,
                    model,
                    [str(v.dtype) for v in model["state_dict"].values()],
                    model_files.weights_sha256(path),
                ]
            )
            rows.append(sorted(model_files.read_safetensors(path)[0].items()))
        for changed in (
            {},
            {"a": torch.arange(4) + 1},
            {"a": torch.arange(4).int()},
            {"a": torch.arange(4).reshape(2, 2)},
            {"c": torch.ones(1)},
        ):
            rows += [
                model_files.state_sha256(state | changed),
                model_files.content_sha256("t", state | changed),
            ]
        rows.append(model_files.content_sha256("u", state))
        from safetensors.torch import save_file

        for metadata in (
            None,
            {"flame_mdm": "{"},
            {"flame_mdm": '{"format": 2}'},
            {"flame_mdm": "[1]"},
            {"flame_mdm_adapter": "{}"},
            {"flame_mdm": '{"format": 1, "config": {}, "facts": {}, "origin": {}}'},
            {"flame_mdm": '{"format": 2, "config": {}, "facts": {}, "origin": {}}', "sha256": "x"},
        ):
            save_file({"a": torch.ones(2)}, "m.safetensors", metadata)
            rows.append(outcome(model_files.read_model_file, Path("m.safetensors")))
        Path("m.safetensors").write_text("x")
        rows.append(outcome(model_files.read_checkpoint, Path("m.safetensors")))
        for number in (None, 1, 2, 3):
            torch.save(
                _checkpoint() | ({} if number is None else {"flame_mdm_format": number}), "c.ckpt"
            )
            content = outcome(model_files.read_checkpoint, Path("c.ckpt"))
            rows.append(content if isinstance(content, str) else sorted(content))
        for root, folder, experiment in (
            ("/d", "/r", "e"),
            ("data", "runs", "e"),
            (None, None, "e/f"),
            ("/d", "/d/r", "e"),
        ):
            rows.append(
                model_files.without_own_paths(
                    {
                        "data_root": root,
                        "run": {"dir": folder},
                        "experiment": experiment,
                        "a": [f"{root}/x"],
                        "b": {"c": f"{root}/x", "d": f"{folder}/y"},
                        "e": f"{root}x",
                    }
                )
            )
        rows.append(model_files.without_own_paths({"experiment": "e", "x": "/y"}))
    return rows


def located_models() -> Any:
    rows: list[Any] = [sorted(locating.SHIPPED)]
    with workspace() as folder:
        for name in (
            "run/checkpoints",
            "many",
            "one",
            "none",
            "runs/a/checkpoints",
            "runs/b/checkpoints",
            "fresh",
            "mixed",
            "user",
            "quickstart_run",
        ):
            Path(name).mkdir(parents=True)
        for name in (
            "run/checkpoints/last.ckpt",
            "run/checkpoints/step=3.ckpt",
            "run/config.yaml",
            "many/a.safetensors",
            "many/b.safetensors",
            "one/m.safetensors",
            "one/.t.safetensors",
            "fresh/config.yaml",
            "mixed/config.yaml",
            "mixed/m.safetensors",
            "plain.ckpt",
            "runs/file",
        ):
            Path(name).write_text("")
        os.mkfifo("pipe.ckpt")
        hf = mock.Mock(side_effect=lambda *args, **options: f"hub {args} {options}")
        with mock.patch("huggingface_hub.hf_hub_download", hf):
            for name in (
                "run",
                "run/",
                "many",
                "one",
                "none",
                "runs",
                "fresh",
                "mixed",
                "plain.ckpt",
                "plan.ckpt",
                "pipe.ckpt",
                "quickstart",
                "quickstrt",
                "package_dip",
                "a/b",
                "a/b@v1",
                "a/b@x/y",
                "a/b/c",
                "a/b.ckpt",
                "user/x",
                "gone/x.safetensors",
                "a b/c",
                "run/checkpoints",
                Path("one"),
                "xyz",
                "a/b@",
                "a/b.pt",
                "none/x",
            ):
                for which in ((), ("best",)):
                    path = outcome(locating.find, name, *which)
                    rows.append(
                        [
                            name,
                            which,
                            str(path).replace(str(Path(locating.__file__).parents[1]), "PACKAGE"),
                        ]
                    )
            hf.side_effect = OSError("a:\nb\nc")
            rows.append(outcome(locating.find, "a/b"))
        return without(folder, rows)


def changed_weights() -> Any:
    rows: list[Any] = []
    weight, up, down, vectors = (
        drawn(4, 3),
        drawn(4, 2, seed=1),
        drawn(2, 3, seed=2),
        drawn(2, 3, seed=3),
    )
    for strength in ((), (0.0,), (0.5,), (-2.0,)):
        rows += [
            adapters.changed(weight, {"up": up, "down": down}, [0], *strength),
            adapters.changed(weight, {"vectors": vectors}, [2, 0], *strength),
        ]
    kept: list[dict[str, Any]] = [{}, {"is_kept": True}, {"is_kept": False}]
    for is_kept in kept:
        change = adapters.Change([1, 1], vectors=nn.Parameter(vectors), **is_kept)
        rows.append([change(weight), sorted(dict(change.named_parameters()))])
    return rows


def rows_of_words() -> Any:
    rows: list[Any] = []
    for buckets in (7, 20, 50, 10_000):
        encoder: Any = SimpleNamespace(buckets=buckets)
        for vocabulary in ((), ("walk", "jump", "a"), [f"w{k}" for k in range(8)]):
            rows.append(adapters.word_rows(encoder, [f"new{k}" for k in range(9)], vocabulary))
    return rows


def attached_adapters() -> Any:
    rows: list[Any] = []
    for condition, layers, action, words in (
        ("learned", 3, False, [3, 7]),
        ("learned", 3, True, []),
        ("learned", 2, False, [1]),
        ("none", 1, False, [1]),
    ):
        model = copy.deepcopy(_model(condition, layers))
        torch.manual_seed(0)
        adapters.attach(model, _about(action=action, rows=words))
        trained = {name: list(p.shape) for name, p in model.named_parameters() if p.requires_grad}
        down = [p for name, p in model.named_parameters() if name.endswith("down")]
        rows.append(
            [
                trained,
                down[0],
                down[-1],
                sum(
                    float(p.detach().sum()) for n, p in model.named_parameters() if n.endswith("up")
                ),
            ]
        )
    model = copy.deepcopy(_model())
    model.denoiser = nn.Linear(1, 1)  # type: ignore[assignment]
    return rows, outcome(adapters.attach, model, _about())


def merged_adapters() -> Any:
    rows: list[Any] = []
    with workspace() as folder:
        base = _model()
        file = hub_file(base, "base.safetensors")
        state = model_files.read_model_file(file)["state_dict"]
        files = []
        for number, action in enumerate((False, True)):
            model = copy.deepcopy(base)
            about = _about(
                action=action,
                base=model_files.state_sha256(state),
                words=[f"w{number}", "a"],
                captions=[f"c{number}"],
            )
            torch.manual_seed(number)
            adapters.attach(model, about)
            for name, p in model.named_parameters():
                if p.requires_grad:
                    p.data = drawn(*p.shape, seed=len(name) + number, dtype=torch.float32)
            torch.save(
                _checkpoint(
                    config={**base.config, "adapter": about},
                    facts=base.facts,
                    state_dict=model.state_dict(),
                    flame_mdm_format=2,
                ),
                f"{number}.ckpt",
            )
            adapters.write_adapter(Path(f"{number}.safetensors"), Path(f"{number}.ckpt"))
            files.append(f"{number}.safetensors")
            metadata, changes = model_files.read_safetensors(Path(files[-1]))
            rows.append([metadata["flame_mdm_adapter"], sorted(changes)])
            merged = adapters.read_merged(Path(f"{number}.ckpt"))
            rows.append(
                [
                    torch.cat(
                        [v.flatten().double() for _, v in sorted(merged["state_dict"].items())]
                    ),
                    "adapter" in merged["config"],
                ]
            )
        for adapter, strength in (
            (files[0], ()),
            (files[0], (0.5,)),
            (files[1], (0.0,)),
            (files, (0.25,)),
            (files, ([0.5, -1.0],)),
            (files[::-1], ([0, 1.5],)),
            ((), ()),
            (Path(files[1]), ([2.0],)),
        ):
            merged = adapters.read_merged(file, adapter, *strength)
            rows.append(
                [
                    merged["facts"]["vocabulary"],
                    merged["facts"]["captions"],
                    torch.cat(
                        [v.flatten().double() for _, v in sorted(merged["state_dict"].items())]
                    ),
                ]
            )
        for adapter, strength in (
            (files, [1.0]),
            (files[0], math.inf),
            (files[0], []),
            ([], 2.0),
            ("base.safetensors", 1.0),
            ("gone.safetensors", 1.0),
        ):
            rows.append(
                str(outcome(adapters.read_merged, file, adapter, strength))[:120].replace("{", "(")
            )
        other = hub_file(_model(layers=2), "other.safetensors")
        rows.append(outcome(adapters.read_merged, other, files[0]))
        receiver = copy.deepcopy(base)
        for p in receiver.parameters():
            p.data.zero_()
        rows += [
            adapters.copy_matching_weights(receiver, other),
            receiver.denoiser.get_parameter("input.weight").double(),
            outcome(adapters.copy_weights, receiver, other),
        ]
        adapters.attach(receiver, _about())
        adapters.copy_weights(receiver, file)
        rows.append(torch.cat([p.detach().flatten().double() for p in receiver.parameters()]))
        narrow = nn.Linear(1, 1)
        rows += [
            outcome(adapters.copy_matching_weights, narrow, other),
            outcome(fit.__dict__["_start_from"], SimpleNamespace(generator=receiver), "gone.ckpt"),
        ]
        rows.append(
            printed(
                fit.__dict__["_start_from"],
                SimpleNamespace(generator=copy.deepcopy(base)),
                "other.safetensors",
            )
        )
        return without(folder, rows)


def hub_file(model: MotionGenerator, name: str) -> Path:
    """Writes a model file."""
    return model_files.write_model_file(
        name,
        model.state_dict(),
        config=model.config,
        facts=model.facts,
        origin={"made": "m", "steps": 5},
    )


def exported_and_pushed_models() -> Any:
    rows: list[Any] = []
    with workspace() as folder:
        hub_file(_model(), "base.safetensors")
        base = model_files.read_model_file(Path("base.safetensors"))
        for number, extra in enumerate(
            (
                {"global_step": 7},
                {"current_model_state": {}, "global_step": 8},
                {"origin": {"made": "x"}},
            )
        ):
            content = {k: base[k] for k in ("config", "facts", "state_dict")}
            torch.save({**content, "flame_mdm_format": 2, **extra}, f"{number}.ckpt")
            for half in ({}, {"half": True}):
                model = model_files.read_model_file(
                    hub.export(f"{number}.ckpt", f"o{number}", **half)
                )  # type: ignore[arg-type]
                origin = {k: v for k, v in model["origin"].items() if k != "sha256"}
                rows.append(
                    [
                        origin,
                        {str(v.dtype): v.ndim for v in model["state_dict"].values()},
                        torch.cat([v.flatten().double() for v in model["state_dict"].values()]),
                    ]
                )
        for repository in ("a/b", "a", "a/b/c", "/b", "a/.b", "a.b-c/d_e", "a/b c"):
            rows.append(
                outcome(
                    hub.push,
                    "base.safetensors",
                    repository,
                    f"p{repository.count('/')}",
                    upload=False,
                    private=True,
                )
            )
        rows.append(sorted(str(p) for p in Path().rglob("p*/*")))
        for name, text in (
            ("README.md", "mine"),
            ("config.yaml", "mine"),
            ("model.safetensors", "mine"),
        ):
            hub.push("base.safetensors", "a/b", f"q{name}", upload=False, private=True)
            Path(f"q{name}", name).write_text(text)
            rows.append(
                outcome(hub.push, "base.safetensors", "a/b", f"q{name}", upload=False, private=True)
            )
        Path("qq").mkdir()
        Path("qq/model.safetensors").write_text("x")
        rows.append(outcome(hub.push, "base.safetensors", "a/b", "qq", upload=False, private=True))
        with mock.patch("huggingface_hub.HfApi") as api:
            for fault in (None, OSError("a:\nb")):
                api.return_value.upload_folder.side_effect = fault
                rows.append(
                    [
                        outcome(
                            hub.push, "base.safetensors", "a/b", "pp", upload=True, private=True
                        ),
                        [str(call) for call in api.mock_calls],
                    ]
                )
        for condition, changes in (
            ("LearnedTokens", {}),
            ("ActionLabels", {"actions": ["run", "jump"]}),
            ("Unconditional", {"dataset": "kit"}),
            (None, {"fingerprint": None, "dataset": "humanml3d"}),
            (
                "LearnedTokens",
                {
                    "licenses": [
                        {"license": "CC-BY-4.0", "clips": 3, "minutes": 1.5, "actions": ["a|b"]},
                        {"license": "own", "clips": 1, "minutes": 2, "actions": []},
                    ]
                },
            ),
        ):
            config = {
                "experiment": "e_x",
                "denoiser": {"_target_": "m.Net"},
                **({"condition": {"_target_": f"m.{condition}"}} if condition else {}),
            }
            rows.append(
                hub.card(
                    {
                        "config": config,
                        "facts": _facts(**changes),
                        "state_dict": {"a": torch.ones(30, 50)},
                        "origin": {"made": "*m*"},
                    },
                    "u/n",
                    "ab",
                )
            )
        return without(folder, rows)


def loaded_models() -> Any:
    rows: list[Any] = []
    with workspace() as folder:
        file = hub_file(_model(), "base.safetensors")
        model = loading.load(file)
        rows.append(
            [
                model.steps,
                model.sha256 == model_files.hashlib.sha256(file.read_bytes()).hexdigest(),
                model.training,
                model.describe(),
                model.conditioned_on,
            ]
        )
        content = model_files.read_model_file(file)
        for changes in (
            {"global_step": 9},
            {"config": content["config"] | {"task": {"_target_": "mine.Task"}}},
            {
                "config": content["config"]
                | {"denoiser": content["config"]["denoiser"] | {"num_layers": 2}}
            },
            {
                "config": content["config"]
                | {"denoiser": content["config"]["denoiser"] | {"num_layers": 9000}}
            },
            {"state_dict": {k: v for k, v in content["state_dict"].items() if "output" not in k}},
            {"config": content["config"] | {"task": {"_target_": "flame_mdm.task.ClassifierTask"}}},
            {"config": content["config"] | {"denoiser": {"_target_": "os.system"}}},
            {"origin": None},
        ):
            torch.save(
                {**content, "flame_mdm_format": 2, "origin": {"steps": 3}, **changes}, "m.ckpt"
            )
            model = outcome(loading.load, "m.ckpt")
            rows.append(
                str(model)[:300]
                if isinstance(model, str)
                else [model.steps, torch.cat([p.flatten().double() for p in model.parameters()])]
            )
        with (
            mock.patch.object(loading, "NO_GPU", "no GPU"),
            mock.patch("torch.cuda.device_count", return_value=2),
        ):
            rows += [outcome(loading.check_device, name) for name in ("cpu", "meta", "tpux")]
        rows += [outcome(loading.check_device, "cpu"), outcome(loading.load, "gone.ckpt")]
        return without(folder, rows)


class Unsafe:
    """An object whose class torch refuses."""


def files_of_torch() -> Any:
    rows: list[Any] = []
    good = {
        "a": torch.ones(3),
        "b": [1, 2.5, None, True, "x", b"y", (1,)],
        3: {-5: "x"},
        "o": OrderedDict(x=1),
        "s": {1, 2},
    }
    contents: list[Any] = [
        good,
        {2**60: 1},
        {2**60 - 1: 1},
        {-(2**60): 1},
        {1 - 2**60: 1},
        {(1, 2): 3},
        {1.5: 2},
        {None: 1},
        {True: 1},
        {b"x": 1},
        {2**60},
        {1.5},
        {"x"},
        OrderedDict([(2**61, 1)]),
        OrderedDict([("k", 2**61)]),
        Counter({2**61: 1}),
        Counter("aab"),
        Unsafe(),
        bytearray(b"xy"),
        1 + 2j,
        {"x": {2**70: 1}},
        [{0.5: 1}],
        (),
        {1: Unsafe(), 2**61: 1},
    ]
    with workspace() as folder:
        for content in contents:
            for options in ({}, {"_use_new_zipfile_serialization": False}):
                torch.save(content, "f.pt", **options)
                rows.append(str(outcome(torch_files.read_torch, Path("f.pt"))).split("\n")[0][:200])
                rows.append(str(outcome(torch_files.check_keys, Path("f.pt"))).split("\n")[0][:200])
        torch.save(good, "f.pt")
        data = Path("f.pt").read_bytes()
        Path("flip.pt").write_bytes(
            data.replace(torch.ones(3).numpy().tobytes(), torch.zeros(3).numpy().tobytes())
        )
        Path("cut.pt").write_bytes(data[:-30])
        with (
            zipfile.ZipFile("f.pt") as old,
            zipfile.ZipFile("packed.pt", "w", zipfile.ZIP_DEFLATED) as new,
        ):
            for member in old.infolist():
                new.writestr(member.filename, old.read(member))
        Path("text.pt").write_text("text")
        Path("p.pt").write_bytes(pickle.dumps({"a": 1}, protocol=4))
        for name in ("flip.pt", "cut.pt", "packed.pt", "text.pt", "p.pt", "gone.pt"):
            for read in (torch_files.check_torch, torch_files.check_keys, torch_files.read_torch):
                rows.append(re_first(outcome(read, Path(name))))
        for options in ({}, {"run_code": True}, {"advice": "Beware"}):
            for content in (good, [1], {1.5: 2}, {"x": Unsafe()}):
                torch.save(content, "g.pt")
                rows.append(
                    re_first(outcome(released_weights.read_released, Path("g.pt"), **options))
                )
        for content, key in (
            (good, None),
            ({"a": torch.ones(2)}, None),
            ({"k": {"a": torch.ones(2)}, "z": 1}, "k"),
            ({"k": 3}, "k"),
            ({"k": 3}, "q"),
            ({str(k): 1 for k in range(9)}, None),
        ):
            torch.save(content, "g.pt")
            rows.append(outcome(released_weights.read_weights, Path("g.pt"), key))
        return [
            row.replace(__name__, "MODULE") for row in without(folder, [str(row) for row in rows])
        ]


def re_first(value: Any) -> str:
    """The beginning of the text of a result."""
    return str(value).split("\n")[0][:160].split(" object at 0x")[0]


# Released models ---------------------------------------------------------------------------------


def states_of_released_files() -> Any:
    rows: list[Any] = []
    a, b, c = ({"w": torch.full((2,), value)} for value in (1.0, 2.0, 3.0))
    named = {"ema_model.model.w": torch.ones(1), "net.w": torch.zeros(1), "z": torch.ones(2)}
    for content in (
        a,
        {"model": a, "model_avg": b},
        {"state_dict": c},
        {"state_dict": named},
        {"state_dict": {"net.w": torch.ones(3)}},
        {"model": a},
        {},
        {"state_dict": 3},
        {1: torch.ones(1)},
        {"model_avg": b},
        named,
    ):
        for options in ({}, {"ema": True}, {"ema": False}):
            rows.append(outcome(released_weights.released_state, content, **options))
    for key, ndim in (("w", ()), ("w", (1,)), ("q", ())):
        rows.append(outcome(released_weights.shape_of, a, key, *ndim))
    listed = released_weights.__dict__["_listed"]
    rows += [listed(range(count)) for count in (0, 1, 5, 6, 12)]
    rows += [
        outcome(released_weights.renamed, {"x.a": torch.ones(1), "y.b": torch.ones(2)}, prefixes)
        for prefixes in ({"x.": "p.", "y.": ""}, {"x.": "p."})
    ]
    net = nn.Linear(2, 3)
    rows += [
        outcome(released_weights.load_strictly, net.train(), state, "f").training
        if state
        else outcome(released_weights.load_strictly, net, {}, "f")
        for state in (net.state_dict(), None)
    ]
    return rows


def _released_state(arch: str, **extra: tuple[int, ...]) -> dict[str, Tensor]:
    """Random weights of a small network, by the names of the authors."""
    d, ff, f = 8, 12, 263
    stack = {"trans_enc": "seqTransEncoder", "trans_dec": "seqTransDecoder", "gru": ""}[arch]
    shapes: dict[str, tuple[int, ...]] = {
        "input_process.poseEmbedding.weight": (d, f + (d if arch == "gru" else 0)),
        "input_process.poseEmbedding.bias": (d,),
        "output_process.poseFinal.weight": (f, d),
        "output_process.poseFinal.bias": (f,),
        "embed_timestep.time_embed.0.weight": (d, d),
        "embed_timestep.time_embed.0.bias": (d,),
        "embed_timestep.time_embed.2.weight": (d, d),
        "embed_timestep.time_embed.2.bias": (d,),
        "embed_text.weight": (d, 5),
        "embed_text.bias": (d,),
        "clip_model.x": (3,),
        "sequence_pos_encoder.pe": (9, 1, d),
        **extra,
    }
    state = {
        name: drawn(*shape, seed=k, dtype=torch.float32)
        for k, (name, shape) in enumerate(shapes.items())
    }
    torch.manual_seed(1)
    if arch == "gru":
        gru = nn.GRU(d, d, num_layers=3)
        return state | {f"gru.{name}": value for name, value in gru.state_dict().items()}
    kind = nn.TransformerEncoderLayer if arch == "trans_enc" else nn.TransformerDecoderLayer
    for number in range(2):
        state |= {f"{stack}.layers.{number}.{k}": v for k, v in kind(d, 2, ff).state_dict().items()}
    return state


def imported_networks() -> Any:
    rows: list[Any] = []
    targets = {
        "embed_target_cond.mlp.0.weight": (8, 32),
        "embed_target_cond.mlp.0.bias": (8,),
        "embed_target_cond.mlp.2.weight": (8, 8),
        "embed_target_cond.mlp.2.bias": (8,),
    }
    for arch, options, extra in (
        ("trans_enc", {}, {}),
        ("trans_enc", {"mask_frames": True}, {}),
        ("trans_dec", {}, {}),
        ("trans_dec", {"emb_trans_dec": True}, {}),
        ("gru", {}, {}),
        (
            "trans_dec",
            {"text_encoder_type": "bert", "context_len": 5, "pred_len": 7, "emb_policy": "concat"},
            {},
        ),
        ("trans_dec", {"text_encoder_type": "bert", "emb_trans_dec": True}, {}),
        ("trans_enc", {}, {"embed_action.action_embedding": (4, 8)}),
        ("trans_enc", {"lambda_target_loc": 1.0}, {}),
        ("trans_enc", {"multi_target_cond": True}, {}),
        ("trans_dec", {"lambda_target_loc": 1.0}, targets),
    ):
        for token in ({}, {"time_token": True}):
            state = _released_state(arch, **extra)
            if "embed_action.action_embedding" in state:
                state = {k: v for k, v in state.items() if not k.startswith("embed_text")}
            given: dict[str, Any] = {"arch": arch, "num_heads": 2, **options}
            result = outcome(released.import_mdm, state, released_options.Options(**given), **token)
            if isinstance(result, str):
                rows.append([arch, options, result[:200]])
                continue
            rows.append(
                [
                    arch,
                    options,
                    result.network.__name__,
                    result.features,
                    result.options,
                    sorted(result.state),
                    result.action_embedding,
                ]
            )
            if not token and (
                arch == "trans_dec" or result.action_embedding is not None or not options
            ):
                for kind, dataset, changes in (
                    ("mdm", "humanml", {}),
                    ("mfm", "kit", {"ode_kwargs": {"method": "dopri5", "step_size": 0.3}}),
                    (
                        "mdm",
                        "uestc",
                        {"num_frames": 50, "cond_mask_prob": 0.0, "sigma_small": False},
                    ),
                    ("mfm", "humanact12", {"ode_kwargs": {"method": "midpoint"}}),
                    ("mfm", "humanml", {"lambda_vel": 2.0, "lambda_rcxyz": 3.0, "lambda_fc": 4.0}),
                ):
                    chosen = released_options.Options.model_validate(
                        {"arch": arch, "dataset": dataset, **options, **changes}, strict=False
                    )
                    config, facts = released.__dict__["_mdm_recipe"](kind, result, chosen)
                    rows.append(
                        [
                            config[name]
                            for name in ("experiment", "condition", "process", "task", "losses")
                        ]
                        + [facts]
                    )
    ours = {"target.network.0.weight": 1, "target.network.2.weight": 1}
    rows += [
        released.__dict__["_target_options"](names)
        for names in (
            ours,
            {"target.weights": 1},
            {
                "target.networks.0.0.weight": 1,
                "target.networks.0.2.weight": 1,
                "target.networks.0.4.weight": 1,
                "target.networks.1.0.weight": 1,
            },
            {},
            {"target.network.0.weight": 1},
        )
    ]
    return rows


def imported_files() -> Any:
    rows: list[Any] = []
    with workspace() as folder:
        state = _released_state("trans_enc")
        torch.save({"model": state, "model_avg": {k: v + 1 for k, v in state.items()}}, "m.pt")
        Path("args.json").write_text(
            json.dumps({"dataset": "humanml", "num_heads": 2, "diffusion_steps": 50})
        )
        Path("stats").mkdir()
        np.save("stats/Mean.npy", np.linspace(-1, 1, 263))
        np.save("stats/Std.npy", np.linspace(1, 2, 263))
        for options in (
            {},
            {"averaged": False},
            {"num_heads": 4},
            {"num_heads": 3},
            {"stats": None},
            {"kind": "mfm"},
            {"args": None},
            {"kind": "flame"},
            {"kind": "flame", "args": None},
        ):
            arguments: dict[str, Any] = {
                "kind": "mdm",
                "file": "m.pt",
                "args": "args.json",
                "out": "o",
                "stats": "stats",
                **options,
            }
            path = outcome(released.import_released, **arguments)
            if isinstance(path, str):
                rows.append([options, path[:200]])
                continue
            model = model_files.read_model_file(path)
            rows.append(
                [
                    options,
                    model["config"],
                    model["facts"],
                    {k: v for k, v in model["origin"].items() if k != "sha256"},
                    [
                        model["state_dict"][name].double()
                        for name in (
                            "denoiser.input.bias",
                            "representation.mean",
                            "representation.std",
                        )
                    ],
                ]
            )
        for name, value in (
            ("Mean", np.ones(5)),
            ("Mean", np.full(263, np.inf)),
            ("Std", np.zeros(263)),
            ("Std", np.full(263, -1.0)),
            ("Mean", np.array(["x"] * 263)),
        ):
            old = np.load(f"stats/{name}.npy")
            np.save(f"stats/{name}.npy", value)
            rows.append(
                outcome(released.import_released, "mdm", "m.pt", "args.json", "o", stats="stats")
            )
            np.save(f"stats/{name}.npy", old)
        Path("args.json").write_text(json.dumps({"dataset": "uestc", "num_heads": 2}))
        rows += [
            outcome(released.import_released, "mdm", "m.pt", "args.json", "o", stats=stats)
            for stats in (None, "stats")
        ]
        return without(folder, rows)


def options_of_released_models() -> Any:
    texts: list[Any] = [
        {},
        {"arch": "gru"},
        {"arch": "x"},
        {"arch": None},
        {"layers": 3},
        {"unknown": 1},
        {"unknown": None},
        {"emb_before_mask": True},
        {"emb_before_mask": False},
        {"hml_type": None},
        {"hml_type": "x"},
        {"emb_policy": "CONCAT"},
        {"emb_policy": "concat", "arch": "trans_dec", "text_encoder_type": "bert"},
        {"context_len": 5, "pred_len": 0, "arch": "trans_dec", "text_encoder_type": "bert"},
        {"context_len": 5, "pred_len": 2},
        {"pred_len": 2},
        {
            "model": {"arch": "gru"},
            "training": {"diffusion_steps": 7, "arch": "trans_enc"},
            "num_frames": 9,
        },
        {"model": {"arch": "gru"}, "arch": "trans_dec"},
        {"model": 3},
        {"ode_kwargs": {"step_size": "2e-2"}},
        {"ode_kwargs": {"step_size": 2}},
        {"ode_kwargs": {"method": "rk4", "x": 1}},
        {"ode_kwargs": 3},
        {"diffusion_steps": 0},
        {"cond_mask_prob": 1.5},
        {"num_heads": 0},
        [1],
        {"lambda_vel": "x"},
    ]
    rows: list[Any] = [
        released_options.read_options(None, {}),
        outcome(released_options.read_options, None, {"num_heads": 3, "x": 1}),
    ]
    with workspace():
        for content in texts:
            Path("a.json").write_text(json.dumps(content))
            rows.append([content, outcome(released_options.read_options, "a.json", {})])
        rows.append(outcome(released_options.read_options, "a.json", {"num_heads": 7}))
    equal = released_options.__dict__["_equal"]
    rows.append(
        [
            equal(a, b)
            for a in (1, 1.0, "1e-5", "x", None, 1e-5, False)
            for b in (1, 1e-5, "x", False, 0.0, "1e-5")
        ]
    )
    for kind in ("flame", "mclip"):
        for options in (
            {},
            {"x": 1},
            3,
            dict(list(released_weights.NAMES["options"][kind]["neutral"].items())[:3]),
            dict.fromkeys(list(released_weights.NAMES["options"][kind]["neutral"])[:1], "other"),
        ):
            rows.append(
                outcome(released_options.check_hyperparameters, {"hyper_parameters": options}, kind)
            )
    return rows


# Exported models ---------------------------------------------------------------------------------


def parts_of_runner() -> Any:
    rows: list[Any] = []
    seen = {"walk", "jumping", "hop", "dance", "two", "runs", "clap", "skipped", "tie"}
    words = (
        "walks",
        "walked",
        "jump",
        "jumped",
        "hopping",
        "dancing",
        "danced",
        "two",
        "three",
        "run",
        "running",
        "clapped",
        "skip",
        "ties",
        "tying",
        "x",
        "ing",
        "bed",
        "dances",
        "jumpings",
        "claps",
        "hope",
    )
    rows.append({word: runner.known_form(word, seen) for word in words})
    rows += [
        runner.words("A man's 2_legs, RÜN! don't"),
        [runner.hashed(word, n) for word in words[:5] for n in (7, 1000)],
        runner.key("a", 1, "b"),
        runner.key(),
    ]
    rows += [
        runner.normal(number, frames, features)
        for number, frames, features in ((0, 3, 4), (2**64 + 5, 5, 3), (-1, 2, 1), (77, 4, 7))
    ]
    rows.append(runner.mixed(np.arange(6, dtype=np.uint64) * np.uint64(2**60)).tolist())
    before, x = (drawn(n, 6, seed=n).numpy() for n in (2, 9))
    for fade in (
        None,
        {"frames": 4, "begin": 1, "end": 4},
        {"frames": 20, "begin": 0, "end": 6},
        {"frames": 9, "begin": 2, "end": 3},
        {"frames": 1, "begin": 0, "end": 6},
    ):
        rows.append(runner.joined(before, x, fade))
    with workspace():
        Path("sub").mkdir()
        Path("f").write_bytes(b"12345")
        rows += [
            outcome(runner.read_file, Path(name), most)
            for name, most in (("f", 5), ("f", 4), ("sub", 9), ("gone", 9))
        ]
        for name in ("m.npz", "m", "m.x", "sub", "gone/x", "sub/y.npz"):
            rows.append(outcome(runner.write, name, joints=np.arange(6), text="t"))
        rows += [sorted(str(p) for p in Path().rglob("*")), np.load("m.npz")["joints"]]
        rows += [
            printed(runner.main, line)
            for line in (
                ["a"],
                ["a", "b", "c", "d"],
                ["gone", "x", "o.npz"],
                ["gone", "x", "o.npz", "seed=x"],
                ["gone", "x", "o.npz", "seconds=x"],
                ["gone", "x", "o.npz", "seconds=2", "seed=3"],
            )
        ]
    rows += [runner.first_line(ValueError(text)) for text in ("", "a\nb", " \n x")]
    number_of = runner.__dict__["_number_of"]
    rows += [
        outcome(number_of, {"a": text}, key, kind)
        for text in ("1", "1.5", "x" * 50)
        for key in "ab"
        for kind in (int, float)
    ]
    return rows


def _description(**changes: Any) -> dict[str, Any]:
    usual = {
        "format": 1,
        "experiment": "e",
        "reads": "text",
        "buckets": 50,
        "max_words": 4,
        "actions": ["run", "jump"],
        "vocabulary": ["walk", "person", "jumps"],
        "captions": ["x"],
        "function_words": ["a"],
        "features": 3,
        "fps": 20,
        "max_frames": 40,
        "padded_frames": 0,
        "skeleton": {"joints": ["p"], "parents": [-1], "feet": []},
        "clip_x0": False,
        "steps": [
            [5.0, 0.5, 0.25, 0.75, 0.5, 0.125, 0.25],
            [2.0, 0.25, 0.5, 0.5, 0.25, 0.0, 0.0],
            [0.0, 1.0, 0.25, 0.0, 1.0, -0.25, 0.5],
        ],
        "sha256": dict.fromkeys(runner.GRAPHS[:2], "0" * 64),
    }
    content = {k: v for k, v in (usual | changes).items() if v is not ...}
    return content | {"digest": runner.digest(content)}


def descriptions_of_exported_models() -> Any:
    rows: list[Any] = [
        outcome(runner.check, content)
        for content in (
            [],
            {},
            {"format": 2},
            _description(),
            _description() | {"fps": 3},
            _description() | {"digest": "x"},
        )
    ]
    values: dict[str, list[Any]] = {
        "experiment": ["", "a\n", "x" * 1000, "x" * 1001, 3],
        "reads": ["none", "other", "texts"],
        "buckets": [..., 0, 10_000_001, True, 1.0],
        "max_words": [..., 1001],
        "actions": [[""], [3], "x"],
        "features": [0, 2000, 2001],
        "fps": [0.5, 1, 1000, 1001, 12.5],
        "max_frames": [1, 2, 10_001],
        "padded_frames": [40, 39, -1],
        "start": [[[0.0] * 3], [[0.0] * 2], [[0.0] * 3] * 38, [[0.0] * 3] * 39, []],
        "fade": [
            {"frames": 3, "begin": 0},
            {"frames": 0, "begin": 0, "end": 1},
            {"frames": 3, "begin": 0, "end": 2},
        ],
        "root": [[[0, 1]] * 3, [[0, 1]] * 2, [[0, 1, 2]] * 3],
        "clip_x0": [1, True],
        "skeleton": [{}, {"joints": [], "parents": [-2], "feet": 3}],
        "steps": [[], [[0.0] * 6], [[2e9] * 7], [["x"] * 7]],
        "sha256": [
            {},
            {"denoiser.onnx": "x", "joints.onnx": "0" * 64},
            dict.fromkeys(runner.GRAPHS, "a" * 64),
        ],
        "vocabulary": [3, ["\n"]],
        "captions": [...],
        "extra": [1],
    }
    for name, options in values.items():
        rows += [
            [name, str(value)[:30], outcome(runner.check, _description(**{name: value}))]
            for value in options
        ]
    rows.append(outcome(runner.check, _description(reads="none", buckets=..., max_words=...)))
    return rows


class Session:
    """A graph that computes a simple function of its inputs."""

    def __init__(self, kind: str):
        self.kind = kind

    def run(self, _: Any, inputs: dict[str, Any]) -> list[np.ndarray]:
        if self.kind == "joints":
            return [inputs["x"][:, :, None, :3] * 2]
        if self.kind == "poses":
            return [np.ones((22, 3)), np.ones((len(inputs["joints"]), 22, 4))]
        x = inputs["x_t"]
        shift = sum(
            float(np.sum(np.cos(np.asarray(inputs[k], dtype=np.float64) + len(k))))
            for k in sorted(inputs)
            if k not in ("x_t",)
        )
        return [np.tanh(x * 0.5 + np.float32(shift)) if self.kind != "nan" else x * np.nan]


def motions_of_runner() -> Any:
    rows: list[Any] = []
    start_frames = drawn(4, 3).tolist()
    variants: list[dict[str, Any]] = [
        {},
        {"padded_frames": 40},
        {"clip_x0": True},
        {"reads": "action"},
        {"reads": "none"},
        {"vocabulary": []},
        {"start": start_frames},
        {"start": start_frames, "fade": {"frames": 3, "begin": 1, "end": 3}},
        {"fps": 12.5},
        {"max_frames": 90},
    ]
    for number, changes in enumerate(variants):
        sampler = runner.Sampler.__new__(runner.Sampler)
        sampler.content, sampler.denoiser, sampler.joints, sampler.poses = (
            _description(**changes),
            Session("denoiser"),
            Session("joints"),
            None,
        )
        for options in (
            {},
            {"seconds": 1.0},
            {"seconds": 0.1},
            {"seconds": 0.05},
            {"seconds": 4.5, "seed": 3},
            {"seconds": 0},
            {"seconds": -1},
            {"seconds": 700.0},
            {"seconds": 1.03, "sample": 2},
            {"seconds": 1.0, "text": "other"},
            {"seconds": math.nan},
        ):
            prompt = {"action": "jump", "none": ""}.get(
                sampler.content["reads"], "a person walks and jumping far away"
            )
            rows.append([number, options, outcome(sampler.generate, prompt, **options)])
        rows += [
            outcome(sampler.generate, "nothing", 1.0),
            outcome(sampler.unknown, "A person flies"),
            outcome(sampler.unknown, "flies"),
            outcome(sampler.unknown, "a walking walks"),
        ]
        rows += [
            sampler.decode(drawn(5, 3).numpy()),
            outcome(sampler.rotations, drawn(5, 22, 3).numpy()),
        ]
    sampler.poses = Session("poses")
    rows.append(sampler.rotations(drawn(5, 22, 3).numpy()))
    sampler.joints, sampler.denoiser = Session("poses"), Session("nan")
    rows += [
        str(outcome(sampler.decode, drawn(5, 3).numpy()))[:80],
        outcome(sampler.generate, "walk", 1.0),
    ]
    with workspace() as folder:
        Path("m").mkdir()
        rows.append(outcome(runner.Sampler, "m"))
        for text in ("{", "[1]", json.dumps(_description()), json.dumps(_description(fps=0))):
            Path("m/model.json").write_text(text)
            for graph in (b"", b"\x08location", b"x"):
                Path("m/denoiser.onnx").write_bytes(graph)
                rows.append(outcome(runner.Sampler, "m"))
        content = _description(
            sha256={
                name: runner.hashlib.sha256(b"\x08location").hexdigest()
                for name in runner.GRAPHS[:2]
            }
        )
        Path("m/model.json").write_text(json.dumps(content))
        Path("m/denoiser.onnx").write_bytes(b"\x08location")
        rows.append(outcome(runner.Sampler, "m"))
        return without(folder, rows)


def plans_of_samplers() -> Any:
    from flame_mdm.processes.diffusion import GaussianDiffusion as Diffusion
    from flame_mdm.processes.flow_matching import FlowMatching

    rows: list[Any] = []
    for kind, samplers in (
        (Diffusion, ("ancestral", "ddim", "dpm_solver_pp_2m")),
        (FlowMatching, ("euler", "midpoint", "heun", "dopri5")),
    ):
        for options in combinations(
            6,
            14,
            sampler=samplers,
            num_inference_steps=(4, 3),
            eta=(None, 0.5),
            spacing=(None, "stride"),
            variance=("fixed_small", "fixed_large", "learned_range"),
        ):
            variance = options.pop("variance")
            process: Any = outcome(
                kind,
                **({"num_train_timesteps": 12, "variance": variance} if kind is Diffusion else {}),
            )
            if kind is FlowMatching or options["sampler"] != "ddim":
                options |= {"eta": None}
            if kind is FlowMatching:
                options |= {"spacing": None}
            rows.append(
                [
                    kind.__name__,
                    options,
                    outcome(onnx_export.sampling_plan, process, SamplerOptions(**options))
                    if not isinstance(process, str)
                    else process,
                ]
            )
    for model in (_model(), _model("none", 1)):
        content = onnx_export.description(model)
        rows.append({k: v for k, v in content.items() if k not in ("function_words",)})
        rows.append(
            [
                [
                    g.name,
                    list(g.examples),
                    {k: list(v.shape) for k, v in g.examples.items()},
                    g.outputs,
                    {k: sorted(v) for k, v in g.dimensions.items()},
                ]
                for g in onnx_export.graphs(model)
            ]
        )
        torch.manual_seed(0)
        call = onnx_export.Call(model)
        condition = (
            (torch.tensor([[[1, 2], [3, 4], [5, 6]]] * 2), torch.tensor([3, 2]))
            if model.conditioned_on == "text"
            else ()
        )
        with torch.no_grad():
            rows.append(
                call(
                    drawn(2, 6, model.representation.features, dtype=torch.float32),
                    torch.tensor([3.0, 1.0]),
                    torch.tensor([6, 4]),
                    *condition,
                ).double()
            )
    rows.append(outcome(onnx_export.export_onnx, "gone.ckpt", "o"))
    return rows


# Adaptation --------------------------------------------------------------------------------------


def recipes_of_adaptations() -> Any:
    rows: list[Any] = []
    model = copy.deepcopy(_model())
    model.facts["captions"] = [f"base {k}" for k in range(5)]
    captions = [f"c{k}" for k in range(7)]
    for words in (
        [],
        ["optimizer.lr=0.5"],
        ["trainer.max_steps=7"],
        ["denoiser.latent_dim=3"],
        ["process=x"],
        ["losses.joints=1"],
    ):
        for data in ({"crop": {"max_frames": 30}}, None):
            base: Any = SimpleNamespace(
                config={**model.config, "data": data},
                facts=model.facts | {"max_frames": 43},
                representation=model.representation,
            )
            result = outcome(
                adaptation.__dict__["_recipe"], base, captions, "limp", Path("runs/x"), words
            )
            rows.append(
                result
                if isinstance(result, str)
                else [
                    result[k]
                    for k in (
                        "task",
                        "experiment",
                        "run",
                        "data",
                        "optimizer",
                        "callbacks",
                        "trainer",
                    )
                ]
            )
    for rank, action in ((4, True), (8, False)):
        with mock.patch.object(
            adaptation, "read_merged", return_value={"state_dict": {"a": torch.ones(2)}}
        ):
            rows.append(
                adaptation.__dict__["_about"](
                    model, [*captions, "walks a lot a"] * 4, "limp", rank, Path("x"), action
                )
            )
    samples = adaptation._Samples(model, ["a", "b", "c"])
    rows += [
        samples.count(),
        samples.captions,
        [x.double() if isinstance(x, Tensor) else x for x in samples.statistics()],
    ]
    task = adaptation.AdaptationTask.__new__(adaptation.AdaptationTask)
    with (
        mock.patch.object(
            adaptation.GeneratorTask,
            "dropped",
            return_value=torch.tensor([True, True, False, False]),
        ),
        mock.patch.object(adaptation.AdaptationTask, "device", torch.device("cpu")),
    ):
        batch: Any = SimpleNamespace(ids=[f"{adaptation.KEPT}1", "x", f"{adaptation.KEPT}2", "y"])
        rows.append(adaptation.AdaptationTask.dropped(task, batch))
    for name in ("two words", "a_b", "", "ü1", "-"):
        rows.append(outcome(adaptation.adapt, "quickstart", "gone", name))
    return rows


CASES = cases_of(globals())


@pytest.mark.parametrize("case", CASES)
def test_results_are_as_recorded(case: Case):
    check(NAME, case)


if __name__ == "__main__":
    record(NAME, CASES)
