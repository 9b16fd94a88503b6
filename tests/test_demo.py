"""The demo in the browser: requests, links, programs that give the same motions, limits, and the page itself."""

import http.client
import io
import json
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, quote, urlencode

import numpy as np
import pytest
from support.browser import CHROMIUM, browser
from support.fixtures import ROOT

from flame_mdm.__main__ import main
from flame_mdm.demo.request import MAX_EDITS, Change, Request, checked, parse_query
from flame_mdm.errors import UserError
from flame_mdm.formats.readers import read
from flame_mdm.formats.retarget import presets

FAST = {"seconds": 1.0, "num_inference_steps": 3}
EDITED = Request(
    text="a person walks", samples=2, seed=5, guidance_scale=1.5, sampler="ddim", **FAST,
    edits=(
        Change(motion=1, text="a person waves", region_seconds=(0.25, 0.75), joints=("left_arm", "head")[:1]),
        Change(motion=0, text="a person's jump; $HOME", strength=0.6, samples=2, seed=7),
    ),
)  # fmt: skip

PATH = Request(text="a person walks @1 | a person waves", path=((0.4, 0.5), (0.123456789, 1.2)), **FAST)


def parsed(query: str) -> Request:
    return parse_query(parse_qsl(query))


@pytest.mark.parametrize(
    "request_", [Request(text="a person walks"), EDITED, PATH, Request(text="ü & = # % + ' \" <b>")]
)
def test_a_link_reproduces_its_request(request_):
    assert parsed(request_.query()) == request_
    assert parsed(request_.query() + "&__theme=dark") == request_


def test_a_link_names_every_option_that_is_not_left_to_the_model():
    keys = [key for key, _ in parse_qsl(EDITED.query())]
    sampling = ["guidance_scale", "num_inference_steps", "sampler", "cleanup"]
    assert keys == ["model", "text", "seconds", "samples", "seed", *sampling, "edit", "edit"]


def test_way_points_are_reached_at_a_constant_speed_just_before_the_end():
    asked = Request(text="a person walks @4 | a person waves", seconds=1.2, path=((0.0, 3.0), (1.0, 3.0)))
    points = asked.targets("text")["root"]
    assert points == [{"time": 3.75, "position": [0.0, 3.0]}, {"time": 5.0, "position": [1.0, 3.0]}]
    assert asked.targets("none")["root"][1]["time"] == 1.0  # the text is not used: no parts
    assert parsed("path=0,3 1,3") == Request(path=((0, 3), (1, 3)))


BAD = {
    "seconds=-1": "seconds=-1: input should be greater than 0",
    "seconds=nan": "seconds=nan",
    "seconds=inf": "seconds=inf",
    "seconds=1e9": "seconds=1e9: input should be less than or equal to 30",
    "seconds=20": "20 seconds (400 frames) cannot be sampled",
    "seconds=0.01": "too short",
    "seconds=soon": "seconds=soon: input should be a valid number",
    "samples=0": "samples=0",
    "samples=5": "samples=5: input should be less than or equal to 4",
    "samples=1.5": "samples=1.5",
    "seed=-1": "seed=-1",
    "seed=99999999999999999999": "seed=99999999999999999999",
    "num_inference_steps=1000000": "num_inference_steps=1000000",
    "num_inference_steps=400": "400",
    "guidance_scale=NaN": "guidance_scale=NaN",
    "sampler=../../etc": "sampler=../../etc",
    "sampler=euler": "unknown sampler 'euler': GaussianDiffusion has ancestral",
    "model=/etc/passwd": "unknown model '/etc/passwd'",
    "model=quikstart": "Did you mean quickstart?",
    "cleanup=maybe": "cleanup=maybe",
    "text=": "the text is empty",
    "text=walks+@600+|+waves": "the parts are too long: give at most 30 seconds in total",
    "text=walks+|": "part 2 is empty",
    f"text={'x' * 100_000}": "string should have at most 300 characters",
    "text=" + quote("a\x00b\x1b[31m"): "text=",
    "path=0,nan": "path.0.1=nan: input should be a finite number",
    "path=0,1+20.5,0": "path.1.0=20.5: input should be less than or equal to 20",
    "path=0,1+2": "path=0,1 2: give way points as x,z in meters, such as 0,1 0.5,2",
    "path=0,x": "path.0.1=x: input should be a valid number",
    "path=0,19": "root[0]: 19.0 m from the start in 0.8 seconds is impossible",
    "path=" + "+".join(["0,1"] * 17): "should have at most 16 items",
    "file=/etc/passwd": "unknown option file",
    "seed=1&seed=2": "seed is given twice",
    "edit=<script>alert(1)</script>": "edit=<script>",
    "edit=" + "[" * 5000: "edit=",
    "edit=" + quote('{"region_seconds": [0.5, NaN]}'): "edits.0.region_seconds.1",
    "edit=" + quote('{"region_seconds": [0.7, 0.2]}'): "is not a range",
    "edit=" + quote('{"joints": ["tail"]}'): "edits.0.joints.0=tail",
    "edit=" + quote('{"motion": 3, "strength": 0.5}'): "there are 1 motions",
    "edit=" + quote('{"path": "/etc/passwd"}'): "unknown option",
    "edit={}": "no part of the motion is kept",
    "&".join(["edit=" + quote('{"strength": 0.5}')] * (MAX_EDITS + 1)): "edits=",
}  # fmt: skip


def query_of(bad: str) -> str:
    given = {key for key, _ in parse_qsl(bad, keep_blank_values=True)}
    rest = {"text": "a person walks", **FAST}
    return "&".join([bad, urlencode({key: value for key, value in rest.items() if key not in given})])


def test_a_cleared_field_is_left_to_the_default():
    assert checked(Request, {"text": "a person walks", "sampler": "", "seed": None}) == Request(text="a person walks")
    with pytest.raises(UserError, match=r"unknown option seeds\. Did you mean seed"):
        checked(Request, {"seeds": 1})


def test_the_command_lines_and_the_python_lines_give_the_same_motions(tmp_path, monkeypatch):
    from flame_mdm.demo.studio import Studio

    monkeypatch.chdir(tmp_path)
    studio = Studio(["quickstart"], "cpu")
    for asked in (PATH, Request(text="a person walks", **FAST), EDITED):
        ours = studio.motions(asked)
        names: dict[str, Any] = {}
        exec(asked.python("text", "cpu"), names)
        for line in asked.command("text", None).splitlines():
            if line.startswith("echo "):
                subprocess.run(line, shell=True, check=True)
                continue
            program, *words = shlex.split(line)
            assert (program, main(words)) == ("flame-mdm", 0)
        folder = Path(words[-1].removeprefix("out="))
        files = sorted(folder.glob("motion_*.npz"))[len(asked.edits) > 0 :]
        assert len(ours) == len(names["motions"]) == len(files)
        for motion, program, file in zip(ours, names["motions"], files, strict=True):
            assert motion.cleanup == (not asked.path)
            np.testing.assert_array_equal(motion.joints, program.joints)
            np.testing.assert_array_equal(motion.joints, read(file).joints)
        assert Path("motion.bvh").stat().st_size > 1000
    assert not np.array_equal(ours[0].joints, ours[1].joints)


def test_an_edit_keeps_the_rest_of_the_motion():
    from flame_mdm.demo.studio import Studio

    studio = Studio(["quickstart"], "cpu")
    base = Request(text="a person walks", cleanup=False, **FAST)
    before = studio.motions(base)[0]
    change = Change(text="a person waves", region_seconds=(0.5, 1.0))
    after = studio.motions(base.model_copy(update={"edits": (change,)}))[0]
    np.testing.assert_allclose(after.joints[:9], before.joints[:9], atol=1e-4)
    assert np.abs(after.joints[12:] - before.joints[12:]).max() > 0.02


def test_a_request_stops_within_a_step_and_the_next_one_runs():
    from flame_mdm.demo import studio as module

    studio, stop, seen = module.Studio(["quickstart"], "cpu"), threading.Event(), []
    asked = Request(text="a person walks", seconds=1)

    def report(calls: int) -> None:
        seen.append(calls)
        if calls == 5:
            stop.set()

    with pytest.raises(module.Stopped, match="canceled"):
        studio.motions(asked, report, stop)
    assert seen == [0, 1, 2, 3, 4, 5]
    assert len(studio.motions(asked)) == 1
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "TIME_LIMIT", -1.0)
        with pytest.raises(UserError, match="stopped after"):
            studio.motions(asked.model_copy(update={"seed": 1}))


def test_the_demo_refuses_a_wrong_port(capsys):
    assert main(["demo", "port=99999"]) == 1
    assert "port=99999: give a number from 0 to 65535" in capsys.readouterr().err


def test_the_demo_names_the_missing_package(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "gradio", None)
    assert main(["demo"]) == 1
    assert capsys.readouterr().err == 'error: the demo needs the package gradio. Run pip install "flame-mdm[demo]"\n'


@pytest.fixture(scope="module")
def process() -> Iterator[tuple[str, int]]:
    """Address and process id of a demo."""
    pytest.importorskip("gradio", reason="gradio is not installed")
    words = [sys.executable, "-m", "flame_mdm", "demo", "port=0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True, cwd=ROOT) as running:
        assert running.stdout is not None
        address = running.stdout.readline().split()[0]
        try:
            yield address, running.pid
        finally:
            running.send_signal(signal.SIGINT)
            assert running.wait(20) == 130


@pytest.fixture
def server(process) -> str:
    return process[0]


def get(address: str, data: bytes | None = None) -> tuple[int, bytes]:
    head = {"Content-Type": "application/json"} if data else {}
    try:
        with urllib.request.urlopen(urllib.request.Request(address, data, head), timeout=120) as answer:
            return answer.status, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def generated(server: str, query: str) -> list[Any]:
    """Outputs of the page for a query string."""
    _, body = get(f"{server}/gradio_api/call/generate", json.dumps({"data": [query]}).encode())
    _, stream = get(f"{server}/gradio_api/call/generate/{json.loads(body)['event_id']}")
    assert b"event: complete" in stream, stream[-500:]
    return json.loads(re.findall(rb"^data: (.*)$", stream, re.MULTILINE)[-1])


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: bad[:40])
def test_a_bad_request_gets_one_clear_line(server, bad):
    query = query_of(bad)
    notes = generated(server, query)[1]
    assert notes.count("<p") == 1
    assert 'class="error" role="alert"' in notes
    assert not re.search(r"<(script|b|img)\b", notes)
    text = re.sub("<[^>]*>", "", notes).replace("&lt;", "<").replace("&gt;", ">").replace("&#x27;", "'")
    assert BAD[bad] in text
    assert len(text) < 300
    if len(query) < 20_000:  # longer lines are refused by the server itself
        status, body = get(f"{server}/motion.bvh?{query}")
        assert status == 400
        assert body.decode() in text or text in body.decode()


def test_files_outside_of_the_page_are_not_served(server):
    paths = ["gradio_api/file=/etc/passwd", f"gradio_api/file={__file__}", "gradio_api/file=../../etc/passwd"]
    paths += ["../../../etc/passwd", "static/../../../etc/passwd", "motion.py?text=x", "motion../x?text=x"]
    for path in paths:
        status, body = get(f"{server}/{path}")
        assert status in (400, 403, 404), path
        assert b"root:" not in body
    assert get(f"{server}/gradio_api/upload", b"x" * 10)[0] == 413
    connection = http.client.HTTPConnection(server.removeprefix("http://"), timeout=60)
    connection.request("POST", "/gradio_api/call/generate", headers={"Content-Length": "2000000"})
    assert connection.getresponse().status == 413
    connection.close()


def test_fifty_requests_from_eight_clients_are_answered_in_constant_memory(server, process):
    def ask(number: int) -> int:
        asked = Request(text="a person walks", seed=number, samples=2, **FAST)
        player, notes, query, *_ = generated(server, asked.query())
        assert "<iframe" in player
        assert notes == ""
        assert parsed(query) == asked
        return number

    with ThreadPoolExecutor(8) as clients:
        assert len(set(clients.map(ask, range(70)))) == 70  # fills the memory of results
        before = resident(process[1])
        assert len(set(clients.map(ask, range(100, 150)))) == 50
    assert resident(process[1]) - before < 30e6


def resident(process: int) -> int:
    """Bytes of memory of a process."""
    return int(re.findall(r"VmRSS:\s+(\d+) kB", Path(f"/proc/{process}/status").read_text())[0]) * 1024


def test_downloads_are_the_shown_motion(server):
    from flame_mdm.demo.studio import Studio

    motion = Studio(["quickstart"], "cpu").motions(EDITED)[1]
    status, body = get(f"{server}/motion.npz?{EDITED.query()}&motion=1")
    assert status == 200
    with np.load(io.BytesIO(body)) as content:
        np.testing.assert_allclose(content["joints"], motion.joints, atol=1e-5)  # other numbers of threads
    assert get(f"{server}/motion.npz?{EDITED.query()}&motion=2")[0] == 400
    for rig in presets():
        assert get(f"{server}/motion.bvh?{EDITED.query()}&rig={rig}")[1].startswith(b"HIERARCHY")
    assert get(f"{server}/motion.bvh?{EDITED.query()}&rig=no")[0] == 400


def test_several_actions_in_one_text(server):
    asked = Request(text="a person walks @1 | a person waves", **FAST)
    assert generated(server, asked.query())[1] == ""
    with np.load(io.BytesIO(get(f"{server}/motion.npz?{asked.query()}")[1])) as content:
        assert len(content["joints"]) == 40


@pytest.mark.tools
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_person_uses_the_page(server, tmp_path):
    with browser(tmp_path / "profile") as tab:
        tab.open(server)
        tab.wait("document.querySelectorAll('#player iframe').length === 1", 60)
        tab.type("#ask textarea", "a person waves with the right hand")
        click(tab, "Generate")
        link = tab.wait("location.search.includes('right') && location.href")
        frames = []
        for number in range(2):  # the person moves
            time.sleep(0.4)
            frames.append(tab.screenshot(tmp_path / f"{number}.png"))
        assert frames[0] != frames[1]

        files = tab.run("Object.fromEntries([...document.querySelectorAll('#files a')].map(a => [a.text, a.href]))")
        assert list(files)[:4] == ["BVH", "GLB", "NPZ", "MP4"]
        shown = joints_of(files["NPZ"])
        assert shown.shape == (60, 22, 3)
        bvh = get(files["BVH"])[1].decode()
        assert (bvh.count("JOINT"), bvh.count("Frames: 60")) == (21, 1)
        glb = get(files["GLB"])[1]
        size = int.from_bytes(glb[12:16], "little")
        content = json.loads(glb[20 : 20 + size])
        assert (glb[:4], len(glb), len(content["skins"])) == (b"glTF", int.from_bytes(glb[8:12], "little"), 1)

        tab.type("#edit [placeholder=start]", "1.5")
        click(tab, "Change")
        edited = tab.wait("location.search.includes('edit=') && location.href")
        after = joints_of(
            tab.wait(
                "[...document.querySelectorAll('#files a')].map(a => a.href).find(h => "
                "h.includes('.npz') && h.includes('edit='))"
            )
        )
        assert np.abs(after[:24] - shown[:24]).max() < 0.1
        assert np.abs(after[36:] - shown[36:]).max() > 0.2

        for address, expected in ((link, shown), (edited, after)):  # a link gives the same motion
            tab.open("about:blank")
            tab.open(address)
            tab.wait("!!document.querySelector('#player iframe')")
            assert tab.run("document.querySelector('#ask textarea').value") == "a person waves with the right hand"
            query = tab.wait("document.querySelector('#files a')?.href").partition("?")[2]
            np.testing.assert_array_equal(joints_of(f"{server}/motion.npz?{query}"), expected)
        assert [url for url in tab.requested if not url.startswith((server, "data:", "blob:", "about:"))] == []
        assert tab.errors == []
        tab.size(390, 844)
        assert tab.run("document.documentElement.scrollWidth <= innerWidth")


@pytest.mark.tools
@pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")
def test_a_person_writes_a_sequence_in_rows_and_draws_a_path(server, tmp_path):
    text = "document.querySelector('#text textarea').value"
    with browser(tmp_path / "profile") as tab:
        tab.open(f"{server}/?{urlencode({'text': 'a person walks', **FAST})}")
        tab.wait("!!document.querySelector('#files a')", 60)
        click(tab, "+ Add an action")
        tab.send("Input.insertText", text="a person stands")
        tab.type("[aria-label='Seconds of action 1']", "2")
        assert tab.run(text) == "a person walks @2 | a person stands"
        click(tab, "+ Add an action")
        tab.wait("document.querySelectorAll('#parts .part').length === 3")
        tab.click("[aria-label='Remove action 3']")
        tab.wait("document.querySelectorAll('#parts .part').length === 2")
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
            x, y, width, height = tab.run(
                "(r => [r.x, r.y, r.width, r.height])(document.querySelector('#floor svg').getBoundingClientRect())"
            )
            for kind in ("mousePressed", "mouseReleased"):
                at = {"x": x + right * width, "y": y + down * height}
                tab.send("Input.dispatchMouseEvent", type=kind, **at, button="left", clickCount=1)
        tab.wait("document.querySelectorAll('#floor circle').length === 3")
        tab.click("[data-point='2'] circle")  # removes it
        tab.wait("document.querySelectorAll('#floor circle').length === 2")
        drawn = tab.run("document.querySelector('#path textarea, #path input').value")
        assert drawn == "0.6,0.8 0.3,1.2"  # the view: x from 3 (left) to -3, z from 3 (top) to -1.5
        click(tab, "Generate")
        tab.wait("location.search.includes('path=')")
        address = tab.wait(
            "[...document.querySelectorAll('#files a')].map(a => a.href).find(h => /npz.*path=/.test(h))"
        )
        joints = joints_of(address)
        points = parsed(address.partition("?")[2].partition("&motion=")[0]).targets("text")["root"]
        assert [point["position"] for point in points] == [[0.6, 0.8], [0.3, 1.2]]
        for point in points:
            assert np.abs(joints[round(20 * point["time"]), 0, [0, 2]] - point["position"]).max() < 0.03

        link = tab.run("location.href")
        tab.open("about:blank")
        tab.open(link)  # shows the path
        tab.wait("document.querySelectorAll('#floor circle').length === 2")
        click(tab, "Clear")
        tab.wait("!document.querySelector('#floor circle')")
        click(tab, "Generate")
        tab.wait("location.search && !location.search.includes('path=')")
        assert tab.errors == []


def click(tab: Any, label: str) -> None:
    tab.run(f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() === {json.dumps(label)}).click()")


def joints_of(address: str) -> np.ndarray:
    with np.load(io.BytesIO(get(address)[1])) as content:
        return content["joints"]
