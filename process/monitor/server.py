"""An HTTP server with bounds: connections in all and by client, and time for each request and answer."""

import asyncio
import logging
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h11
import uvicorn
from uvicorn.protocols.http.h11_impl import H11Protocol

MAX_CONNECTIONS = 256
MAX_CONNECTIONS_OF_CLIENT = 64
STUCK_S = 10.0  # an unfinished request, or an answer that is not taken, ends after so long
KEEP_ALIVE_S = 10
MAX_HEAD_BYTES = 8192
_OPEN: Counter[str] = Counter()


class BoundedProtocol(H11Protocol):  # type: ignore[misc]
    """One connection. Who opens too many, sends half a request or does not take the answer is hung up on."""

    _client_host = ""
    _counted = False

    def connection_made(self, transport: asyncio.Transport) -> None:
        """Take it, or hang up."""
        super().connection_made(transport)
        self._client_host = self.client[0] if self.client else ""
        if sum(_OPEN.values()) >= MAX_CONNECTIONS or _OPEN[self._client_host] >= MAX_CONNECTIONS_OF_CLIENT:
            transport.abort()
            return
        _OPEN[self._client_host] += 1
        self._counted = True
        self._seen: Any = None
        self._check = self.loop.call_later(STUCK_S, self._hang_up_when_stuck)

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget it."""
        super().connection_lost(exc)
        if self._counted:
            self._counted = False
            self._check.cancel()
            _OPEN[self._client_host] -= 1
            if not _OPEN[self._client_host]:
                del _OPEN[self._client_host]

    def send_400_response(self, msg: str) -> None:
        """Say that a request is none, or hang up where its answer is given already."""
        try:
            super().send_400_response(msg)
        except h11.LocalProtocolError:
            self.transport.abort()

    def _hang_up_when_stuck(self) -> None:
        cycle = self.cycle  # of the last request that came whole
        answered = cycle is not None and cycle.response_complete
        if cycle is self._seen and not (answered and self.timeout_keep_alive_task is not None):
            self.transport.abort()
            return
        self._seen = cycle
        self._check = self.loop.call_later(STUCK_S, self._hang_up_when_stuck)


def make_server(app: Callable[..., Any], certificate: Path | None = None, key: Path | None = None) -> uvicorn.Server:
    """A server of ``app`` that says nothing of itself."""
    logging.getLogger("uvicorn.error").setLevel(logging.ERROR)  # what strangers send is no event of ours
    config = uvicorn.Config(
        app,
        http=BoundedProtocol,
        ws="none",
        lifespan="off",
        loop="asyncio",
        log_config=None,
        access_log=False,
        server_header=False,
        date_header=False,
        proxy_headers=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=2,
        h11_max_incomplete_event_size=MAX_HEAD_BYTES,
        ssl_certfile=certificate and str(certificate),
        ssl_keyfile=key and str(key),
    )
    return uvicorn.Server(config)
