"""Drives headless Chromium over its DevTools protocol."""

from __future__ import annotations

import asyncio
import base64
import json
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import aiohttp
import pytest

CHROMIUM = shutil.which("chromium")


def in_chromium(test: Callable[..., None]) -> Callable[..., None]:
    """Marks a test that drives Chromium."""
    return pytest.mark.tools(
        pytest.mark.skipif(CHROMIUM is None, reason="chromium is not installed")(test)
    )


class Tab:
    """A page in the browser; `requested` lists the addresses that it asked for, `errors` the errors of its scripts."""

    def __init__(self, loop: asyncio.AbstractEventLoop, socket: aiohttp.ClientWebSocketResponse):
        self.loop, self.socket = loop, socket
        self.requested: list[str] = []
        self.errors: list[str] = []
        self._number = 0

    def send(self, method: str, **parameters: Any) -> dict[str, Any]:
        return self.loop.run_until_complete(self._send(method, parameters))

    async def _send(self, method: str, parameters: dict[str, Any]) -> dict[str, Any]:
        self._number += 1
        await self.socket.send_json({"id": self._number, "method": method, "params": parameters})
        while True:
            message = json.loads((await asyncio.wait_for(self.socket.receive(), 60)).data)
            if message.get("id") == self._number:
                assert "error" not in message, message["error"]
                return message["result"]
            event = message.get("params", {})
            if message["method"] == "Network.requestWillBeSent":
                self.requested.append(event["request"]["url"])
            if message["method"] == "Runtime.exceptionThrown":
                self.errors.append(str(event["exceptionDetails"]))

    def run(self, script: str) -> Any:
        """Returns the value of a JavaScript expression."""
        answer = self.send(
            "Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait(self, script: str, seconds: float = 30) -> Any:
        """Returns the value of an expression once it is true."""
        end = time.monotonic() + seconds
        while not (value := self.run(script)):
            assert time.monotonic() < end, f"not true in {seconds} s: {script}"
            time.sleep(0.05)
        return value

    def open(self, url: str) -> None:
        self.send("Page.navigate", url=url)

    def size(self, width: int, height: int) -> None:
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=height,
            deviceScaleFactor=1,
            mobile=False,
        )

    def type(self, selector: str, text: str) -> None:
        """Replaces the text of a field, as keys would."""
        self.wait(f"!!document.querySelector({json.dumps(selector)})")
        self.run(
            f"(e => {{ e.focus(); e.select() }})(document.querySelector({json.dumps(selector)}))"
        )
        self.send("Input.insertText", text=text)

    def click(self, selector: str) -> None:
        """Clicks the middle of an element with the mouse."""
        x, y = self.wait(
            f"(e => {{ if (!e) return 0; e.scrollIntoView({{block: 'center'}}); const r = e.getBoundingClientRect();"
            f" return [r.x + r.width / 2, r.y + r.height / 2] }})(document.querySelector({json.dumps(selector)}))"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self, path: Path, whole: bool = False) -> bytes:
        data = base64.b64decode(
            self.send("Page.captureScreenshot", captureBeyondViewport=whole)["data"]
        )
        path.write_bytes(data)
        return data


@contextmanager
def browser(profile: Path, width: int = 1280, height: int = 900) -> Iterator[Tab]:
    """Starts Chromium with an empty page."""
    assert CHROMIUM is not None
    words = [
        CHROMIUM,
        "--headless",
        "--no-sandbox",
        "--disable-gpu",
        "--no-first-run",
        "--disable-dev-shm-usage",
    ]
    words += [
        "--disable-background-networking",
        f"--user-data-dir={profile}",
        "--remote-debugging-port=0",
    ]
    with subprocess.Popen(
        [*words, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            port = profile / "DevToolsActivePort"
            end = time.monotonic() + 60
            while not (port.exists() and len(port.read_text().splitlines()) == 2):
                assert time.monotonic() < end
                time.sleep(0.05)
            yield from _tab(int(port.read_text().splitlines()[0]), width, height)
        finally:
            process.terminate()


def _tab(port: int, width: int, height: int) -> Iterator[Tab]:
    loop = asyncio.new_event_loop()

    async def connect() -> tuple[aiohttp.ClientSession, aiohttp.ClientWebSocketResponse]:
        session = aiohttp.ClientSession()
        while True:
            async with session.get(f"http://127.0.0.1:{port}/json") as answer:
                pages = [page for page in await answer.json() if page["type"] == "page"]
            if pages:
                return session, await session.ws_connect(
                    pages[0]["webSocketDebuggerUrl"], max_msg_size=0
                )

    session, socket = loop.run_until_complete(connect())
    try:
        tab = Tab(loop, socket)
        for domain in ("Page", "Runtime", "Network"):
            tab.send(f"{domain}.enable")
        tab.size(width, height)
        yield tab
    finally:
        loop.run_until_complete(session.close())
        loop.close()
