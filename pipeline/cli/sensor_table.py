"""The sensor catalogue as a table."""

from __future__ import annotations

from collections.abc import Iterable

from rich.table import Table

from pipeline.cli.terminal import console
from pipeline.sensing.sensors import Sensor


def print_sensors(sensors: Iterable[Sensor]) -> None:
    """The sensors that need no table of the user's."""
    table = Table(box=None, pad_edge=False)
    for name in ("sensor", "channels", "elevation deg", "azimuth step deg", "beams", "range m", "source"):
        table.add_column(name, justify="left" if name in ("sensor", "source") else "right", overflow="fold")
    for s in sensors:
        span = f"{min(s.elevations_deg):g} to {max(s.elevations_deg):g}"
        table.add_row(
            s.name, str(s.channels), span, f"{360 / s.azimuths:.6g}", str(s.beams), f"{s.range_m:g}", s.source
        )
    console(160, soft_wrap=False).print(table)
