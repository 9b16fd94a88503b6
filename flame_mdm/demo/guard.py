"""A guard that refuses all requests to the demo's server unless they come from the page."""

import asyncio
import ipaddress
import re
from collections.abc import Callable, Collection, Mapping
from http import HTTPStatus
from typing import Annotated
from urllib.parse import urlsplit

from pydantic import BaseModel, ConfigDict, Field, StringConstraints, ValidationError
from starlette.datastructures import Headers, QueryParams
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect, Request
from starlette.responses import PlainTextResponse
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from flame_mdm.demo.request import MAX_TEXT, MAX_WAYPOINTS, PLAIN

# Maximum number of bytes in the body of a request, counted as they arrive
MAX_BODY = 64 * 1024
# Maximum time in seconds until the entire body has arrived
BODY_TIME = 10.0
# Maximum number of characters in the path of a URL. File names have at most 255 characters.
MAX_PATH = 200
READ = re.compile(
    r"/|/theme\.css|/favicon\.ico|/manifest\.json|/(assets|static)(/[\w-]+(\.[\w-]+)*)+|/motion\.\w{3}"
    r"|/live\.(html|bvh|glb)|/gradio_api/(queue/data|heartbeat/\w{1,40})",
    re.ASCII,
)
"""Paths that the page requests with GET."""
STREAM = "/gradio_api/queue/data"
HEADERS = {
    "Content-Security-Policy": "default-src 'self'; script-src 'self' 'unsafe-inline' 'unsafe-eval'; "
    "style-src 'self' 'unsafe-inline'; img-src 'self' data: blob:; font-src 'self' data:; connect-src 'self'; "
    "frame-src 'self'; worker-src 'self' blob:; frame-ancestors 'self' https://huggingface.co",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
"""Headers in every response.

With these headers, nothing is loaded from other servers, and only Hugging Face may show the page in
a frame.
"""

Id = Annotated[str, StringConstraints(pattern=r"^\w{1,40}$")]


class Post(BaseModel):
    """The body of a request. Values are not converted, and unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Call(Post):
    """A call to one of the page's functions.

    The arguments are strings, never objects that could refer to a file.
    """

    data: Annotated[list[Annotated[str, Field(max_length=20_000)]], Field(max_length=1)]
    fn_index: int
    session_hash: Id
    trigger_id: int | None = None
    event_data: None = None


class Reset(Post):
    """A message in which the page states that it is no longer waiting for the result of a call."""

    event_id: Id


class Cancellation(Reset):
    """The cancellation of a waiting or running call."""

    session_hash: Id
    fn_index: int


Meters = Annotated[float, Field(ge=-1e4, le=1e4, allow_inf_nan=False)]


class LiveCall(Post):
    """A request for a stream's frames from index `begin`; `stream` is "" for a new stream."""

    stream: Annotated[str, StringConstraints(pattern=r"^([0-9a-f]{32})?$")]
    text: Annotated[str, StringConstraints(min_length=1, max_length=MAX_TEXT, pattern=PLAIN)]
    begin: Annotated[int, Field(ge=0, le=10_000_000)]
    path: Annotated[list[tuple[Meters, Meters]], Field(max_length=MAX_WAYPOINTS)] = []


POSTS: dict[str, type[Post]] = {
    "/live": LiveCall,
    "/gradio_api/cancel": Cancellation,
    "/gradio_api/reset": Reset,
    "/gradio_api/queue/join": Call,
    "/gradio_api/run/predict": Call,
}
"""The requests that the page sends with POST."""


class Guard:
    """ASGI middleware that checks requests before the application receives them.

    The guard checks the host, origin, path, size and content of the request. `hosts` contains the
    names of this server, in addition to localhost and numeric addresses. A request with any other
    host name may come from a page whose domain name was made to resolve to this computer (DNS
    rebinding). `calls` contains one entry per function that the page can call: the key is the
    function's index, and the value consists of the function's path and a check of the arguments.
    `is_open` returns whether a session has called a function and may therefore read results.
    """

    def __init__(
        self,
        app: ASGIApp,
        hosts: Collection[str],
        calls: Mapping[int, tuple[str, Callable[[list[str]], bool]]],
        is_open: Callable[[str], bool],
    ):
        self.app = app
        self.is_open = is_open
        self.hosts = {host.lower() for host in hosts if not _is_address(host)} - {"localhost"}
        self.calls = calls
        self.closing = asyncio.Event()

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "lifespan":
            return await self.app(scope, receive, send)
        if scope["type"] != "http":
            return await send({"type": "websocket.close", "code": 1008})

        async def send_headers(message: Message) -> None:
            if message["type"] == "http.response.start":
                kept = [
                    (k, v)
                    for k, v in message.get("headers", ())
                    if not k.lower().startswith(b"access-control")
                ]
                message["headers"] = [
                    *kept,
                    *((k.lower().encode(), v.encode()) for k, v in HEADERS.items()),
                ]
            await send(message)

        try:
            headers = Headers(scope=scope)
            self._check_sender(headers, scope["path"])
            if scope["method"] == "POST" and headers.get("content-type") != "application/json":
                raise HTTPException(
                    HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "this request does not come from this page"
                )
            body = await _body(Request(scope, receive))
            self._check_content(scope, body)
        except HTTPException as refusal:
            answer = PlainTextResponse(refusal.detail, refusal.status_code, {"Connection": "close"})
            return await answer(scope, receive, send_headers)
        messages: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

        async def replay() -> Message:
            return messages.pop() if messages else await self._until_closing(receive)

        return await self.app(scope, replay, send_headers)

    async def _until_closing(self, receive: Receive) -> Message:
        """Returns the next message.

        When the server stops, the next message is a disconnect message, so that open streams end.
        """
        tasks = [asyncio.ensure_future(receive()), asyncio.ensure_future(self.closing.wait())]
        try:
            done, _ = await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            return tasks[0].result() if tasks[0] in done else {"type": "http.disconnect"}
        finally:
            for task in tasks:
                task.cancel()

    def _check_sender(self, headers: Headers, path: str) -> None:
        host = headers.get("host", "")
        name = _host_name(f"//{host}")
        if name not in self.hosts | {"localhost"} and not _is_address(name):
            line = "this demo is not served under that name. Start it with hosts=NAME"
            raise HTTPException(HTTPStatus.MISDIRECTED_REQUEST, line)
        origin = headers.get("origin", f"http://{host}")
        # A proxy may replace the host, but not the origin
        same = _network_location(origin) == host.lower() or _host_name(origin) in self.hosts
        if not same or (
            path != "/" and headers.get("sec-fetch-site", "none") not in ("same-origin", "none")
        ):
            raise HTTPException(
                HTTPStatus.FORBIDDEN, "this request comes from a page on another site"
            )

    def _check_content(self, scope: Scope, body: bytes) -> None:
        method, path = scope["method"], scope["path"]
        if (
            method in ("GET", "HEAD")
            and len(path) <= MAX_PATH
            and READ.fullmatch(path)
            and not body
        ):
            if path == STREAM:
                self._check_session(QueryParams(scope["query_string"]))
            return
        if method != "POST" or path not in POSTS:
            raise HTTPException(HTTPStatus.NOT_FOUND, "this page has nothing at that address")
        try:
            content = POSTS[path].model_validate_json(body)
        except ValidationError as error:
            raise HTTPException(
                HTTPStatus.BAD_REQUEST, "this request does not come from this page"
            ) from error
        if isinstance(content, Call):
            address, accepts = self.calls.get(content.fn_index, ("", bool))
            if address != path or not accepts(content.data):
                raise HTTPException(
                    HTTPStatus.BAD_REQUEST, "this request does not come from this page"
                )

    def _check_session(self, query: QueryParams) -> None:
        sessions = query.getlist("session_hash")
        if len(sessions) != 1 or not self.is_open(sessions[0]):
            raise HTTPException(HTTPStatus.NOT_FOUND, "this page has no such session. Reload it")


async def _body(request: Request) -> bytes:
    body = bytearray()
    try:
        async with asyncio.timeout(BODY_TIME):
            async for part in request.stream():
                body += part
                if len(body) > MAX_BODY:
                    raise HTTPException(
                        HTTPStatus.REQUEST_ENTITY_TOO_LARGE, "this request is too large"
                    )
    except ClientDisconnect as error:
        raise HTTPException(HTTPStatus.BAD_REQUEST, "the request is incomplete") from error
    except TimeoutError as error:
        raise HTTPException(
            HTTPStatus.REQUEST_TIMEOUT, "the request took too long to arrive"
        ) from error
    return bytes(body)


def _network_location(address: str) -> str:
    """Returns the host and port of an address in lower case, or "" if the address is invalid."""
    try:
        return urlsplit(address).netloc.lower()
    except ValueError:
        return ""


def _host_name(address: str) -> str:
    try:
        return (urlsplit(address).hostname or "").lower()
    except ValueError:
        return ""


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False
