"""The readers of road maps that the core has: OpenStreetMap and SUMO; see :mod:`egvs.creation.map_readers`."""

from __future__ import annotations

from egvs.core.readers import Reader, with_gzip

READERS = (
    Reader(
        "OpenStreetMap",
        "map",
        "egvs.creation.openstreetmap.reader",
        suffixes=with_gzip(".osm", ".osm.xml", ".pbf"),
        head=rb"<osm[\s>]",  # the comment of a SUMO network may name <osm-files
        gives=("roads", "solids"),
    ),
    Reader(
        "SUMO network",
        "map",
        "egvs.creation.sumo_network",
        suffixes=with_gzip(".net.xml"),
        head=rb"<net[\s>]",
        gives=("roads",),
    ),
)
