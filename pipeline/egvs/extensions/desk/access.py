"""Restrict the desk to browsers that opened the address that ``egvs desk`` printed, and limit what they send.

The rules are those of :mod:`egvs.explore.access`: a random key in the address, new at every start; a cookie for the
browser that opened it; this machine as host, and this page as origin. Requests that change something must state an
origin, which browsers always do. Every answer has a strict Content-Security-Policy.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import parse_qsl

HOST = "127.0.0.1"
KEY_PARAMETER = "key"
_NAMES = (HOST, "localhost")
_REFUSAL = b'Open the address that "egvs desk" printed in the terminal; it contains the key to this page.\n'

POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    f"font-src 'self'; frame-src http://{HOST}:*; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""What the browser may load: files of this server, and the page of ``egvs explore`` in a frame."""

_HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-opener-policy", b"same-origin"),
)

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
Application = Callable[[Message, Receive, Send], Awaitable[None]]


class KeyGuard:
    """ASGI middleware that lets requests with the key pass.

    Parameters
    ----------
    application
        What is guarded.
    port
        Port of the server.

    Attributes
    ----------
    key
        The key in the address.
    """

    def __init__(self, application: Application, port: int) -> None:
        self.key = secrets.token_urlsafe(24)
        self._application, self._port = application, port
        self._cookie = f"egvs_desk_{port}"  # browsers do not separate cookies by port

    async def __call__(self, scope: Message, receive: Receive, send: Send) -> None:
        """Answer a request, or pass it on."""
        if scope["type"] == "lifespan":
            await self._application(scope, receive, send)
            return
        if scope["type"] != "http":  # there is no websocket
            await send({"type": "websocket.close", "code": 1008})
            return

        async def send_with_policy(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", ()), *_HEADERS]
            await send(message)

        if not self._is_from_here(scope):
            await _answer(send_with_policy, 403, _REFUSAL)
        elif self._is_key(_query_key(scope)) and scope["method"] == "GET":
            cookie = f"{self._cookie}={self.key}; HttpOnly; SameSite=Strict; Path=/"
            extra = [(b"location", b"/"), (b"set-cookie", cookie.encode())]
            await _answer(send_with_policy, 303, b"", extra)
        elif self._is_key(self._cookie_key(scope)):
            await self._application(scope, receive, send_with_policy)
        else:
            await _answer(send_with_policy, 403, _REFUSAL)

    def _is_from_here(self, scope: Message) -> bool:
        hosts = [f"{name}:{self._port}".encode() for name in _NAMES]
        origins = [[b"http://" + host] for host in hosts]
        if scope["method"] in ("GET", "HEAD"):
            origins.append([])
        return _values(scope, b"host") in [[host] for host in hosts] and _values(scope, b"origin") in origins

    def _is_key(self, value: bytes) -> bool:
        return secrets.compare_digest(value, self.key.encode())

    def _cookie_key(self, scope: Message) -> bytes:
        for header in _values(scope, b"cookie"):
            for pair in header.split(b";"):
                name, _, value = pair.strip().partition(b"=")
                if name == self._cookie.encode():
                    return value
        return b""


def _values(scope: Message, name: bytes) -> list[bytes]:
    return [value for key, value in scope["headers"] if key == name]


def _query_key(scope: Message) -> bytes:
    query: bytes = scope["query_string"]
    try:
        return dict(parse_qsl(query.decode("ascii"))).get(KEY_PARAMETER, "").encode("utf-8", "surrogateescape")
    except ValueError:
        return b""


async def _answer(send: Send, status: int, body: bytes, extra: list[tuple[bytes, bytes]] | None = None) -> None:
    headers = [
        (b"content-type", b"text/plain; charset=utf-8"),
        (b"content-length", str(len(body)).encode()),
        (b"cache-control", b"no-store"),
        *(extra or ()),
    ]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": body})
