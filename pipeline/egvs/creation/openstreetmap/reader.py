"""Read roads and static objects of an OpenStreetMap extract.

Streets are cut around a junction, and roads that cross its region on another level are left out
(:mod:`egvs.creation.openstreetmap.street_network`, :mod:`egvs.creation.road_levels`). Buildings, trees, barriers,
bridge decks and poles become solids (:mod:`egvs.creation.openstreetmap.solids`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from shapely.geometry.base import BaseGeometry

from egvs.core.errors import InputError
from egvs.creation import junctions, road_levels
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.map_parts import ImportCounts, MapContext, MappedPole, MappedSolid, RoadOptions, SolidMap
from egvs.creation.openstreetmap import ATTRIBUTION, elevation
from egvs.creation.openstreetmap import solids as osm_solids
from egvs.creation.openstreetmap import street_network as osm_network
from egvs.creation.openstreetmap.side_evidence import choose_map_side, exceptions_note
from egvs.creation.road_levels import OtherLevels
from egvs.formats import osm as osm_files
from egvs.formats.osm import OsmExtract

SURROUNDINGS_M = 300.0
"""How far from the junction streets are simulated: enough for the queues and platoons that reach it."""

_BEYOND_M = 500.0
"""With a position, streets are read up to this distance beyond the surroundings: the junction can be up to
:data:`~egvs.creation.junctions.MAX_FROM_POINT_M` from it, and streets that meet outside may be joined to one node."""

_ONE_LEVEL = OtherLevels()


def check_inside_extract(extract: OsmExtract, at: tuple[float, float] | None, option: str = "--at") -> None:
    """Raise an InputError if a position (latitude, longitude in degrees) of an option is outside the extract."""
    if at is None or extract.bounds.contains(*at):
        return
    b = extract.bounds
    bounds = f"latitude {b.south_deg:g} to {b.north_deg:g}, longitude {b.west_deg:g} to {b.east_deg:g}"
    hint = f"Choose a position inside the extract: {bounds}."
    if extract.bounds.contains(at[1], at[0]):
        hint = f"Latitude comes first: did you mean {option} {at[1]!r},{at[0]!r}?"
    raise InputError(option, f"{at[0]:g},{at[1]:g} is outside the extract", hint)


@dataclass(frozen=True)
class OsmRoads:
    """The roads of an extract; a :class:`~egvs.creation.road_source.RoadSource`.

    Attributes
    ----------
    extract, path
        The map and its file.
    flags
        Options of netconvert.
    network, streets
        The network, as text and read.
    others
        Ways on other levels than the junction.
    map_notes, turn_notes
        Sentences for the user about the map, and about the turns of the network.
    """

    extract: OsmExtract
    path: Path
    flags: tuple[str, ...]
    network: str
    streets: Streets
    others: OtherLevels = _ONE_LEVEL
    attribution: str = ATTRIBUTION
    map_notes: tuple[str, ...] = ()
    turn_notes: tuple[str, ...] = ()

    @classmethod
    def read(cls, path: Path, options: RoadOptions) -> OsmRoads:
        """Read an extract and build the network of all its streets, or of those around a position.

        Parameters
        ----------
        path
            XML (plain or gzipped) or PBF.
        options
            ``at`` must be inside the extract.

        Raises
        ------
        InputError
            When the file is damaged or has no drivable streets, the position is outside, or the side of traffic is
            unclear.
        """
        extract = osm_files.read_osm(path)
        check_inside_extract(extract, options.at)
        side = choose_map_side(extract, options.requested_left, options.at, str(path))
        flags = osm_network.netconvert_flags(extract, lefthand=side.lefthand, walk=options.walk)
        notes = side.note, *exceptions_note(extract, lefthand=side.lefthand)
        if options.has_terrain:
            flags += road_levels.keep_levels_flags(extract)
        else:
            elevations = elevation.read_elevations(extract)
            if elevations.note:
                notes = *notes, elevations.note
            if elevations.heights_m:
                extract = elevation.add_elevations(extract, elevations.heights_m)
                flags += elevation.ELEVATION_FLAGS
        if options.at is not None:
            reach_m = _BEYOND_M + (SURROUNDINGS_M if options.surroundings_m is None else options.surroundings_m)
            extract = osm_network.drop_far_streets(extract, options.at, reach_m)
        network, streets, turn_notes = osm_network.build_network(extract, path, flags)
        return cls(extract, path, tuple(flags), network, streets, map_notes=notes, turn_notes=turn_notes)

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about the map, and about the turns of the network."""
        return (*self.map_notes, *self.turn_notes)

    @property
    def keeps_heights(self) -> bool:
        """False: heights of the map (``ele``) count from sea level."""
        return False

    @property
    def level_notes(self) -> tuple[str, ...]:
        """A sentence about roads on other levels, if there are any."""
        if not self.others.roads:
            return ()
        titles = ", ".join(self.others.road_titles)
        return (f"Roads on another level are left out of the traffic in the region of interest: {titles}.",)

    def on_level_of(self, junction: StreetJunction) -> OsmRoads:
        """Return the roads without those that cross a junction's region on another level."""
        window = junctions.region_around(junction).area.buffer(road_levels.MARGIN_M, join_style="mitre")
        others = road_levels.find_other_levels(self.extract, self.streets, junction, window)
        if not others.roads:
            return replace(self, others=others)
        extract = osm_network.cut_out_roads(self.extract, self.streets, others.roads, window)
        network, streets, notes = osm_network.build_network(extract, self.path, self.flags)
        return replace(self, extract=extract, network=network, streets=streets, others=others, turn_notes=notes)

    def around(self, junction: StreetJunction, radius_m: float | None) -> OsmRoads:
        """Return the roads within a radius of a junction, in the same frame; :data:`SURROUNDINGS_M` if it is None."""
        radius_m = SURROUNDINGS_M if radius_m is None else radius_m
        if math.isinf(radius_m):
            return self
        network, streets, notes = osm_network.crop_network(
            self.extract, self.path, self.flags, self.streets, junction, radius_m
        )  # fmt: skip
        return replace(self, network=network, streets=streets, turn_notes=notes)

    def edge_levels(self) -> dict[str, int]:
        """Return the levels of the edges that are not on the ground: bridges and tunnels."""
        return road_levels.edge_levels((edge.id for edge in self.streets.network.edges), self.extract)

    def solids(self, window: BaseGeometry) -> SolidMap:
        """Return the static objects in a window (world frame, metres), bridges over the junction included."""
        solids, counts = osm_solids.map_solids(self.extract, self.streets, self.others.decks, window)
        poles = osm_solids.carrying_poles(self.extract, self.streets, window)
        return SolidMap(tuple(solids), counts=counts, attribution=ATTRIBUTION, is_base=True, poles=poles)


def open_roads(path: Path, options: RoadOptions) -> OsmRoads:
    """Return the roads of an extract; InputError when it is damaged or has no drivable streets."""
    return OsmRoads.read(path, options)


def read_solids(paths: Sequence[Path], context: MapContext) -> SolidMap:
    """Return the static objects of extracts whose roads are not used; InputError when a file is damaged."""
    assert context.streets is not None, "the road map is read first"
    if context.frame is None:
        problem = "the extract is in degrees, but the road map has no reference system"
        raise InputError(paths[0], problem, "Use a road map with a reference system.")
    solids: list[MappedSolid] = []
    poles: list[MappedPole] = []
    counts = ImportCounts()
    for path in paths:
        extract = osm_files.read_osm(path)
        of_file, counts_of_file = osm_solids.map_solids(extract, context.streets, window=context.window)
        solids += of_file
        poles += osm_solids.carrying_poles(extract, context.streets, context.window)
        counts = counts.plus(counts_of_file)
    return SolidMap(tuple(solids), counts=counts, attribution=ATTRIBUTION, is_base=True, poles=tuple(poles))
