"""Networks that were written in another format and read back: which lane is which, and the signal programs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from scipy.spatial import KDTree

from egvs.creation.map_parts import RoadOptions
from egvs.extensions.maps.lanelet2 import reader as lanelet2
from egvs.extensions.maps.lanelet2.network import read_network_text
from egvs.extensions.maps.opendrive import reader as opendrive
from egvs.traffic import sumo
from egvs.traffic.network import Lane, Network
from tests.extensions.maps.lanelet2_maps import lane_names, signal_sequences, write_network

MAX_END_ERROR_M = 1.5
"""Junctions of a ring of the roundabout cut lanes by 1.3 m more after OpenDRIVE."""


@dataclass(frozen=True)
class NetworkText:
    """A SUMO network, as text and parsed."""

    text: str

    @cached_property
    def root(self) -> ElementTree.Element:
        return ElementTree.fromstring(self.text)

    @cached_property
    def network(self) -> Network:
        return read_network_text(self.text)

    @cached_property
    def lanes(self) -> dict[str, Lane]:
        return {f"{edge.id}_{i}": lane for edge in self.network.edges for i, lane in enumerate(edge.lanes)}

    @property
    def lefthand(self) -> bool:
        return self.root.get("lefthand") == "true"


def write_and_read_lanelet2(original: NetworkText, folder: Path) -> NetworkText:
    """Return a network after it was written as a Lanelet2 map."""
    written = write_network(original.network, original.text)
    path = written.writer.write(folder / "map.osm", local=True, turn_lines=1)
    return NetworkText(lanelet2.read_roads(path, RoadOptions(lefthand=original.lefthand)).network)


def write_and_read_opendrive(original: NetworkText, folder: Path, *, marks: bool = True) -> NetworkText:
    """Return a network after netconvert wrote it as an OpenDRIVE map.

    netconvert marks all borders between lanes as broken lines. With ``marks``, those that no vehicle may cross in the
    original get their solid lines.
    """
    (folder / "before.net.xml").write_text(original.text, encoding="utf-8")
    flags = ["--opendrive-output.lefthand-left"] if original.lefthand else []
    sumo.run_program("netconvert", ["-s", "before.net.xml", "--opendrive-output", "map.xodr", *flags], folder)
    options = RoadOptions(lefthand=original.lefthand)
    copy = NetworkText(opendrive.read_roads(folder / "map.xodr", options).network)
    if not marks:
        return copy
    tree = ElementTree.parse(folder / "map.xodr")
    mark_borders(tree.getroot(), original, copy)
    tree.write(folder / "marked.xodr", encoding="utf-8", xml_declaration=True)
    return NetworkText(opendrive.read_roads(folder / "marked.xodr", options).network)


def mark_borders(road_map: ElementTree.Element, original: NetworkText, copy: NetworkText) -> None:
    """Write into an OpenDRIVE map between which lanes no vehicle may change in the original network."""
    match = match_lanes(original, copy)
    lanes = {lane.attrib["id"]: lane for lane in original.root.iter("lane")}
    origins = {
        lane.attrib["id"]: param.attrib["value"]
        for lane in copy.root.iter("lane")
        for param in lane.iter("param")
        if param.get("key") == "origId"
    }
    map_lanes = {
        f"{road.attrib['id']}_{lane.attrib['id']}": lane for road in road_map.iter("road") for lane in road.iter("lane")
    }
    for edge in original.network.edges:
        for index in range(len(edge.lanes) - 1):
            outer, inner = lanes[f"{edge.id}_{index}"], lanes[f"{edge.id}_{index + 1}"]
            to_inner, to_outer = ("changeRight", "changeLeft") if original.lefthand else ("changeLeft", "changeRight")
            lines = [
                "solid" if key in lane.attrib else "broken" for lane, key in ((inner, to_outer), (outer, to_inner))
            ]
            road, _, number = origins[match[inner.attrib["id"]]].rpartition("_")
            lane = map_lanes[f"{road}_{-int(number) if original.lefthand else number}"]
            for mark in lane.iter("roadMark"):
                mark.set("type", lines[0] if lines[0] == lines[1] else " ".join(lines))


def match_lanes(original: NetworkText, copy: NetworkText) -> dict[str, str]:
    """Return the lane of the copy that begins and ends where each original lane does."""
    ends_m = [
        np.array([[*lane.shape_m[0, :2], *lane.shape_m[-1, :2]] for lane in side.lanes.values()])
        for side in (copy, original)
    ]
    error_m, index = KDTree(ends_m[0]).query(ends_m[1])
    assert error_m.max() < MAX_END_ERROR_M
    names = list(copy.lanes)
    match = dict(zip(original.lanes, (names[number] for number in index), strict=True))
    assert len(set(match.values())) == len(match)
    return match


def match_edges(match: Mapping[str, str]) -> dict[str, str]:
    """Return the edge of the copy for each original edge; all its lanes are on one."""
    edges: dict[str, str] = {}
    for lane, other in match.items():
        edge, other_edge = lane.rpartition("_")[0], other.rpartition("_")[0]
        assert edges.setdefault(edge, other_edge) == other_edge
    return edges


def with_programs_of(original: NetworkText, copy: NetworkText, match: Mapping[str, str], folder: Path) -> NetworkText:
    """Return a copy with the signal programs of the original.

    All turns that a program of the copy switches together must be those that the original switches alike.
    """
    sequences = signal_sequences(original.root)
    programs = {logic.attrib["id"]: logic for logic in original.root.iter("tlLogic")}
    if not programs:
        return copy
    original_link = {}
    for connection in original.root.findall("connection"):
        if "tl" in connection.attrib:
            source, target = lane_names(connection)
            original_link[match[source], match[target]] = connection.attrib["tl"], int(connection.attrib["linkIndex"])

    links: dict[str, dict[int, tuple[str, tuple[str, ...]]]] = {}
    elements = []
    for connection in copy.root.findall("connection"):
        if "tl" not in connection.attrib:
            continue
        light, index = original_link.pop(lane_names(connection))
        governed = light, sequences[light, index]
        same = links.setdefault(connection.attrib["tl"], {}).setdefault(int(connection.attrib["linkIndex"]), governed)
        assert same == governed, "turns that the original switches differently share a link"
        keys = ("from", "to", "fromLane", "toLane", "tl", "linkIndex")
        attributes = " ".join(f'{key}="{connection.attrib[key]}"' for key in keys)
        elements.append(f"<connection {attributes}/>")
    assert not original_link, "turns lost their signal"

    for node, governed_links in links.items():
        (light,) = {light for light, _ in governed_links.values()}
        states = ["".join(row) for row in zip(*(governed_links[i][1] for i in sorted(governed_links)), strict=True)]
        assert sorted(governed_links) == list(range(len(governed_links)))
        durations = [phase.attrib["duration"] for phase in programs[light].iter("phase")]
        phases = "".join(
            f'<phase duration="{duration}" state="{state}"/>' for duration, state in zip(durations, states, strict=True)
        )
        offset = programs[light].attrib["offset"]
        elements.insert(0, f'<tlLogic id="{node}" type="static" programID="0" offset="{offset}">{phases}</tlLogic>')
    (folder / "copy.net.xml").write_text(copy.text, encoding="utf-8")
    (folder / "copy.tll.xml").write_text(f"<tlLogics>{''.join(elements)}</tlLogics>", encoding="utf-8")
    options = ["-s", "copy.net.xml", "-i", "copy.tll.xml", "--no-turnarounds", "--precision", "3"]
    sumo.run_netconvert(options, folder, "switched.net.xml")
    return NetworkText((folder / "switched.net.xml").read_text(encoding="utf-8"))
