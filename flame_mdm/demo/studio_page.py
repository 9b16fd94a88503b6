"""The demo page: form, player, edits, downloads and links.

`page.js` writes the links, and the server handles them.
"""

import re
from base64 import b64encode
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from threading import Event
from types import SimpleNamespace
from typing import Any

import gradio as gr

from flame_mdm.conditions.language.abilities import Abilities
from flame_mdm.conditions.language.parsing import understand
from flame_mdm.conditions.language.reading import NotUnderstood, Reader
from flame_mdm.demo.chips import chips
from flame_mdm.demo.live import STAND, WALK, LiveStreams
from flame_mdm.demo.request import MAX_TEXT, DemoRequest, parse_query, query_pairs
from flame_mdm.demo.still_pictures import still
from flame_mdm.demo.studio import FORMATS, Studio
from flame_mdm.errors import UserError, first_line, markdown_text, one_line
from flame_mdm.formats.motion import Motion
from flame_mdm.formats.retarget import presets
from flame_mdm.generator import MotionGenerator
from flame_mdm.processes.guidance import STEERING_STEPS
from flame_mdm.sampling.motion_request import read_parts
from flame_mdm.sampling.referee.judging import evidence_marks, try_judge
from flame_mdm.visualize import player_page

QUEUE = 64  # maximum number of waiting requests; additional requests are refused
FORM = [
    "model",
    "text",
    "seconds",
    "seed",
    "samples",
    "guidance_scale",
    "num_inference_steps",
    "sampler",
]
FORM += ["cleanup", "split", "path"]
PARTS = ("left_arm", "right_arm", "left_leg", "right_leg", "upper_body", "lower_body")
RIGGED = (".bvh", ".fbx", ".glb")
PROGRAMS = {
    "Blender": ("glb", ""),
    "Unreal FBX": ("fbx", "&amp;rig=unreal"),
    "Unreal GLB": ("glb", "&amp;rig=unreal"),
    "Unity FBX": ("fbx", "&amp;rig=unity"),
    "Unity GLB": ("glb", "&amp;rig=unity"),
    "Mixamo FBX": ("fbx", "&amp;rig=mixamo"),
    "Mixamo GLB": ("glb", "&amp;rig=mixamo"),
}
"""Download buttons for programs: the file extension and the skeleton in the file's address.

Other formats are under "More".
"""
EXAMPLES = (
    "a person walks forward",
    "a person runs",
    "a person waves with the left hand",
    "a person jumps twice",
    "a person kicks with the right leg",
    "a person sits down",
    "a person sneaks",
    "a person climbs a ladder",
    "a person does three jumping jacks",
    "a person swings a sword",
    "a person talks on the phone",
    "a person does a push-up",
)
"""Example texts; the page shows those that its model can generate."""
EMPTY = '<div class="empty">Describe a motion, then press Generate</div>'
EDITORS = """<div id="parts"><div class="head"><span>Action</span><span>Seconds</span></div>
<div class="list"></div><button type="button" class="add">+ Add an action</button></div>
<details id="floor"><summary>Path on the floor</summary><svg role="img" aria-label="Floor from above"></svg>
<div><output></output><button type="button" class="clear">Clear</button></div></details>"""
FOLD = "() => ({ __type__: 'update', open: innerWidth > 760 })"
SHOW_LINK = "(query) => { history.replaceState(null, '', '?' + query); return location.href }"


def build_page(studio: Studio) -> gr.Blocks:
    """Returns the page. The functions `show`, `halt` and `switch` of the page run on the server."""
    stops: dict[str, Event] = {}

    def show(query: str, web: gr.Request, progress: gr.Progress = gr.Progress()) -> dict[Any, Any]:  # noqa: B008
        stop = stops[str(web.session_hash)] = Event()
        try:
            request = studio.understood(parse_query(query_pairs(query)))
            model = studio.model(request.model)
            runs = 1 + len(request.edits) + (STEERING_STEPS if request.path else 0)
            steps = request.num_inference_steps or model.sampler_options.num_inference_steps
            total = (steps if isinstance(steps, int) else len(steps or ())) * runs

            def report(calls: int) -> None:
                progress((calls, max(total, calls + 1)), "Generating", unit="steps")

            return _result(ui, studio, request, studio.motions(request, report, stop))
        except NotUnderstood as error:
            return {ui.notes: _refusal(error)}
        except UserError as error:
            return {ui.notes: _note("error", first_line(error))}
        finally:
            stops.pop(str(web.session_hash), None)

    def leave(web: gr.Request) -> None:
        if stop := stops.get(str(web.session_hash)):
            stop.set()

    def halt(web: gr.Request) -> str:
        leave(web)
        return '<p class="warning" role="alert">Canceled</p>'

    def switch(name: str) -> list[Any]:
        model = studio.model(name)
        samplers = gr.Dropdown(choices=list(model.process.samplers), value=None)
        return [_buttons(_examples(model)), samplers, _vocabulary(model)]

    with gr.Blocks(title="flame_mdm", analytics_enabled=False) as blocks:
        ui = _with_live(studio, studio.live) if studio.live else _layout(studio)
        fields = [vars(ui)[name] for name in FORM]
        edit = [ui.query, ui.chosen, ui.new, ui.begin, ui.end, ui.parts, ui.again]
        quick: dict[str, Any] = {
            "queue": False,
            "show_progress": "hidden",
            "api_visibility": "private",
        }
        read, compose = (
            f"(...values) => links.{name}({FORM}, values)" for name in ("read", "compose")
        )
        calls = ("links.change", "links.vary", "editor")
        change, vary, sketch = (f"(...values) => {name}(...values)" for name in calls)
        first = [
            blocks.load(None, fields, [ui.request, *fields], js=read, **quick),
            ui.go.click(None, fields, ui.request, js=compose, **quick),
            ui.text.submit(None, fields, ui.request, js=compose, **quick),
            ui.apply.click(None, edit, ui.request, js=change, **quick),
            ui.new.submit(None, edit, ui.request, js=change, **quick),
            ui.variations.click(
                None, [ui.query, ui.chosen, ui.again], ui.request, js=vary, **quick
            ),
        ]
        outputs = [ui.player, ui.notes, ui.query, ui.files, ui.python, ui.chosen, ui.text]
        run: dict[str, Any] = {
            "show_progress_on": ui.player,
            "concurrency_limit": 1,
            "concurrency_id": "model",
        }
        running = [
            event.then(show, ui.request, outputs, api_visibility="private", **run)
            for event in first
        ]
        for event in running:
            event.then(None, ui.query, ui.link, js=SHOW_LINK, **quick)
        ui.cancel.click(halt, None, ui.notes, cancels=running, **quick)
        ui.model.change(switch, ui.model, [ui.examples, ui.sampler, ui.words], **quick)
        for event in (ui.text.change, ui.seconds.change, ui.path.change):
            event(None, [ui.text, ui.seconds, ui.path], None, js=sketch, **quick)
        blocks.load(None, None, ui.edit, js=FOLD, **quick)
        blocks.unload(leave)
    blocks.queue(max_size=QUEUE, default_concurrency_limit=1)
    return blocks


def _with_live(studio: Studio, live: LiveStreams) -> SimpleNamespace:
    """Places the page's components in a tab, next to the tab with the stream. Returns them."""
    fps = live.model.representation.fps
    walk = f'data-walk="{WALK}"' if live.can_lead else ""
    with gr.Tabs():
        with gr.Tab("Motion"):
            ui = _layout(studio)
        with gr.Tab("Live"):
            gr.HTML(
                f'<div id="live" class="live" data-fps="{fps:g}" data-stand="{STAND}" {walk}>'
                '<button type="button" class="start">Start a stream</button></div>'
            )
    return ui


def _layout(studio: Studio) -> SimpleNamespace:
    """Places the components of the page in the current `gr.Blocks` and returns them by name."""
    names = list(studio.files)
    model = studio.model(names[0])
    samplers, examples = list(model.process.samplers), _examples(model)
    ui = SimpleNamespace()
    gr.Markdown("# Ask for a motion", elem_id="title")
    ui.examples = gr.HTML(_buttons(examples), elem_id="examples")
    with gr.Row(elem_id="stage"):
        with gr.Column(elem_id="ask"):
            options: dict[str, Any] = {
                "max_length": MAX_TEXT,
                "lines": 2,
                "autofocus": True,
                "elem_id": "text",
            }
            ui.text = gr.Textbox(next(iter(examples)), label="What the person does", **options)
            gr.HTML(EDITORS, js_on_load="editor()")
            label = "Waypoints: meters to the left, meters ahead"
            ui.path = gr.Textbox(
                label=label, placeholder="0,1 0.5,2", max_length=MAX_TEXT, elem_id="path"
            )
            with gr.Row():
                ui.go = gr.Button("Generate", variant="primary", min_width=90, elem_id="go")
                ui.cancel = gr.Button("Cancel", min_width=90)
        with gr.Column(elem_id="show"):
            ui.notes = gr.HTML(elem_id="notes")
            ui.player = gr.HTML(EMPTY, elem_id="player")
            ui.files = gr.HTML(elem_id="files")
        with gr.Column(elem_id="options"):
            with gr.Row():
                # An empty number field would be read as 0.
                ui.seconds = gr.Textbox(
                    label="Seconds", placeholder="automatic", max_length=9, min_width=90
                )
                ui.seed = gr.Number(0, label="Seed", precision=0, min_width=90)
                ui.samples = gr.Number(1, label="Samples", precision=0, min_width=90)
            with gr.Accordion("Model and sampling", open=len(names) > 1):
                ui.model = gr.Dropdown(names, value=names[0], label="Model")
                with gr.Row():
                    number: dict[str, Any] = {
                        "placeholder": "default",
                        "max_length": 9,
                        "min_width": 90,
                    }
                    ui.guidance_scale = gr.Textbox(label="Guidance", **number)
                    ui.num_inference_steps = gr.Textbox(label="Steps", **number)
                    ui.sampler = gr.Dropdown(samplers, value=None, label="Sampler", min_width=120)
                label = "Clean up: smooth the motion and keep feet from sliding (not with a path)"
                ui.cleanup = gr.Checkbox(True, label=label)
                ui.split = gr.Checkbox(True, label="Split a sentence into its actions")
            with gr.Accordion("Words the model knows", open=False):
                ui.words = gr.Markdown(_vocabulary(model))
    with gr.Accordion("Keep a part of this motion, change the rest", elem_id="edit") as ui.edit:
        gr.Markdown("Choose a time, body parts, or both. They change; everything else is kept.")
        ui.chosen = gr.Radio([("1", 0)], value=0, label="Motion to edit", visible=False)
        with gr.Row():
            ui.begin = gr.Textbox(
                label="Change from second", placeholder="start", max_length=9, min_width=120
            )
            ui.end = gr.Textbox(label="to second", placeholder="end", max_length=9, min_width=120)
            ui.parts = gr.Dropdown(
                PARTS, multiselect=True, label="Body parts that change", min_width=220
            )
        with gr.Row():
            ui.new = gr.Textbox(
                label="What the person does there", max_length=MAX_TEXT, scale=3, min_width=220
            )
            ui.again = gr.Number(0, label="Seed", precision=0, min_width=90)
        with gr.Row():
            ui.apply = gr.Button("Change")
            ui.variations = gr.Button("Three variations of the whole motion")
    with gr.Accordion("The same motion as a link and in Python", open=False, elem_id="same"):
        ui.link = gr.Textbox(label="Link", interactive=False, buttons=["copy"], elem_id="link")
        ui.python = gr.Code(
            label="Python", language="python", lines=2, interactive=False, wrap_lines=True
        )
    ui.request = gr.Textbox(visible="hidden", elem_id="request")
    ui.query = gr.Textbox(visible="hidden", elem_id="query")
    return ui


def _result(
    ui: SimpleNamespace, studio: Studio, request: DemoRequest, motions: Sequence[Motion]
) -> dict[Any, Any]:
    kind = studio.model(request.model).conditioned_on
    names = [f"Motion {number + 1}" if len(motions) > 1 else "" for number in range(len(motions))]
    scene = [replace(motion, id=name) for motion, name in zip(motions, names, strict=True)]
    if request.edits:  # the result is shown next to the motion before the last edit
        *before, last = request.edits
        original = studio.motions(request.model_copy(update={"edits": tuple(before)}))[last.motion]
        scene.insert(0, replace(original, id="before", text=f"before: {original.text}"))
    links = ""
    for number, motion in enumerate(motions):
        links += "" if request.edits else _verdicts(names[number], motion)
        address = f"?{escape(request.query())}&amp;motion={number}"
        files = [(f"motion{extension}{address}", name) for extension, name in FORMATS.items()]
        programs = [
            (f"motion.{ending}{address}{rig}", name) for name, (ending, rig) in PROGRAMS.items()
        ]
        rigs = [
            (f"motion{end}{address}&amp;rig={rig}", f"{rig} {end[1:]}")
            for rig in presets()
            for end in RIGGED
        ]
        links += f"<div>{names[number]} For {_links(programs)}</div>"
        links += f"<div>Files {_links(files)}</div>"
        links += f"<details><summary>More</summary><div>{_links(rigs)}</div></details>"
    text = (request.edits[-1].text if request.edits else "") or request.text
    marks = [] if request.edits else [evidence_marks(motion) for motion in scene]
    player = escape(player_page(scene, text or "Motion", marks=marks))
    return {
        ui.player: f'<iframe title="Player" sandbox="allow-scripts allow-downloads" srcdoc="{player}"></iframe>',
        ui.text: request.text,
        ui.notes: _understood(studio, request),
        ui.query: request.query(),
        ui.files: links,
        ui.python: request.python(kind, studio.device),
        ui.chosen: gr.Radio(
            [(str(k + 1), k) for k in range(len(motions))], value=0, visible=len(motions) > 1
        ),
    }


def _verdicts(name: str, motion: Motion) -> str:
    """Returns the referee's verdicts on the claims in a motion's text, or "" if there are none."""
    judgment = try_judge(motion)
    if judgment is None:
        return ""
    lines = "".join(f"<div>{escape(one_line(str(verdict)))}</div>" for verdict in judgment.verdicts)
    summary = f"{name} {judgment.true} of {len(judgment.verdicts)} claims are true".strip()
    return f'<details class="verdicts"><summary>{summary}</summary>{lines}</details>'


def _understood(studio: Studio, request: DemoRequest) -> str:
    """Returns the chips for the text, and messages about the text."""
    notes = "".join(_note("warning", line) for line in studio.advice(request))
    readings, reader = studio.readings(request), studio.reader(request.model)
    if not readings or reader is None:
        return notes
    lines = dict.fromkeys(line for reading in readings for line in reading.changes)
    shown = chips(reader.abilities, read_parts(request.text), readings)
    return shown + "".join(_note("warning", line) for line in lines) + notes


def _refusal(error: NotUnderstood) -> str:
    """Returns the message for a text that contains no action known to the model.

    The actions that are closest in meaning are shown as buttons with pictures.
    """
    message = escape(one_line(error.message))
    if not error.nearest:
        return f'<p class="error" role="alert">{message}. Name an action</p>'
    buttons = _buttons({text: _still(text) for text in error.nearest})
    return (
        f'<p class="error" role="alert">{message}. Nearest in meaning:</p>'
        f'<p class="nearest">{buttons}</p>'
    )


def _still(text: str) -> str:
    """Returns the address of a picture of the action in the text, or "" if there is none."""
    mention = understand(text).mentions[0]
    image = still(mention.action, mention.attributes.get("side"))
    if image is None:
        return ""
    return f"data:image/webp;base64,{b64encode(image).decode()}"


def _note(kind: str, line: str) -> str:
    """Returns a message.

    If the message suggests a text, the suggestion is shown as a button that puts it into the form.
    """
    shown = re.sub(
        r"Did you mean &#x27;(.+?)&#x27;\?$",
        r'<button type="button">\1</button>',
        escape(one_line(line)),
    )
    alert = ' role="alert"' if kind == "error" else ""
    return f'<p class="{kind}"{alert}>{shown}</p>'


def _links(files: Sequence[tuple[str, str]]) -> str:
    return "".join(f'<a href="{address}" download>{name}</a>' for address, name in files)


def _examples(model: MotionGenerator) -> dict[str, str]:
    """Maps texts or actions from the training data to picture addresses ("" = no picture)."""
    if model.conditioned_on == "text" and Reader.fits(model.facts):
        doable = Abilities(model.facts).actions
        return {
            text: _still(text) for text in EXAMPLES if understand(text).mentions[0].action in doable
        }
    texts = list(
        model.facts["actions"]
        if model.conditioned_on == "action"
        else model.facts.get("captions", ())
    )
    return {one_line(text): "" for text in texts[:: max(1, len(texts) // 6)][:6]} or {
        "a person walks": ""
    }


def _buttons(examples: Mapping[str, str]) -> str:
    image = '<img src="{}" alt="">'
    texts = (
        f"{picture and image.format(picture)}{escape(text)}" for text, picture in examples.items()
    )
    return "".join(f'<button type="button">{text}</button>' for text in texts)


def _vocabulary(model: MotionGenerator) -> str:
    words = (
        model.facts["actions"]
        if model.conditioned_on == "action"
        else model.facts.get("vocabulary", ())
    )
    return ", ".join(map(markdown_text, words)) or "The model does not list them."
