"""Connections to the demo's server, with deadlines and limits in total and per address."""

import asyncio
from dataclasses import dataclass
from functools import partial
from ipaddress import IPv4Address, IPv6Address, IPv6Network, ip_address
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol


@dataclass(frozen=True, kw_only=True)
class ConnectionLimits:
    """Limits on the connections to a server.

    A connection is *waiting* until the headers of a request are complete, and again after the
    response. When the maximum number of connections is reached, a new connection replaces the one
    that has been waiting longest. If no connection is waiting, the request of the new connection is
    answered with status 503.

    Attributes:
        total: maximum number of open connections.
        per_address: maximum number of open connections per address, or per 64-bit IPv6
            network.
        header_seconds: maximum waiting time of a connection, regardless of how many bytes of the
            headers arrive.
        idle_seconds: maximum waiting time after a response if no data arrives.
        stall_seconds: maximum time for which a client may stop reading its response.
    """

    total: int = 256
    per_address: int = 32
    header_seconds: float = 10.0
    idle_seconds: int = 5
    stall_seconds: float = 30.0


def server_settings(app: ASGIApp, limits: ConnectionLimits) -> uvicorn.Config:
    """Returns the settings of a server that serves `app` within these limits."""
    options: dict[str, Any] = {
        "http": partial(Connection, limits=limits),
        "ws": "none",
        "timeout_keep_alive": limits.idle_seconds,
        "timeout_graceful_shutdown": 3,
        "log_level": "warning",
    }
    return uvicorn.Config(app, **options)


class Connection(H11Protocol):
    """A connection that enforces `ConnectionLimits`."""

    def __init__(self, *arguments: Any, limits: ConnectionLimits, **keywords: Any):
        super().__init__(*arguments, **keywords)
        self.limits = limits
        self.network: IPv4Address | IPv6Network | None = None
        self.deadline: asyncio.TimerHandle | None = None  # None while a request is being answered
        self.stall: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Watches a new connection.

        If there are too many connections, the longest-waiting connections are closed.
        """
        super().connection_made(transport)
        self.network = _network(self.client[0]) if self.client else None
        self._watch()

        others = [
            connection for connection in self.connections if isinstance(connection, Connection)
        ]
        self._make_room(
            [other for other in others if other.network == self.network], self.limits.per_address
        )
        self._make_room(others, self.limits.total)

    def connection_lost(self, exc: Exception | None) -> None:
        """Stops the timers of a connection that has ended."""
        self._stop_timers()
        super().connection_lost(exc)

    def handle_events(self) -> None:
        """Handles received data and starts or stops the timers."""
        super().handle_events()
        self._watch()

    def on_response_complete(self) -> None:
        """Starts to wait for the next request when a response is complete."""
        super().on_response_complete()
        self._watch()

    def pause_writing(self) -> None:
        """Starts the timer that closes the connection if the client does not read."""
        super().pause_writing()
        # The timer aborts the connection rather than closing it, because closing would wait for the
        # client to read.
        self.stall = self.loop.call_later(self.limits.stall_seconds, self.transport.abort)

    def resume_writing(self) -> None:
        """Stops the timer that `pause_writing` started, because the client is reading again."""
        super().resume_writing()
        if self.stall is not None:
            self.stall.cancel()
            self.stall = None

    def close(self) -> None:
        """Closes the connection and stops counting it."""
        self._stop_timers()
        self.connections.discard(self)
        self.transport.close()

    def _watch(self) -> None:
        """Starts the timer when the connection begins to wait, and stops it when a request arrives."""
        if self.transport.is_closing():
            return

        waiting = self.cycle is None or self.cycle.response_complete
        if waiting and self.deadline is None:
            self.deadline = self.loop.call_later(self.limits.header_seconds, self.close)
        elif not waiting and self.deadline is not None:
            self.deadline.cancel()
            self.deadline = None

    def _make_room(self, group: "list[Connection]", limit: int) -> None:
        """Closes the longest-waiting connections in a group until the group is within the limit."""
        excess = len(group) - limit
        if excess <= 0:
            return

        deadlines = [
            (other.deadline.when(), other)
            for other in group
            if other.deadline and other is not self
        ]
        closed = sorted(deadlines, key=lambda pair: pair[0])[:excess]
        for _, other in closed:
            other.close()
        if len(closed) < excess:
            self.limit_concurrency = 0  # uvicorn answers the request with 503

    def _stop_timers(self) -> None:
        for timer in (self.deadline, self.stall):
            if timer is not None:
                timer.cancel()
        self.deadline = self.stall = None


def _network(address: str) -> IPv4Address | IPv6Network:
    """Returns an IPv4 address, or the 64-bit network of an IPv6 address.

    An IPv6 subscriber usually has an entire network.
    """
    parsed = ip_address(address.partition("%")[0])
    if isinstance(parsed, IPv6Address):
        return parsed.ipv4_mapped or IPv6Network((parsed, 64), strict=False)
    return parsed
