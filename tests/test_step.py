"""The cost of a step for the host. Neither training nor sampling waits for the device between steps."""

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest
import torch
from lightning import Callback, LightningModule, Trainer
from support.fixtures import ROOT
from support.runs import RECIPES, SMALL, WIDTHS, built
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

import flame_mdm.task
from flame_mdm.batch import Condition
from flame_mdm.config import compose
from flame_mdm.sampler_options import SamplerOptions
from flame_mdm.task import GeneratorTask
from flame_mdm.training.callbacks import Measurements
from flame_mdm.training.fit import fit
from flame_mdm.training.overhead import STEP_HOOKS, skip_exchange_of_signals
from flame_mdm.training.speed import accelerate

sys.path.append(str(ROOT / "benchmarks"))  # the scripts import each other

import host

METHODS = ("item", "tolist", "numpy", "cpu", "__bool__", "__int__", "__float__", "__index__")
"""Methods of tensors that return values to the host."""

OPERATIONS = ("_local_scalar_dense", "nonzero", "masked_select", "equal", "is_nonzero", "unique")
"""Operations whose result, or its size, the host must know; `x[mask]` is one of them."""


class Waits(TorchDispatchMode):
    """Records what would make the host wait for a GPU, by the label at that time."""

    def __init__(self) -> None:
        super().__init__()
        self.label: Any = None
        self.seen: list[tuple[Any, str]] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.removeprefix("aten::")
        result = func(*args, **(kwargs or {}))
        devices = {x.device.type for x in (*args, result) if isinstance(x, Tensor)}
        is_copy = name in ("_to_copy", "copy_") and len(devices) > 1
        # An index is copied, and a mask is counted, inside of the operation.
        indices = args[1] if name.startswith("index") and isinstance(args[1], list | tuple) else ()
        is_hidden = any(
            index is not None and (index.device != args[0].device or index.dtype == torch.bool)
            for index in indices
        )
        if name.startswith(OPERATIONS) or is_copy or is_hidden:
            self.seen.append((self.label, name))
        return result

    def labels(self) -> set[Any]:
        return {label for label, _ in self.seen}


@contextmanager
def waits(monkeypatch: pytest.MonkeyPatch) -> Iterator[Waits]:
    recorded = Waits()

    def recording(name: str, method: Callable[..., Any]) -> Callable[..., Any]:
        def call(tensor: Tensor, *args: Any, **options: Any) -> Any:
            recorded.seen.append((recorded.label, name))
            return method(tensor, *args, **options)

        return call

    select = Tensor.__getitem__

    def selected(tensor: Tensor, index: Any) -> Tensor:
        parts = index if isinstance(index, tuple) else (index,)
        if tensor.device.type != "cpu" and any(isinstance(part, list) for part in parts):
            recorded.seen.append((recorded.label, "list as index"))  # is copied to the device
        return select(tensor, index)

    with monkeypatch.context() as patched, recorded:
        patched.setattr(Tensor, "__getitem__", selected)
        for name in METHODS:
            patched.setattr(Tensor, name, recording(name, getattr(Tensor, name)))
        yield recorded


def test_everything_that_waits_is_recorded(monkeypatch):
    x, mask = torch.arange(3.0), torch.tensor([True, False, True])
    actions: dict[str, Callable[[], Any]] = {
        "item": lambda: x[1].item(),
        "cpu": lambda: x.cpu(),
        "list": lambda: x.tolist(),
        "bool": lambda: bool(mask[0]),
        "if": lambda: 1 if mask.all() else 0,
        "float": lambda: float(x[1]),
        "mask": lambda: x[mask],
        "nonzero": lambda: mask.nonzero(),
        "numpy": lambda: x.numpy(),
        "equal": lambda: torch.equal(x, x),
        "copy": lambda: torch.zeros(2, device="meta").copy_(x[:2]),
        "list as index": lambda: torch.zeros(2, 2, device="meta")[:, [0, 1]],
    }
    with waits(monkeypatch) as recorded:
        for recorded.label, action in actions.items():
            action()
        recorded.label = "nothing"
        x.masked_fill(mask, 0.0).sum().clamp(min=1)
    assert recorded.labels() == set(actions)


def test_only_steps_that_log_wait_for_the_device(tiny, tmp_path, monkeypatch):
    """The batch of the next step is loaded in the same interval, so that it is included."""
    words = [*tiny, "speed=fast", "trainer.max_steps=9", "trainer.log_every_n_steps=4"]
    words += ["callbacks.samples=null", "logger=csv", "trainer.enable_progress_bar=true"]
    step = GeneratorTask.training_step

    with waits(monkeypatch) as recorded:

        def labelled(task: GeneratorTask, batch: Any, batch_idx: int) -> Tensor:
            recorded.label = batch_idx
            return step(task, batch, batch_idx)

        monkeypatch.setattr(GeneratorTask, "training_step", labelled)
        fit(tmp_path / "run", compose("quickstart", words))
    in_steps = {label for label in recorded.labels() if label is not None}
    # Steps 4 and 8 log. The last one saves the checkpoint, and everything after it counts as its.
    assert in_steps - {0} == {3, 7, 8}


@pytest.mark.parametrize("recipe", RECIPES)
def test_steps_of_all_kinds_of_models_do_not_wait_for_the_device(recipe, data_root, monkeypatch):
    words = [*RECIPES[recipe], "speed=fast", f"data_root={data_root}"]
    config, data, task = built(words, recipe)
    accelerate(task, data, config)
    optimizer, batches = task.train().make_optimizer(), iter(data.train_dataloader())

    def step(number: int) -> None:
        task.training_step(next(batches), number).backward()
        torch.nn.utils.clip_grad_norm_(task.parameters(), 1.0)
        optimizer.step()
        optimizer.zero_grad()

    step(0)  # copies constants to the device
    with waits(monkeypatch) as recorded:
        for recorded.label in range(1, 4):
            step(recorded.label)
    assert recorded.seen == []


class Mixtures(TorchDispatchMode):
    """Records sums, differences and products of tensors of different precision."""

    def __init__(self) -> None:
        super().__init__()
        self.seen: list[tuple[str, list[tuple[int, ...]]]] = []

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        name = func._schema.name.removeprefix("aten::").rstrip("_")
        operands = [x for x in args if isinstance(x, Tensor) and x.is_floating_point() and x.ndim]
        if name in ("add", "sub", "mul") and len({x.dtype for x in operands}) > 1:
            self.seen.append((name, [tuple(x.shape) for x in operands]))
        return func(*args, **(kwargs or {}))


@pytest.mark.parametrize("recipe", RECIPES)
def test_no_operation_of_fast_steps_mixes_precisions(recipe, data_root):
    """On a CPU, such operations take up to 10 times as long as a conversion."""
    words = [*RECIPES[recipe], "speed=fast", f"data_root={data_root}"]
    config, data, task = built(words, recipe)
    accelerate(task, data, config)
    batch = next(iter(data.train_dataloader()))
    with Mixtures() as recorded:
        with torch.autocast("cpu", torch.bfloat16):
            loss = task.train().training_step(batch, 0)
        loss.backward()
    assert recorded.seen == []


@pytest.mark.parametrize("recipe", RECIPES)
def test_losses_copy_nothing_from_the_host_to_the_device(recipe, data_root, monkeypatch):
    """The device is torch's "meta", whose tensors have no values to wait for."""
    words = [*RECIPES[recipe], f"data_root={data_root}"]
    _, data, task = built(words, recipe)
    batch, device = next(iter(data.train_dataloader())), torch.device("meta")
    cond = _on(device, task.generator.condition(batch))
    task.to(device)
    monkeypatch.setattr(task.generator.condition, "forward", lambda batch: cond)
    monkeypatch.setattr(flame_mdm.task, "seed_generator", lambda *_: None)
    batch = batch.to(device)

    task.training_step(batch, 0)  # copies constants
    with waits(monkeypatch) as recorded:
        task.training_step(batch, 1).backward()
    assert recorded.seen == []


def _on(device: torch.device, cond: Condition) -> Condition:
    """Returns a condition on a device."""
    values = {
        name: value.detach().to(device)
        for name in ("pooled", "tokens", "token_mask")
        if (value := getattr(cond, name)) is not None
    }
    null = None if cond.null is None else _on(device, cond.null)
    return replace(cond, null=null, **values)


SAMPLERS = {
    "synthetic/mdm": ["ancestral", "ddim", "dpm_solver_pp_2m"],
    "synthetic/mfm": ["euler", "midpoint", "heun", "rk4"],
}


@pytest.mark.parametrize(
    ("recipe", "sampler"),
    [(recipe, sampler) for recipe, samplers in SAMPLERS.items() for sampler in samplers],
)
def test_sampling_does_not_wait_between_calls_of_the_denoiser(
    recipe, sampler, data_root, monkeypatch
):
    """Except for dopri5, which chooses its steps by the error that it measures."""
    words = [*SMALL, *WIDTHS, "condition=learned", f"data_root={data_root}"]
    _, data, task = built(words, recipe)
    model, batch = task.generator.eval(), next(iter(data.val_dataloader()))
    options = SamplerOptions(sampler=sampler, num_inference_steps=5, guidance_scale=2.5)
    calls, forward = 0, model.denoiser.forward

    with waits(monkeypatch) as recorded:

        def counted(*args: Any) -> Tensor:
            nonlocal calls
            calls += 1
            recorded.label = calls
            return forward(*args)

        monkeypatch.setattr(model.denoiser, "forward", counted)
        model.generate(batch, options)
    assert calls >= 5
    assert recorded.labels() <= {None, 1}, "the first call computes the doubled condition"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA GPU")
def test_no_step_synchronizes_with_a_gpu(tiny, tmp_path, monkeypatch):
    words = [*tiny, "speed=fast", "trainer.accelerator=gpu", "trainer.max_steps=9"]
    words += ["trainer.log_every_n_steps=4", "callbacks.samples=null", "logger=csv"]
    step, quiet = GeneratorTask.training_step, {1, 2, 4, 5, 6}

    def watched(task: GeneratorTask, batch: Any, batch_idx: int) -> Tensor:
        torch.cuda.set_sync_debug_mode("error" if batch_idx in quiet else "default")
        return step(task, batch, batch_idx)

    monkeypatch.setattr(GeneratorTask, "training_step", watched)
    try:
        fit(tmp_path / "run", compose("quickstart", words))
    finally:
        torch.cuda.set_sync_debug_mode("default")


def test_lightning_calls_only_hooks_that_do_something(tiny, tmp_path, monkeypatch):
    called: set[str] = set()
    calls, measure = [], Measurements.on_before_optimizer_step

    def counted(*args: Any) -> None:
        calls.append(args)
        measure(*args)

    def step(task: GeneratorTask, batch: Any, batch_idx: int) -> Tensor:
        for owner, base in [
            (task, LightningModule),
            *((c, Callback) for c in task.trainer.callbacks),  # type: ignore[attr-defined]
        ]:
            for name in STEP_HOOKS:
                is_empty = getattr(type(owner), name) is getattr(base, name)
                assert callable(getattr(owner, name)) != is_empty, (owner, name)
                called.add(name if is_empty else "")
        return original(task, batch, batch_idx)

    original = GeneratorTask.training_step
    monkeypatch.setattr(GeneratorTask, "training_step", step)
    monkeypatch.setattr(Measurements, "on_before_optimizer_step", counted)
    words = [*tiny, "trainer.max_steps=2", "callbacks.samples=null", "logger=csv"]
    fit(tmp_path / "run", compose("quickstart", words))
    assert called == {*STEP_HOOKS, ""}
    assert len(calls) == 2


def test_lightning_does_not_ask_all_processes_for_signals_in_every_step(monkeypatch):
    asked = []
    monkeypatch.setattr(torch.distributed, "broadcast", lambda *_, **__: asked.append(1))
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    loop = trainer.fit_loop.epoch_loop
    loop._broadcast_sigterm_tensor()
    assert asked == [1], "Lightning's own way"
    skip_exchange_of_signals(trainer)
    loop._broadcast_sigterm_tensor()
    assert asked == [1]


@pytest.fixture
def count_calls(monkeypatch) -> Callable[[Callable[[], list[float]]], list[float]]:
    """Returns a function that counts function calls per step, which replaces the measurement of seconds."""
    number = 0

    def count(frame: Any, event: str, argument: Any) -> None:
        nonlocal number
        number += event in ("call", "c_call")

    def counted(run: Callable[[], list[float]]) -> list[float]:
        sys.setprofile(count)
        try:
            return run()
        finally:
            sys.setprofile(None)

    monkeypatch.setattr(host.time, "thread_time", lambda: number)
    return counted


def test_a_step_calls_hardly_more_functions_than_one_of_bare_lightning(count_calls, tmp_path):
    """The time per step of `make bench`, as far as it does not depend on the machine."""
    host.built(tmp_path)
    (bare,) = count_calls(lambda: host.bare(60, tmp_path))
    (without_averages,) = count_calls(lambda: host.framework(60, tmp_path, ["ema=null"]))
    (complete,) = count_calls(lambda: host.framework(60, tmp_path))
    assert without_averages <= 1.1 * bare
    assert complete <= 1.2 * bare
