"""Damaged Lanelet2 maps end in an InputError that names the file, or in a network that SUMO reads; in no other error.

The mutants are those of the fuzzer (``tests/fuzz/mutating.py``).
"""

from __future__ import annotations

import gzip
import random
from pathlib import Path

import pytest

from egvs.core.errors import InputError
from egvs.creation.map_parts import RoadOptions
from egvs.extensions.maps.lanelet2 import reader as lanelet2
from egvs.extensions.maps.lanelet2.network import read_network_text
from tests.extensions.maps.lanelet2_maps import MapWriter, make_crossing
from tests.fuzz.mutating import mutant

PROJECTOR = (
    b"projector_type: LocalCartesian\nvertical_datum: WGS84\nmap_origin:\n  latitude: 49.0\n  longitude: 8.4\n"
    b"  altitude: 0.0\n"
)
KINDS = ("map.osm", "map.osm.gz", "map_projector_info.yaml")


def read_mutants(folder: Path, name: str, seeds: range) -> tuple[int, int]:
    """Return how many mutants were read, and how many rejected."""
    path = make_crossing(tags={"speed_limit": "50"}).writer.write(folder / "map.osm")
    if name == "map.osm.gz":
        path.rename(folder / "plain.osm")
        path = folder / name
        path.write_bytes(gzip.compress((folder / "plain.osm").read_bytes(), mtime=0))
    changed = path
    if name.endswith(".yaml"):
        changed = folder / name
        changed.write_bytes(PROJECTOR)
    sound = changed.read_bytes()
    assert read_network_text(lanelet2.read_roads(path, RoadOptions()).network).connections
    read = rejected = 0
    for seed in seeds:
        changed.write_bytes(mutant(random.Random(seed), sound))
        try:
            read_network_text(lanelet2.read_roads(path, RoadOptions()).network)
            read += 1
        except InputError as error:
            assert str(folder) in str(error), seed
            assert len(str(error)) < 4000, seed
            rejected += 1
    return read, rejected


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_some_mutants(tmp_path: Path, name: str) -> None:
    read, rejected = read_mutants(tmp_path, name, range(12))
    assert read + rejected == 12
    assert rejected > 0


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize("count", [60, pytest.param(200, marks=pytest.mark.nightly)])
def test_many_mutants(tmp_path: Path, name: str, count: int) -> None:
    read, rejected = read_mutants(tmp_path, name, range(count))
    assert read + rejected == count
    assert rejected > count // 10


def random_map(seed: int, folder: Path) -> Path:
    """Write a map of lanelets between random lines: overlapping, turned, degenerate."""
    draw = random.Random(seed)
    writer = MapWriter()
    points = [(draw.randint(0, 4) * 10, draw.randint(0, 4) * 10, draw.choice([0, 0, 6])) for _ in range(12)]
    kinds = [{"type": "virtual"}, {"type": "line_thin", "subtype": "solid"}]
    lines = [
        writer.line([draw.choice(points) for _ in range(draw.randint(2, 4))], **draw.choice(kinds)) for _ in range(15)
    ]
    lanelets = [
        writer.lanelet(
            draw.choice(lines),
            draw.choice(lines),
            subtype=draw.choice(["road", "road", "crosswalk", "bus_lane"]),
            one_way=draw.choice(["yes", "no"]),
        )
        for _ in range(15)
    ]
    for subtype in ("traffic_light", "right_of_way", "all_way_stop"):
        members = [("way", draw.choice(lines), "ref_line")]
        members += [("relation", draw.choice(lanelets), role) for role in ("yield", "right_of_way")]
        writer.refer(draw.choice(lanelets), writer.regulation(members, subtype))
    return writer.write(folder / "map.osm", local=True, turn_lines=seed)


@pytest.mark.slow
@pytest.mark.parametrize("walk", [False, True])
def test_random_maps(tmp_path: Path, walk: bool) -> None:
    read = 0
    for seed in range(8):
        path = random_map(seed, tmp_path)
        try:
            read_network_text(lanelet2.read_roads(path, RoadOptions(walk=walk)).network)
            read += 1
        except InputError as error:
            assert str(path) in str(error), seed
            assert "cannot be made into roads" not in str(error), seed
    assert read > 4
