"""Who may ask, how often and how much: an ASGI application around the monitor's that turns the rest away.

What is turned away costs next to nothing and is told nothing.
"""

import base64
import hashlib
import hmac
import time
from collections import OrderedDict
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

CLIENT_RATE_HZ, CLIENT_BURST = 60.0, 120.0
TOTAL_RATE_HZ, TOTAL_BURST = 600.0, 1200.0
CLIENTS_REMEMBERED = 1024
MAX_BODY_BYTES = 1024
SECURITY_HEADERS = {
    "content-security-policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "permissions-policy": "camera=(), geolocation=(), microphone=()",
    "referrer-policy": "no-referrer",
    "x-content-type-options": "nosniff",
    "x-frame-options": "DENY",
    "cache-control": "no-store",
}
_CHALLENGE = {"www-authenticate": 'Basic realm="monitor", charset="UTF-8"'}


class Guard:
    """Lets through who has the token, or who asks a loopback address by its own name when there is none."""

    def __init__(self, app: App, token: str | None, own_hosts: frozenset[str]) -> None:
        """``own_hosts``: names that a browser on this computer may call us by, where there is no token: a page from
        elsewhere whose name was bound to our address is not us (DNS rebinding)."""
        self._app = app
        self._token_hash = None if token is None else _hash(token.encode())
        self._own_hosts = own_hosts
        self._clients: OrderedDict[str, _Bucket] = OrderedDict()
        self._total = _Bucket(TOTAL_RATE_HZ, TOTAL_BURST)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """One request."""
        if scope["type"] == "lifespan":
            await self._app(scope, receive, send)
            return
        if scope["type"] != "http":  # a WebSocket: closed before it is accepted
            await send({"type": "websocket.close", "code": 1008})
            return
        refusal = self._refusal(scope)
        if refusal is not None:
            await _refuse(send, *refusal)
            return
        await self._app(scope, _bounded(receive), _with_headers(send))

    def _refusal(self, scope: Scope) -> tuple[int, dict[str, str]] | None:
        client = scope["client"][0] if scope.get("client") else ""
        if not (self._bucket(client).take() and self._total.take()):
            return 429, {"retry-after": "1"}
        headers = _headers(scope)
        if self._token_hash is None:
            if _host_name(headers.get("host", "")) not in self._own_hosts:
                return 421, {}
        elif not self._has_token(headers.get("authorization", "")):
            return 401, _CHALLENGE
        length = headers.get("content-length", "0")
        if not length.isascii() or not length.isdigit() or int(length[:9]) > MAX_BODY_BYTES:
            return 413, {"connection": "close"}
        return None

    def _has_token(self, authorization: str) -> bool:
        scheme, _, given = authorization.partition(" ")
        if scheme.lower() == "basic":  # what a browser asks its user for: any name, the token as password
            try:
                _, _, given = base64.b64decode(given, validate=True).decode().partition(":")
            except ValueError:
                given = ""
        elif scheme.lower() != "bearer":
            given = ""
        assert self._token_hash is not None
        return hmac.compare_digest(_hash(given.encode()), self._token_hash)  # hashes: not even the length shows

    def _bucket(self, client: str) -> "_Bucket":
        bucket = self._clients.pop(client, None) or _Bucket(CLIENT_RATE_HZ, CLIENT_BURST)
        self._clients[client] = bucket
        while len(self._clients) > CLIENTS_REMEMBERED:
            self._clients.popitem(last=False)
        return bucket


class _Bucket:
    """A token bucket: ``rate_hz`` in the long run, ``burst`` at once."""

    def __init__(self, rate_hz: float, burst: float) -> None:
        self._rate_hz, self._burst = rate_hz, burst
        self._level, self._at_s = burst, time.monotonic()

    def take(self) -> bool:
        now_s = time.monotonic()
        self._level = min(self._burst, self._level + (now_s - self._at_s) * self._rate_hz)
        self._at_s = now_s
        if self._level < 1.0:
            return False
        self._level -= 1.0
        return True


class BodyTooLarge(Exception):
    """A body without a length, and longer than any of ours."""


def _bounded(receive: Receive) -> Receive:
    taken = 0

    async def bounded() -> MutableMapping[str, Any]:
        nonlocal taken
        message = await receive()
        taken += len(message.get("body", b""))
        if taken > MAX_BODY_BYTES:
            raise BodyTooLarge
        return message

    return bounded


def _with_headers(send: Send) -> Send:
    async def sending(message: MutableMapping[str, Any]) -> None:
        if message["type"] == "http.response.start":
            given = {name for name, _ in message["headers"]}
            message["headers"] = [
                *message["headers"],
                *((n.encode(), v.encode()) for n, v in SECURITY_HEADERS.items() if n.encode() not in given),
            ]
        await send(message)

    return sending


async def _refuse(send: Send, status: int, headers: dict[str, str]) -> None:
    every = {"content-length": "0", **SECURITY_HEADERS, **headers}
    pairs = [(name.encode(), value.encode()) for name, value in every.items()]
    await send({"type": "http.response.start", "status": status, "headers": pairs})
    await send({"type": "http.response.body", "body": b""})


def _headers(scope: Scope) -> dict[str, str]:
    """By lower-case name; of one that comes twice, the last."""
    return {name.decode("latin-1"): value.decode("latin-1") for name, value in scope["headers"]}


def _host_name(host: str) -> str:
    """Without its port."""
    if host.startswith("["):
        return host.partition("]")[0] + "]"
    return host.partition(":")[0].lower()


def _hash(token: bytes) -> bytes:
    return hashlib.sha256(token).digest()
