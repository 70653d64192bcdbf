"""What ``egvs city new`` prints: what was found in the map, and what was assumed."""

from __future__ import annotations

import shlex
from collections.abc import Iterator

from egvs.cli.console import WIDE, Column, console, make_table
from egvs.cli.new_summary import describe_dropped, describe_solids, describe_streets
from egvs.creation.openstreetmap import ATTRIBUTION
from egvs.extensions.city.creation import IMPORT_FILE, NewCity, NewJunction


def print_new_city(city: NewCity) -> None:
    """Print what ``egvs city new`` created."""
    columns: list[Column[NewJunction]] = [
        Column("junction", lambda row: row.id, "left"),
        Column("title", lambda row: row.junction.title, "left", wrap=True),
        Column("lanes in", lambda row: str(row.junction.lanes_in)),
        Column("poles", lambda row: str(len(row.poles))),
        Column("sites", lambda row: str(row.n_candidates)),
    ]
    out = console(WIDE)
    out.print(make_table(columns, city.junctions))
    for name, text in _city_lines(city):
        out.print(f"{name:<9} {text}")
    for note in city.notes:
        out.print(f"note: {note}")
    out.print(f"Map data {ATTRIBUTION}")
    out.print(f"next: {shlex.join(['egvs', 'city', 'run', str(city.folder)])}")


def _city_lines(city: NewCity) -> Iterator[tuple[str, str]]:
    poles = sum(len(row.poles) for row in city.junctions)
    sites = sum(row.n_candidates for row in city.junctions)
    yield "junctions", f"{len(city.junctions):,} with {poles:,} poles and {sites:,} candidate sites"
    if city.left_out:
        reasons = [f"{len(ids):,} ({reason})" for reason, ids in city.left_out.items()]
        yield "", f"left out: {', '.join(reasons)}"
    yield "streets", describe_streets(city.streets)
    used = f"{city.traffic.vehicles_per_h:,} vehicles start per hour (assumed)"
    yield "traffic", f"the network {city.traffic.summary}: {used}"
    yield "solids", describe_solids(city.statics)
    if left_out := describe_dropped(city.statics):
        yield "", f"left out: {left_out} (all counts: {IMPORT_FILE})"
