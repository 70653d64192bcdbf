"""Serve the desk until it is interrupted."""

from __future__ import annotations

import contextlib
import socket
from collections.abc import Callable
from pathlib import Path

import uvicorn

from egvs.extensions.desk.access import HOST, KEY_PARAMETER, KeyGuard
from egvs.extensions.desk.events import Events
from egvs.extensions.desk.server import Desk, make_application
from egvs.extensions.desk.workspace import Workspace

_CLOSE_S = 1
"""Time for open connections to end."""


class _Server(uvicorn.Server):
    """Ends the events of open pages when it stops; a connection that is cut would be reported as an error."""

    def __init__(self, config: uvicorn.Config, events: Events) -> None:
        super().__init__(config)
        self._events = events

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        self._events.close()
        await super().shutdown(sockets)


def make_server(folder: Path, scratch: Path, port: int) -> tuple[uvicorn.Server, str, Desk]:
    """Return the server for a folder, the address to open, and its state.

    Parameters
    ----------
    folder
        Folder with scenarios.
    scratch
        A temporary folder.
    port
        Port of the socket that it will listen on.
    """
    desk = Desk(Workspace(folder, scratch))
    guard = KeyGuard(make_application(desk), port)
    config = uvicorn.Config(
        guard, log_level="error", access_log=False, server_header=False, ws="none", proxy_headers=False,
        timeout_graceful_shutdown=_CLOSE_S,
    )  # fmt: skip
    return _Server(config, desk.events), f"http://{HOST}:{port}/?{KEY_PARAMETER}={guard.key}", desk


def serve(folder: Path, scratch: Path, listening: socket.socket, announce: Callable[[str], None]) -> None:
    """Serve a folder until Ctrl-C; ``announce`` is called with the address."""
    server, address, _ = make_server(folder, scratch, listening.getsockname()[1])
    with contextlib.suppress(KeyboardInterrupt):  # the normal way to stop
        announce(address)
        server.run(sockets=[listening])
    print()
