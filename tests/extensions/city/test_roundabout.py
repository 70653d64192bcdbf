"""A roundabout is one junction of a city."""

from __future__ import annotations

from pathlib import Path

from egvs.extensions.city import creation
from tests.creation.test_roundabouts import read, ring_map


def test_roundabout_is_one_junction_of_the_city(tmp_path: Path) -> None:
    streets = read(ring_map(tmp_path / "ring.osm"))
    (ring,) = (junction for junction in streets.junctions if junction.is_crossing)
    assert creation.choose_junctions(streets, creation.ALL, None).junctions == {"j01": ring}
