"""`speed=fast` and the moving average."""

import math
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lightning import LightningModule
from lightning.pytorch.callbacks import EMAWeightAveraging, WeightAveraging
from torch import Tensor, nn
from torch.nn import functional
from torch.optim.swa_utils import AveragedModel

from evaluators.extractors.action_gru import ActionGRU
from flame_mdm.__main__ import main
from flame_mdm.checkpoints.model_files import read_checkpoint
from flame_mdm.config import Config, compose, instantiate
from flame_mdm.data.datamodule import MotionDataModule
from flame_mdm.denoisers.layers import Transformer
from flame_mdm.errors import UserError
from flame_mdm.seeds import seed_generator
from flame_mdm.task import GeneratorTask
from flame_mdm.training import speed
from flame_mdm.training.attention import attention
from flame_mdm.training.averaging import MovingAverage
from flame_mdm.training.recurrence import FastGRU
from flame_mdm.training.speed import CheapDropout

CPU = torch.device("cpu")


def test_cheap_dropout_drops_with_its_probability(subtests):
    for p in (0.1, 0.5, 1e-3):
        with subtests.test(p=p):
            layer, x = CheapDropout(p), torch.ones(1000, 1001)
            seed_generator(1, CPU)
            y = layer(x)
            dropped = float((y == 0).double().mean())
            assert abs(dropped - p) < 5 * math.sqrt(p * (1 - p) / x.numel()) + 2**-17
            torch.testing.assert_close(y[y != 0].unique(), torch.tensor([1 / (1 - p)]))


def test_the_decisions_of_cheap_dropout_are_independent(subtests):
    layer = CheapDropout(0.5)
    seed_generator(2, CPU)
    keep = (layer(torch.ones(4_000_000)) != 0).double() - 0.5
    # Four neighbors share one random number, and so do elements at a distance of an eighth
    for lag in (1, 2, 3, 4, 5, 8, 1024, 500_000, 1_000_000, 500_001):
        with subtests.test(lag=lag):
            correlation = float((keep[:-lag] * keep[lag:]).mean() * 4)
            assert abs(correlation) < 5 / math.sqrt(len(keep)), lag
    again = (layer(torch.ones(4_000_000)) != 0).double() - 0.5
    assert abs(float((again * keep).mean() * 4)) < 5 / math.sqrt(len(keep))


def test_cheap_dropout_is_a_function_of_the_seed_and_passes_gradients():
    layer, x = CheapDropout(0.3), torch.randn(7, 13, requires_grad=True)
    outputs = []
    for _ in range(2):
        seed_generator(3, CPU)
        outputs.append(layer(x))
    assert torch.equal(*outputs)
    (gradient,) = torch.autograd.grad(outputs[0].sum(), x)
    torch.testing.assert_close(gradient, torch.where(outputs[0] == 0, 0.0, 1 / 0.7))
    assert torch.equal(layer.eval()(x), x)
    assert layer.train()(x.to(torch.bfloat16)).dtype == torch.bfloat16


def attended(
    attend: Callable[..., Tensor], inputs: Sequence[Tensor], mask: Tensor | None
) -> list[Tensor]:
    """Returns the result of attention and the gradients of its query, key and value."""
    inputs = [x.detach().requires_grad_() for x in inputs]
    result = attend(*inputs, attn_mask=mask)
    result.square().sum().backward()
    return [result, *(x.grad for x in inputs if x.grad is not None)]


@pytest.mark.parametrize("keys", [9, 33])
def test_attention_by_matrix_products_is_the_fused_one(keys, subtests):
    """Short and long rows of weights take different paths in the backward pass."""
    query = torch.randn(2, 9, 4, 8, dtype=torch.float64).transpose(1, 2)
    key, value = torch.randn(2, 2, 4, keys, 8, dtype=torch.float64)
    of_keys = torch.arange(keys) < torch.tensor([keys, 4])[:, None, None, None]
    of_pairs = torch.rand(2, 1, 9, keys) > 0.3
    for name, mask in {"none": None, "keys": of_keys, "pairs": of_pairs}.items():
        inputs = [query, key, value]
        expected = attended(functional.scaled_dot_product_attention, inputs, mask)
        with subtests.test(mask=name):
            torch.testing.assert_close(attended(attention, inputs, mask), expected)
        with subtests.test("in bfloat16", mask=name):
            half = attended(attention, [x.bfloat16() for x in inputs], mask)
            assert all(x.dtype == torch.bfloat16 for x in half)
            for x, y in zip(half, expected, strict=True):
                assert (x - y).norm() < 0.02 * y.norm()


def test_attention_multiplies_in_the_precision_of_autocast():
    query, key, value = torch.randn(3, 2, 4, 9, 8)
    with torch.autocast("cpu", torch.bfloat16):
        result = attention(query, key, value)
    assert torch.equal(result, attention(query.bfloat16(), key.bfloat16(), value.bfloat16()))


def test_a_simplified_network_computes_the_same_without_dropout():
    network = Transformer(16, 32, 2, 4, 0.1, cross_attention=True)
    x, memory, mask = (
        torch.randn(3, 7, 16),
        torch.randn(3, 5, 16),
        torch.arange(7) < torch.tensor([[7], [3], [1]]),
    )
    names, expected = list(network.state_dict()), network.eval()(x, mask, memory)
    speed._simplify(network)
    torch.testing.assert_close(network(x, mask, memory), expected)
    assert list(network.state_dict()) == names
    assert not any(isinstance(module, nn.Dropout) for module in network.modules())


class Tiny(LightningModule):
    def __init__(self) -> None:
        super().__init__()
        self.layer = nn.Linear(3, 2)
        self.register_buffer("seen", torch.zeros(1))


def train_with(callbacks: list[WeightAveraging], model: Tiny, steps: int) -> Iterator[int]:
    """Changes the weights at random in each step and calls the callbacks twice, as with two accumulated batches."""
    trainer: Any = SimpleNamespace(global_step=0)
    for callback in callbacks:
        callback.setup(trainer, model, "fit")
        callback.on_train_start(trainer, model)
    for trainer.global_step in range(1, steps + 1):
        for callback in callbacks:
            callback.on_train_batch_start(trainer, model, None, 0)
        for p in model.parameters():
            p.data.add_(torch.randn_like(p))
        model.get_buffer("seen").add_(1)
        for callback in callbacks * 2:
            callback.on_train_batch_end(trainer, model, None, None, 0)
        yield trainer.global_step


def saved(callback: WeightAveraging, model: Tiny) -> dict[str, Any]:
    trainer: Any = None
    checkpoint: dict[str, Any] = {"state_dict": model.state_dict()}
    callback.on_save_checkpoint(trainer, model, checkpoint)
    return checkpoint


def test_the_moving_average_is_that_of_lightning():
    model = Tiny()
    ours, theirs = MovingAverage(0.9), EMAWeightAveraging(use_buffers=False, decay=0.9)
    list(train_with([ours, theirs], model, 11))
    mine, reference = saved(ours, model), saved(theirs, model)
    torch.testing.assert_close(mine["averaging_state"], reference["averaging_state"])
    torch.testing.assert_close(mine["state_dict"], reference["state_dict"])
    assert float(mine["state_dict"]["seen"]) == 11


def test_the_moving_average_of_flame_is_that_of_its_code():
    """FLAME's code copies the weights every 10 steps up to step 100, and averages them at 110, 120, ..."""
    model, expected = Tiny(), torch.zeros(0)
    average = MovingAverage(**compose("humanml3d/flame_code")["ema"])
    for step in train_with([average], model, 130):
        weight = model.layer.weight.detach()
        if step % 10 == 0:
            expected = weight.clone() if step <= 100 else 0.99 * expected + 0.01 * weight
        if step >= 10:
            torch.testing.assert_close(
                saved(average, model)["state_dict"]["layer.weight"], expected
            )


@pytest.mark.parametrize("recipe", ["mdm_50_steps", "mdm_decoder_distilbert"])
def test_the_moving_average_of_mdm_starts_from_the_initial_weights_as_in_its_code(recipe):
    """MDM's code: a copy of the initial weights, then average = 0.9999 * average + 0.0001 * weights in every step."""
    model = Tiny()
    expected = model.layer.weight.detach().clone()
    average = MovingAverage(**compose(f"humanml3d/{recipe}")["ema"])
    for _ in train_with([average], model, 5):
        expected = 0.9999 * expected + 0.0001 * model.layer.weight.detach()
        torch.testing.assert_close(saved(average, model)["state_dict"]["layer.weight"], expected)


@pytest.mark.parametrize("start", [0, 8])
def test_a_resumed_average_keeps_the_initial_weights_before_its_first_update(start):
    model = Tiny()
    initial = model.layer.weight.detach().clone()
    average = MovingAverage(0.5, 4, update_starting_at_step=start, from_initial_weights=True)
    list(train_with([average], model, 2))
    trainer: Any = SimpleNamespace(global_step=2)
    average.on_train_start(trainer, model)
    average.on_train_batch_start(trainer, model, None, 0)
    torch.testing.assert_close(saved(average, model)["state_dict"]["layer.weight"], initial)


def test_a_new_average_starts_from_weights_that_changed_after_it_was_made():
    """The text encoder is pretrained, or a teacher is copied, before the first step."""
    model = Tiny()
    average: Any = MovingAverage(0.5, from_initial_weights=True)
    average._average_model = AveragedModel(model)
    with torch.no_grad():
        model.layer.weight += 1
    trainer: Any = SimpleNamespace(global_step=0)
    average.on_train_start(trainer, model)
    average.on_train_batch_start(trainer, model, None, 0)
    (averaged,) = (p for p in average.averages if p.shape == model.layer.weight.shape)
    torch.testing.assert_close(averaged, model.layer.weight.detach())


@pytest.mark.parametrize(("decay", "expected"), [(0.0, "last"), (1.0, "first")])
def test_the_factor_of_an_average_is_from_zero_to_one(decay, expected):
    """With 0, the average is the last weights; with 1, it stays at the first ones."""
    model, average = Tiny(), MovingAverage(decay)
    weights = [model.layer.weight.detach().clone() for _ in train_with([average], model, 3)]
    averaged = saved(average, model)["state_dict"]["layer.weight"]
    torch.testing.assert_close(averaged, weights[-1 if expected == "last" else 0])
    with pytest.raises(UserError, match=r"ema\.decay=.*: expected a number from 0 to 1"):
        MovingAverage(decay * 3 - 1)


def test_a_resumed_average_goes_on():
    model = Tiny()
    average = MovingAverage(0.5)
    list(train_with([average], model, 2))
    before = saved(average, model)["state_dict"]["layer.weight"].clone()
    trainer: Any = SimpleNamespace(global_step=2)
    average.on_train_start(trainer, model)
    trainer.global_step = 3
    average.on_train_batch_end(trainer, model, None, None, 0)
    expected = (before + model.layer.weight.detach()) / 2
    torch.testing.assert_close(saved(average, model)["state_dict"]["layer.weight"], expected)


@pytest.mark.slow
def test_fast_is_reproducible_resumes_exactly_and_is_recorded(tiny, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    options = [
        *tiny,
        "callbacks.samples=null",
        "denoiser.dropout=0.2",
        "callbacks.checkpoints.every_n_steps=2",
    ]

    def train(name: str, steps: int, speed: str = "fast") -> dict[str, Any]:
        words = [
            *options,
            f"speed={speed}",
            f"run.dir={tmp_path / name}",
            f"trainer.max_steps={steps}",
        ]
        assert main(["train", "quickstart", *words]) == 0
        return read_checkpoint(tmp_path / name / "checkpoints" / "last.ckpt")

    whole = train("whole", 4)
    assert "bf16-mixed, speed=fast" in capsys.readouterr().out
    train("parts", 2)
    parts = train("parts", 4)
    assert all(
        torch.equal(value, parts["state_dict"][name]) for name, value in whole["state_dict"].items()
    )
    facts = [
        checkpoint["facts"]["training"]
        for checkpoint in (whole, train("reference", 1, "reference"))
    ]
    assert [(f["speed"], f["precision"]) for f in facts] == [
        ("fast", "bf16-mixed"),
        ("reference", "32-true"),
    ]


def test_bfloat16_is_chosen_where_the_processor_computes_with_it(monkeypatch, subtests):
    cases = (
        ("amx_bf16", "32-true", "bf16-mixed"),
        ("avx2", "32-true", "32-true"),
        ("amx_bf16", *["16-mixed"] * 2),
    )
    for has, precision, chosen in cases:
        with subtests.test(has=has, precision=precision, chosen=chosen):
            monkeypatch.setattr(torch.cpu, "get_capabilities", lambda has=has: {has: True})
            config = compose(
                "quickstart", ["trainer.accelerator=cpu", f"trainer.precision={precision}"]
            )
            assert speed.accelerate(*parts(config), config) == chosen


def test_only_grus_that_are_not_replaced_are_trained_in_float32_on_a_cpu(monkeypatch):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"amx_bf16": True})
    for name in ("mdm_encoder_small", "mdm_unet_small", "mdm_gru_small"):
        config = compose("quickstart", ["trainer.accelerator=cpu", f"denoiser={name}"])
        task, data = parts(config)
        assert speed.accelerate(task, data, config) == "bf16-mixed"
    task.add_module("other", nn.Sequential(nn.GRU(2, 2, bidirectional=True)))
    assert speed.accelerate(task, data, config) == "32-true"


@pytest.mark.parametrize("batch_first", [False, True])
@pytest.mark.parametrize("has_state", [False, True])
def test_the_fast_gru_has_the_results_and_gradients_of_torch(batch_first, has_state):
    gru = nn.GRU(5, 7, 3, batch_first=batch_first).double()
    fast = FastGRU(gru)
    x = torch.randn(4, 9, 5, dtype=torch.float64, requires_grad=True)
    rows = 4 if batch_first else 9
    state = torch.randn(3, rows, 7, dtype=torch.float64, requires_grad=True) if has_state else None
    inputs = [x, *gru.parameters(), *([] if state is None else [state])]

    results = []
    for network in (gru, fast):
        output, last = network(x, state)
        total = (output * torch.arange(7)).sin().sum() + last[1].square().sum()
        results.append([output, last, *torch.autograd.grad(total, inputs)])
    for of_torch, of_ours in zip(*results, strict=True):
        torch.testing.assert_close(of_ours, of_torch)
    assert fast.state_dict().keys() == gru.state_dict().keys()
    assert all(a is b for a, b in zip(fast.parameters(), gru.parameters(), strict=True))


def test_the_fast_gru_recurs_in_float32_when_inputs_are_multiplied_in_bfloat16():
    gru = nn.GRU(16, 16, 2)
    x = torch.randn(30, 2, 16)
    expected = torch.autograd.grad(gru(x)[0].square().sum(), list(gru.parameters()))
    with torch.autocast("cpu", torch.bfloat16):
        output, _ = FastGRU(gru)(x)
    assert output.dtype == torch.float32
    gradients = torch.autograd.grad(output.square().sum(), list(gru.parameters()))
    torch.testing.assert_close(output, gru(x)[0], atol=0.01, rtol=0)
    for gradient, of_torch in zip(gradients, expected, strict=True):
        error = (gradient - of_torch).norm() / of_torch.norm()
        assert 0 < error < 0.02


@pytest.mark.parametrize(
    ("options", "is_replaced"),
    [
        ({}, True),
        ({"num_layers": 2, "batch_first": True}, True),
        ({"bidirectional": True}, False),
        ({"bias": False}, False),
        ({"num_layers": 2, "dropout": 0.1}, False),
    ],
)
def test_grus_that_run_forward_are_replaced(options, is_replaced):
    network = nn.Sequential(nn.GRU(2, 3, **options)).eval()
    speed._simplify(network)
    assert isinstance(network[0], FastGRU) == is_replaced
    assert not network[0].training


def test_a_classifier_with_a_fast_gru_computes_the_same():
    network = ActionGRU(num_joints=3, hidden=8, num_actions=2)
    joints = torch.randn(4, 6, 3, 3)
    mask = torch.arange(6) < torch.tensor([[6], [2], [1], [5]])
    state = network.random_state([1, 2, 3, 4])
    expected = network.logits(joints, mask, state)
    speed._simplify(network)
    torch.testing.assert_close(network.logits(joints, mask, state), expected)
    assert torch.equal(network.random_state([1, 2, 3, 4]), state)


def parts(config: Config) -> tuple[GeneratorTask, MotionDataModule]:
    representation = instantiate(config["representation"])
    return GeneratorTask.build(config, representation), instantiate(
        config["data"], representation=representation
    )


@pytest.mark.parametrize(
    ("words", "multiple"),
    [
        ("trainer.max_steps=5000", 32),
        ("trainer.max_steps=4999", 0),
        ("+denoiser.mask_padding=false", 1),
        ("+data.pad_multiple=48", 48),
    ],
)
def test_long_runs_on_cuda_are_compiled_for_few_lengths(words, multiple, monkeypatch, capsys):
    for name in ("is_available", "is_bf16_supported"):
        monkeypatch.setattr(torch.cuda, name, lambda **_: True)
    options = []
    monkeypatch.setattr(nn.Module, "compile", lambda self, **chosen: options.append(chosen))
    config = compose("quickstart", ["trainer.max_steps=5000", words])
    task, data = parts(config)
    assert speed.accelerate(task, data, config) == "bf16-mixed"
    assert options == [{"dynamic": False}] * (multiple > 0)
    assert data.pad_multiple == max(multiple, 1)
    assert ("compiling the network" in capsys.readouterr().out) == (multiple > 0)
    assert any(isinstance(module, nn.Dropout) for module in task.generator.denoiser.modules())


def test_a_seed_gives_the_numbers_of_torch_manual_seed():
    torch.manual_seed(5)
    expected = torch.rand(4)
    seed_generator(5, CPU)
    assert torch.equal(torch.rand(4), expected)
