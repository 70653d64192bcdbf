"""Rasters that make GDAL open other files or addresses are rejected, or do nothing."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.maps.formats import rasters
from tests.formats.foreign_files import Watched, attacks, watch

rasterio = pytest.importorskip("rasterio", reason="rasterio is not installed (egvs[gis])")

pytestmark = pytest.mark.system


@pytest.fixture
def watched(tmp_path: Path) -> Iterator[Watched]:
    with watch(tmp_path) as folder_and_server:
        yield folder_and_server


@pytest.mark.parametrize("attack", ["another file", "network", "VACUUM INTO", "raster"])
def test_raster_of_another_kind_is_rejected(watched: Watched, tmp_path: Path, attack: str) -> None:
    path = tmp_path / "heights.tif"
    path.write_bytes(attacks(watched.folder, watched.url)[attack])
    with pytest.raises(InputError, match=r"heights\.tif: cannot be read as GeoTIFF"):
        rasters.read_geotiff_header(path)
    watched.check()


@pytest.mark.slow
def test_overviews_that_a_tiff_names_are_not_opened(watched: Watched, tmp_path: Path) -> None:
    path = tmp_path / "heights.tif"
    transform = rasterio.Affine(10, 0, 500_000, 0, -10, 5_400_000)
    profile = {"width": 8, "height": 8, "count": 1, "dtype": "float64", "crs": "EPSG:32632", "transform": transform}
    with rasterio.open(path, "w", driver="GTiff", **profile) as file:
        file.write(np.ones((1, 8, 8)))
        file.update_tags(ns="OVERVIEWS", OVERVIEW_FILE=f"/vsicurl/{watched.url}/x.tif")
    assert rasters.read_geotiff(path, (0, 0, 1e6, 1e7)).heights_m.sum() == 64.0
    watched.check()
