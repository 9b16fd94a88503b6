"""`speed=fast` compiles the training steps of long runs on a CPU."""

import os
import shutil
import sysconfig
from functools import partial
from itertools import islice
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from support.runs import RECIPES, built
from torch import Tensor, nn
from torch._dynamo.testing import CompileCounter
from torch._functorch import config as functorch
from torch._inductor import config as inductor
from torch.nn import functional

from flame_mdm.batch import MotionBatch
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.task import GeneratorTask
from flame_mdm.training import compilation, speed
from flame_mdm.training.compilation import FastConvolution, FastReLU
from flame_mdm.training.distillation import DistillationTask
from flame_mdm.training.recurrence import gru_gradients, gru_states
from flame_mdm.training.speed import dropout_factors

HEADER = Path(sysconfig.get_path("include"), "Python.h")
needs_compiler = pytest.mark.skipif(
    not shutil.which(os.environ.get("CXX", "g++")) or not HEADER.exists(),
    reason="needs a C++ compiler and Python's header files",
)


@pytest.fixture(autouse=True)
def _settings_of_the_compiler(monkeypatch):
    """A CPU that multiplies in bfloat16, and a compiler that has not compiled anything yet."""
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True})
    torch.compiler.reset()
    yield
    torch.compiler.reset()


def accelerated(words: list[str], recipe: str) -> tuple[MotionDataModule, GeneratorTask]:
    """Returns the data and the task of a recipe, after `speed=fast` has prepared them."""
    config, data, task = built(words, recipe)
    assert speed.accelerate(task, data, config) == "bf16-mixed"
    return data, task


def first_batches(data: MotionDataModule) -> list[MotionBatch]:
    """Returns four training batches."""
    return list(islice(data.train_dataloader(), 4))


LONG = "trainer.max_steps=5000"


@pytest.mark.parametrize(
    ("words", "compiles"),
    [
        ([LONG], True),
        (["trainer.max_steps=4999"], False),
        ([LONG, "task.checkpoint_activations=true"], False),
    ],
)
def test_long_runs_on_a_cpu_compile_their_steps(words, compiles, data_root, capsys, monkeypatch):
    monkeypatch.setattr(compilation, "missing_tool", lambda: None)
    _, task = accelerated([*RECIPES["quickstart"], f"data_root={data_root}", *words], "quickstart")
    assert task.compiles_steps == compiles
    assert ("compiling the network" in capsys.readouterr().out) == compiles


@pytest.mark.parametrize("missing", ["compiler", "header"])
def test_steps_are_not_compiled_without_a_compiler(
    missing, data_root, tmp_path, capsys, monkeypatch
):
    monkeypatch.setenv("CXX", "no-such-compiler" if missing == "compiler" else "python3")
    monkeypatch.setattr(sysconfig, "get_path", lambda name: str(tmp_path))
    _, task = accelerated([*RECIPES["quickstart"], f"data_root={data_root}", LONG], "quickstart")
    assert not task.compiles_steps
    name = "no-such-compiler" if missing == "compiler" else str(tmp_path / "Python.h")
    output = capsys.readouterr().out
    assert "training without compilation" in output
    assert name in output


def test_a_task_with_a_loss_of_its_own_is_not_compiled(monkeypatch, capsys):
    monkeypatch.setattr(compilation, "missing_tool", lambda: None)
    task: Any = object.__new__(DistillationTask)
    nn.Module.__init__(task)
    task.checkpoints_activations, task.compiles_steps = False, False
    compilation.compile_steps(task, SimpleNamespace())  # type: ignore[arg-type]
    assert not task.compiles_steps
    assert not capsys.readouterr().out


@pytest.mark.parametrize("recipe", RECIPES)
def test_one_graph_computes_the_loss_for_all_lengths(recipe, data_root, monkeypatch):
    """The backend runs the traced operations as they are, so the losses are equal bit for bit."""
    monkeypatch.setattr(compilation, "missing_tool", lambda: None)
    graphs = CompileCounter()
    backend = partial(torch.compile, backend=graphs, fullgraph=True)
    monkeypatch.setattr("flame_mdm.task.torch.compile", backend)
    words = [*RECIPES[recipe], f"data_root={data_root}"]
    data, task = accelerated([*words, LONG], recipe)
    task.train()

    def loss(number: int, batch: MotionBatch) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return task.training_step(batch, number)

    batches = first_batches(data)
    frames = {batch.x.shape[1] for batch in batches}
    for number, batch in enumerate(batches):
        task.compiles_steps = True
        compiled = loss(number, batch)
        task.compiles_steps = False
        assert torch.equal(compiled, loss(number, batch))
    assert len(frames) > 1 or recipe == "synthetic/dip"
    assert graphs.frame_count == 1


def test_only_training_steps_are_compiled(data_root, monkeypatch):
    monkeypatch.setattr(compilation, "missing_tool", lambda: None)
    graphs = CompileCounter()
    monkeypatch.setattr("flame_mdm.task.torch.compile", partial(torch.compile, backend=graphs))
    words = [*RECIPES["quickstart"], f"data_root={data_root}", LONG]
    data, task = accelerated(words, "quickstart")
    batch = next(iter(data.train_dataloader()))
    task.eval().losses_of(batch)
    assert graphs.frame_count == 0
    task.train().training_step(batch, 0)
    assert graphs.frame_count == 1


def test_training_goes_on_if_the_compiler_fails(data_root, monkeypatch, capsys):
    monkeypatch.setattr(compilation, "missing_tool", lambda: None)

    def backend(*_: Any) -> Any:
        raise RuntimeError("no space left")

    monkeypatch.setattr("flame_mdm.task.torch.compile", partial(torch.compile, backend=backend))
    words = [*RECIPES["quickstart"], f"data_root={data_root}", LONG]
    data, task = accelerated(words, "quickstart")
    batch = next(iter(data.train_dataloader()))
    losses = [task.train().training_step(batch, 0) for _ in range(2)]
    output = capsys.readouterr().out
    assert output.count("the compiler failed") == 1
    assert "no space left" in output
    assert not task.compiles_steps
    assert torch.equal(*losses)


@needs_compiler
@pytest.mark.slow
def test_compiled_steps_have_the_losses_and_gradients_of_others(data_root):
    """Two compilations that begin with motions of different lengths agree bit for bit."""
    recipe = "synthetic/mfm"
    words = [*RECIPES[recipe], f"data_root={data_root}", "denoiser.dropout=0.2", LONG]
    data, task = accelerated(words, recipe)
    task.train()
    parameters = [p for p in task.generator.denoiser.parameters() if p.requires_grad]
    batches = sorted(first_batches(data), key=lambda batch: batch.x.shape[1])
    short, long = batches[0], batches[-1]
    assert short.x.shape[1] < long.x.shape[1]

    def step(batch: Any) -> list[Tensor]:
        with torch.autocast("cpu", torch.bfloat16):
            loss = task.training_step(batch, 7)
        return [loss.detach(), *torch.autograd.grad(loss, parameters, allow_unused=True)]

    task.compiles_steps = False
    expected = step(long)
    task.compiles_steps = True
    step(short)
    results = step(long)
    torch.compiler.reset()
    task.compiled_loss = None
    with inductor.patch(fx_graph_cache=False), functorch.patch(enable_autograd_cache=False):
        again = step(long)
    for value, same, of_eager in zip(results, again, expected, strict=True):
        assert torch.equal(value, same)
        assert (value - of_eager).norm() <= 0.02 * of_eager.norm()


@pytest.mark.parametrize(
    "options", [{}, {"padding": 1}, {"stride": 2, "padding": 1}, {"bias": False, "padding": 2}]
)
def test_fast_convolutions_have_the_results_and_gradients_of_torch(options):
    convolution = nn.Conv1d(3, 5, 3, dtype=torch.float64, **options)
    assert FastConvolution.replaces(convolution)
    fast = FastConvolution(convolution)
    x = torch.randn(2, 3, 9, dtype=torch.float64, requires_grad=True)
    inputs = [x, *convolution.parameters()]
    results = []
    for network in (convolution, fast):
        y = network(x)
        results.append([y, *torch.autograd.grad(y.sin().sum(), inputs)])
    torch.testing.assert_close(*results)
    assert fast.state_dict().keys() == convolution.state_dict().keys()


@pytest.mark.parametrize(
    "options",
    [{"groups": 3}, {"dilation": 2}, {"padding": "same"}, {"padding_mode": "circular"}],
)
def test_other_convolutions_are_not_replaced(options):
    network = nn.Sequential(nn.Conv1d(3, 3, 3, **options))
    compilation._replace_layers(network)
    assert isinstance(network[0], nn.Conv1d)


def test_the_fast_relu_has_the_results_and_gradients_of_torch():
    x = torch.tensor([-2.0, -0.0, 0.0, 3.0, float("inf")], requires_grad=True)
    results = []
    for rectify in (functional.relu, FastReLU()):
        y = rectify(x)
        results.append((y, *torch.autograd.grad(y, x, torch.arange(1.0, 6.0))))
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_the_compiler_knows_the_shapes_of_opaque_functions(subtests):
    gates, first = torch.randn(4, 2, 9), torch.randn(2, 3)
    weight, bias, z = torch.randn(9, 3), torch.randn(9), torch.rand(4, 2, 3)
    checks = ("test_schema", "test_faketensor")
    calls: list[tuple[Any, tuple[Any, ...]]] = [
        (gru_states, (gates, first, weight, bias)),
        (gru_gradients, (torch.randn(4, 2, 3), z, torch.rand(4, 2, 3, 3), weight)),
        (dropout_factors, (torch.randn(3, 5), 0.5)),
    ]
    for function, arguments in calls:
        with subtests.test(function=function._qualname):
            torch.library.opcheck(function, arguments, test_utils=checks)
