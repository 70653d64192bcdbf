"""``egvs explore``: parses, opens the page, and waits until Ctrl-C."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pipeline.cli.arguments import Jobs, Out, Set


def explore(
    place: Annotated[
        Path, typer.Argument(metavar="RUN|SCENARIO", help="The folder of a run, or a scenario, which is run first.")
    ],
    port: Annotated[int, typer.Option(min=0, max=65535, help="Of the page, on this machine; 0: any free one.")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")] = True,
    out: Out = None,
    set_: Set = None,
    jobs: Jobs = None,
    view: Annotated[
        str, typer.Option(metavar="LINK", help='What is shown first, as "Link to this view" in the page has it.')
    ] = "",
) -> None:
    """Move sensors in the browser, and see at once what they are worth there."""
    import webbrowser

    from pipeline.cli.progress import Screen
    from pipeline.core import files, plugins

    plugins.require("egvs explore", "explore", "viser")
    from pipeline.explore.opening import open_session
    from pipeline.explore.page import Page, refuse_taken

    refuse_taken(port)
    with Screen("explore") as screen:
        session = open_session(
            place, set_ or (), out, jobs=jobs, progress=screen.progress, listener=screen.stage_event
        )  # fmt: skip
    words = ["egvs", "explore", str(place), *(word for one in set_ or () for word in ("--set", one))]
    with files.scratch() as scratch:
        page = Page(session, scratch, port, (*words, *(() if out is None else ("--out", str(out)))))
        try:
            if view:
                page.open_at(view, "--view")
            print(f"{page.address}  (Ctrl-C ends it)", flush=True)
            if browser:
                webbrowser.open(page.address)
            page.run()
        except KeyboardInterrupt:  # how it is meant to end
            print()
        finally:
            page.stop()
