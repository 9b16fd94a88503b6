"""Connections to the demo: silent, half-open, idle and unread ones keep nobody else out."""

import contextlib
import dataclasses
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

uvicorn = pytest.importorskip("uvicorn", reason="gradio, which needs uvicorn, is not installed")
connections = pytest.importorskip("flame_mdm.demo.connections")

SOON = 5.0  # seconds in which the server must have acted
LIMITS = connections.ConnectionLimits(header_seconds=60, idle_seconds=60, stall_seconds=60)
REQUEST = b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n"
STREAM = REQUEST.replace(b" / ", b" /stream ")
LAST = b"\r\n0\r\n\r\n"  # end of an answer
LARGE = REQUEST.replace(b" / ", b" /large ")


async def app(scope: Any, receive: Any, send: Any) -> None:
    """Answers at once, or never ends the answer (/stream), or sends more than the sockets hold (/large)."""
    if scope["type"] == "lifespan":
        return
    await send(
        {
            "type": "http.response.start",
            "status": 200,
            "headers": [(b"content-type", b"text/plain")],
        }
    )
    if scope["path"] == "/stream":
        await send({"type": "http.response.body", "body": b"first", "more_body": True})
        await receive()
        await receive()
    for _ in range(100 if scope["path"] == "/large" else 0):
        await send({"type": "http.response.body", "body": bytes(2**18), "more_body": True})
    await send({"type": "http.response.body", "body": b"answer", "more_body": False})


Client = Callable[..., socket.socket]


@contextmanager
def served(**limits: Any) -> Iterator[Client]:
    """A function that connects to a server with these limits and sends bytes, if given."""
    settings = connections.server_settings(app, dataclasses.replace(LIMITS, **limits))
    settings.lifespan = "off"
    server = uvicorn.Server(settings)
    with contextlib.ExitStack() as stack:
        listening = stack.enter_context(socket.create_server(("127.0.0.1", 0), backlog=512))
        thread = threading.Thread(target=server.run, args=([listening],))
        thread.start()

        def connect(sent: bytes = b"", source: str = "127.0.0.1", **options: int) -> socket.socket:
            client = stack.enter_context(socket.socket())
            client.settimeout(SOON)
            for name, value in options.items():
                client.setsockopt(socket.SOL_SOCKET, getattr(socket, name), value)
            client.bind((source, 0))
            client.connect(listening.getsockname())
            client.sendall(sent)
            return client

        try:
            yield connect
        finally:
            server.should_exit = server.force_exit = True
            thread.join(SOON)
            assert not thread.is_alive()


def received(client: socket.socket, end: bytes = b"") -> bytes:
    """All bytes that the server sends until `end`, or until it closes the connection."""
    content = b""
    with contextlib.suppress(ConnectionResetError):
        while part := client.recv(2**16):
            content += part
            if end and end in content:
                break
    return content


@pytest.mark.parametrize(
    "sent", [b"", b"GET / HTTP/1.1\r\nHost: local"], ids=["silent", "half-open"]
)
def test_300_silent_or_half_open_connections_keep_nobody_out(sent: bytes) -> None:
    with served() as connect:
        held = [connect(sent, f"127.0.0.{2 + number % 100}") for number in range(300)]
        assert b"answer" in received(connect(REQUEST, "127.0.0.250"), b"answer")
        assert received(held[0]) == b""  # made way


def test_many_connections_of_one_address_keep_not_even_the_same_address_out() -> None:
    with served(per_address=4) as connect:
        held = [connect() for _ in range(40)]
        assert b"answer" in received(connect(REQUEST), b"answer")
        assert [received(client) for client in held[:36]] == [b""] * 36


def test_requests_in_progress_are_limited_per_address_and_in_total() -> None:
    with served(per_address=2, total=3) as connect:
        streams = [connect(STREAM, f"127.0.0.{last}") for last in (2, 2)]
        assert all(b"first" in received(client, b"first") for client in streams)
        assert b" 503 " in received(connect(REQUEST, "127.0.0.2"))
        assert b"first" in received(connect(STREAM, "127.0.0.3"), b"first")
        assert b" 503 " in received(connect(REQUEST, "127.0.0.4"))
        streams[0].close()
        while b" 503 " in (answer := received(connect(REQUEST, "127.0.0.4"), b"answer")):
            pass  # until the server has seen the end of the stream
        assert b"answer" in answer


def test_headers_have_a_deadline_that_single_bytes_do_not_extend() -> None:
    with served(header_seconds=0.3) as connect:
        silent, slow = connect(), connect(b"GET / HTTP/1.1\r\nX: ")
        slow.settimeout(0.02)
        with contextlib.suppress(ConnectionError):
            for _ in range(int(SOON / 0.02)):
                slow.sendall(b"x")
                with contextlib.suppress(TimeoutError):
                    if slow.recv(1) == b"":
                        break
            else:
                raise AssertionError("the connection is still open")
        assert received(silent) == b""


def test_a_request_in_progress_outlives_the_deadline_of_its_headers() -> None:
    with served(header_seconds=0.2) as connect:
        stream = connect(STREAM)
        assert b"first" in received(stream, b"first")
        stream.settimeout(0.6)
        with pytest.raises(TimeoutError):
            stream.recv(1)


def test_after_an_answer_a_half_request_and_an_idle_connection_expire() -> None:
    with served(header_seconds=0.4) as connect:
        half = connect(REQUEST)
        assert b"answer" in received(half, LAST)
        half.sendall(REQUEST[:20])
        assert received(half) == b""
    with served(idle_seconds=0.2) as connect:
        idle = connect(REQUEST)
        assert b"answer" in received(idle)


def test_a_client_that_does_not_read_its_answer_is_disconnected() -> None:
    with served(stall_seconds=0.2) as connect:
        client = connect(LARGE, SO_RCVBUF=4096)
        threading.Event().wait(0.5)
        assert len(received(client)) < 100 * 2**18


@pytest.mark.parametrize(
    ("address", "network"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("2001:db8:0:1::5", "2001:db8:0:1::/64"),
        ("fe80::1%eth0", "fe80::/64"),
    ],
)
def test_addresses_of_one_ipv6_network_count_together(address: str, network: str) -> None:
    assert str(connections._network(address)) == network
