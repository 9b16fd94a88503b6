"""The demo's server: page, motion files and limits.

The server requires the `demo` extra (gradio).
"""

import asyncio
import os
import re
import socket
import tempfile
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from pathlib import Path

# gradio reads these variables when it is imported
os.environ |= {
    "GRADIO_ANALYTICS_ENABLED": "False",
    "HF_HUB_DISABLE_TELEMETRY": "1",
}

import gradio as gr
import uvicorn
from fastapi import FastAPI
from fastapi.responses import HTMLResponse, JSONResponse, PlainTextResponse, Response
from gradio import themes
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request

from flame_mdm.conditions.language.reading import NotUnderstood
from flame_mdm.data.standing import standing
from flame_mdm.demo.connections import ConnectionLimits, server_settings
from flame_mdm.demo.guard import Guard, LiveCall
from flame_mdm.demo.live import LiveStreams
from flame_mdm.demo.request import parse_query, query_pairs
from flame_mdm.demo.studio import Studio
from flame_mdm.demo.studio_page import build_page
from flame_mdm.errors import UserError, first_line, one_line, say
from flame_mdm.visualize import player_page

# Number of open pages for which gradio keeps state. It stores half a megabyte per page, which the
# demo does not need.
SESSIONS = 64
# Maximum number of motion files that are written at the same time, and maximum number of requests
# that wait for a file
WRITERS = 2
WAITING_FILES = 32
WAITING_BLOCKS = 32  # maximum number of requests that wait for frames of a stream
BUSY = "too many files are being written. Try again in a minute"
FOLDER = Path(__file__).parent
FONT, MONO = ("system-ui", "sans-serif"), ("ui-monospace", "monospace")


def serve(
    sources: Sequence[str],
    host: str = "127.0.0.1",
    port: int = 7860,
    device: str | None = None,
    hosts: Collection[str] = (),
) -> None:
    """Serves the page of `Studio(sources)` until the process is interrupted.

    Raises `UserError` if the port or a model cannot be used.
    """
    import torch

    try:
        listening = socket.create_server(
            (host, port), family=socket.AF_INET6 if ":" in host else socket.AF_INET
        )
    except OSError as error:
        raise UserError(
            f"host={host} port={port}: {error.strerror}. Choose another host or port"
        ) from error
    with listening:
        studio = Studio(sources, device or ("cuda" if torch.cuda.is_available() else "cpu"))
        with tempfile.TemporaryDirectory(prefix="flame_mdm_demo_") as folder:
            os.environ["GRADIO_TEMP_DIR"] = folder
            app = web_app(studio, {host, *hosts})
            say(
                f"http://{f'[{host}]' if ':' in host else host}:{listening.getsockname()[1]}  (Ctrl+C stops the demo)"
            )
            Server(server_settings(app, connection_limits(hosts))).run([listening])


def connection_limits(hosts: Collection[str]) -> ConnectionLimits:
    """Returns the connection limits for a server.

    If `hosts` is not empty, the demo runs behind a web server with these names, so all visitors
    seem to have the same address.
    """
    limits = ConnectionLimits()
    return replace(limits, per_address=limits.total) if hosts else limits


class Server(uvicorn.Server):
    """Ends the streams of open pages at shutdown, before the server waits for running requests."""

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self.config.app.closing.set()  # type: ignore[union-attr]
        await super().shutdown(sockets)


def source(name: str) -> str:
    """Returns the contents of a file in this module's folder."""
    return (FOLDER / name).read_text(encoding="utf-8")


class Writers:
    """Limits the number of motion files that are written at the same time.

    Attributes:
        turns: semaphore that is held while a file is written.
        waiting: number of requests that are waiting for a file, including those whose file is being
            written.
    """

    def __init__(self) -> None:
        self.turns = asyncio.Semaphore(WRITERS)
        self.waiting = 0

    @property
    def is_full(self) -> bool:
        """Whether new requests are refused."""
        return self.waiting >= WAITING_FILES


def add_live(app: FastAPI, live: LiveStreams, writers: Writers) -> None:
    """Adds the routes for stream blocks (`/live`), stream files, and the stream player."""
    waiting = 0

    @app.get("/live.html")
    async def player() -> Response:
        still = standing(live.model.representation, 10)
        return HTMLResponse(player_page([still], "Live"))

    @app.post("/live")
    async def block(web: Request) -> Response:
        nonlocal waiting
        if waiting >= WAITING_BLOCKS:
            return JSONResponse(
                {"error": "too many streams are waiting. Try again in a minute"}, 503
            )
        waiting += 1
        try:
            call = LiveCall.model_validate_json(await web.body())
            content = await run_in_threadpool(
                live.block, call.stream, call.text, call.begin, call.path
            )
            return JSONResponse(content)
        except NotUnderstood as error:
            return JSONResponse({"error": error.message, "nearest": list(error.nearest)}, 400)
        except UserError as error:
            return JSONResponse({"error": first_line(error)}, 400)
        finally:
            waiting -= 1

    @app.get("/live{ending}")
    async def file(ending: str, stream: str = "") -> Response:
        if writers.is_full:
            return PlainTextResponse(BUSY, 503)
        writers.waiting += 1
        try:
            async with writers.turns:
                content = await run_in_threadpool(live.file, stream, ending)
        except UserError as error:
            return PlainTextResponse(first_line(error), 400)
        finally:
            writers.waiting -= 1
        return Response(content, media_type="application/octet-stream")


def web_app(studio: Studio, hosts: Collection[str] = ()) -> Guard:
    """Returns the application, which serves the page at `/` and files at `/motion.bvh?...`.

    The address of a file contains the query string of a link to the request.
    """
    app = FastAPI(openapi_url=None)
    writers = Writers()

    @app.get("/motion{extension}")
    async def motion_file(extension: str, web: Request) -> Response:
        if writers.is_full:
            return PlainTextResponse(BUSY, 503)
        writers.waiting += 1
        try:
            pairs = query_pairs(web.url.query)
            options = {key: value for key, value in pairs if key in ("motion", "rig")}
            number = options.get("motion", "0")
            if not number.isdecimal() or len(number) > 3:
                raise UserError(f"motion={one_line(number[:20])}: not a motion number")
            request = parse_query([pair for pair in pairs if pair[0] not in options])
            async with writers.turns:
                await web.body()  # a disconnection is reported only after the body
                if await web.is_disconnected():
                    return Response(status_code=499)
                content = await run_in_threadpool(
                    studio.file, request, int(number), extension, options.get("rig")
                )
        except UserError as error:
            return PlainTextResponse(first_line(error), 400)
        finally:
            writers.waiting -= 1
        words = "-".join(re.findall(r"[a-z0-9]+", request.text.lower()))[:60]
        # The rig is part of the file name
        rig = f"-{options['rig']}" if options.get("rig") else ""
        name = f"{words or 'motion'}-{int(number) + 1}{rig}{extension}"
        headers = {"Content-Disposition": f'attachment; filename="{name}"'}
        return Response(content, media_type="application/octet-stream", headers=headers)

    if studio.live is not None:
        add_live(app, studio.live, writers)
    blocks = build_page(studio)
    blocks.state_session_capacity = SESSIONS
    # Without this setting, gradio does not check which files it may read
    blocks.has_launched = True
    gr.mount_gradio_app(
        app,
        blocks,
        path="/",
        theme=themes.Default(primary_hue="blue", font=FONT, font_mono=MONO),
        css_paths=[FOLDER / "page.css", FOLDER / "live.css"],
        head=f"<script>{source('page.js')}</script>"
        f'<script type="module">{source("live.js")}{source("live_page.js")}</script>',
        footer_links=[],
        ssr_mode=False,
        run_history=False,
        allowed_paths=[],
        max_file_size=1,
        show_error=False,
    )
    queue, direct = "/gradio_api/queue/join", "/gradio_api/run/predict"
    calls: dict[str, tuple[str, Callable[[list[str]], bool]]] = {
        "show": (queue, lambda data: len(data) == 1),
        "halt": (direct, lambda data: data == []),
        "switch": (direct, lambda data: len(data) == 1 and data[0] in studio.files),
    }
    numbers = {number: calls[fn.name] for number, fn in blocks.fns.items() if fn.name in calls}
    return Guard(
        app, hosts, numbers, lambda session: session in blocks._queue.pending_messages_per_session
    )
