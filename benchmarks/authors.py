"""Training step of the MDM authors' code, run from a clone of GuyTevet/motion-diffusion-model.

The authors' network, diffusion, optimizer and loss logging are unchanged. CLIP is replaced with a
stub that returns zeros, as in the framework's step. The body model is omitted, because a training
step on HumanML3D does not use it.
"""

import sys
from collections.abc import Callable
from importlib import import_module
from types import ModuleType, SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from flame_mdm.batch import MotionBatch

CLIP_WIDTH, CLIP_TOKENS = 512, 77


class _Clip(nn.Module):
    """A stub for CLIP that returns zeros as text features."""

    def encode_text(self, tokens: Tensor) -> Tensor:
        return torch.zeros(len(tokens), CLIP_WIDTH, device=tokens.device)


class _Rotation2xyz:
    """A stub for the converter of SMPL rotations, which a step on HumanML3D does not call."""

    def __init__(self, *_: Any, **__: Any) -> None:
        self.smpl_model = nn.Module()


def _stubs() -> dict[str, ModuleType]:
    """Returns the modules that replace CLIP and the body model."""
    clip: Any = ModuleType("clip")
    clip.load = lambda *_, **__: (_Clip(), None)
    clip.tokenize = lambda texts, context_length=CLIP_TOKENS, **_: torch.zeros(
        len(texts), context_length, dtype=torch.int64
    )
    clip.model = SimpleNamespace(convert_weights=lambda model: None)

    body: Any = ModuleType("model.rotation2xyz")
    body.Rotation2xyz = _Rotation2xyz
    return {"clip": clip, "model.rotation2xyz": body}


def authors_step(
    repository: str, width: int, layers: int, device: str
) -> Callable[[MotionBatch], None]:
    """Returns the authors' training step for HumanML3D, with the defaults of their parser.

    Args:
    repository: path of the clone.
    width: width of the network.
    layers: number of layers of the network.
    device: cpu or cuda.
    """
    sys.path.insert(0, repository)
    sys.modules.update(_stubs())
    words = [
        "--save_dir",
        "none",
        "--dataset",
        "humanml",
        "--latent_dim",
        str(width),
        "--layers",
        str(layers),
    ]
    typed, sys.argv = sys.argv, ["train", *words]
    try:
        arguments = import_module("utils.parser_util").train_args()
    finally:
        sys.argv = typed

    create = import_module("utils.model_util").create_model_and_diffusion
    model, diffusion = create(arguments, SimpleNamespace(dataset=SimpleNamespace(num_actions=1)))
    model.to(device)  # in the authors' class, neither `to` nor `train` returns the model
    model.train()
    trainer = import_module("diffusion.fp16_util").MixedPrecisionTrainer(model=model)
    optimizer = torch.optim.AdamW(
        trainer.master_params, arguments.lr, weight_decay=arguments.weight_decay
    )
    times = import_module("diffusion.resample").create_named_schedule_sampler("uniform", diffusion)

    def step(batch: MotionBatch) -> None:
        motions = batch.x.transpose(1, 2)[:, :, None]  # (B, 263, 1, F)
        texts = ["a person walks"] * len(batch)
        condition = {"mask": batch.mask[:, None, None], "lengths": batch.lengths, "text": texts}

        trainer.zero_grad()
        t, weights = times.sample(len(batch), motions.device)
        losses = diffusion.training_losses(
            model, motions, t, model_kwargs={"y": condition}, dataset=None
        )
        trainer.backward((losses["loss"] * weights).mean())
        trainer.optimize(optimizer)

    return step
