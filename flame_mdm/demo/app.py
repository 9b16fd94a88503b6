"""The page: form, player, edits, downloads, links. It needs the extra `demo` (gradio)."""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from threading import Event
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, urlencode

os.environ |= {"GRADIO_ANALYTICS_ENABLED": "False", "HF_HUB_DISABLE_TELEMETRY": "1"}  # read when gradio is imported

import gradio as gr
import uvicorn
from fastapi import FastAPI
from fastapi.responses import PlainTextResponse, Response
from gradio import themes
from starlette.requests import Request as WebRequest

from flame_mdm.demo.request import (
    MAX_TEXT,
    Request,
    parse_query,
)
from flame_mdm.demo.studio import FORMATS, Studio
from flame_mdm.errors import UserError, first_line, markdown_text
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import presets
from flame_mdm.processes.guidance import STEERING_STEPS
from flame_mdm.visualize import player_page

QUEUE = 64
"""Maximum number of waiting requests; further ones are told to come back."""
MAX_BODY = 2**20
"""Maximum number of bytes of a request to the server."""
POLICY = (
    "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; frame-src 'self'; worker-src 'self' blob:"
)
"""Nothing is loaded from other servers, so the page works, and stays private, without the internet."""
FONT, MONO = ("system-ui", "sans-serif"), ("ui-monospace", "monospace")
PARTS = ("left_arm", "right_arm", "left_leg", "right_leg", "upper_body", "lower_body")
RIGGED = (".bvh", ".glb")
VARIED = 0.5
"""Strength of the variations of a motion."""
EMPTY = '<div class="empty">Describe a motion, then press Generate</div>'
EDITORS = """<div id="parts"><div class="head"><span>Action</span><span>Seconds</span></div>
<div class="list"></div><button type="button" class="add">+ Add an action</button></div>
<details id="floor"><summary>Path on the floor</summary><svg role="img" aria-label="Floor from above"></svg>
<div><output></output><button type="button" class="clear">Clear</button></div></details>"""
SHOW_LINK = "(query) => { history.replaceState(null, '', '?' + query); return location.href }"


class Shown(NamedTuple):
    """Components that show a result, or their values, in the order of the outputs of every event."""

    player: Any
    notes: Any
    query: Any
    files: Any
    command: Any
    python: Any
    chosen: Any


def serve(sources: Sequence[str], host: str = "127.0.0.1", port: int = 7860, device: str | None = None) -> None:
    """Serves the page until the process is interrupted.

    Args:
        sources: names of models, as for `flame_mdm.load`; the first is selected at first.
        host: address to listen on; 127.0.0.1 is this computer alone, 0.0.0.0 all networks.
        port: to listen on; 0 = any free one.
        device: of the models; default: cuda if available.

    Raises:
        UserError: the port is in use, or a model cannot be found or loaded.
    """
    import socket

    import torch

    from flame_mdm.errors import say

    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as listening:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            listening.bind((host, port))
            listening.listen()
        except OSError as error:
            raise UserError(f"host={host} port={port}: {error.strerror}. Choose another host or port") from error
        studio = Studio(sources, device or ("cuda" if torch.cuda.is_available() else "cpu"))
        with tempfile.TemporaryDirectory(prefix="flame_mdm_demo_") as folder:
            os.environ["GRADIO_TEMP_DIR"] = folder
            app = web_app(studio, device)
            say(f"http://{f'[{host}]' if ':' in host else host}:{listening.getsockname()[1]}  (Ctrl+C stops the demo)")
            uvicorn.Server(uvicorn.Config(app, log_level="warning")).run([listening])


def web_app(studio: Studio, device: str | None = None) -> FastAPI:
    """Returns the application: the page at `/`, files at `/motion.bvh?...` with the query string of a link.

    Args:
        studio: makes the motions.
        device: to name in command lines; None = the default.
    """
    app = FastAPI(openapi_url=None)

    @app.middleware("http")
    async def guard(web: WebRequest, proceed: Callable[[WebRequest], Any]) -> Response:
        length = web.headers.get("content-length", "0")
        if web.method == "POST" and (not length.isdecimal() or int(length) > MAX_BODY or "/upload" in web.url.path):
            return PlainTextResponse("this request is too large, or not one of this page", 413)
        response = await proceed(web)
        response.headers["Content-Security-Policy"] = POLICY
        return response

    @app.get("/motion{extension}")
    def motion_file(extension: str, web: WebRequest) -> Response:
        pairs = web.query_params.multi_items()
        chosen = {key: value for key, value in pairs if key in ("motion", "rig")}
        number = chosen.get("motion", "0")
        try:
            if not number.isdecimal() or len(number) > 3:
                raise UserError(f"motion={number[:20]}: not a number of a motion")
            request = parse_query([pair for pair in pairs if pair[0] not in chosen])
            content = studio.file(request, int(number), extension, chosen.get("rig"))
        except (UserError, ValueError) as error:
            return PlainTextResponse(first_line(error), 400)
        name = f"{'-'.join(request.text.lower().split())[:60] or 'motion'}-{number}{extension}"
        kept = "".join(c for c in name if c.isascii() and (c.isalnum() or c in "-."))
        headers = {"Content-Disposition": f'attachment; filename="{kept}"', "X-Content-Type-Options": "nosniff"}
        return Response(content, media_type="application/octet-stream", headers=headers)

    return gr.mount_gradio_app(
        app,
        page(studio, device),
        path="/",
        theme=themes.Default(primary_hue="blue", font=FONT, font_mono=MONO),
        css_paths=Path(__file__).with_name("page.css"),
        head=f"<script>{Path(__file__).with_name('page.js').read_text(encoding='utf-8')}</script>",
        footer_links=[],
        ssr_mode=False,
        run_history=False,
        allowed_paths=[],
        max_file_size=1,
    )


def page(studio: Studio, device: str | None) -> gr.Blocks:
    """Returns the page; arguments as for `web_app`."""
    stops: dict[str, Event] = {}
    names = list(studio.files)
    samplers = list(studio.model(names[0]).process.samplers)

    def show(query: str, web: gr.Request, progress: gr.Progress = gr.Progress()) -> Shown:  # noqa: B008
        stop = stops[str(web.session_hash)] = Event()
        try:
            request = _read(query)
            model = studio.model(request.model)
            runs = 1 + len(request.edits) + STEERING_STEPS * bool(request.path)
            steps = request.num_inference_steps or model.sampler_options.num_inference_steps
            total = (len(steps) if isinstance(steps, list) else steps) * runs

            def report(calls: int) -> None:
                progress((calls, max(total, calls + 1)), "Generating", unit="steps")

            motions = studio.motions(request, report, stop)
            return _shown(studio, device, request, motions)
        except (UserError, ValueError) as error:
            note = f'<p class="error" role="alert">{escape(first_line(error))}</p>'
            return Shown(*[gr.skip()] * len(Shown._fields))._replace(notes=note)
        finally:
            stops.pop(str(web.session_hash), None)

    def leave(web: gr.Request) -> None:
        if stop := stops.get(str(web.session_hash)):
            stop.set()

    def halt(web: gr.Request) -> str:
        leave(web)
        return '<p class="warning" role="alert">Canceled</p>'

    def fill(query: str) -> list[Any]:
        query = query or Request(model=names[0], text=_examples(studio, names[0])[0]).query()
        try:
            values = _read(query).model_dump()
        except (UserError, ValueError):  # `show` says why
            return [query, *[gr.skip()] * len(FORM)]
        return [query, *(values[key] for key in FORM)]

    def compose(*values: Any) -> str:
        given = dict(zip(FORM, values, strict=True))
        return urlencode({key: value for key, value in given.items() if value is not None})

    def change(query: str, motion: int, text: str, begin: str, end: str, parts: list[str], seed: Any) -> str:
        region = [begin or 0, end or _read(query).seconds] if begin or end else None
        edit = {"motion": motion, "text": text, "region_seconds": region, "joints": parts, "seed": seed}
        return _with_edit(query, edit)

    def vary(query: str, motion: int, seed: Any) -> str:
        text = _text(_read(query))
        return _with_edit(query, {"motion": motion, "text": text, "strength": VARIED, "samples": 3, "seed": seed})

    def switch(name: str) -> list[Any]:
        samples = [[text] for text in _examples(studio, name)]
        choices = list(studio.model(name).process.samplers)
        return [gr.Dataset(samples=samples), gr.Dropdown(choices=choices, value=None), _vocabulary(studio, name)]

    with gr.Blocks(title="flame_mdm", analytics_enabled=False) as blocks:
        gr.Markdown("# Ask for a motion", elem_id="title")
        with gr.Row(elem_id="stage"):
            with gr.Column(elem_id="ask"):
                label = "What the person does"
                text = gr.Textbox(label=label, max_length=MAX_TEXT, lines=2, autofocus=True, elem_id="text")
                gr.HTML(EDITORS, js_on_load="editor()")
                label = "Way points: meters to the left, meters ahead"
                path = gr.Textbox(label=label, placeholder="0,1 0.5,2", max_length=MAX_TEXT, elem_id="path")
                with gr.Row():
                    go = gr.Button("Generate", variant="primary")
                    cancel = gr.Button("Cancel")
            with gr.Column(elem_id="show"):
                notes = gr.HTML(elem_id="notes")
                player = gr.HTML(EMPTY, elem_id="player")
                files = gr.HTML(elem_id="files")
            with gr.Column(elem_id="options"):
                known = [[example] for example in _examples(studio, names[0])]
                examples = gr.Dataset(components=[text], samples=known, label="Examples")
                with gr.Row():
                    seconds = gr.Number(3, label="Seconds", step=0.5, min_width=90)
                    seed = gr.Number(0, label="Seed", precision=0, min_width=90)
                    samples = gr.Number(1, label="Samples", precision=0, min_width=90)
                with gr.Accordion("Model and sampling", open=len(names) > 1):
                    model = gr.Dropdown(names, value=names[0], label="Model")
                    with gr.Row():
                        guidance = gr.Textbox(label="Guidance", placeholder="model's", max_length=9, min_width=90)
                        steps = gr.Textbox(label="Steps", placeholder="model's", max_length=9, min_width=90)
                        sampler = gr.Dropdown(samplers, value=None, label="Sampler", min_width=120)
                    cleanup = gr.Checkbox(
                        True, label="Clean up: smooth motion, feet that do not slide (not with a path)"
                    )
                with gr.Accordion("Words the model knows", open=False):
                    words = gr.Markdown(_vocabulary(studio, names[0]))
        with gr.Accordion("Keep a part of this motion, change the rest", elem_id="edit"):
            gr.Markdown("Choose a time, body parts, or both. They change; everything else is kept.")
            chosen = gr.Radio([("1", 0)], value=0, label="Motion to edit", visible=False)
            with gr.Row():
                begin = gr.Textbox(label="Change from second", placeholder="start", max_length=9, min_width=120)
                end = gr.Textbox(label="to second", placeholder="end", max_length=9, min_width=120)
                parts = gr.Dropdown(PARTS, multiselect=True, label="Body parts that change", min_width=220)
            with gr.Row():
                new = gr.Textbox(label="What the person does there", max_length=MAX_TEXT, scale=3, min_width=220)
                again = gr.Number(0, label="Seed", precision=0, min_width=90)
            with gr.Row():
                apply = gr.Button("Change")
                variations = gr.Button("Three variations of the whole motion")
        with gr.Accordion("The same motion by link, command line and Python", open=False, elem_id="same"):
            link = gr.Textbox(label="Link", interactive=False, buttons=["copy"], elem_id="link")
            command = gr.Code(label="Command line", language="shell", lines=2, interactive=False, wrap_lines=True)
            python = gr.Code(label="Python", language="python", lines=2, interactive=False, wrap_lines=True)
        asked = gr.Textbox(visible="hidden", elem_id="asked")
        query = gr.Textbox(visible="hidden", elem_id="query")

        form = [model, text, seconds, seed, samples, guidance, steps, sampler, cleanup, path]
        outputs = list(Shown(player, notes, query, files, command, python, chosen))
        quick: dict[str, Any] = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
        edit = [query, chosen, new, begin, end, parts, again]
        first = [
            blocks.load(fill, asked, [asked, *form], js="() => location.search.slice(1)", **quick),
            *(each(compose, form, asked, **quick) for each in (go.click, text.submit)),
            *(each(change, edit, asked, **quick) for each in (apply.click, new.submit)),
            variations.click(vary, [query, chosen, again], asked, **quick),
            examples.click(lambda row: row[0], examples, text, **quick).then(compose, form, asked, **quick),
        ]
        run: dict[str, Any] = {"show_progress_on": player, "concurrency_limit": 1, "concurrency_id": "model"}
        hidden: dict[str, Any] = {"api_visibility": "private"}
        running: list[Any] = [first[0].then(show, asked, outputs, api_name="generate", **run)]
        running += [event.then(show, asked, outputs, **run, **hidden) for event in first[1:]]
        for event in running:
            event.then(None, query, link, js=SHOW_LINK, **quick)
        cancel.click(halt, None, notes, cancels=running, **quick)
        model.change(switch, model, [examples, sampler, words], **quick)
        for event in (text.change, seconds.change, path.change):
            event(None, [text, seconds, path], None, js="(...values) => editor(...values)", **quick)
        blocks.unload(leave)
    blocks.queue(max_size=QUEUE, default_concurrency_limit=1)
    return blocks


FORM = (
    "model",
    "text",
    "seconds",
    "seed",
    "samples",
    "guidance_scale",
    "num_inference_steps",
    "sampler",
    "cleanup",
    "path",
)
"""Keys of `Request`, in the order of the fields of the form."""


def _read(query: str) -> Request:
    return parse_query(parse_qsl(query, max_num_fields=50))


def _text(request: Request) -> str:
    """Returns the text that the shown motions follow."""
    return request.edits[-1].text if request.edits else request.text


def _with_edit(query: str, edit: dict[str, Any]) -> str:
    return f"{query}&{urlencode({'edit': json.dumps({key: value for key, value in edit.items() if value})})}"


def _shown(studio: Studio, device: str | None, request: Request, motions: Sequence[Motion]) -> Shown:
    kind = studio.model(request.model).conditioned_on
    scene = list(motions)
    if request.edits:  # next to the motion before the last edit
        *before, last = request.edits
        original = studio.motions(request.model_copy(update={"edits": tuple(before)}))[last.motion]
        scene.insert(0, replace(original, text=f"before: {original.text}"))
    query = escape(request.query())
    links = ""
    for number in range(len(motions)):
        address = f"?{query}&amp;motion={number}"
        files = [(f"motion{extension}{address}", name) for extension, name in FORMATS.items()]
        rigs = [(f"motion{end}{address}&amp;rig={rig}", f"{rig} {end[1:]}") for rig in presets() for end in RIGGED]
        links += f"<div>{f'Motion {number + 1}' * (len(motions) > 1)}{_links(files)}</div>"
        links += f"<details><summary>for other skeletons</summary><div>{_links(rigs)}</div></details>"
    player = escape(player_page(scene, _text(request) or "Motion"))
    return Shown(
        player=f'<iframe title="Player" sandbox="allow-scripts allow-downloads" srcdoc="{player}"></iframe>',
        notes="".join(f'<p class="warning">{escape(line)}</p>' for line in studio.advice(request)),
        query=request.query(),
        files=links,
        command=request.command(kind, device),
        python=request.python(kind, studio.device),
        chosen=gr.Radio([(str(k + 1), k) for k in range(len(motions))], value=0, visible=len(motions) > 1),
    )


def _links(files: Sequence[tuple[str, str]]) -> str:
    return "".join(f'<a href="{address}" download>{name}</a>' for address, name in files)


def _examples(studio: Studio, name: str) -> list[str]:
    """Returns up to six texts or actions of the training data."""
    model = studio.model(name)
    known = list(model.facts["actions"] if model.conditioned_on == "action" else model.facts.get("captions", ()))
    return known[:: max(1, len(known) // 6)][:6] or ["a person walks"]


def _vocabulary(studio: Studio, name: str) -> str:
    model = studio.model(name)
    known = model.facts["actions"] if model.conditioned_on == "action" else model.facts.get("vocabulary", ())
    return ", ".join(map(markdown_text, known)) or "The model does not list them."
