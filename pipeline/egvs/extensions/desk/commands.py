"""The command of this extension: ``egvs desk``."""

from __future__ import annotations

import socket
import webbrowser
from pathlib import Path
from typing import Annotated

import typer

from egvs.cli.commands import Command
from egvs.core import files, plugins
from egvs.core.errors import InputError


def desk(
    folder: Annotated[
        Path, typer.Argument(metavar="[FOLDER]", help="Folder with your scenarios and runs, or a scenario.")
    ] = Path(),
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port of the page on this machine; 0 for any.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
) -> None:
    """Plan in the browser: map, poles, counts, run, ranking, plan."""
    plugins.require_libraries("egvs desk", "desk", "starlette", "uvicorn")
    from egvs.extensions.desk.serving import serve

    if not folder.is_dir():
        raise InputError(folder, "no such folder", "Give a folder for your scenarios; egvs desk opens the present one.")
    listening = _listen(port)

    def announce(address: str) -> None:
        print(f"{address}  (press Ctrl-C to stop)", flush=True)
        if browser:
            webbrowser.open(address)

    with listening, files.temporary_folder() as scratch:
        serve(folder, scratch, listening, announce)


def _listen(port: int) -> socket.socket:
    """Return a socket that listens on a port of this machine; InputError if it cannot be used."""
    from egvs.extensions.desk.access import HOST

    listening = socket.socket()
    listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listening.bind((HOST, port))
    except OSError as error:
        listening.close()
        hint = "Use another port, or 0 for any free one."
        raise InputError("--port", f"port {port} cannot be used ({error.strerror})", hint) from None
    listening.listen()
    return listening


COMMANDS = (Command("desk", "Start here", desk),)
