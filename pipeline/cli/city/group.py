"""The verbs of ``egvs city``."""

from __future__ import annotations

import typer

from pipeline.cli.city import making, placing, running

app = typer.Typer(no_args_is_help=True, help="Every junction of a city, on one machine or a cluster.")

for verb in (making.new, making.traffic, running.run, placing.place):
    app.command()(verb)
