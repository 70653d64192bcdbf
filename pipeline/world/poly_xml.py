"""Reads the polygons of a SUMO .poly.xml as footprints. World frame, metres."""

from __future__ import annotations

from pathlib import Path

from pipeline.core.errors import InputError
from pipeline.formats import safe_xml
from pipeline.world.footprints import Footprint, FootprintFile, polygons_of


def read_poly_xml(path: Path, height_m: float) -> FootprintFile:
    """Footprints of a SUMO .poly.xml; a ``height`` parameter overrides the default height.

    InputError names the polygon that is not in metres, or not sound.
    """
    file = FootprintFile()
    for number, element in enumerate(safe_xml.children(path, "additional")):
        if element.tag != "poly":
            file.left_out[f"<{element.tag}> of .poly.xml"] += 1
            continue
        name = element.get("id", f"{path.stem}_{number}")
        place = f"{path}: poly {name}"
        if element.get("geo", "false").lower() in ("true", "1"):
            raise InputError(place, "has longitude and latitude (geo)", "a shape in the network's metres")
        try:
            points = [tuple(float(v) for v in pair.split(",")[:2]) for pair in element.get("shape", "").split()]
            top = next((float(p.get("value", "")) for p in element if p.get("key") == "height"), height_m)
        except ValueError as error:
            what = f"has a value that is no number ({error})"
            raise InputError(place, what, "shape='x,y x,y ...' in metres") from None
        if element.get("fill", "false").lower() not in ("true", "1") or len(points) < 3:
            file.left_out["lines of .poly.xml"] += 1
            continue
        ring = [*points, points[0]]
        for part in polygons_of({"type": "Polygon", "coordinates": [ring]}, {}, place, file.mended):
            file.footprints.append(Footprint(name, element.get("type", "polygon"), part, 0.0, top))
    return file
