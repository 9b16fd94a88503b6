"""The demo in the browser: requests, links, programs that give the same motions, limits, and the page itself."""

import contextlib
import io
import json
import os
import random
import re
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import urllib.error
import urllib.request
from collections import OrderedDict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple
from urllib.parse import parse_qsl, quote, urlencode

import numpy as np
import pytest
from support.browser import browser, in_chromium
from support.fixtures import ROOT
from support.refusals import error_of

from flame_mdm.__main__ import main
from flame_mdm.demo import studio as making
from flame_mdm.demo.live import STAND, WALK
from flame_mdm.demo.request import (
    FAR,
    MAX_EDITS,
    MAX_TEXT,
    MAX_WAYPOINTS,
    DemoEdit,
    DemoRequest,
    checked,
    parse_query,
)
from flame_mdm.errors import UserError
from flame_mdm.formats.retarget import presets
from flame_mdm.sampling.motion_request import USUAL_SECONDS

FAST = {"seconds": 1.0, "num_inference_steps": 3}
EDITED = DemoRequest(
    text="a person walks", samples=2, seed=5, guidance_scale=1.5, sampler="ddim", **FAST,
    edits=(
        DemoEdit(motion=1, text="a person waves", region_seconds=(0.25, 0.75), joints=("left_arm",)),
        DemoEdit(motion=0, text="a person's jump; $HOME", strength=0.6, samples=2, seed=7),
    ),
)  # fmt: skip

PATH = DemoRequest(
    text="a person walks @1 | a person waves", path=((0.4, 0.5), (0.123456789, 1.2)), **FAST
)


def parsed(query: str) -> DemoRequest:
    return parse_query(parse_qsl(query))


def test_a_link_reproduces_its_request_and_names_every_option_that_is_not_left_to_the_model(
    subtests,
):
    for request in (
        DemoRequest(text="a person walks"),
        EDITED,
        PATH,
        DemoRequest(text="ü & = # % + ' \" <b>"),
    ):
        with subtests.test(request=request):
            assert parsed(request.query()) == parsed(request.query() + "&__theme=dark") == request
    sampling = ["guidance_scale", "num_inference_steps", "sampler", "cleanup", "split"]
    keys = ["model", "text", "seconds", "samples", "seed", *sampling, "edit", "edit"]
    assert [key for key, _ in parse_qsl(EDITED.query())] == keys


@pytest.mark.parametrize(
    "options",
    [
        {"guidance_scale": 0.0}, {"seed": 0}, {"cleanup": False, "split": False}, {"text": ""},
        {"guidance_scale": 0.0, "seconds": 0.5, "samples": 1}, {"path": ((0.0, 0.0),)},
    ],
    ids=str,
)  # fmt: skip
def test_values_of_zero_and_false_are_part_of_a_link(options: dict[str, Any]):
    request = DemoRequest(**options)
    assert parsed(request.query()) == request
    values = dict(parse_qsl(request.query()))
    for name, value in options.items():
        assert (name in values) == (value != ""), name


MOST: dict[str, tuple[Any, Any]] = {
    "text": ("x" * 300, "x" * 301),
    "seconds": (30, 30.1),
    "samples": (4, 5),
    "seed": (2**31 - 1, 2**31),
    "num_inference_steps": (1000, 1001),
    "sampler": ("s" * 40, "s" * 41),
    "path": (((20.0, -20.0),) * 16, ((0.0, 0.0),) * 17),
    "edits": ((DemoEdit(motion=3),) * 8, (DemoEdit(),) * 9),
}
LEAST: dict[str, tuple[Any, Any]] = {
    "seconds": (0.001, 0),
    "samples": (1, 0),
    "seed": (0, -1),
    "num_inference_steps": (1, 0),
    "path": (((-20.0, 20.0),), ((0.0, 20.1),)),
    "edits": ((DemoEdit(),), ({"motion": 4},)),
}


@pytest.mark.parametrize("bounds", [MOST, LEAST], ids=["most", "least"])
@pytest.mark.parametrize("name", MOST)
def test_a_request_is_accepted_up_to_its_limits(name: str, bounds: dict[str, tuple[Any, Any]]):
    accepted, refused = bounds.get(name, MOST[name])
    assert getattr(DemoRequest(**{name: accepted}), name) == accepted
    with pytest.raises(ValueError, match="1 validation error"):
        DemoRequest(**{name: refused})


def test_a_variation_of_a_motion_keeps_its_text_and_path_and_the_last_step_is_cleaned_up():
    variation = DemoEdit(motion=1, strength=0.5, seed=3)
    part = DemoEdit(motion=2, region_seconds=(0.5, 1.0), strength=0.5)
    request = DemoRequest(text="walks", samples=3, seed=9, split=False, edits=(variation, part))
    first = {"texts": "walks", "split": False, "samples": 3, "seed": 9}
    steps = request.steps("text")
    assert steps[0] == (None, first)
    assert steps[1] == (1, {"texts": "walks", "strength": 0.5, "samples": 1, "seed": 3})
    region = {"region_seconds": [0.5, 1.0], "strength": 0.5, "samples": 1, "seed": 0}
    assert steps[2] == (2, {**region, "cleanup": True})
    led = DemoRequest(text="walks", path=((0.0, 1.0),), edits=(variation,)).steps("text")
    assert led[1][1]["targets"] == led[0][1]["targets"]
    assert "cleanup" not in led[1][1]
    assert led[0][1]["seconds"] == 3
    assert "cleanup" not in DemoRequest(text="walks", cleanup=False).steps("text")[0][1]
    assert "texts" not in DemoRequest(text="walks").steps("none")[0][1]
    assert DemoRequest(text="walks").steps("action")[0][1]["actions"] == "walks"


def test_waypoints_are_reached_at_a_constant_speed_just_before_the_end():
    request = DemoRequest(
        text="a person walks @4 | a person waves", seconds=1.2, path=((0.0, 3.0), (1.0, 3.0))
    )
    points = request.targets("text")["root"]
    assert points == [{"time": 3.75, "position": [0.0, 3.0]}, {"time": 5.0, "position": [1.0, 3.0]}]
    assert request.targets("none")["root"][1]["time"] == 1.0  # the text is not used: no parts
    assert parsed("path=0,3 1,3") == DemoRequest(path=((0, 3), (1, 3)))


BAD = {
    "seconds=-1": "seconds=-1: input should be greater than 0", "seconds=nan": "seconds=nan",
    "seconds=0.01": "too short", "seconds=20": "20 seconds (400 frames) cannot be sampled",
    "seconds=1e9": "seconds=1e9: input should be less than or equal to 30",
    "samples=5": "samples=5: input should be less than or equal to 4", "samples=1.5": "samples=1.5",
    "seed=99999999999999999999": "seed=99999999999999999999", "seed=1&seed=2": "seed is given twice",
    "num_inference_steps=1000000": "num_inference_steps=1000000", "num_inference_steps=400": "400",
    "guidance_scale=NaN": "guidance_scale=NaN", "cleanup=maybe": "cleanup=maybe",
    "sampler=../../etc": "unknown sampler '../../etc'. Available for GaussianDiffusion: ancestral",
    "model=/etc/passwd": "unknown model '/etc/passwd'", "model=packige": "Did you mean package?",
    "text=": "the text is empty", "text=walks+|": "part 2 is empty", "text=" + quote("a\x00b\x1b[31m"): "text=",
    "text=walks+@600+|+waves": "the parts are too long. Use at most 30 seconds in total",
    "text=walks+@20+|+waves+@20": "the parts are too long. Use at most 30 seconds in total",
    "text=walks+|+waves+|+sits&seconds=11": "the parts are too long. Use at most 30 seconds in total",
    f"text={'x' * 100_000}": "string should have at most 300 characters",
    "text=walks+%E2%80%AEkcab": "string should match", "file=/etc/passwd": "unknown option file",
    "path=0,nan": "path.0.1=nan: input should be a finite number",
    "path=0,1+20.5,0": "path.1.0=20.5: input should be less than or equal to 20",
    "path=0,1+2": "path=0,1 2: expected waypoints as x,z in meters", "path=0,x": "path=0,x: expected waypoints as x,z",
    "path=0,19": "root[0]: 19.0 m from the start in 0.8 seconds is too far",
    "path=" + "+".join(["0,1"] * 17): "should have at most 16 items",
    "edit=<script>alert(1)</script>": "edit=<script>", "edit=" + "[" * 5000: "edit=",
    "edit=" + quote('{"region_seconds": [0.5, NaN]}'): "edits.0.region_seconds.1",
    "edit=" + quote('{"region_seconds": [0.7, 0.2]}'): "is not a range",
    "edit=" + quote('{"joints": ["tail"]}'): "edits.0.joints.0=tail",
    "edit=" + quote('{"motion": 3, "strength": 0.5}'): "there are 1 motions",
    "edit=" + quote('{"path": "/etc/passwd"}'): "unknown option", "edit={}": "no part of the motion is kept",
    "&".join(["edit=" + quote('{"strength": 0.5}')] * (MAX_EDITS + 1)): "edits=",
}  # fmt: skip


def query_of(bad: str) -> str:
    keys = {key for key, _ in parse_qsl(bad, keep_blank_values=True)}
    rest = {"text": "a person walks", **FAST}
    return "&".join(
        [bad, urlencode({key: value for key, value in rest.items() if key not in keys})]
    )


@pytest.fixture(scope="module")
def studio() -> making.Studio:
    return making.Studio(["package"], "cpu")


def test_the_python_lines_and_the_files_give_the_same_motions(
    studio, tmp_path, monkeypatch, subtests
):
    monkeypatch.chdir(tmp_path)
    for request in (
        PATH.model_copy(update={"edits": (DemoEdit(strength=0.5, samples=2),)}),
        EDITED,
    ):
        with subtests.test(path=request.path):
            ours, names = studio.motions(request), dict[str, Any]()
            exec(request.python("text", "cpu"), names)
            for motion, program in zip(ours, names["motions"], strict=True):
                assert motion.cleanup == (not request.path)
                np.testing.assert_array_equal(motion.joints, program.joints)
            assert studio.file(request, 0, ".bvh") == Path("motion.bvh").read_bytes()
    with np.load(io.BytesIO(studio.file(EDITED, 1, ".npz"))) as file:
        np.testing.assert_array_equal(file["joints"], ours[1].joints)
    assert all(studio.file(EDITED, 1, ".bvh", rig).startswith(b"HIERARCHY") for rig in presets())
    for rig in ("unreal", "unity", "mixamo"):
        with subtests.test(rig=rig):
            assert studio.file(EDITED, 1, ".fbx", rig).startswith(b"Kaydara FBX Binary")
    for wrong, says in (
        ((2, ".bvh"), "there are 2 motions"),
        ((0, ".exe"), "this format is not available"),
        ((0, ".bvh", "no"), "no"),
    ):
        with subtests.test(wrong=wrong, says=says), pytest.raises(UserError, match=says):
            studio.file(EDITED, *wrong)


def test_a_request_stops_within_a_step_and_the_next_one_runs(studio, monkeypatch):
    stop, seen, request = threading.Event(), [], DemoRequest(text="a person walks", seconds=1)

    def report(calls: int) -> None:
        seen.append(calls)
        if calls == 5:
            stop.set()

    with pytest.raises(UserError, match="canceled"):
        studio.motions(request, report, stop)
    assert seen == [0, 1, 2, 3, 4, 5]
    assert len(studio.motions(request)) == 1
    monkeypatch.setattr(making, "TIME_LIMIT", -1.0)
    with pytest.raises(UserError, match="stopped after"):
        studio.motions(request.model_copy(update={"seed": 1}))


@pytest.mark.parametrize(
    ("request_", "text", "captions", "advice"),
    [
        (
            DemoRequest(text="a man walks forward, then jumps moonily"),
            "a man walks forward | jumps moonily",
            ["a person walks forward", "a person jumps"],
            [],  # the reading has the words that are ignored
        ),
        (
            DemoRequest(text="a man walks forward, then jumps moonily", split=False),
            "a man walks forward, then jumps moonily",
            [],
            ["never seen in training: moonily. Did you mean 'a man slowly walks forward'?"],
        ),
        (
            DemoRequest(text="a person walks @1 | waves"),
            "a person walks @1 | waves",
            ["a person walks forward", "a person waves"],
            [],
        ),
        (
            DemoRequest(text="walks", split=False, edits=(DemoEdit(text="a person glorps"),)),
            "walks",
            [],
            ["never seen in training: glorps."],
        ),
        (DemoRequest(text=""), "", [], []),
    ],
)
def test_a_sentence_becomes_parts_that_are_read_unless_it_stays_as_it_is(
    studio, request_: DemoRequest, text: str, captions: list[str], advice: list[str]
):
    understood = studio.understood(request_)
    assert understood == request_.model_copy(update={"text": text})
    read = [caption for reading in studio.readings(understood) for caption in reading.captions]
    assert read == captions
    assert studio.advice(understood) == advice


def test_motions_that_were_used_longest_ago_are_forgotten_first(studio, monkeypatch):
    seeds = list[int]()
    monkeypatch.setattr(making, "KEPT", 2)
    monkeypatch.setattr(making, "generate", lambda model, **keys: seeds.append(keys["seed"]) or [])
    monkeypatch.setattr(studio, "_made", OrderedDict())
    for seed in (1, 2, 1, 3, 1, 2):
        studio.motions(DemoRequest(text="a person walks", seed=seed))
    assert seeds == [1, 2, 3, 2]


def test_the_command_offers_the_first_model_with_each_adapter(monkeypatch):
    served = list[tuple[Any, ...]]()
    app = SimpleNamespace(serve=lambda *values: served.append(values))
    monkeypatch.setitem(sys.modules, "flame_mdm.demo.app", app)
    monkeypatch.setattr("flame_mdm.commands.demo.find_spec", bool)
    words = ["adapter=x.safetensors y.safetensors", "port=8000", "hosts=a.example b.example"]
    assert main(["demo", "ckpt=one two", *words, "host=0.0.0.0", "device=cpu"]) == 0
    sources = ["one", "two", "one + x.safetensors", "one + y.safetensors"]
    assert served == [(sources, "0.0.0.0", 8000, "cpu", ["a.example", "b.example"])]


def test_parts_that_are_too_long_for_the_page_are_not_read(studio):
    with pytest.raises(UserError, match="the parts are too long"):
        studio.understood(DemoRequest(text="walks @20 | waves @11"))


def test_refusals_of_files_name_no_temporary_folder(studio, subtests):
    request = DemoRequest(text="a person walks", **FAST)
    studio.motions(request)
    for extension in (".npz", ".mp4"):
        with subtests.test(extension=extension):
            with pytest.raises(UserError) as error:
                studio.file(request, 0, extension, "unreal")
            assert str(error.value).startswith(f"motion{extension}")
            assert tempfile.gettempdir() not in str(error.value)


def test_an_invalid_origin_is_refused(subtests):
    guard = pytest.importorskip("flame_mdm.demo.guard", reason="gradio is not installed")
    headers = pytest.importorskip("starlette.datastructures").Headers
    checked = guard.Guard(None, (), {}, bool)
    checked._check_sender(headers({"host": "localhost", "origin": "http://localhost"}), "/")
    for origin in ("http://[", "http://[::1", "[", "null"):
        with subtests.test(origin=origin), pytest.raises(guard.HTTPException, match="another site"):
            checked._check_sender(headers({"host": "localhost", "origin": origin}), "/")


def test_a_wrong_port_and_a_missing_package_are_one_line(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gradio", None)
    assert error_of(capsys, "demo", "port=99999").startswith(
        "error: port=99999: expected a number from 0 to 65535"
    )
    assert (
        error_of(capsys, "demo")
        == 'error: the demo requires the gradio package. Run pip install "flame-mdm[demo]"'
    )


INSIDE = """
import json
from starlette.testclient import TestClient
import flame_mdm.demo.app as demo
import flame_mdm.demo.studio as kept
from test_demo import EDITED, body_of

demo.SESSIONS, kept.KEPT, studio = 16, 16, demo.Studio(["package"], "cpu")
demo.Studio = lambda *words: studio  # for the server that starts below
app = demo.web_app(studio)
gradio = next(route for route in app.app.routes if route.path == "").app
halt = next(number for number, (path, _) in app.calls.items() if "predict" in path)
studio.motions(EDITED)
with TestClient(app, "http://localhost") as client, studio._working:
    requests = EDITED, EDITED.model_copy(update={"seed": 6})
    files = [client.get(f"/motion.npz?{request.query()}") for request in requests]
    rigs = [client.get(f"/motion.bvh?{EDITED.query()}{rig}") for rig in ("", "&rig=unreal", "&rig=unity")]
    names = [answer.headers["content-disposition"] for answer in rigs]
    for number in range(demo.SESSIONS + 20):
        body = json.loads(body_of(halt, session=f"s{number}"))
        answer = client.post("/gradio_api/run/predict", json=body)
        assert answer.status_code == 200, answer.text
own = [route.path for route in gradio.routes if hasattr(route, "path")]
groups = [group.original_router for group in gradio.routes if hasattr(group, "original_router")]
api = [route.path for group in groups for route in group.routes]
routes = sorted({*own, *(path if path.startswith("/gradio_api") else f"/gradio_api{path}" for path in api)})
sessions = [len(gradio.state_holder.session_data), demo.SESSIONS]
statuses = [file.status_code for file in files]
print(json.dumps({"routes": routes, "sessions": sessions, "files": statuses, "names": names}), flush=True)
"""
NORMAL = (
    "from flame_mdm.__main__ import main; sys.exit(main(['demo', 'port=0', 'hosts=demo.example']))"
)


class Server(NamedTuple):
    address: str
    process: int
    # Facts about a demo in the same process that is not served.
    inside: dict[str, Any]


@pytest.fixture(scope="module")
def normal(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A demo, which ends by a signal while a page is open; no request of the tests below makes it print a traceback."""
    pytest.importorskip("gradio", reason="gradio is not installed")
    errors = tmp_path_factory.mktemp("demo") / "errors"
    words = [sys.executable, "-c", f"import sys; {INSIDE}{NORMAL}"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(ROOT), str(ROOT / "tests")])}
    with (
        errors.open("w") as file,
        subprocess.Popen(
            words, stdout=subprocess.PIPE, stderr=file, text=True, cwd=ROOT, env=environment
        ) as running,
    ):
        assert running.stdout is not None
        inside = json.loads(running.stdout.readline())
        address = running.stdout.readline().split()[0]
        try:
            yield Server(address, running.pid, inside)
            with urllib.request.urlopen(f"{address}/gradio_api/heartbeat/open"):
                running.send_signal(signal.SIGTERM)
                assert running.wait(20) in (143, -signal.SIGTERM)
        finally:
            running.kill()
    assert "Traceback" not in (printed := errors.read_text()), printed[-3000:]


@pytest.fixture
def server(normal) -> str:
    return normal.address


def get(address: str, data: bytes | None = None, **headers: str) -> tuple[int, bytes]:
    headers = {key.replace("_", "-"): value for key, value in headers.items()}
    headers |= {"Content-Type": "application/json"} if data else {}
    try:
        with urllib.request.urlopen(
            urllib.request.Request(address, data, headers), timeout=120
        ) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def body_of(function: int, *data: Any, session: str = "") -> bytes:
    session = session or f"s{random.getrandbits(40)}"
    call = {
        "data": data,
        "event_data": None,
        "fn_index": function,
        "trigger_id": None,
        "session_hash": session,
    }
    return json.dumps(call).encode()


def generated(server: str, query: str, session: str = "") -> list[Any]:
    """Outputs of the page for a query string."""
    session = session or f"s{random.getrandbits(40)}"
    config = re.findall(
        r"window.gradio_config = (\{.*?\});</script>", get(server)[1].decode(), re.DOTALL
    )[0]
    functions = json.loads(config)["dependencies"]
    show = next(function["id"] for function in functions if len(function["outputs"]) == 7)
    status, body = get(f"{server}/gradio_api/queue/join", body_of(show, query, session=session))
    assert status == 200, body
    _, stream = get(f"{server}/gradio_api/queue/data?session_hash={session}")
    output = json.loads(re.findall(rb"^data: (.*process_completed.*)$", stream, re.MULTILINE)[-1])[
        "output"
    ]
    assert "data" in output, (query[:200], output)
    return output["data"]


@pytest.mark.parametrize(
    ("query", "seconds"),
    [
        ("text=walks+@10+|+waves+@20", 30),
        ("text=walks+@20+|+waves+@20", 40),
        ("text=walks+|+waves+|+sits&seconds=11", 33),
    ],
)
def test_the_parts_of_a_text_are_limited_in_total(query: str, seconds: int):
    request = parsed(query)
    if seconds <= 30:
        making.check_length(request)
        return
    with pytest.raises(
        UserError, match=r"the parts are too long\. Use at most 30 seconds in total"
    ):
        making.check_length(request)


@pytest.mark.slow
def test_a_bad_request_gets_one_clear_line(server):
    wrong = []
    for bad, words in BAD.items():
        if len(query := query_of(bad)) > 15_000:
            continue
        notes = generated(server, query)[1]
        text = (
            re.sub("<[^>]*>", "", notes)
            .replace("&lt;", "<")
            .replace("&gt;", ">")
            .replace("&#x27;", "'")
        )
        one = notes.count("<p") == 1 and 'class="error" role="alert"' in notes and len(text) < 300
        if not one or words not in text or re.search(r"<(script|b|img)\b", notes):
            wrong.append((bad[:40], text[:300]))
        status, body = get(f"{server}/motion.bvh?{query}")
        if status != 400 or not (
            body.decode() in text or text in body.decode() or b"no longer in memory" in body
        ):
            wrong.append((bad[:40], body[:300]))
    assert not wrong


def test_a_sentence_becomes_parts_and_a_suggestion_a_button(server):
    request = DemoRequest(text="a person walks. Then she waves the lefft hand", **FAST)
    _, notes, query, *_, text = generated(server, request.query())
    assert text == parsed(query).text == "a person walks | she waves the lefft hand"
    assert "&#x27;lefft&#x27; is read as &#x27;left&#x27;" in notes
    assert (
        '<option value="a person walks | a person waves with the left hand" selected>left</option>'
        in notes
    )
    assert (
        '<option value="a person walks | a person waves with the right hand">right</option>'
        in notes
    )
    assert ">walks</option>" in notes, "the chip beside it says the direction"
    _, notes, *_, text = generated(server, request.model_copy(update={"split": False}).query())
    assert text == request.text
    refused = generated(server, query_of("text=asdf+qwer"))[1]
    assert "no word says what happens. Name an action" in refused
    refused = generated(server, query_of("text=a+person+on+a+shelf"))[1]
    assert "no word says what happens. Nearest in meaning:" in refused
    assert refused.count('<button type="button"><img src="data:image/webp;base64,') == 3


@pytest.mark.slow
def test_no_function_and_no_route_opens_a_file(normal, tmp_path):
    """Every function of the page and every route of gradio gets payloads that name files."""
    (tmp_path / "secret.txt").write_text("TOP SECRET")
    opened, routes = [], normal.inside["routes"]
    assert len(routes) > 60, routes
    for path in (str(tmp_path / "secret.txt"), "/dev/zero"):
        file = {"path": path, "meta": {"_type": "gradio.FileData"}, "orig_name": "x", "url": path}
        posts = [("/gradio_api/run/predict", body_of(number, file)) for number in range(30)]
        posts += [("/gradio_api/queue/join", body_of(number, [file])) for number in range(30)]
        posts += [("/gradio_api/run/predict", body_of(6, json.dumps(file)))]
        gets = []
        for route in routes:
            named = re.sub(r"\{(path|path_or_url|url_path)(:path)?\}", path, route)
            named = re.sub(r"\{(\w+)(:\w+)?\}", "generate", named)
            posts.append(
                (
                    named,
                    json.dumps(
                        {"data": [file], "fn_index": 6, "session_hash": "s", **file}
                    ).encode(),
                )
            )
            if "heartbeat" not in route and "{" in route:
                gets.append((named, None))
        for route, data in [*posts, *gets]:
            status, body = get(f"{normal.address}{quote(route)}", data)
            if (
                status not in (400, 404)
                or b"SECRET" in body
                or b"root:" in body
                or path.encode() in body
            ):
                opened.append(f"{status} {route} {data} {body[:100]!r}")
    assert opened == []
    assert "<iframe" in generated(normal.address, query_of("seed=3"))[0]


def test_requests_of_other_sites_and_for_other_names_are_refused(server, subtests):
    motion = f"{server}/motion.npz?{EDITED.query()}"
    assert get(server, Host="evil.example")[0] == get(motion, Host="evil.example:80")[0] == 421
    assert get(server, Host="localhost:1")[0] == 200
    assert get(server, Host="demo.example", Origin="https://demo.example")[0] == 200
    for origin in ("http://evil.example", "null", "http://127.0.0.1:1"):
        with subtests.test(origin=origin):
            assert get(server, Origin=origin)[0] == 403
    assert (
        get(motion, Sec_Fetch_Site="cross-site")[0]
        == get(motion, Sec_Fetch_Site="same-site")[0]
        == 403
    )
    assert get(server, Sec_Fetch_Site="cross-site", Origin=server)[0] == 200  # a link to the page


@pytest.mark.parametrize(
    "address",
    [
        "gradio_api/queue/data?session_hash=x%00",
        "gradio_api/queue/data?session_hash=nobody",
        "gradio_api/queue/data?session_hash=a&session_hash=b",
        "gradio_api/queue/data",
        "assets/" + "a" * 300,
        "static/" + "%C3%A9" * 90,
        "assets/" + "/".join(["a"] * 3000),
        "motion.npz?" + "&".join(f"a{number}=1" for number in range(60)),
        "gradio_api/heartbeat/%C3%A9",
    ],
    ids=lambda address: address[:40],
)
def test_an_address_that_the_page_does_not_use_gets_one_line(server, address):
    status, body = get(f"{server}/{address}")
    assert status in (400, 404)
    assert body.decode() in (
        "this page has nothing at that address",
        "this page has no such session. Reload it",
        "the link has 60 options. Use at most 50",
    )


def test_a_link_with_too_many_options_is_refused_on_the_page(server):
    notes = generated(server, "&".join(f"a{number}=1" for number in range(51)))[1]
    assert "the link has 51 options. Use at most 50" in notes


def test_bodies_are_counted_as_they_arrive(server, subtests):
    host, port = server.removeprefix("http://").split(":")
    head, sent = (
        f"POST /gradio_api/queue/join HTTP/1.1\r\nHost: {host}\r\nTransfer-Encoding: chunked\r\n\r\n",
        0,
    )
    with socket.create_connection((host, int(port)), timeout=60) as connection:
        connection.sendall(head.encode())
        with contextlib.suppress(OSError):  # the server closes the connection
            while sent < 300:
                connection.sendall(b"%x\r\n%s\r\n" % (2**20, b"x" * 2**20))
                sent += 1
    assert sent < 30, f"the server read {sent} MiB"
    for route, size, status in (("queue/join", 70_000, 413), ("upload", 10, 404)):
        with subtests.test(route=route, size=size, status=status):
            assert get(f"{server}/gradio_api/{route}", b"x" * size)[0] == status


def test_files_come_from_memory_while_the_model_works_and_old_sessions_are_forgotten(normal):
    assert normal.inside["files"] == [200, 400]
    assert normal.inside["sessions"][0] == normal.inside["sessions"][1]


def test_downloads_are_named_after_their_rig(normal):
    names = [
        f'attachment; filename="a-person-walks-1{rig}.bvh"' for rig in ("", "-unreal", "-unity")
    ]
    assert normal.inside["names"] == names


@pytest.mark.slow
def test_requests_from_eight_clients_are_answered_in_constant_memory(normal):
    def ask(number: int) -> bool:
        request = DemoRequest(text="a person walks", seed=number, samples=2, **FAST)
        player, notes, query, *_ = generated(normal.address, request.query())
        return "<iframe" in player and "warning" not in notes and parsed(query) == request

    def resident() -> int:
        return int(
            re.findall(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{normal.process}/status").read_text())[0]
        )

    with ThreadPoolExecutor(8) as clients:
        assert all(clients.map(ask, range(16)))  # fills the memory of results
        before = resident()
        assert all(clients.map(ask, range(100, 116)))
    assert resident() - before < 16_000, "a MiB per request"


LINKS = "[...document.querySelectorAll('#files a')]"


@in_chromium
def test_a_person_uses_the_page(server, tmp_path, subtests):
    with browser(tmp_path / "profile") as tab:
        tab.open(server)
        tab.wait("document.querySelectorAll('#player iframe').length === 1", 60)
        tab.type("#ask textarea", "a person waves with the right hand")
        click(tab, "Generate")
        link = tab.wait("location.search.includes('right') && location.href")
        files = tab.run(f"Object.fromEntries({LINKS}.map(a => [a.text, a.href]))")
        programs = [
            f"{name} {kind}" for name in ("Unreal", "Unity", "Mixamo") for kind in ("FBX", "GLB")
        ]
        assert list(files)[:12] == ["Blender", *programs, "BVH", "FBX", "GLB", "NPZ", "MP4"]
        shown = joints_of(files["NPZ"])
        assert shown.shape == (60, 22, 3)

        tab.type("#edit [placeholder=start]", "1.5")
        click(tab, "Change")
        edited = tab.wait("location.search.includes('edit=') && location.href")
        both = "h.includes('.npz') && h.includes('edit=')"
        after = joints_of(tab.wait(f"{LINKS}.map(a => a.href).find(h => {both})"))
        assert np.abs(after[:24] - shown[:24]).max() < 0.1
        assert np.abs(after[36:] - shown[36:]).max() > 0.2

        for address, expected in ((link, shown), (edited, after)):  # a link gives the same motion
            with subtests.test(address=address, expected=expected):
                tab.open("about:blank")
                tab.open(address)
                query = tab.wait("document.querySelector('#files a')?.href").partition("?")[2]
                assert (
                    tab.run("document.querySelector('#ask textarea').value")
                    == "a person waves with the right hand"
                )
                np.testing.assert_array_equal(joints_of(f"{server}/motion.npz?{query}"), expected)
        assert [
            url for url in tab.requested if not url.startswith((server, "data:", "blob:", "about:"))
        ] == []
        assert tab.errors == []
        tab.size(390, 844)
        tab.open(link)
        tab.wait(
            "document.querySelectorAll('#examples img').length > 8 && !!document.querySelector('#files a')",
            60,
        )
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")
        example = tab.run("document.querySelectorAll('#examples button')[3].textContent")
        tab.click("#examples button:nth-child(4)")
        tab.wait(f"new URLSearchParams(location.search).get('text') === {json.dumps(example)}")


@in_chromium
def test_a_person_writes_a_sequence_in_rows_and_draws_a_path(server, tmp_path):
    text = "document.querySelector('#text textarea').value"
    with browser(tmp_path / "profile") as tab:
        tab.open(f"{server}/?{urlencode({'text': 'a person walks', **FAST})}")
        tab.wait("!!document.querySelector('#files a')", 60)
        click(tab, "+ Add an action")
        tab.send("Input.insertText", text="a person stands")
        tab.type("[aria-label='Seconds of action 1']", "2")
        assert tab.run(text) == "a person walks @2 | a person stands"
        tab.type("#text textarea", "a person walks @1.5 | <b> | stands @2")
        rows = "[...document.querySelectorAll('#parts .part')]"
        values = f"{rows}.map(row => [...row.querySelectorAll('input')].map(input => input.value))"
        tab.wait(f"{rows}.length === 3")
        assert tab.run(values) == [["a person walks", "1.5"], ["<b>", ""], ["stands", "2"]]
        for left in (2, 0):  # a single action needs no row
            tab.click("[aria-label='Remove action 2']")
            tab.wait(f"{rows}.length === {left}")
        assert tab.run(text) == "a person walks @1.5"

        tab.click("#floor summary")
        tab.wait("document.querySelector('#floor output')?.textContent.includes('Click to add')")
        for right, down in ((0.4, 0.49), (0.45, 0.4), (0.6, 0.45)):
            tab.run("document.querySelector('#floor svg').scrollIntoView({block: 'center'})")
            box = "document.querySelector('#floor svg').getBoundingClientRect()"
            x, y, width, height = tab.run(f"(r => [r.x, r.y, r.width, r.height])({box})")
            for kind in ("mousePressed", "mouseReleased"):
                at = {"x": x + right * width, "y": y + down * height}
                tab.send("Input.dispatchMouseEvent", type=kind, **at, button="left", clickCount=1)
        tab.click("[data-point='2'] circle")  # removes it
        tab.wait("document.querySelectorAll('#floor circle').length === 2")
        drawn = tab.run("document.querySelector('#path textarea, #path input').value")
        assert drawn == "0.6,0.8 0.3,1.2"  # the view: x from 3 (left) to -3, z from 3 (top) to -1.5
        click(tab, "Generate")
        tab.wait("location.search.includes('path=')")
        address = tab.wait(f"{LINKS}.map(a => a.href).find(h => /npz.*path=/.test(h))")
        end = joints_of(address)[round(20 * (1.5 - 0.2)), 0, [0, 2]]
        np.testing.assert_allclose(end, [0.3, 1.2], atol=0.03)
        click(tab, "Clear")
        tab.wait("!document.querySelector('#floor circle')")
        assert tab.errors == []


def click(tab: Any, label: str) -> None:
    tab.run(
        f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(label)}).click()"
    )


def joints_of(address: str) -> np.ndarray:
    with np.load(io.BytesIO(get(address)[1])) as content:
        return content["joints"]


def test_a_variation_may_have_a_text_of_its_own_and_sentences_are_split_in_the_first_step_alone():
    other = DemoEdit(strength=0.5, text="waves", samples=2)
    new = DemoEdit(region_seconds=(0.0, 0.5), text="")
    options = {"guidance_scale": 0.0, "num_inference_steps": 7, "sampler": "ddim"}
    request = DemoRequest(text="walks", seconds=2.5, split=False, edits=(other, new), **options)
    assert request.steps("text") == [
        (None, {"texts": "walks", "seconds": 2.5, "split": False, "samples": 1, "seed": 0, **options}),
        (0, {"texts": "waves", "strength": 0.5, "samples": 2, "seed": 0, **options}),
        (0, {"region_seconds": [0.0, 0.5], "samples": 1, "seed": 0, **options, "cleanup": True}),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("seconds", "total"), [(None, 1.5 + 3 + 3), (2.0, 1.5 + 2 + 2), (0.25, 1.5 + 0.5)]
)
def test_parts_last_as_long_as_they_state_or_as_the_field_says_or_three_seconds(seconds, total):
    parts = [("walks", 1.5), ("waves", None), ("sits", None)]
    assert DemoRequest(seconds=seconds).total_seconds(parts) == total


def test_the_program_loads_the_adapter_onto_the_device_and_edits_the_chosen_motion():
    request = DemoRequest(
        model="base + styles.safetensors",
        text="walks",
        cleanup=False,
        edits=(DemoEdit(motion=2, joints=("arms",)),),
    )
    assert request.python("text", "cuda").splitlines() == [
        "import flame_mdm",
        "",
        "model = flame_mdm.load('base', 'cuda', adapter='styles.safetensors')",
        "motions = flame_mdm.generate(model, texts='walks', samples=1, seed=0)",
        "motions = flame_mdm.edit(model, motions[2], joints=['arms'], samples=1, seed=0)",
        'motions[0].save("motion.bvh")  # or .glb, .npz, .mp4',
    ]
    plain = DemoRequest(model="base").python("none", "cpu").splitlines()
    assert plain[2:4] == [
        "model = flame_mdm.load('base')",
        "motions = flame_mdm.generate(model, samples=1, seed=0, cleanup=True)",
    ]


def test_empty_fields_are_left_to_the_model_and_zeros_are_not():
    fields = {"text": "walks", "seconds": "", "sampler": None, "guidance_scale": 0, "seed": "0"}
    assert checked(fields) == DemoRequest(text="walks", guidance_scale=0.0, seed=0)
    with pytest.raises(UserError, match=r"^samples=0: input should be greater than or equal to 1"):
        checked({"samples": 0})


def test_messages_are_escaped_and_suggest_texts_as_buttons():
    pytest.importorskip("gradio", reason="gradio is not installed")
    from flame_mdm.conditions.language.reading import NotUnderstood
    from flame_mdm.demo.studio_page import PROGRAMS, _buttons, _links, _note, _refusal, _still

    line = "never seen in training: <b>. Did you mean 'a man walks'?"
    assert _note("warning", line) == (
        '<p class="warning">never seen in training: &lt;b&gt;. '
        '<button type="button">a man walks</button></p>'
    )
    assert _note("error", "too long") == '<p class="error" role="alert">too long</p>'
    assert _refusal(NotUnderstood("'<x>': no word says what happens", ())) == (
        '<p class="error" role="alert">&#x27;&lt;x&gt;&#x27;: no word says what happens. '
        "Name an action</p>"
    )
    nearest = ("a person kicks with the left leg", "a person jumps")
    shown = _refusal(NotUnderstood("no", nearest))
    assert re.findall(r"<button type=\"button\"><img[^>]*>([^<]*)</button>", shown) == list(nearest)
    left, right = (_still(f"a person kicks with the {side} leg") for side in ("left", "right"))
    assert left.startswith("data:image/webp;base64,")
    assert left != right
    assert left in shown
    assert _buttons({"<walk>": ""}) == '<button type="button">&lt;walk&gt;</button>'
    assert _links([("motion.bvh?a", "BVH")]) == '<a href="motion.bvh?a" download>BVH</a>'
    for name, (ending, rig) in PROGRAMS.items():
        program, *written = name.lower().split()
        assert rig == ("" if program == "blender" else f"&amp;rig={program}")
        assert ending == (written[0] if written else "glb")
        assert program == "blender" or program in presets()


def test_the_page_and_the_server_have_the_same_limits():
    page, live = ((ROOT / "flame_mdm" / "demo" / name).read_text() for name in ("page.js", "live.js"))  # fmt: skip
    numbers = {
        name: float(value)
        for text in (page, live)
        for name, value in re.findall(r"\b([A-Z][A-Z_]+) = (\d+(?:\.\d+)?)\b", text)
    }
    assert numbers == {
        **{"FAR": FAR, "STRENGTH": 0.5, "SAMPLES": 3, "MOST_POINTS": MAX_WAYPOINTS},
        **{"AHEAD": 1, "SLOW": 0.15, "EASE": 0.15, "LEAD": 0.25, "STEP": 0.1},
        **{"CHIPS": 6, "SPARE": 1.4, "TIMED": 5},
    }
    assert f'maxlength="{MAX_TEXT}"' in live
    assert page.count(f"|| {USUAL_SECONDS:g}") == 2  # without a number of seconds
    goes = re.findall(r"const GOES = /(.*)/i;", live)[0]
    assert re.search(goes, WALK)
    assert not re.search(goes, STAND)
    for text in ("she runs", "tiptoe", "crawls", "jogging"):
        assert bool(re.search(goes, text)) == (text != "jogging"), text


def waiting(time: float | None) -> Any:
    """A connection that waits until a time, or one whose request is being answered."""
    closed: list[bool] = []
    deadline = None if time is None else SimpleNamespace(when=lambda: time)
    return SimpleNamespace(deadline=deadline, closed=closed, close=lambda: closed.append(True))


@pytest.mark.parametrize(
    ("times", "limit", "closed", "is_refused"),
    [
        ([3.0, 1.0, 2.0], 4, [], False),
        ([3.0, 1.0, 2.0], 3, [1], False),
        ([3.0, 1.0, 2.0], 2, [1, 2], False),
        ([None, 5.0, None], 3, [1], False),
        ([None, 5.0, None], 2, [1], True),
        ([None, None, None], 3, [], True),
    ],
)
def test_connections_that_have_waited_longest_make_room_for_a_new_one(
    times, limit: int, closed: list[int], is_refused: bool
):
    connections = pytest.importorskip("flame_mdm.demo.connections", reason="uvicorn is missing")
    new, others = waiting(0.5), [waiting(time) for time in times]
    new.limit_concurrency = None
    connections.Connection._make_room(new, [*others, new], limit)
    assert [k for k, other in enumerate(others) if other.closed] == closed
    assert not new.closed
    assert (new.limit_concurrency == 0) == is_refused


def test_the_page_offers_texts_that_the_model_knows_and_lists_its_words():
    pytest.importorskip("gradio", reason="gradio is not installed")
    from flame_mdm.demo.studio_page import EXAMPLES, _examples, _vocabulary

    captions = [f"caption {number}" for number in range(20)]
    facts: dict[str, Any] = {"captions": captions, "actions": ["walk", "<run>"]}
    labeled: Any = SimpleNamespace(conditioned_on="action", facts=facts | {"vocabulary": ["a"]})
    assert _examples(labeled) == {"walk": "", "<run>": ""}
    assert _vocabulary(labeled) == "walk, &lt;run&gt;"
    read: Any = SimpleNamespace(conditioned_on="text", facts=facts | {"vocabulary": ["a", "b"]})
    assert list(_examples(read)) == [captions[number] for number in (0, 3, 6, 9, 12, 15)]
    assert _vocabulary(read) == "a, b"
    unknown: Any = SimpleNamespace(conditioned_on="none", facts={})
    assert _examples(unknown) == {"a person walks": ""}
    assert _vocabulary(unknown) == "The model does not list them."
    words = "a person walks forward runs waves with the left hand jumps twice"
    single = {"actions": ["walk", "wave"], "verbs": ["walks"], "vocabulary": words.split()}
    reader: Any = SimpleNamespace(conditioned_on="text", facts=single)
    assert list(_examples(reader)) == [EXAMPLES[0], EXAMPLES[2]]
    assert all(picture.startswith("data:image/webp") for picture in _examples(reader).values())
