"""The roads of a map, from which those around a junction are taken."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

from shapely.geometry.base import BaseGeometry

from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.creation import junctions
from egvs.creation.junctions import StreetJunction, Streets
from egvs.creation.map_parts import RoadMap, SolidMap
from egvs.creation.plain_network import NETWORK_FILE
from egvs.traffic import sumo

_GENERATED = re.compile(r"<!-- generated on .*?-->\n*", re.DOTALL)
"""Date and paths that netconvert writes at the top of a network."""


class RoadSource(Protocol):
    """A road map, read."""

    @property
    def network(self) -> str:
        """The text of the network."""

    @property
    def path(self) -> Path:
        """The file of the map."""

    @property
    def streets(self) -> Streets:
        """The same network, read."""

    @property
    def attribution(self) -> str:
        """Who made the map, and its licence; empty if unknown."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences for the user about the complete map."""

    @property
    def keeps_heights(self) -> bool:
        """Whether its heights are used as they are (:class:`~egvs.creation.map_parts.RoadMap`)."""

    @property
    def level_notes(self) -> tuple[str, ...]:
        """Sentences for the user about roads that :meth:`on_level_of` left out."""

    def on_level_of(self, junction: StreetJunction) -> RoadSource:
        """Return the roads without those that cross a junction's region on another level."""

    def around(self, junction: StreetJunction, radius_m: float | None) -> RoadSource:
        """Return the roads within a radius of a junction, in the same frame: all if it is inf, the default if None."""

    def edge_levels(self) -> dict[str, int]:
        """Return the levels of the edges that are known not to be on the ground: bridges and tunnels."""

    def solids(self, window: BaseGeometry) -> SolidMap | None:
        """Return the static objects of the road map in a window (world frame, metres); None: its reader reads them."""


@contextmanager
def network_file(network: str, road_map: Path) -> Iterator[Path]:
    """Write a network that was made from a map to a temporary file; errors about it name the map."""
    with files.temporary_folder() as folder:
        files.write_text(folder / NETWORK_FILE, network)
        try:
            yield folder / NETWORK_FILE
        except InputError as error:
            raise junctions.unusable_network(error, folder, road_map) from None


@dataclass(frozen=True)
class NetworkRoads:
    """Roads of a map that is converted as a whole; they are not divided by level, and cut on request only."""

    road_map: RoadMap
    streets: Streets
    path: Path

    @classmethod
    def read(cls, road_map: RoadMap, path: Path) -> NetworkRoads:
        """Read the network of a road map.

        Parameters
        ----------
        road_map
            The road map.
        path
            Its file, for messages.

        Raises
        ------
        InputError
            When the network has no road, or SUMO cannot have written it.
        """
        with network_file(road_map.network, path) as network:
            return cls(road_map, junctions.read_streets(network), path)

    @property
    def network(self) -> str:
        """The text of the network."""
        return self.road_map.network

    @property
    def attribution(self) -> str:
        """Who made the map, and its licence; empty if unknown."""
        return self.road_map.attribution

    @property
    def notes(self) -> tuple[str, ...]:
        """Sentences of the reader."""
        return self.road_map.notes

    @property
    def keeps_heights(self) -> bool:
        """Whether its heights are used as they are."""
        return self.road_map.keeps_heights

    @property
    def level_notes(self) -> tuple[str, ...]:
        """No sentences, since no road is left out."""
        return ()

    def edge_levels(self) -> dict[str, int]:
        """Return no levels: only heights of lanes tell them."""
        return {}

    def solids(self, window: BaseGeometry) -> SolidMap | None:
        """Return None: static objects are read apart from roads."""
        del window
        return None

    def on_level_of(self, junction: StreetJunction) -> NetworkRoads:
        """Return all roads: heights of lanes tell levels apart."""
        del junction
        return self

    def around(self, junction: StreetJunction, radius_m: float | None) -> NetworkRoads:
        """Return the roads that reach into a square around a junction, in the same frame; all if the radius is None."""
        if radius_m is None or math.isinf(radius_m):
            return self
        (x_m, y_m), name = junction.at_m, "whole.net.xml"
        square = f"{x_m - radius_m:.2f},{y_m - radius_m:.2f},{x_m + radius_m:.2f},{y_m + radius_m:.2f}"
        flags = ["-s", name, "--keep-edges.in-boundary", square, "--offset.disable-normalization", "true"]
        with files.temporary_folder() as folder:
            (folder / name).write_text(self.network, encoding="utf-8")
            try:
                sumo.run_netconvert(flags, folder, NETWORK_FILE)
            except RunError as error:
                hint = "Use another radius, or --surroundings all."
                raise InputError("--surroundings", f"netconvert cannot cut the network: {error}", hint) from None
            network = (folder / NETWORK_FILE).read_text(encoding="utf-8")
        note = f"The network is cut {radius_m:g} m from the junction."
        network = _GENERATED.sub("", network, count=1)
        road_map = replace(self.road_map, network=network, notes=(*self.road_map.notes, note))
        return NetworkRoads.read(road_map, self.path)
