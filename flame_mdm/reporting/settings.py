"""Hyperparameters of recipes, for tables."""

import inspect
from collections.abc import Callable
from typing import Any

from hydra.utils import get_class

from flame_mdm.config import Config, compose, parameters

Sizes = Callable[[str], dict[str, Any]]
"""Returns the sizes that only a built network has, `features` and `parameters`, by the name of a recipe."""

LABELS = {
    "optimizer._target_": "optimizer",
    "optimizer.lr": "learning rate",
    "optimizer.weight_decay": "weight decay",
    "optimizer.betas": "β1, β2",
    "data.batch_size": "batch",
    "trainer.max_steps": "training steps",
    "process.num_train_timesteps": "diffusion steps T",
    "process.schedule": "β schedule",
    "process.timestep_sampling": "schedule sampler",
    "process.prediction": "prediction",
    "process.variance": "variance",
    "features": "motion width",
    "denoiser.latent_dim": "latent width",
    "denoiser.ff_size": "feed-forward width",
    "denoiser.num_layers": "layers",
    "denoiser.num_heads": "heads",
    "denoiser.dropout": "dropout",
    "denoiser.max_frames": "longest motion, frames",
    "condition.model": "text encoder",
    "condition.max_tokens": "longest text, tokens",
    "condition.freeze": "language model frozen",
    "denoiser.length_token": "motion-length token",
    "denoiser.cross_attention": "cross-attention",
    "task.cond_drop_prob": "p of the null condition",
    "task.guidance_scale": "guidance scale s",
    "task.sampler": "sampler",
    "task.num_inference_steps": "sampling steps",
    "ema.update_every_n_steps": "EMA update, steps",
    "ema.decay": "EMA decay",
    "losses.joints": "λ position",
    "losses.velocity": "λ velocity",
    "losses.foot_contact": "λ foot contact",
    "task.network.latent_dim": "motion encoder, latent width",
    "task.network.ff_size": "motion encoder, feed-forward width",
    "task.network.num_layers": "motion encoder, layers",
    "task.network.num_heads": "motion encoder, heads",
    "task.network.dropout": "motion encoder, dropout",
    "task.network.max_frames": "longest motion, frames",
    "task.network.embedding_dim": "width of the common space",
    "parameters": "parameters, M",
}
"""Labels of the hyperparameters in tables, by dotted key; `features` and `parameters` are counted."""


def values(name: str, sizes: Sizes | None = None) -> dict[str, Any]:
    """Returns the hyperparameters of a recipe, by the keys of `LABELS`. Unset ones have the default of their class."""
    config = compose(name)
    settings = {key: value(config, key) for key in LABELS if "." in key} | (sizes(name) if sizes else {})
    return {key: setting for key, setting in settings.items() if setting is not None}


def value(config: Config, key: str) -> Any:
    """Returns the value of a dotted key: from the recipe, or else the default of the class, or else None."""
    *path, name = key.split(".")
    node: Any = config
    for part in path:
        node = node.get(part) or {}
    if name in node:
        return node[name].rpartition(".")[2] if name == "_target_" else node[name]
    if "_target_" in node and name in parameters(node["_target_"]):
        return inspect.signature(get_class(node["_target_"])).parameters[name].default
    return None


def setting_text(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, list | tuple):
        return ", ".join(map(setting_text, value))
    if isinstance(value, int):
        return f"{value:,}"
    return f"{value:.4g}" if isinstance(value, float) else str(value)
