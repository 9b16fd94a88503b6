"""`flame-mdm demo [CKPT ...]`: serves a page that generates motions from texts."""

from __future__ import annotations

import shlex
from functools import partial

from flame_mdm.config import Config, run
from flame_mdm.errors import UserError

USAGE = """
usage: flame-mdm demo [CKPT ...] [host=127.0.0.1] [port=7860] [device=cuda]

Serves a page where you type a sentence, watch the motion, edit it and download it. Without CKPT, it uses the model in
the package. It needs the extra demo: pip install "flame-mdm[demo]"
Keys, with their defaults: experiments/demo.yaml
"""


def demo(config: Config) -> None:
    """Serves the page until interrupted.

    Raises:
        UserError: If gradio is not installed, the port is invalid or in use, or a model cannot be found or loaded.
    """
    if not 0 <= config["port"] <= 65535:
        raise UserError(f"port={config['port']}: give a number from 0 to 65535; 0 is any free port")
    try:
        import gradio  # noqa: F401
    except ImportError as error:
        raise UserError('the demo needs the package gradio. Run pip install "flame-mdm[demo]"') from error

    from flame_mdm.demo.app import serve

    serve(shlex.split(str(config["ckpt"])), str(config["host"]), config["port"], config["device"])


main = partial(
    run,
    demo,
    usage=USAGE,
    name="demo",
    objects=("ckpt*",),
    text=("ckpt", "host"),
    kinds={"port": "int", "device": "str"},
)
