"""Damaged maps and terrain: every mutant is read, or refused with one message; no other exception, no endless work."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path

import pytest
from shapely.geometry import box

from egvs.core.errors import EgvsError
from egvs.creation.map_parts import Alignment, MapContext, RoadOptions
from egvs.extensions.maps.opendrive import reader as opendrive
from egvs.extensions.maps.terrain import landxml as landxml_terrain
from egvs.extensions.maps.terrain import rasters
from egvs.formats.georeference import WorldFrame
from tests.extensions.maps import opendrive_maps as maps
from tests.extensions.maps.formats.test_landxml import FACES, landxml
from tests.extensions.maps.formats.test_rasters import EAST, NORTH, plane_cells, write_ascii, write_tiff
from tests.fuzz.mutating import mutant

CONTEXT = MapContext(WorldFrame("EPSG:32632", (-EAST, -NORTH)), box(0, 0, 120, 80))


def _tiff(folder: Path) -> bytes:
    return write_tiff(
        folder / "base.tif", plane_cells().astype("float32"), compress="deflate", nodata=-9999
    ).read_bytes()


def _ascii(folder: Path) -> bytes:
    return write_ascii(folder / "base.asc", plane_cells()).read_bytes()


def _landxml(folder: Path) -> bytes:
    head = '<Units><Metric linearUnit="meter"/></Units><CoordinateSystem epsgCode="32632"/>'
    return landxml(FACES, head).replace(">2000 1000", f">{NORTH} {EAST}").encode()


def _opendrive(folder: Path) -> bytes:
    signal = '<signal id="s1" s="95" t="-8" dynamic="yes" orientation="+" type="1000001"/>'
    return maps.merge(signal).encode()


def _read_aligned(path: Path) -> None:
    import numpy as np

    here = np.array([[EAST, NORTH], [EAST + 100, NORTH]])
    context = MapContext(None, CONTEXT.window, Alignment(here, here - [EAST, NORTH]))
    rasters.read_terrain([path], context).height_m(np.array([[30.0, 30.0]]))


READERS: dict[str, tuple[Callable[[Path], bytes], Callable[[Path], object]]] = {
    "a.tif": (_tiff, lambda path: rasters.read_terrain([path], CONTEXT)),
    "a.asc": (_ascii, _read_aligned),
    "a.xml": (_landxml, lambda path: landxml_terrain.read_terrain([path], CONTEXT)),
    "a.xodr": (_opendrive, lambda path: opendrive.read_roads(path, RoadOptions(walk=True))),
}


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("count", [50, pytest.param(200, marks=pytest.mark.nightly)])
def test_mutants_are_read_or_refused(name: str, count: int, tmp_path: Path) -> None:
    make, read = READERS[name]
    data = make(tmp_path)
    path = tmp_path / name
    path.write_bytes(data)
    read(path)
    refused = 0
    for case in range(count):
        path.write_bytes(mutant(random.Random(f"{name}{case}"), data))
        try:
            read(path)
        except EgvsError as error:
            assert name in str(error) and "\n\n" not in str(error), (case, error)
            assert error.exit_code == 2, (case, error)
            refused += 1
    assert 0.15 * count < refused < count
