"""Read OpenDRIVE maps (``.xodr``) as SUMO networks, through netconvert, and check by road what was lost.

Steps of :func:`read_roads`: parse and check the map (:mod:`egvs.extensions.maps.formats.opendrive`); write a copy as
netconvert expects it (:mod:`egvs.extensions.maps.formats.opendrive_copy`); run netconvert; compare its network with the
map (:mod:`egvs.extensions.maps.opendrive.check`); add the connections that it lacks, and close lanes that are not for
vehicles, by patches that netconvert applies; forbid the lane changes that the road marks forbid; add the height of the
header's offset.

netconvert (1.28) loses the second of two lanes that lead to one in a junction, opens sidewalks to cars when it imports
them, and ignores road marks and the height of the header's offset.

World frame: that of the network, x east, y north in metres. Without a projection in the map, it is the map's own frame.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np

from egvs.core import files, limits
from egvs.core.errors import InputError
from egvs.core.wording import by_number, list_first, number_of
from egvs.creation import junctions
from egvs.creation.driving_side import DrivingSide, Evidence, choose_side, majority, side_in_frame
from egvs.creation.map_parts import RoadMap, RoadOptions
from egvs.creation.terrain import draping, network_heights
from egvs.creation.turns import Connection, list_turns, patch_network
from egvs.extensions.maps.formats import opendrive
from egvs.extensions.maps.formats.opendrive import OpenDriveMap, Road
from egvs.extensions.maps.formats.opendrive_copy import CopyOptions, write_copy
from egvs.extensions.maps.opendrive.check import (
    HEIGHT_OFF_M,
    OFF_M,
    MadeNetwork,
    MapComparison,
    compare_with_map,
    read_made_network,
)
from egvs.extensions.maps.opendrive.lane_changes import ForbiddenChanges, find_forbidden_changes, forbid_changes
from egvs.extensions.maps.opendrive.turns import DRIVING_TYPES, mirrored, permitted_turns
from egvs.formats import georeference
from egvs.traffic import sumo

RESOLUTION_M = 0.5
"""Distance of the points on curves; lanes of CARLA's Town01 are then at most 0.014 m off, and 0.028 m by default."""

ALLOWED = {"sidewalk": "pedestrian", "walking": "pedestrian", "biking": "bicycle"}
"""Who may use lanes that are not for vehicles; those of other types are closed."""

_FLAGS = ("--opendrive.curve-resolution", f"{RESOLUTION_M:g}", "--output.original-names", "--precision", "3")
_PATCH_FLAGS = ("--no-turnarounds.except-deadend", "--output.original-names", "--precision", "3")
_WALK_FLAGS = ("--walkingareas", "--crossings.guess")
_OWN_FRAME_FLAG = "--offset.disable-normalization"

_MAP, _NETWORK, _PATCHED = "map.xodr", "network.net.xml", "patched.net.xml"
_EDGE_PATCH = "patch.edg.xml"
_GENERATED = re.compile(r"<!-- generated on .*?-->", re.DOTALL)
_GEOID = re.compile(r"\+(?:geoidgrids|vunits|vto_meter)=\S+\s*")
_LISTED = 5


def read_roads(path: Path, options: RoadOptions) -> RoadMap:
    """Return the SUMO network of an OpenDRIVE map.

    Parameters
    ----------
    path
        The map, gzipped or not.
    options
        Traffic drives on the left if they say so, or the map does (``rule="LHT"``, or its lanes); then lanes with
        positive ids lead along their roads. With ``walk``, sidewalks are imported, and crossings are guessed.

    Raises
    ------
    InputError
        When the map is damaged, is for the other side of traffic than the options say, has roads for left- and for
        right-hand traffic, or netconvert cannot use it.
    """
    road_map = opendrive.read_opendrive(path)
    check_size(road_map, path)
    reference, notes = _projection(road_map, path)
    side = _choose_side(road_map, reference, options.requested_left, path)
    lefthand = side.lefthand
    copy_options = CopyOptions(
        reference,
        rotation_rad=road_map.offset_rad if reference else 0.0,
        swap_lanes=lefthand,
        keeps_type=_import_all if options.walk else is_driving,
        keeps_all_lights=options.walk,
    )
    with _conversion(path) as folder:
        write_copy(path, road_map, folder / _MAP, copy_options)
        copied = _read_copy(folder / _MAP, path)
        flags = [*_FLAGS, *(["--lefthand"] if lefthand else []), *([] if reference else [_OWN_FRAME_FLAG])]
        if options.walk:
            flags.append("--opendrive.import-all-lanes")
        sumo.run_netconvert(["--opendrive-files", _MAP, *flags], folder, _NETWORK)

        made = read_made_network(folder / _NETWORK)
        comparison = compare_with_map(made, copied, mirrored=lefthand)
        name = _patch(folder, made, comparison, options)
        after = comparison
        if name != _NETWORK:
            after = compare_with_map(read_made_network(folder / name), copied, mirrored=lefthand)
        notes += (*_patch_notes(comparison, after), *comparison_notes(after, road_map))
        if not options.walk:
            notes += _light_notes(road_map)
        text = (folder / name).read_text(encoding="utf-8")
        changes = find_forbidden_changes(read_made_network(folder / name), copied, mirrored=lefthand)
    text = forbid_changes(text, changes, lefthand=lefthand)
    notes += _lane_change_notes(changes)

    text = _GENERATED.sub("<!-- made from an OpenDRIVE map -->", text, count=1)
    height_m = copied.offset_m[2]
    if height_m:
        text = network_heights.shift_heights(text, height_m)
        notes += (f"The header's offset of {height_m:g} m was added to all heights.",)
    if any(road_map.offset_m) and not reference:
        notes += ("The header's offset is left out, since it refers to an unknown reference system.",)
    has_heights = bool(height_m) or any(_has_relief(road) for road in road_map.roads.values())
    if has_heights:
        notes += _level_notes(text)
    return RoadMap(text, notes=(*notes, *_map_notes(road_map), side.note), has_heights=has_heights)


def _read_copy(copy: Path, path: Path) -> OpenDriveMap:
    """Read the copy of a map; messages name the map."""
    try:
        return opendrive.read_opendrive(copy)
    except InputError as error:
        raise InputError(error.where.replace(str(copy), str(path)), error.problem, error.hint) from None


def is_driving(lane_type: str) -> bool:
    """Return whether lanes of a type are for vehicles."""
    return lane_type in DRIVING_TYPES


def check_size(road_map: OpenDriveMap, path: Path) -> None:
    """Raise an InputError when the lanes of a map are so long that their points would need too much memory."""
    points = 0.0
    for road in road_map.roads.values():
        lanes = sum(len(section.lanes) for section in road.sections) + 1
        pieces = sum(piece.length_m for piece in road.plan)
        points += (max(road.length_m, pieces) / RESOLUTION_M + len(road.plan)) * lanes
    problem = f"has lanes so long that they need {points:,.0f} points"
    limits.MAP_OBJECTS.check(path, points, problem)


def _import_all(_lane_type: str) -> bool:
    return True


def _choose_side(road_map: OpenDriveMap, reference: str, lefthand: bool | None, path: Path) -> DrivingSide:
    """Decide on which side traffic drives: as the roads state, or else as their lanes lead; maps up to version 1.4 do
    not state a rule.
    """
    roads = road_map.roads.values()
    left = [road.id for road in roads if road.rule == "LHT"]
    if 0 < len(left) < len(roads):
        problem = f"has roads for left-hand traffic ({_listed(left)}) and for right-hand traffic"
        raise InputError(path, problem, "Use a map in which all traffic keeps to one side.")
    evidence: Evidence | None
    if any(road.rule for road in roads):
        evidence = (
            Evidence("left", 'its roads state rule="LHT"') if left else Evidence("right", 'its roads state rule="RHT"')
        )
    else:
        right_turns, left_turns = (_turns_in_junctions(lanes) for lanes in (road_map, mirrored(road_map)))
        counts = {"right": right_turns, "left": left_turns}
        reasons = [
            f"{counts[side]} turns are from lanes on the {side}, {counts[other]} from lanes on the {other}"
            for side, other in (("left", "right"), ("right", "left"))
        ]
        evidence = majority(left_turns, right_turns, (reasons[0], reasons[1]))
    of_map = [] if evidence is None else [evidence]
    return choose_side(lefthand, of_map, _side_of_position(road_map, reference, path), str(path))


def _turns_in_junctions(road_map: OpenDriveMap) -> int:
    return sum(bool(turn.junction) for turn in permitted_turns(road_map))


def _side_of_position(road_map: OpenDriveMap, reference: str, path: Path) -> Evidence | None:
    """Return the side of traffic where a map lies; its lanes count more."""
    start = next((road.plan[0] for road in road_map.roads.values() if road.plan), None)
    if not reference or start is None:
        return None
    frame = georeference.WorldFrame.from_projection(reference, (0.0, 0.0), str(path))
    return side_in_frame(frame, np.add((start.x_m, start.y_m), road_map.offset_m[:2]).tolist())


def _projection(road_map: OpenDriveMap, path: Path) -> tuple[str, tuple[str, ...]]:
    """Return the map's projection as a PROJ string, empty if it has none, and what to tell."""
    text = _GEOID.sub("", road_map.reference).strip()
    if not text:
        return "", ("The map declares no reference system; the network has its metres.",)
    problem = f"The map's reference system ({text[:60]!r}) is no map projection in metres; the network has the map's."
    if text.startswith("+") and "+proj=" not in text and "+init=" not in text:
        return "", (problem,)
    try:
        georeference.WorldFrame.from_projection(text, (0.0, 0.0), str(path))
        return georeference.proj_string(text, str(path)), ()
    except InputError:
        return "", (problem,)


@contextmanager
def _conversion(path: Path) -> Iterator[Path]:
    """Yield a temporary folder; raise netconvert's errors there, and those of its networks, as errors of a map."""
    with files.temporary_folder() as folder:
        try:
            yield folder
        except sumo.SumoInputError as error:
            hint = "Correct the map, or export it again."
            raise error.for_input(path, "netconvert cannot use the map", hint) from None
        except InputError as error:
            raise junctions.unusable_network(error, folder, path) from None


def _patch(folder: Path, made: MadeNetwork, comparison: MapComparison, options: RoadOptions) -> str:
    """Add missing connections, remove others, and close lanes; return the name of the resulting network."""
    added = [
        Connection(source.edge, source.index, target.edge, target.index)
        for source, target in comparison.missing.values()
        if made.turns.can_connect(source.edge, target.edge)
    ]
    removed = [Connection(*connection) for connection in comparison.added]
    edges = _edge_patches(made) if options.walk else []
    if not added and not removed and not edges:
        return _NETWORK
    flags = [*_PATCH_FLAGS]
    if edges:
        (folder / _EDGE_PATCH).write_text(_element("edges", edges), encoding="utf-8")
        flags += ["-e", _EDGE_PATCH, *_WALK_FLAGS]
    patch_network(folder, _NETWORK, _PATCHED, removed=removed, added=added, flags=flags)
    return _PATCHED


def _edge_patches(made: MadeNetwork) -> list[str]:
    """Return an edge element for each edge with lanes that are not for vehicles, with who may use them."""
    by_edge: dict[str, dict[int, str]] = {}
    for lanes in made.lanes.values():
        for lane in lanes:
            if not is_driving(lane.type):
                by_edge.setdefault(lane.edge, {})[lane.index] = lane.type
    patches = []
    for edge, types in sorted(by_edge.items()):
        lanes_text = ""
        for index, lane_type in sorted(types.items()):
            allowed = ALLOWED.get(lane_type)
            permission = 'disallow="all"' if allowed is None else f'allow="{allowed}"'
            lanes_text += f'<lane index="{index}" {permission}/>'
        patches.append(f"<edge id={quoteattr(edge)}>{lanes_text}</edge>")
    return patches


def _element(tag: str, children: Iterable[str]) -> str:
    return f"<{tag}>\n" + "\n".join(children) + f"\n</{tag}>\n"


def _patch_notes(before: MapComparison, after: MapComparison) -> tuple[str, ...]:
    notes = []
    added = [turn for turn in before.missing if turn not in after.missing]
    if added:
        roads = _listed(turn.source.road for turn in added)
        notes.append(
            f"{len(added)} of {number_of(before.turns, 'turn')} that netconvert had lost"
            f" {by_number(len(added), 'was', 'were')} added, from roads {roads}."
        )
    removed = sorted({*before.added} - {*after.added})
    if removed:
        edges = list_turns(f"{source} to {target}" for source, _, target, _ in removed)
        notes.append(
            f"{number_of(len(removed), 'connection')} that {by_number(len(removed), 'is', 'are')} not in the map"
            f" {by_number(len(removed), 'was', 'were')} removed: {edges}."
        )
    return tuple(notes)


def _light_notes(road_map: OpenDriveMap) -> tuple[str, ...]:
    """Return a sentence on the traffic lights that are not in the copy."""
    roads = [road.id for road in road_map.roads.values() if any(map(road.is_light_elsewhere, road.signals))]
    if not roads:
        return ()
    return (
        "Traffic lights at no junction, such as those of pedestrian crossings, are left out (--walk keeps them), on"
        f" {by_number(len(roads), 'road', 'roads')} {_listed(roads)}.",
    )


def _lane_change_notes(changes: ForbiddenChanges) -> tuple[str, ...]:
    """Return sentences on lane changes, by edge."""
    notes = []
    if changes.to_lanes:
        count = len(changes.to_lanes)
        notes.append(f"Road marks forbid lane changes from {number_of(count, 'lane')}, of {_listed(changes.edges)}.")
    if changes.opened:
        lanes = _listed(f"{edge}_{lane}" for edge, lane in changes.opened)
        notes.append(
            "Lanes that nothing leads to, and that can only be reached across a mark that forbids it; vehicles may"
            f" change to them: {lanes}."
        )
    return tuple(notes)


def comparison_notes(comparison: MapComparison, road_map: OpenDriveMap) -> tuple[str, ...]:
    """Return sentences on what a network lacks, by road id."""
    lost_lanes = len(comparison.lost_lanes)
    lost_turns = [*comparison.lost_turns, *comparison.missing]
    notes = [
        f"{comparison.lanes - lost_lanes} of {comparison.lanes} lanes for vehicles and"
        f" {comparison.turns - len(lost_turns)} of {comparison.turns} turns of the map are in the network."
    ]
    if lost_lanes:
        notes.append(f"Lanes of these roads are missing: {_listed(key.road for key in comparison.lost_lanes)}.")
    if lost_turns:
        turns = (f"{turn.source.road} to {turn.target.road}" for turn in lost_turns)
        notes.append(f"Turns between these roads are missing: {_listed(turns)}.")
    if comparison.added:
        edges = (f"{source} to {target}" for source, _, target, _ in comparison.added)
        notes.append(
            f"{number_of(len(comparison.added), 'connection')} {by_number(len(comparison.added), 'is', 'are')}"
            f" not in the map: {_listed(edges)}."
        )
    if comparison.guessed:
        edges = (f"{source} to {target}" for source, _, target, _ in comparison.guessed)
        guessed = (
            f"{number_of(len(comparison.guessed), 'connection')}"
            f" {by_number(len(comparison.guessed), 'is', 'are')} guessed, from lanes that the map links to none"
        )
        notes.append(f"{guessed}: {_listed(edges)}.")
    far = {road: off_m for road, off_m in comparison.off_m.items() if off_m > OFF_M}
    if far:
        notes.append(
            f"Lanes of {number_of(len(far), 'road')} lie more than {OFF_M:g} m off the map, up to"
            f" {max(far.values()):.1f} m:"
            f" {_listed(far)}."
        )
    high = {road: off_m for road, off_m in comparison.height_off_m.items() if off_m > HEIGHT_OFF_M}
    if high:
        notes.append(f"Heights of these roads differ by up to {max(high.values()):.1f} m: {_listed(high)}.")
    if comparison.restricted:
        notes.append(
            f"{number_of(comparison.restricted, 'lane')} narrower than 1.8 m"
            f" {by_number(comparison.restricted, 'is', 'are')} closed to normal traffic."
        )
    signals = sum(signal.dynamic for road in road_map.roads.values() for signal in road.signals)
    if signals:
        notes.append(
            f"{number_of(signals, 'traffic light')}: places and programs are not in the network; SUMO's default"
            " programs are"
            " used."
        )
    if comparison.unlit_roads:
        notes.append(f"Traffic lights of these roads have no effect: {_listed(comparison.unlit_roads)}.")
    return tuple(notes)


def _map_notes(road_map: OpenDriveMap) -> tuple[str, ...]:
    """Return sentences on what no network can have, and on what the map does not state."""
    notes = ["Road classes are assumed by speed limit."]
    roads = [road for road in road_map.roads.values() if not road.junction]
    without_speed = [road.id for road in roads if not road.states_speed]
    if without_speed:
        notes.append(
            f"{len(without_speed)} of {number_of(len(roads), 'road')} {by_number(len(without_speed), 'has', 'have')} no"
            f" speed limit: 50 km/h assumed, {_listed(without_speed)}."
        )
    if road_map.virtual:
        count = len(road_map.virtual)
        passing = [road for road in road_map.roads if road_map.is_in_virtual_junction(road)]
        notes.append(
            f"{number_of(count, 'virtual junction')}, which {by_number(count, 'joins', 'join')} roads between their"
            f" ends, and the roads through {by_number(count, 'it', 'them')} are left out: {_listed(passing) or 'none'}."
        )
    sloped = [road.id for road in road_map.roads.values() if any(any(cubic[1:]) for cubic in road.superelevations)]
    if sloped:
        notes.append(
            f"The slope across {number_of(len(sloped), 'road')} (superelevation) is left out: {_listed(sloped)}."
        )
    signs = sum(not signal.dynamic for road in road_map.roads.values() for signal in road.signals)
    if signs:
        notes.append(f"{number_of(signs, 'sign or mark', 'signs and marks')} {by_number(signs, 'is', 'are')} left out.")
    return tuple(notes)


def _level_notes(network_text: str) -> tuple[str, ...]:
    """Return a sentence on roads that lead over others."""
    pairs = draping.roads_above_others(network_text)
    if not pairs:
        return ()
    listed = _listed(f"{upper} over {lower}" for upper, lower in pairs)
    return (
        f"In {number_of(len(pairs), 'place')}, roads lead over others: {listed}. Without a terrain, the ground rises"
        " to the upper one.",
    )


def _has_relief(road: Road) -> bool:
    return any(any(cubic[1:]) for cubic in road.elevations)


def _listed(names: Iterable[str]) -> str:
    """Return the first of some names, without repetitions, and the number of the others."""
    return list_first(list(dict.fromkeys(names)), _LISTED)
