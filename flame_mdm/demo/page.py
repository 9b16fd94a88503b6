"""The page: form, player, edits, downloads, links. `page.js` writes the links; the server reads and answers them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from html import escape
from threading import Event
from types import SimpleNamespace
from typing import Any
from urllib.parse import parse_qsl

import gradio as gr

from flame_mdm.demo.request import MAX_TEXT, DemoRequest, parse_query
from flame_mdm.demo.studio import FORMATS, Studio
from flame_mdm.errors import UserError, first_line, markdown_text, one_line
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import presets
from flame_mdm.processes.guidance import STEERING_STEPS
from flame_mdm.visualize import player_page

QUEUE = 64
"""Maximum number of waiting requests; further ones are told to come back."""
PARTS = ("left_arm", "right_arm", "left_leg", "right_leg", "upper_body", "lower_body")
RIGGED = (".bvh", ".glb")
EMPTY = '<div class="empty">Describe a motion, then press Generate</div>'
EDITORS = """<div id="parts"><div class="head"><span>Action</span><span>Seconds</span></div>
<div class="list"></div><button type="button" class="add">+ Add an action</button></div>
<details id="floor"><summary>Path on the floor</summary><svg role="img" aria-label="Floor from above"></svg>
<div><output></output><button type="button" class="clear">Clear</button></div></details>"""
SHOW_LINK = "(query) => { history.replaceState(null, '', '?' + query); return location.href }"


def build_page(studio: Studio, device: str | None = None) -> gr.Blocks:
    """Returns the page; the server calls its functions `show`, `halt` and `switch`.

    Args:
        studio: Makes the motions.
        device: Device to name in command lines; None = the default.
    """
    stops: dict[str, Event] = {}

    def show(query: str, web: gr.Request, progress: gr.Progress = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
        stop = stops[str(web.session_hash)] = Event()
        try:
            request = parse_query(parse_qsl(query, max_num_fields=50))
            model = studio.model(request.model)
            runs = 1 + len(request.edits) + STEERING_STEPS * bool(request.path)
            steps = request.num_inference_steps or model.sampler_options.num_inference_steps
            total = (steps if isinstance(steps, int) else len(steps or ())) * runs

            def report(calls: int) -> None:
                progress((calls, max(total, calls + 1)), "Generating", unit="steps")

            return _result(ui, studio, device, request, studio.motions(request, report, stop))
        except UserError as error:
            return {ui.notes: f'<p class="error" role="alert">{escape(one_line(first_line(error)))}</p>'}
        finally:
            stops.pop(str(web.session_hash), None)

    def leave(web: gr.Request) -> None:
        if stop := stops.get(str(web.session_hash)):
            stop.set()

    def halt(web: gr.Request) -> str:
        leave(web)
        return '<p class="warning" role="alert">Canceled</p>'

    def switch(name: str) -> list[Any]:
        choices = list(studio.model(name).process.samplers)
        return [_buttons(_examples(studio, name)), gr.Dropdown(choices=choices, value=None), _vocabulary(studio, name)]

    with gr.Blocks(title="flame_mdm", analytics_enabled=False) as blocks:
        ui = _layout(studio)
        form = {"model": ui.model, "text": ui.text, "seconds": ui.seconds, "seed": ui.seed, "samples": ui.samples}
        form |= {"guidance_scale": ui.guidance, "num_inference_steps": ui.steps, "sampler": ui.sampler}
        form |= {"cleanup": ui.cleanup, "path": ui.path}
        fields, edit = list(form.values()), [ui.query, ui.chosen, ui.new, ui.begin, ui.end, ui.parts, ui.again]
        quick: dict[str, Any] = {"queue": False, "show_progress": "hidden", "api_visibility": "private"}
        read, compose = (f"(...values) => links.{name}({list(form)}, values)" for name in ("read", "compose"))
        change, vary, sketch = (
            f"(...values) => {name}(...values)" for name in ("links.change", "links.vary", "editor")
        )
        first = [
            blocks.load(None, fields, [ui.request, *fields], js=read, **quick),
            ui.go.click(None, fields, ui.request, js=compose, **quick),
            ui.text.submit(None, fields, ui.request, js=compose, **quick),
            ui.apply.click(None, edit, ui.request, js=change, **quick),
            ui.new.submit(None, edit, ui.request, js=change, **quick),
            ui.variations.click(None, [ui.query, ui.chosen, ui.again], ui.request, js=vary, **quick),
        ]
        outputs = [ui.player, ui.notes, ui.query, ui.files, ui.command, ui.python, ui.chosen]
        run: dict[str, Any] = {"show_progress_on": ui.player, "concurrency_limit": 1, "concurrency_id": "model"}
        running = [event.then(show, ui.request, outputs, api_visibility="private", **run) for event in first]
        for event in running:
            event.then(None, ui.query, ui.link, js=SHOW_LINK, **quick)
        ui.cancel.click(halt, None, ui.notes, cancels=running, **quick)
        ui.model.change(switch, ui.model, [ui.examples, ui.sampler, ui.words], **quick)
        for event in (ui.text.change, ui.seconds.change, ui.path.change):
            event(None, [ui.text, ui.seconds, ui.path], None, js=sketch, **quick)
        blocks.unload(leave)
    blocks.queue(max_size=QUEUE, default_concurrency_limit=1)
    return blocks


def _layout(studio: Studio) -> SimpleNamespace:
    """Returns the components of the page by name, after placing them in the current `gr.Blocks`."""
    names = list(studio.files)
    samplers, captions = list(studio.model(names[0]).process.samplers), _examples(studio, names[0])
    ui = SimpleNamespace()
    gr.Markdown("# Ask for a motion", elem_id="title")
    with gr.Row(elem_id="stage"):
        with gr.Column(elem_id="ask"):
            label = "What the person does"
            ui.text = gr.Textbox(captions[0], label=label, max_length=MAX_TEXT, lines=2, autofocus=True, elem_id="text")
            gr.HTML(EDITORS, js_on_load="editor()")
            label = "Way points: meters to the left, meters ahead"
            ui.path = gr.Textbox(label=label, placeholder="0,1 0.5,2", max_length=MAX_TEXT, elem_id="path")
            with gr.Row():
                ui.go = gr.Button("Generate", variant="primary", elem_id="go")
                ui.cancel = gr.Button("Cancel")
        with gr.Column(elem_id="show"):
            ui.notes = gr.HTML(elem_id="notes")
            ui.player = gr.HTML(EMPTY, elem_id="player")
            ui.files = gr.HTML(elem_id="files")
        with gr.Column(elem_id="options"):
            ui.examples = gr.HTML(_buttons(captions), elem_id="examples")
            with gr.Row():
                ui.seconds = gr.Number(3, label="Seconds", step=0.5, min_width=90)
                ui.seed = gr.Number(0, label="Seed", precision=0, min_width=90)
                ui.samples = gr.Number(1, label="Samples", precision=0, min_width=90)
            with gr.Accordion("Model and sampling", open=len(names) > 1):
                ui.model = gr.Dropdown(names, value=names[0], label="Model")
                with gr.Row():
                    ui.guidance = gr.Textbox(label="Guidance", placeholder="model's", max_length=9, min_width=90)
                    ui.steps = gr.Textbox(label="Steps", placeholder="model's", max_length=9, min_width=90)
                    ui.sampler = gr.Dropdown(samplers, value=None, label="Sampler", min_width=120)
                label = "Clean up: smooth motion, feet that do not slide (not with a path)"
                ui.cleanup = gr.Checkbox(True, label=label)
            with gr.Accordion("Words the model knows", open=False):
                ui.words = gr.Markdown(_vocabulary(studio, names[0]))
    with gr.Accordion("Keep a part of this motion, change the rest", elem_id="edit"):
        gr.Markdown("Choose a time, body parts, or both. They change; everything else is kept.")
        ui.chosen = gr.Radio([("1", 0)], value=0, label="Motion to edit", visible=False)
        with gr.Row():
            ui.begin = gr.Textbox(label="Change from second", placeholder="start", max_length=9, min_width=120)
            ui.end = gr.Textbox(label="to second", placeholder="end", max_length=9, min_width=120)
            ui.parts = gr.Dropdown(PARTS, multiselect=True, label="Body parts that change", min_width=220)
        with gr.Row():
            ui.new = gr.Textbox(label="What the person does there", max_length=MAX_TEXT, scale=3, min_width=220)
            ui.again = gr.Number(0, label="Seed", precision=0, min_width=90)
        with gr.Row():
            ui.apply = gr.Button("Change")
            ui.variations = gr.Button("Three variations of the whole motion")
    with gr.Accordion("The same motion by link, command line and Python", open=False, elem_id="same"):
        ui.link = gr.Textbox(label="Link", interactive=False, buttons=["copy"], elem_id="link")
        ui.command = gr.Code(label="Command line", language="shell", lines=2, interactive=False, wrap_lines=True)
        ui.python = gr.Code(label="Python", language="python", lines=2, interactive=False, wrap_lines=True)
    ui.request = gr.Textbox(visible="hidden", elem_id="request")
    ui.query = gr.Textbox(visible="hidden", elem_id="query")
    return ui


def _result(
    ui: SimpleNamespace, studio: Studio, device: str | None, request: DemoRequest, motions: Sequence[Motion]
) -> dict[Any, Any]:
    """Returns the values of the components that show the motions of a request."""
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
    text = request.edits[-1].text if request.edits else request.text
    player = escape(player_page(scene, text or "Motion"))
    return {
        ui.player: f'<iframe title="Player" sandbox="allow-scripts allow-downloads" srcdoc="{player}"></iframe>',
        ui.notes: "".join(f'<p class="warning">{escape(line)}</p>' for line in studio.advice(request)),
        ui.query: request.query(),
        ui.files: links,
        ui.command: request.command(kind, device),
        ui.python: request.python(kind, studio.device),
        ui.chosen: gr.Radio([(str(k + 1), k) for k in range(len(motions))], value=0, visible=len(motions) > 1),
    }


def _links(files: Sequence[tuple[str, str]]) -> str:
    return "".join(f'<a href="{address}" download>{name}</a>' for address, name in files)


def _examples(studio: Studio, name: str) -> list[str]:
    """Returns up to six texts or actions of the training data."""
    model = studio.model(name)
    texts = list(model.facts["actions"] if model.conditioned_on == "action" else model.facts.get("captions", ()))
    return [one_line(text) for text in texts[:: max(1, len(texts) // 6)][:6]] or ["a person walks"]


def _buttons(texts: Sequence[str]) -> str:
    return "<p>Examples</p>" + "".join(f'<button type="button">{escape(text)}</button>' for text in texts)


def _vocabulary(studio: Studio, name: str) -> str:
    model = studio.model(name)
    words = model.facts["actions"] if model.conditioned_on == "action" else model.facts.get("vocabulary", ())
    return ", ".join(map(markdown_text, words)) or "The model does not list them."
