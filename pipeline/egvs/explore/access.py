"""Who may use the page: browsers that opened the address that ``egvs explore`` printed, and nobody else.

The address holds a key that is drawn afresh at every start. Who brings it gets a cookie, and every other request must
show that cookie: so no other user or program of this machine gets in. A page of another origin that a browser has open
cannot use the browser's cookie either, as the origin of a connection has to be this one; nor can a name that its owner
has pointed at this machine (DNS rebinding), as a request has to name this machine as its host.
"""

from __future__ import annotations

import http
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

KEY_PARAMETER = "key"
"""Of the query of the address."""

_HOSTS = ("127.0.0.1", "localhost")
_MAX_QUERY_LENGTH = 4096
_REFUSAL = "egvs explore: open the address that it printed; it holds the key to this page.\n"

RequestHandler = Callable[[ServerConnection, Request], Response | None]


class AccessGuard:
    """Stands before a server.

    Parameters
    ----------
    opened
        Called with the rest of an address's query (key and value), from the server's thread; gives the query that the
        browser is sent on to.
    """

    def __init__(self, opened: Callable[[dict[str, str]], dict[str, str]]) -> None:
        self.key = secrets.token_urlsafe(24)
        self.is_active = False
        self._opened = opened

    @contextmanager
    def before_a_server(self) -> Iterator[None]:
        """A server of websockets that is started in the meantime asks this guard before it answers."""
        real = websockets.asyncio.server.serve

        def serve(*args: Any, process_request: RequestHandler, **more: Any) -> Any:
            self.is_active = True
            return real(*args, process_request=self.before(process_request), **more)

        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = real  # type: ignore[misc]

    def before(self, answer: RequestHandler) -> RequestHandler:
        """An answer to requests that are let through."""

        def guarded(connection: ServerConnection, request: Request) -> Response | None:
            port = connection.local_address[1]
            return self.refusal_or_welcome(port, request) or answer(connection, request)

        return guarded

    def refusal_or_welcome(self, port: int, request: Request) -> Response | None:
        """What is said to a request that brings the key, or must not pass; None for one that passes."""
        headers, ours = request.headers, [f"{host}:{port}" for host in _HOSTS]
        is_page, origins = "Upgrade" not in headers, [[f"http://{its}"] for its in ours]
        if is_page:
            origins.append([])  # browsers name none where somebody opens an address
        is_ours = headers.get_all("Host") in [[its] for its in ours] and headers.get_all("Origin") in origins
        if not is_ours or len(request.path) > _MAX_QUERY_LENGTH:
            return _response(http.HTTPStatus.FORBIDDEN)
        query = dict(parse_qsl(urlsplit(request.path).query))
        if is_page and self._is_key(query.pop(KEY_PARAMETER, "")):
            to = urlencode(self._opened(query), safe=",")
            cookie = f"{_cookie_name(port)}={self.key}; HttpOnly; SameSite=Strict; Path=/"
            return _response(http.HTTPStatus.SEE_OTHER, {"Location": f"/?{to}" if to else "/", "Set-Cookie": cookie})
        return None if self._is_key(_cookie_key(headers, port)) else _response(http.HTTPStatus.FORBIDDEN)

    def _is_key(self, value: str) -> bool:
        return secrets.compare_digest(value.encode(), self.key.encode())


def _cookie_name(port: int) -> str:
    """A name of its own for each port: browsers keep cookies by machine."""
    return f"egvs_explore_{port}"


def _cookie_key(headers: Headers, port: int) -> str:
    """The key in the cookie; empty where there is none."""
    pairs = (pair.strip().partition("=") for its in headers.get_all("Cookie") for pair in its.split(";"))
    return next((value for name, _, value in pairs if name == _cookie_name(port)), "")


def _response(status: http.HTTPStatus, more: dict[str, str] | None = None) -> Response:
    body = b"" if status is http.HTTPStatus.SEE_OTHER else _REFUSAL.encode()
    headers = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",
        **(more or {}),
    }
    return Response(status.value, status.phrase, Headers(headers), body)
