"""`flame-mdm push CKPT user/name`: uploads a model file and its model card to the Hugging Face hub."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from flame_mdm.commands import ModelSettings
from flame_mdm.config.options import option, required
from flame_mdm.errors import say


@dataclass(frozen=True, kw_only=True)
class PushSettings(ModelSettings):
    """usage: flame-mdm push CKPT user/name [OUT] [private=true] [dry_run=true]

    Writes model.safetensors, config.yaml and a model card, and uploads them to the Hugging Face hub.
    """

    OBJECTS: ClassVar = ("ckpt", "repository", "out")
    repository: str = required("user/name on the Hugging Face hub")
    out: str | None = option(None, "local folder for the files; default: push/<name>")
    private: bool = option(False, "true = the repository is private")
    dry_run: bool = option(False, "true = write the folder without uploading it")


def main(settings: PushSettings) -> None:
    """Uploads a model with its card to the Hugging Face hub."""
    file = settings.model_file()
    from flame_mdm.checkpoints.hub import push

    name, upload = settings.repository, not settings.dry_run
    folder = settings.out or Path("push") / name.rpartition("/")[2]
    folder = push(file, name, folder, upload=upload, private=settings.private)
    say(f"{f'uploaded to {name}' if upload else 'not uploaded'}: {folder}")
