"""Memory of trainings, and activation checkpointing."""

from typing import Any

import pytest
import torch
from torch import Tensor, nn

from flame_mdm.batch import Condition
from flame_mdm.config import compose
from flame_mdm.denoisers import Denoiser
from flame_mdm.denoisers.mdm import MDMDecoder, MDMEncoder
from flame_mdm.denoisers.recomputation import recompute_activations, stacked_layers
from flame_mdm.denoisers.unet import MDMUNet
from flame_mdm.training import memory
from flame_mdm.training.memory import training_memory
from flame_mdm.training.speed import CheapDropout, _simplify

TRANSFORMER = {"latent_dim": 16, "ff_size": 32, "num_layers": 3, "num_heads": 2, "dropout": 0.2}
DENOISERS: dict[str, tuple[type[Denoiser], dict[str, Any]]] = {
    "encoder": (MDMEncoder, TRANSFORMER),
    "decoder": (MDMDecoder, TRANSFORMER),
    "unet": (
        MDMUNet,
        {"latent_dim": 8, "channels": [8, 16], "num_groups": 4, "dropout": 0.2},
    ),
}


def gradients(denoiser: Denoiser) -> list[Tensor]:
    x_t = torch.randn(2, 9, 6, generator=torch.Generator().manual_seed(1))
    mask = torch.arange(9) < torch.tensor([[9], [5]])
    cond = Condition(torch.ones(2, 4), torch.ones(2, 0, 4), None)
    torch.manual_seed(2)  # of dropout
    denoiser(x_t, torch.zeros(2), mask, cond).square().mean().backward()
    return [p.grad for p in denoiser.parameters() if p.grad is not None]


@pytest.mark.parametrize("cheap", [False, True])
@pytest.mark.parametrize("name", DENOISERS)
def test_recomputed_activations_give_the_same_gradients(name, cheap):
    kind, options = DENOISERS[name]
    results, calls = [], 0

    def count(*_: Any) -> None:
        nonlocal calls
        calls += 1

    for recomputes in (False, True):
        torch.manual_seed(0)
        denoiser = kind(6, 6, 4, **options).train()
        if cheap:
            _simplify(denoiser)
            assert any(isinstance(module, CheapDropout) for module in denoiser.modules())
        names = list(denoiser.state_dict())
        if recomputes:
            # a part of a layer is called once more in the backward pass
            next(stacked_layers(denoiser)[0].children()).register_forward_hook(count)
            recompute_activations(denoiser)
        results.append(gradients(denoiser))
        assert list(denoiser.state_dict()) == names
    assert calls == 2
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


def test_a_recipe_recomputes_activations_and_learns_the_same(tiny, tmp_path):
    from flame_mdm.__main__ import main
    from flame_mdm.checkpoints.model_files import read_checkpoint

    states = []
    for recomputes in ("false", "true"):
        folder = tmp_path / recomputes
        words = [*tiny, f"run.dir={folder}", f"+task.checkpoint_activations={recomputes}"]
        words += ["trainer.max_steps=2", "callbacks.samples=null", "callbacks.best=null"]
        assert main(["train", "quickstart", *words, "logger=csv", "denoiser.dropout=0.2"]) == 0
        states.append(read_checkpoint(folder / "checkpoints" / "last.ckpt")["state_dict"])
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())


def test_frames_of_a_prefix_take_the_place_of_frames_to_predict():
    config = compose("humanml3d/mdm", [])
    sizes = {"latent_dim": 16, "ff_size": 16, "num_layers": 1, "num_heads": 2, "dropout": 0.1}
    decoder = sizes | {"_target_": "flame_mdm.denoisers.mdm.MDMDecoder"}
    continued, whole = (
        training_memory(config | {"denoiser": decoder | {"context_frames": count}})
        for count in (90, 0)
    )
    assert continued.activations == pytest.approx(whole.activations, rel=0.05)


def test_memory_follows_from_parameters_batch_size_and_averages():
    need = training_memory(compose("humanml3d/mdm", []))
    assert need.parameters == pytest.approx(17.88e6, rel=1e-3)
    assert need.state == 16 * need.parameters
    averaged = training_memory(compose("humanml3d/mdm", ["ema={decay: 0.9}"]))
    assert averaged.state == 20 * need.parameters

    half = training_memory(compose("humanml3d/mdm", ["data.batch_size=32"]))
    assert half.activations == pytest.approx(need.activations / 2, rel=0.01)
    assert half.state == need.state
    assert need.recomputed < 0.3 * need.activations
    # Per layer and token: inputs and results of attention, feed-forward and norms
    tokens, width, ff, layers = 64 * 197, 512, 1024, 8
    assert need.activations > 4 * tokens * layers * (8 * width + 2 * ff)
    assert need.activations < 4 * tokens * layers * (16 * width + 4 * ff)


def test_tensors_are_counted_once_and_in_the_layer_that_saves_them_first():
    """A linear layer saves its input, and a hyperbolic tangent saves its result."""
    layers = nn.ModuleList(nn.Sequential(nn.Linear(8, 8), nn.Tanh()) for _ in range(2))
    x, size = torch.zeros(5, 8), 4 * 5 * 8
    saved = memory._saved(layers, lambda: layers[1](layers[0](x)))
    assert saved == (3 * size, [(2 * size, size), (size, size)])


def test_a_recomputed_network_holds_the_inputs_of_all_layers_and_the_inside_of_the_largest(
    monkeypatch,
):
    monkeypatch.setattr(memory, "_saved", lambda *_: (100, [(40, 7), (30, 5)]))
    need = training_memory(compose("quickstart"))
    assert (need.activations, need.recomputed) == (100, (100 - 70) + (7 + 5) + 40)
