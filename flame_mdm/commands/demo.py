"""`flame-mdm demo [CKPT ...]`: serves a page that generates motions from texts."""

from dataclasses import dataclass
from importlib.util import find_spec
from typing import ClassVar

from flame_mdm.config.options import option
from flame_mdm.errors import UserError


@dataclass(frozen=True, kw_only=True)
class DemoSettings:
    """usage: flame-mdm demo [CKPT ...] [adapter=FILE] [host=127.0.0.1] [port=7860] [hosts=NAME] [device=cuda]

    Serves a page on which you can type a sentence and then watch, edit and download the motion.
    Without CKPT, the demo uses the models in the package. It requires the demo extra: pip install
    "flame-mdm[demo]". docs/demo.md explains the page.
    """

    OBJECTS: ClassVar = ("ckpt",)
    ckpt: list[str] = option(
        lambda: ["package", "package_dip"],
        "one or more models, separated by spaces: names, files, runs or hub ids",
    )
    adapter: list[str] = option(
        list, "adapters for the first model, separated by spaces; users can choose one of them"
    )
    host: str = option(
        "127.0.0.1",
        "address to listen on. The default accepts only this computer; 0.0.0.0 = all networks",
    )
    port: int = option(7860, "port to listen on; 0 = any free port")
    hosts: list[str] = option(
        list,
        "host names of this server, such as motion.example.org. localhost and IP addresses "
        "always work",
    )
    device: str | None = option(None, "cpu or cuda; default: cuda if available")


def main(settings: DemoSettings) -> None:
    """Serves the demo page until the command is stopped."""
    if not 0 <= settings.port <= 65535:
        raise UserError(
            f"port={settings.port}: expected a number from 0 to 65535; 0 = any free port"
        )
    if find_spec("gradio") is None:
        raise UserError('the demo requires the gradio package. Run pip install "flame-mdm[demo]"')

    from flame_mdm.demo.app import serve
    from flame_mdm.demo.request import PLUS

    sources = [*settings.ckpt, *(f"{settings.ckpt[0]}{PLUS}{file}" for file in settings.adapter)]
    serve(sources, settings.host, settings.port, settings.device, settings.hosts)
