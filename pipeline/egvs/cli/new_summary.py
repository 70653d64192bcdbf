"""What ``egvs new`` prints: what was found in the map, and what was assumed.

One line for each part of the new scenario. Where a part needs more words (what happened to every object of the map),
the line says which file has them.
"""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from egvs.cli.console import Column, console, print_table
from egvs.core.wording import list_first, number_of
from egvs.creation import junctions
from egvs.creation.map_parts import OUT_OF_RANGE, ImportCounts
from egvs.creation.new_scenario import ListedJunction, NewScenario
from egvs.creation.scenario_files import COUNTS_FILE, PITCHES_DEG, SENSOR, SIGNALS_FILE, SITES_FILE, STATICS_FILE
from egvs.scenario.model import SCENARIO_FILE

if TYPE_CHECKING:
    from egvs.creation.junctions import Streets
    from egvs.creation.static_objects import MapSummary

_FILE_WIDTH = 160
_MOST_NAMED = 3


def print_new_scenario(scenario: NewScenario, map_notes: Sequence[str] = ()) -> None:
    """Print what ``egvs new`` created; ``map_notes`` say where the map comes from."""
    out = console(_FILE_WIDTH)
    for name, text in _scenario_lines(scenario):
        out.print(f"{name:<9} {text}")
    for note in (*map_notes, *scenario.notes):
        out.print(f"note: {note}")
    for warning in _scenario_warnings(scenario):
        out.print(f"warning: {warning}")
    if scenario.attributions:
        out.print(f"Map data {'; '.join(scenario.attributions)}")
    check = shlex.join(["egvs", "check", str(scenario.folder)])
    out.print(f"edit: {_tables_to_edit(scenario)}; {SCENARIO_FILE} (existing_poles, costs); then {check}")
    out.print(f"next: {shlex.join(['egvs', 'run', str(scenario.folder)])}")
    out.print(f"      {shlex.join(['egvs', 'place', str(scenario.folder), '--count', '2'])}   (or --budget)")


def print_junctions(listed: Sequence[ListedJunction]) -> None:
    """Print a table of junctions."""
    columns: list[Column[ListedJunction]] = [
        Column("--at", lambda junction: junction.at, "left"),
        Column("arms", lambda junction: str(junction.arms)),
        Column("lanes in", lambda junction: str(junction.lanes_in)),
        Column("signals", lambda junction: "yes" if junction.signalised else "-", "left"),
        Column("junction", lambda junction: junction.title, "left", wrap=True),
    ]
    if any(junction.distance_m is not None for junction in listed):
        columns.insert(1, Column("m away", lambda junction: f"{junction.distance_m or 0.0:,.0f}"))
    print_table(columns, listed, file_width=_FILE_WIDTH)
    print(f"{number_of(len(listed), 'junction')}; egvs new FOLDER --from ... --at LAT,LON makes a scenario of one")


def _scenario_lines(scenario: NewScenario) -> Iterator[tuple[str, str]]:
    junction, region, statics = scenario.junction, scenario.region, scenario.statics
    width_m, depth_m = region.roi.size_m
    arms = f"{number_of(junction.arms, 'arm')}, {number_of(junction.lanes_in, 'incoming lane')}"
    yield "junction", f"{junction.title}: {arms}; {_position(scenario)}"
    if region.other_junctions:
        yield "", f"also in the map: {list_first(region.other_junctions, _MOST_NAMED, '; ')}"
    yield "region", f"{width_m:g} m x {depth_m:g} m x {region.height_m:g} m around the junction"
    yield "streets", describe_streets(scenario.streets)
    yield "traffic", scenario.traffic.describe()
    mounts = f"{len(junctions.HEIGHTS_M)} heights x {len(PITCHES_DEG)} tilts"
    yield "sites", f"{scenario.n_candidates:,} candidates: {scenario.poles} poles x {mounts}, sensor {SENSOR}"
    solids = describe_solids(statics.counts, statics.n_solids)
    if statics.n_solids <= 1:  # the ground
        solids += ": nothing hides vehicles"
    yield "solids", solids
    if left_out := describe_dropped(statics.counts):
        yield "", f"left out: {left_out} (all counts: {STATICS_FILE})"
    for summary in statics.maps if len(statics.maps) > 1 or statics.maps_have_notes else ():
        yield "map", _describe_map(summary)
        for note in summary.notes:
            yield "", note


def _describe_map(summary: MapSummary) -> str:
    """Return the files of a map, its format, and its objects with their heights."""
    files = list_first([path.name for path in summary.paths], 1)
    texts = [f"{files} ({summary.reader}): {describe_solids(summary.counts)}"]
    if summary.height_range_m is not None:
        texts.append("tops at z = {:.1f} to {:.1f} m".format(*summary.height_range_m))
    return ", ".join(texts)


def _tables_to_edit(scenario: NewScenario) -> str:
    """Return the tables of the scenario that a user is expected to edit, with their contents."""
    contents = {COUNTS_FILE: "counted vehicles", SIGNALS_FILE: "signal plan", SITES_FILE: "poles"}
    return ", ".join(f"{name} ({what})" for name, what in contents.items() if (scenario.folder / name).is_file())


def _position(scenario: NewScenario) -> str:
    """Return the position of the junction, and its distance from the requested one."""
    position = f"at {scenario.streets.format_position(scenario.junction.at_m)}"
    if scenario.region.from_at_m is not None:
        return f"{position}, {scenario.region.from_at_m:,.0f} m from --at"
    if scenario.traffic.is_recorded:
        return position
    return f"{position}, the largest of the map; --at chooses another"


def describe_streets(streets: Streets) -> str:
    signalised = sum(junction.signalised for junction in junctions.distinct_crossings(streets))
    length = f"{streets.lane_length_m / 1000:,.1f} km of lanes"
    return (
        f"{number_of(len(streets.network.edges), 'edge')}, {length}, {number_of(signalised, 'junction')} with signals"
    )


def describe_solids(counts: ImportCounts, n_solids: int | None = None) -> str:
    """Return the objects by kind, and the number of solids that ``egvs check`` counts, if it is known."""
    objects = Counter({kind: number for kind, number in counts.objects.items() if kind != "tree_crown"})
    texts = [number_of(number, kind.removesuffix("_trunk").replace("_", " ")) for kind, number in objects.most_common()]
    if not texts:
        return "none"
    total = number_of(objects.total(), "object")
    if n_solids is not None:
        total += f" ({number_of(n_solids, 'solid')} with tree crowns, cut pieces and the ground)"
    return f"{total}: {', '.join(texts)}"


def describe_dropped(counts: ImportCounts) -> str:
    """Return what is left out and why, except objects out of range, which a note names."""
    texts = []
    for reason, kinds in sorted(counts.dropped.items()):
        if reason != OUT_OF_RANGE:
            objects = ", ".join(number_of(number, kind.replace("_", " ")) for kind, number in kinds.most_common())
            texts.append(f"{objects} ({reason.replace('_', ' ')})")
    return "; ".join(texts)


def _scenario_warnings(scenario: NewScenario) -> Iterator[str]:
    if scenario.region.is_far_from_at:
        distance = f"{scenario.region.from_at_m:,.0f} m from --at"
        yield (
            f"the junction ({scenario.junction.title}) is {distance} and may not be the one that you mean."
            " Check the position, and that the map contains the junction."
        )
    yield from scenario.traffic.warnings(scenario.folder / SCENARIO_FILE)
