"""`flame-mdm adapt CKPT source=FOLDER name=WORD`: teaches a trained model the motions in a folder."""

from dataclasses import dataclass
from typing import ClassVar

from flame_mdm.commands import ModelSettings, above_zero, usual_data_root
from flame_mdm.config.options import option, required


@dataclass(frozen=True, kw_only=True)
class AdaptSettings(ModelSettings):
    """usage: flame-mdm adapt CKPT [OUT] source=FOLDER name=limp [trainer.max_steps=2000] [key=value ...]

    Teaches a trained model the motions in a folder while preserving its other abilities. After
    training, prompts that end with "in limp style" produce motions in this style. Writes the
    adapter OUT/limp.safetensors for `sample` and `load`, and a page that compares motions before
    and after training. Run the same command again to resume. docs/own-motion.md explains the steps.
    """

    OBJECTS: ClassVar = ("ckpt", "out")
    COMPOSED: ClassVar = ("ema", "logger", "lr_decay", "lr_warmup", "seed")
    source: str = required("folder of motions with captions; see docs/own-data.md")
    name: str = required("one word for prompts such as 'a person walks in NAME style'")
    out: str | None = option(None, "run directory; default: runs/adapt/NAME")
    action: bool = option(
        False, "true = the clips show an action that is new to the model, rather than a style"
    )
    full: bool = option(
        False, "true = train all weights, which results in a model instead of an adapter"
    )
    force: bool = option(False, "true = accept clips that drift upward or float")
    rank: int = option(
        8,
        "rank of the low-rank updates to the weights; increase it for motions that differ "
        "much from the model's training data",
        above_zero,
    )
    data_root: str = option(usual_data_root, "folder of the prepared data sets")
    composed: tuple[str, ...] = ()


def main(settings: AdaptSettings) -> None:
    """Trains and writes an adapter."""
    file = settings.model_file()

    from flame_mdm.training.adaptation import adapt

    keywords = {
        name: value
        for name, value in vars(settings).items()
        if name not in ("ckpt", "which", "composed")
    }
    adapt(file, overrides=settings.composed, **keywords)
