"""Memory of the CityGML reader does not grow with the file: only what is in the window is kept."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.extensions.maps.formats.small_city_models import (
    city_model,
    city_object,
    multi_surface,
    nest,
    polygon,
    solid,
)
from tests.extensions.maps.test_citygml import at, box_at
from tests.processes import python

FILE_BYTES = 100_000_000
IN_WINDOW = 4 * 4
"""Houses on a grid of 50 m in a window of 200 m, with its edges between them."""

READ = """
import json, resource, sys
import json
from pathlib import Path
import shapely
from egvs.formats.georeference import WorldFrame
from egvs.extensions.maps.buildings import citygml
from egvs.creation.map_parts import MapContext
frame = WorldFrame("EPSG:6677", (7000.0, 51000.0))
result = citygml.read_solids([Path(sys.argv[1])], MapContext(frame, shapely.box(-110, -110, 90, 90)))
used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
dropped = sum(sum(kinds.values()) for kinds in result.counts.dropped.values())
print(json.dumps([used, len(result.meshes), dropped]))
"""


def write_large_model(path: Path, size: int) -> int:
    """Write houses with two levels of detail on a grid of 50 m; return their number."""
    head, tail = city_model("@@").split("@@")
    theme = "<x:appearance><x:Appearance>" + "<x:target>#p</x:target>" * 20 + "</x:Appearance></x:appearance>"
    count = 0
    with path.open("w", encoding="utf-8") as file:
        written = file.write(head)
        while written < size:
            row, column = divmod(count, 100)
            walls = box_at(50.0 * (column - 50), 50.0 * (row - 50))
            coarse = nest(solid(walls), "lod1Solid")
            fine = "".join(
                nest(multi_surface([wall]), "boundedBy", "WallSurface", "lod2MultiSurface") for wall in walls
            )
            written += file.write(city_object("Building", f"b{count}", theme, coarse, fine) + "\n")
            count += 1
        file.write(tail)
    return count


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("file_bytes", "max_bytes"),
    [(25_000_000, 210_000_000), pytest.param(FILE_BYTES, 500_000_000, marks=pytest.mark.nightly)],
)
def test_memory_does_not_grow_with_the_file(tmp_path: Path, file_bytes: int, max_bytes: int) -> None:
    """An empty program that has read a house uses 146 MB; a tree of all elements of 25 MB would take 200 MB more."""
    path = tmp_path / "large.gml"
    count = write_large_model(path, file_bytes)
    assert path.stat().st_size >= file_bytes
    done = python(READ, path)
    assert done.returncode == 0, done.stderr
    used, meshes, dropped = json.loads(done.stdout)
    assert used < max_bytes
    assert (meshes, dropped) == (IN_WINDOW, count - IN_WINDOW)


@pytest.mark.slow
@pytest.mark.system
def test_large_building_is_rejected_before_it_fills_the_memory(tmp_path: Path) -> None:
    """One building of 100 MB; the limit on its surfaces is reached first."""
    wall = f"<gml:surfaceMember>{polygon([at(0, 0, 0), at(0, 1, 0), at(1, 0, 0)])}</gml:surfaceMember>" * 100
    head, tail = city_model(city_object("Building", "b", nest(multi_surface(["#@@"]), "lod2MultiSurface"))).split("#@@")
    path = tmp_path / "large.gml"
    with path.open("w", encoding="utf-8") as file:
        file.write(head + '"/>')
        while file.tell() < FILE_BYTES:
            file.write(wall)
        file.write('<gml:surfaceMember xlink:href="#' + tail)
    done = python("import os; os.environ['EGVS_MAX_TRIANGLES'] = '1000000'\n" + READ, path)
    assert done.returncode != 0
    assert "large.gml: b: has too many surfaces. The limit is 1,000,000 triangles" in done.stderr
