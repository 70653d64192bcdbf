"""egvs visit: the sites of a run that somebody should look at, as a list of positions."""

from pathlib import Path
from typing import Annotated

import typer

from egvs.cli.commands import Command
from egvs.core.errors import InputError


def visit(
    run: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a finished run.")],
    sites: Annotated[int, typer.Option(min=1, help="Number of sites.")] = 3,
) -> None:
    """List the best sites of a run, to visit them."""
    import egvs

    scores = run / "scores.parquet"
    if not scores.is_file():
        raise InputError(run, "there are no scores in this folder", "Run egvs run first.")
    rows = sorted(egvs.read_scores(scores).to_pylist(), key=lambda row: row["rank"])
    for row in rows[:sites]:
        print(f"{row['site']}: x {row['x_m']:.1f} m, y {row['y_m']:.1f} m")


COMMANDS = (Command("visit", "Install", visit),)
