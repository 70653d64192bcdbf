"""Starts and stops the server of viser: for this machine only, and only for browsers with the key."""

from __future__ import annotations

import io
from contextlib import redirect_stdout

import viser

from egvs.core.errors import RunError
from egvs.explore.access import AccessGuard

HOST = "127.0.0.1"
"""The page cannot be reached from other machines."""


class _Server(viser.ViserServer):
    """A server whose page cannot be published."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Refuse to publish the page."""
        return None


def start_server(guard: AccessGuard, port: int = 0) -> viser.ViserServer:
    """Start a server.

    Parameters
    ----------
    guard
        Checks its requests.
    port
        Port on this machine; 0 for any free one. If the port is in use, viser takes another one.

    Raises
    ------
    RunError
        If the guard cannot protect the server.
    """
    with redirect_stdout(io.StringIO()), guard.protect_new_servers():  # viser prints a banner
        server = _Server(host=HOST, port=port, label="egvs explore", verbose=False)
    if not guard.is_active:
        stop_server(server)
        raise RunError("this version of viser starts its server differently, so the page cannot be protected")
    return server


def stop_server(server: viser.ViserServer) -> None:
    """Stop a server and its threads."""
    with redirect_stdout(io.StringIO()):  # viser prints a message
        server.stop()
