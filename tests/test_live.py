"""The demo's streams: blocks for the player, texts, files of the last minute, and limits for visitors."""

import base64
import json
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from support.runs import TINY_DIP, untrained

from flame_mdm import stream
from flame_mdm.data.standing import standing
from flame_mdm.demo import guard
from flame_mdm.demo import live as making
from flame_mdm.demo.live import LiveStreams
from flame_mdm.errors import UserError
from flame_mdm.formats.motion import Motion
from flame_mdm.generator import MotionGenerator
from flame_mdm.representations.skeleton import SMPL22

WALK, SIT = "a person walks", "a person sits down"


@pytest.fixture(scope="module")
def model() -> MotionGenerator:
    """A tiny model with random weights, whose motions are almost a person who stands."""
    model = untrained(TINY_DIP, 40, "synthetic/dip")
    still = standing(model.representation, 10).features[0]
    model.representation.mean.copy_(torch.from_numpy(still))
    model.representation.std.fill_(0.01)
    return model


class Clock:
    """A clock that a test sets."""

    time = 0.0

    def __call__(self) -> float:
        return self.time


def joints_of(motion: dict[str, Any]) -> np.ndarray:
    packed = np.frombuffer(base64.b64decode(motion["joints"]), "<i2").reshape(-1, 22, 3)
    return np.array(motion["center"]) + packed * motion["step"]


def root(block: dict[str, Any], frame: int) -> tuple[float, float]:
    """Returns x and z of the root in a frame of a block."""
    x, _, z = joints_of(block["motion"])[frame, 0].tolist()
    return x, z


def test_blocks_are_those_of_the_stream_and_a_new_text_replaces_frames_that_were_not_shown(
    model, subtests
):
    live = LiveStreams(model)
    first = live.block("", WALK, 0)
    name = first["stream"]
    live.block(name, WALK, 30)
    changed = live.block(name, SIT, 42)
    running = stream(model, WALK)
    running.change(SIT, at=2.1)
    expected = [next(running).joints for _ in range(3)]
    for number, block, joints in ((0, first, expected[0]), (2, changed, expected[2])):
        with subtests.test(block=number):
            assert block["frames"] == len(joints) == 30
            assert (
                np.abs(joints_of(block["motion"]) - joints).max() < 0.001 + block["motion"]["step"]
            )
    turns = base64.b64decode(changed["motion"]["body"]["turns"])
    assert len(turns) == 30 * 28 * 4
    assert json.dumps(changed)
    assert live.file(name, ".bvh").startswith(b"HIERARCHY")
    assert b"Frames: 72" in live.file(name, ".bvh")
    with pytest.raises(UserError, match="a stream cannot be saved in this format"):
        live.file(name, ".exe")


def test_a_text_that_is_refused_leaves_the_stream_as_it_was(model):
    live = LiveStreams(model)
    name = live.block("", WALK, 0)["stream"]
    with pytest.raises(UserError, match="expected a description of what happens"):
        live.block(name, " ", 20)
    assert live.block(name, WALK, 30)["from"] == 30


def test_streams_are_bounded_and_end_when_nobody_reads_them(model, monkeypatch):
    monkeypatch.setattr(making, "MAX_STREAMS", 2)
    clock = Clock()
    live = LiveStreams(model, clock)
    first = live.block("", WALK, 0)["stream"]
    clock.time = 100.0
    live.block("", WALK, 0)
    with pytest.raises(UserError, match="too many streams are running"):
        live.block("", WALK, 0)
    clock.time = 130.0
    live.block("", WALK, 0)
    with pytest.raises(UserError, match="this stream has ended"):
        live.block(first, WALK, 30)


def test_a_stream_computes_no_more_blocks_than_anybody_can_watch(model):
    clock = Clock()
    live = LiveStreams(model, clock)
    name = live.block("", WALK, 0)["stream"]
    for begin in (30, 60, 90, 120, 150, 180, 210):
        live.block(name, WALK, begin)
    with pytest.raises(UserError, match="too many changes in a short time"):
        live.block(name, WALK, 240)
    clock.time = 0.5
    assert live.block(name, WALK, 240)["from"] == 240


def test_a_block_leads_along_waypoints_and_says_when_they_are_reached(model):
    live = LiveStreams(model)
    first = live.block("", WALK, 0)
    name, here = first["stream"], root(first, -1)
    block = live.block(name, WALK, 30, [here, (50.0, 50.0)])
    assert block["reached"] == [30]
    assert live.block(name, WALK, 60, [(50.0, 50.0)])["reached"] == []
    assert live.block(name, WALK, 45, [root(block, 14)])["reached"] == [45]
    with pytest.raises(UserError, match="expected x and z in meters"):
        live.block(name, WALK, 75, [(float("nan"), 0.0)])
    assert live.block(name, WALK, 75)["from"] == 75


def test_visitors_lead_the_person_if_the_model_walks(model, monkeypatch):
    assert LiveStreams(model).can_lead
    monkeypatch.setattr(making, "WALK", " ")
    assert not LiveStreams(model).can_lead


def test_the_last_minute_is_kept(model, monkeypatch):
    monkeypatch.setattr(making, "KEPT", 2.0)
    live = LiveStreams(model)
    name = live.block("", WALK, 0)["stream"]
    for begin in (30, 60):
        live.block(name, WALK, begin)
    assert b"Frames: 40" in live.file(name, ".bvh")


def test_the_server_sends_blocks_within_the_rules_of_the_guard(model, subtests):
    pytest.importorskip("gradio", reason="gradio is not installed")
    from fastapi import FastAPI
    from starlette.testclient import TestClient

    from flame_mdm.demo.app import WAITING_FILES, Writers, add_live
    from flame_mdm.demo.guard import Guard

    app = FastAPI(openapi_url=None)
    writers = Writers()
    add_live(app, LiveStreams(model), writers)
    call = {"stream": "", "text": WALK, "begin": 0}
    with TestClient(Guard(app, (), {}, bool), "http://localhost") as client:
        block = client.post("/live", json=call).json()
        assert (block["from"], block["frames"]) == (0, 30)
        name = block["stream"]
        second = client.post("/live", json={**call, "stream": name, "begin": 30}).json()
        assert second["from"] == 30
        assert client.get(f"/live.bvh?stream={name}").content.startswith(b"HIERARCHY")
        writers.waiting = WAITING_FILES
        busy = client.get(f"/live.bvh?stream={name}")
        assert (busy.status_code, busy.text[:14]) == (503, "too many files")
        writers.waiting = 0
        assert client.get("/live.html").status_code == 200
        for wrong in (
            {"stream": "../etc"},
            {"text": ""},
            {"text": "x" * 301},
            {"text": "walks \u202e"},
            {"begin": -1},
            {"begin": "0"},
            {"file": "/etc/passwd"},
            {"path": [[0.0, 1.0]] * 17},
            {"path": [[0.0, 1.0, 2.0]]},
            {"path": [["0", 1.0]]},
            {"path": [[1e5, 1.0]]},
        ):
            with subtests.test(wrong=wrong):
                assert client.post("/live", json=call | wrong).status_code == 400
        nan = json.dumps(call | {"path": [[float("nan"), 0.0]]})
        headers = {"Content-Type": "application/json"}
        refused = client.post("/live", content=nan, headers=headers)
        assert (refused.status_code, refused.text) == (
            400,
            "this request does not come from this page",
        )
        path = {"stream": name, "begin": 60, "path": [root(second, -1)]}
        led = client.post("/live", json=call | path)
        assert led.json()["reached"] == [60]
        unknown = client.post("/live", json=call | {"stream": "0" * 32})
        assert unknown.json() == {
            "error": "this stream has ended. Reload the page to start another one"
        }
        assert client.get("/live.exe?stream=x").status_code == 404
        headers = {"Origin": "http://evil.example"}
        assert client.post("/live", json=call, headers=headers).status_code == 403


@pytest.mark.parametrize(("hosts", "per_address"), [((), 32), (("motions.example",), 256)])
def test_the_page_is_served_within_the_limits_on_connections(monkeypatch, hosts, per_address):
    app = pytest.importorskip("flame_mdm.demo.app", reason="gradio is not installed")
    served: list[Any] = []
    server = SimpleNamespace(run=lambda sockets: None)
    monkeypatch.setattr(app, "Server", lambda settings: served.append(settings) or server)
    monkeypatch.setattr(app, "Studio", lambda *_: None)
    monkeypatch.setattr(app, "web_app", lambda *_: None)
    monkeypatch.setenv("GRADIO_TEMP_DIR", "")
    app.serve([], port=0, device="cpu", hosts=hosts)
    limits = served[0].http.keywords["limits"]
    assert (limits.total, limits.per_address) == (256, per_address)
    assert (limits.header_seconds, limits.idle_seconds, limits.stall_seconds) == (10, 5, 30)
    assert served[0].timeout_keep_alive == 5


def test_an_idle_stream_may_compute_eight_blocks_at_once_and_no_more(model):
    clock = Clock()
    live = LiveStreams(model, clock)
    name = live.block("", WALK, 0)["stream"]
    clock.time = 100.0  # enough for 200 blocks
    for begin in range(30, 270, 30):
        live.block(name, WALK, begin)
    with pytest.raises(UserError, match="too many changes"):
        live.block(name, WALK, 270)
    clock.time = 100.4  # two blocks per second, one of which was refused at 0.0
    for _ in range(3):  # refused requests do not add to the allowance
        with pytest.raises(UserError, match="too many changes"):
            live.block(name, WALK, 270)
    clock.time = 100.6
    assert live.block(name, WALK, 270)["from"] == 270


def test_a_stream_ends_after_two_minutes_without_a_request_and_after_an_hour(model):
    clock = Clock()
    live = LiveStreams(model, clock)
    name = live.block("", WALK, 0)["stream"]
    clock.time = 120.0
    assert live.block(name, WALK, 30)["from"] == 30
    clock.time = 240.1
    with pytest.raises(UserError, match="this stream has ended"):
        live.block(name, WALK, 60)
    name = live.block("", WALK, 0)["stream"]
    stream = live._streams[name].stream

    class Late:
        """A stream that has run for a long time."""

        frames = 72_001  # one frame more than an hour at 20 frames per second

    live._streams[name].stream = Late()  # type: ignore[assignment]
    with pytest.raises(UserError, match="the limit of one hour"):
        live.block(name, WALK, 72_001)
    Late.frames = 72_000
    with pytest.raises(AttributeError, match="'Late' object"):  # the next block is requested
        live.block(name, WALK, 72_000)
    live._streams[name].stream = stream


def test_the_guard_reads_bodies_and_paths_up_to_its_limits():
    testing = pytest.importorskip("starlette.testclient", reason="starlette is not installed")
    from starlette.applications import Starlette
    from starlette.responses import PlainTextResponse
    from starlette.routing import Mount

    from flame_mdm.demo.guard import Guard

    app = Starlette(routes=[Mount("/", PlainTextResponse("read"))])
    headers = {"Content-Type": "application/json"}
    with testing.TestClient(
        Guard(app, ("Demo.example", "1.2.3.4"), {}, bool), "http://localhost"
    ) as client:
        for size, status in ((64 * 1024, 400), (64 * 1024 + 1, 413)):
            assert client.post("/live", content=b"x" * size, headers=headers).status_code == status
        for length, status in ((200, 200), (201, 404)):
            assert client.get("/assets/" + "a" * (length - 8)).status_code == status
        assert client.post("/live", content=b"{}").status_code == 415
        assert client.get("/assets/a", headers={"Host": "demo.example:80"}).status_code == 200
        assert client.get("/assets/a", headers={"Host": "other.example"}).status_code == 421
        assert client.get("/assets/a", headers={"Host": "9.9.9.9"}).status_code == 200
        called = {"data": ["x"], "fn_index": 3, "session_hash": "s"}
        assert client.post("/gradio_api/queue/join", json=called).status_code == 400
        answer = client.get("/assets/a")
        assert answer.headers["x-content-type-options"] == "nosniff"
        assert "frame-ancestors 'self'" in answer.headers["content-security-policy"]


def test_a_function_of_the_page_is_called_at_its_own_address_with_its_own_arguments():
    testing = pytest.importorskip("starlette.testclient", reason="starlette is not installed")
    from starlette.applications import Starlette
    from starlette.responses import PlainTextResponse
    from starlette.routing import Mount

    from flame_mdm.demo.guard import Guard

    app = Starlette(routes=[Mount("/", PlainTextResponse("called"))])
    queue = "/gradio_api/queue/join"
    calls: Any = {3: (queue, lambda data: data == ["x"])}
    call = {"data": ["x"], "fn_index": 3, "session_hash": "s"}
    opened = Guard(app, (), calls, lambda session: session == "s")
    with testing.TestClient(opened, "http://localhost") as client:
        assert client.post(queue, json=call).text == "called"
        assert client.post("/gradio_api/run/predict", json=call).status_code == 400
        for change in ({"fn_index": 4}, {"data": ["y"]}, {"data": []}, {"session_hash": "a b"}):
            assert client.post(queue, json=call | change).status_code == 400, change
        stream = "/gradio_api/queue/data?session_hash="
        assert [client.get(stream + name).status_code for name in ("s", "t")] == [200, 404]


def test_replaced_frames_are_no_part_of_a_file_that_begins_after_the_start(model, monkeypatch):
    monkeypatch.setattr(making, "KEPT", 2.0)
    live = LiveStreams(model)
    name = live.block("", WALK, 0)["stream"]
    for begin in (30, 60):
        live.block(name, WALK, begin)
    before = live._streams[name].joints.copy()
    assert len(before) == 40  # frames 50 to 89
    block = live.block(name, WALK, 75)
    kept = live._streams[name].joints
    assert len(kept) == 40  # frames 65 to 104
    np.testing.assert_array_equal(kept[:10], before[15:25])
    apart = np.abs(joints_of(block["motion"]) - kept[10:]).max()
    assert apart < 0.001 + block["motion"]["step"]


class Numbered:
    """A stream whose frames are numbered: frame f is at x = f / 100 m."""

    def __init__(self, fps: float):
        self.frames, self.fps = 0, fps
        self.reached: list[int] = []
        self.calls: list[Any] = []

    def lead(self, path: Any) -> None:
        self.calls.append(("lead", path))

    def go_back(self, at: float) -> None:
        self.calls.append(("go_back", at))
        self.frames = round(at * self.fps)

    def change(self, text: str) -> None:
        self.calls.append(("change", text))

    def __next__(self) -> Motion:
        frames = np.arange(self.frames, self.frames + 30)
        self.frames += 30
        joints = np.zeros((30, 22, 3), np.float32)
        joints[..., 0] = frames[:, None] / 100
        return Motion(joints, self.fps, SMPL22)


@pytest.fixture
def shown(model, monkeypatch) -> list[tuple[Motion, int]]:
    """Motions of numbered streams that the player gets at 30 fps, with the number of frames before each."""
    packed: list[tuple[Motion, int]] = []
    monkeypatch.setattr(model.representation, "fps", 30.0)
    monkeypatch.setattr(making, "stream", lambda model, text: Numbered(30.0))
    monkeypatch.setattr(
        making, "packed_motion", lambda motion, before: packed.append((motion, before)) or {}
    )
    return packed


def numbers_of(joints: np.ndarray) -> list[int]:
    return np.round(joints[:, 0, 0] * 100).astype(int).tolist()


def test_a_block_is_shown_with_the_ten_frames_before_it(model, shown):
    live = LiveStreams(model, Clock())
    answers = [live.block("", WALK, 0)]
    name = answers[0]["stream"]
    answers += [live.block(name, text, begin) for text, begin in ((WALK, 30), (SIT, 45), (SIT, 75))]
    assert [(answer["from"], answer["frames"]) for answer in answers] == [
        (0, 30),
        (30, 30),
        (45, 30),
        (75, 30),
    ]
    assert [before for _, before in shown] == [0, 10, 10, 10]
    assert [numbers_of(motion.joints) for motion, _ in shown] == [
        list(range(30)),
        list(range(20, 60)),
        list(range(35, 75)),
        list(range(65, 105)),
    ]
    assert [motion.text for motion, _ in shown] == [WALK, WALK, SIT, SIT]
    assert {motion.fps for motion, _ in shown} == {30.0}
    running: Any = live._streams[name].stream
    calls = [call for call in running.calls if call[0] != "lead"]
    assert calls == [("go_back", 1.5), ("change", SIT)]  # and no change for the last block


def test_a_minute_of_the_stream_is_kept_at_its_frame_rate(model, shown, monkeypatch):
    clock = Clock()
    live = LiveStreams(model, clock)
    name = live.block("", WALK, 0)["stream"]
    for number in range(1, 63):
        clock.time += 1.0
        live.block(name, WALK if number < 40 else SIT, 30 * number)
    assert numbers_of(live._streams[name].joints) == list(range(1890 - 1800, 1890))
    saved: list[Motion] = []

    def save(motion: Motion, path: Any) -> None:
        saved.append(motion)
        path.write_bytes(b"file")

    monkeypatch.setattr(Motion, "save", save)
    assert live.file(name, ".glb") == b"file"
    assert (saved[0].fps, saved[0].text, len(saved[0].joints)) == (30.0, SIT, 1800)


def test_sixteen_streams_run_at_once(model, shown):
    clock = Clock()
    live = LiveStreams(model, clock)
    names = [live.block("", WALK, 0)["stream"] for _ in range(16)]
    assert len(set(names)) == 16
    with pytest.raises(UserError, match="too many streams are running"):
        live.block("", WALK, 0)
    clock.time = 60.0
    live.block(names[0], WALK, 30)
    clock.time = 121.0  # all others have ended
    live.block("", WALK, 0)
    assert next(iter(live._streams)) == names[0]
    assert len(live._streams) == 2


@pytest.mark.parametrize(
    ("path", "is_read"),
    [
        *((path, True) for path in ("/", "/theme.css", "/favicon.ico", "/manifest.json")),
        *((path, True) for path in ("/assets/a-b.c.js", "/static/img/x.png", "/motion.bvh")),
        *((path, True) for path in ("/live.html", "/live.bvh", "/live.glb")),
        *((path, True) for path in ("/gradio_api/queue/data", "/gradio_api/heartbeat/" + "a" * 40)),
        *((path, False) for path in ("/live", "/live.npz", "/motion.html5", "/motion", "/assets")),
        *((path, False) for path in ("/assets/.env", "/assets//a", "/static/../a", "/theme.css/")),
        *((path, False) for path in ("/gradio_api/file=/etc/passwd", "/gradio_api/upload")),
        ("/gradio_api/heartbeat/" + "a" * 41, False),
    ],
)
def test_the_page_reads_its_own_addresses_alone(path: str, is_read: bool):
    assert (guard.READ.fullmatch(path) is not None) == is_read


@pytest.mark.parametrize(
    ("change", "is_valid"),
    [
        ({"begin": 10_000_000}, True),
        ({"begin": 10_000_001}, False),
        ({"stream": "a" * 32}, True),
        ({"stream": "a" * 31}, False),
        ({"stream": "A" * 32}, False),
        ({"path": [[-1e4, 1e4]] * 16}, True),
        ({"path": [[0.0, -10_000.1]]}, False),
        ({"text": "x" * 300}, True),
    ],
    ids=str,
)
def test_requests_for_blocks_are_read_up_to_their_limits(change: dict[str, Any], is_valid: bool):
    content = json.dumps({"stream": "", "text": WALK, "begin": 0} | change)
    if is_valid:
        call = guard.LiveCall.model_validate_json(content).model_dump(mode="json")
        assert call | change == call
    else:
        with pytest.raises(ValueError, match="1 validation error"):
            guard.LiveCall.model_validate_json(content)


@pytest.mark.parametrize(
    ("headers", "path", "status"),
    [
        ({"host": "localhost:7860", "origin": "http://localhost:7860"}, "/live", None),
        ({"host": "LOCALHOST:7860", "origin": "http://localhost:7860"}, "/live", None),
        ({"host": "localhost:7860", "origin": "http://localhost:7861"}, "/live", 403),
        ({"host": "localhost", "origin": "https://Demo.example"}, "/live", None),
        ({"host": "demo.example", "origin": "https://demo.example:8443"}, "/live", None),
        ({"host": "demo.example", "origin": "https://other.example"}, "/live", 403),
        ({"host": "other.example"}, "/", 421),
        ({"host": ""}, "/", 421),
        ({"host": "[::1]:7860"}, "/live", None),
        ({"host": "localhost", "sec-fetch-site": "same-origin"}, "/live", None),
        ({"host": "localhost", "sec-fetch-site": "none"}, "/live", None),
        ({"host": "localhost", "sec-fetch-site": "same-site"}, "/live", 403),
        ({"host": "localhost", "sec-fetch-site": "cross-site"}, "/live", 403),
        ({"host": "localhost", "sec-fetch-site": "cross-site"}, "/", None),
    ],
    ids=str,
)
def test_requests_come_from_the_page_itself_also_behind_a_proxy(headers, path: str, status):
    from starlette.datastructures import Headers
    from starlette.exceptions import HTTPException

    guarded = guard.Guard(None, ("DEMO.example", "10.0.0.1"), {}, bool)  # type: ignore[arg-type]
    if status is None:
        guarded._check_sender(Headers(headers), path)
    else:
        with pytest.raises(HTTPException) as refusal:
            guarded._check_sender(Headers(headers), path)
        assert refusal.value.status_code == status
