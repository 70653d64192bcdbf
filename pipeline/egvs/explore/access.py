"""Restrict the explorer's page to browsers that opened the address that ``egvs explore`` printed.

The address contains a random key, new at every start. A request with the key gets a cookie, and all other requests
must have that cookie, so other users and programs of the machine have no access. Web pages of another origin cannot
use the browser's cookie, because the origin of a connection must be this page; host names that somebody points at this
machine (DNS rebinding) do not work either, because requests must name this machine as their host.
"""

from __future__ import annotations

import asyncio
import http
import logging
import secrets
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlencode, urlsplit

import websockets.asyncio.server
from websockets import Headers
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

_PACKAGE = Path(__file__).parents[1]
KEY_PARAMETER = "key"
"""Parameter of the address's query."""

_HOSTS = ("127.0.0.1", "localhost")
_MAX_PATH_LENGTH = 4096
_REFUSAL = 'Open the address that "egvs explore" printed in the terminal; it contains the key to this page.\n'

# malformed requests, and messages that the page does not send, are answered or end their connection; websockets
# would also print a traceback of each
_SILENT = logging.Logger(f"{__name__}.connections", logging.CRITICAL + 1)

RequestHandler = Callable[[ServerConnection, Request], Response | None]


class AccessGuard:
    """Checks the requests to a server.

    Parameters
    ----------
    on_open
        Called with the rest of an address's query when a browser opens it, in the server's thread; returns the query
        that the browser is redirected to.

    Attributes
    ----------
    key
        The key in the address.
    is_active
        Whether a server uses this guard.
    """

    def __init__(self, on_open: Callable[[dict[str, str]], dict[str, str]]) -> None:
        self.key = secrets.token_urlsafe(24)
        self.is_active = False
        self._on_open = on_open

    @contextmanager
    def protect_new_servers(self) -> Iterator[None]:
        """Protect every websocket server that is started inside the ``with`` block.

        This replaces a function of ``websockets``, because viser has no option for a check of requests.
        """
        original = websockets.asyncio.server.serve

        def serve(*args: Any, process_request: RequestHandler, **options: Any) -> Any:
            self.is_active = True
            asyncio.get_running_loop().set_exception_handler(_report_own_error)
            return original(*args, process_request=self._guarded(process_request), logger=_SILENT, **options)

        websockets.asyncio.server.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            websockets.asyncio.server.serve = original  # type: ignore[misc]

    def _guarded(self, answer: RequestHandler) -> RequestHandler:
        def guarded(connection: ServerConnection, request: Request) -> Response | None:
            port = connection.local_address[1]
            return self.check_request(port, request) or answer(connection, request)

        return guarded

    def check_request(self, port: int, request: Request) -> Response | None:
        """Check a request.

        Parameters
        ----------
        port
            Port of the server.
        request
            The request.

        Returns
        -------
        Response or None
            A redirection for a request with the key, a refusal, or None for a request that may pass.
        """
        headers = request.headers
        is_page = "Upgrade" not in headers
        hosts = [f"{host}:{port}" for host in _HOSTS]
        origins = [[f"http://{host}"] for host in hosts]
        if is_page:
            origins.append([])  # browsers send no origin when somebody opens an address
        has_host = headers.get_all("Host") in [[host] for host in hosts]
        is_address = request.path.isascii() and len(request.path) <= _MAX_PATH_LENGTH
        if not has_host or headers.get_all("Origin") not in origins or not is_address:
            return _response(http.HTTPStatus.FORBIDDEN)
        try:
            query = dict(parse_qsl(urlsplit(request.path).query))
        except ValueError:  # no address that a browser sends
            return _response(http.HTTPStatus.FORBIDDEN)
        if is_page and self._is_key(query.pop(KEY_PARAMETER, "")):
            target = urlencode(self._on_open(query), safe=",")
            location = f"/?{target}" if target else "/"
            cookie = f"{_cookie_name(port)}={self.key}; HttpOnly; SameSite=Strict; Path=/"
            return _response(http.HTTPStatus.SEE_OTHER, {"Location": location, "Set-Cookie": cookie})
        if self._is_key(_cookie_key(headers, port)):
            return None
        return _response(http.HTTPStatus.FORBIDDEN)

    def _is_key(self, value: str) -> bool:
        # bytes of a header that are not ASCII become surrogates
        return secrets.compare_digest(value.encode("utf-8", "surrogateescape"), self.key.encode())


def _report_own_error(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Print the traceback of an error of this program, but none of a message that viser cannot interpret."""
    error = context.get("exception")
    frames = traceback.extract_tb(None if error is None else error.__traceback__)
    if error is None or any(Path(frame.filename).is_relative_to(_PACKAGE) for frame in frames):
        loop.default_exception_handler(context)


def _cookie_name(port: int) -> str:
    """Return a name that depends on the port, because browsers do not separate cookies by port."""
    return f"egvs_explore_{port}"


def _cookie_key(headers: Headers, port: int) -> str:
    """Return the key in the cookie; empty without one."""
    for header in headers.get_all("Cookie"):
        for pair in header.split(";"):
            name, _, value = pair.strip().partition("=")
            if name == _cookie_name(port):
                return value
    return ""


def _response(status: http.HTTPStatus, extra_headers: dict[str, str] | None = None) -> Response:
    body = b"" if status is http.HTTPStatus.SEE_OTHER else _REFUSAL.encode()
    headers = {
        "Content-Type": "text/plain; charset=utf-8",
        "Content-Length": str(len(body)),
        "Cache-Control": "no-store",
        "Referrer-Policy": "no-referrer",
        **(extra_headers or {}),
    }
    return Response(status.value, status.phrase, Headers(headers), body)
