"""Files that try to make GDAL open other files or addresses, and what watches whether they succeed."""

from __future__ import annotations

import socket
import zipfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
import shapely

GEOJSON = (
    '{"type": "FeatureCollection", "features": [{"type": "Feature", "properties": {"site": "stolen", "z_m": 3.0},'
    ' "geometry": {"type": "Point", "coordinates": [9.0, 50.0]}}]}'
)


@dataclass
class Watched:
    """A folder with a secret, and a server, neither of which may be reached."""

    folder: Path
    server: socket.socket

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server.getsockname()[1]}"

    def check(self) -> None:
        assert sorted(path.name for path in self.folder.iterdir()) == ["db.gpkg", "secret", "secret.geojson", "z.zip"]
        with pytest.raises(BlockingIOError):
            self.server.accept()


@contextmanager
def watch(tmp_path: Path) -> Iterator[Watched]:
    """Yield a folder and a server."""
    folder = tmp_path / "canary"
    folder.mkdir()
    (folder / "secret").write_text("secret")
    (folder / "secret.geojson").write_text(GEOJSON)
    with zipfile.ZipFile(folder / "z.zip", "w") as archive:
        archive.writestr("x.geojson", GEOJSON)
    points(folder / "db.gpkg")
    with closing(socket.create_server(("127.0.0.1", 0))) as server:
        server.setblocking(False)
        yield Watched(folder, server)


def points(path: Path) -> Path:
    """Write a GeoPackage with one layer of one point."""
    geopandas = pytest.importorskip("geopandas", reason="geopandas is not installed (egvs[gis])")
    frame = geopandas.GeoDataFrame({"site": ["a"], "z_m": [3.0]}, geometry=[shapely.Point(9, 50)], crs=4326)
    frame.to_file(path, driver="GPKG")
    return path


def vrt(source: str, sql: str = "") -> bytes:
    """An OGR VRT: https://gdal.org/en/stable/drivers/vector/vrt.html."""
    query = f"<SrcSQL>{sql}</SrcSQL>" if sql else ""
    layer = f'<OGRVRTLayer name="a"><SrcDataSource>{source}</SrcDataSource>{query}</OGRVRTLayer>'
    return f"<OGRVRTDataSource>{layer}</OGRVRTDataSource>".encode()


def attacks(folder: Path, url: str) -> dict[str, bytes]:
    """Contents of files by what they try."""
    database = folder / "db.gpkg"
    plain = vrt(f"{folder}/secret.geojson")
    raster = (
        '<VRTDataset rasterXSize="2" rasterYSize="2"><VRTRasterBand dataType="Float64" band="1"><SimpleSource>'
        f"<SourceFilename>/vsicurl/{url}/x.tif</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
    )
    return {
        "another file": plain,
        "byte order mark": b"\xef\xbb\xbf" + plain,
        "comment first": b"<!-- <kml> -->" + plain,
        "as KML": b"<kml>" + plain + b"</kml>",
        "network": vrt(f"/vsicurl/{url}/x.geojson"),
        "network, streamed": vrt(f"/vsicurl_streaming/{url}/x.geojson"),
        "archive": vrt(f"/vsizip/{folder}/z.zip/x.geojson"),
        "VACUUM INTO": vrt(str(database), f"VACUUM INTO '{folder}/new.db'"),
        "ATTACH": vrt(str(database), f"ATTACH DATABASE '{folder}/new.db' AS x"),
        "load_extension": vrt(str(database), f"SELECT load_extension('{folder}/secret')"),
        "web service": f"<OGRWFSDataSource><URL>{url}</URL></OGRWFSDataSource>".encode(),
        "raster": raster.encode(),
        "GeoJSON by address": f"{url}/x.geojson".encode(),
    }
