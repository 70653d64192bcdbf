"""Aerial pictures: where they lie, what is kept of them, and what is refused."""

from __future__ import annotations

import io
import math
import zlib
from pathlib import Path
from urllib.parse import quote

import numpy as np
import pytest

from egvs.formats.georeference import WorldFrame
from egvs.scenario.loading import load
from egvs.world.geolocation import scenario_georeference
from tests.extensions.desk.serving import Client

pytest.importorskip("rasterio", reason="pictures need rasterio: pip install 'egvs[gis]'")

import rasterio
from PIL import Image
from pyproj import Transformer

pytestmark = pytest.mark.system

SIDE = 800
"""Pixels a side of the pictures, of a metre each."""


def write_picture(path: Path, lon_deg: float, lat_deg: float, crs: str | None = "EPSG:3857") -> Path:
    """Write a GeoTIFF around a position: grey, with a red square of 20 pixels in its middle."""
    x, y = Transformer.from_crs("EPSG:4326", "EPSG:3857", always_xy=True).transform(lon_deg, lat_deg)
    pixel = 1 / math.cos(math.radians(lat_deg))  # of Web Mercator
    transform = rasterio.Affine(pixel, 0, x - SIDE / 2 * pixel, 0, -pixel, y + SIDE / 2 * pixel)
    shape = {"count": 3, "height": SIDE, "width": SIDE, "dtype": "uint8", "compress": "deflate"}
    with rasterio.open(path, "w", driver="GTiff", crs=crs, transform=transform, **shape) as file:
        file.write(np.moveaxis(red_square(), -1, 0))
    return path


def at_junction(tmp_path: Path) -> list[float]:
    """Longitude and latitude in degrees of the middle of the town."""
    scenario = load(tmp_path / "work" / "town")
    frame = scenario_georeference(scenario).frame
    assert frame is not None
    (degrees,) = frame.to_degrees(np.array([scenario.roi.center_m[:2]])).tolist()
    return degrees


def red_square() -> np.ndarray:
    """The pixels of a picture, (rows, columns, 3) uint8."""
    pixels = np.full((SIDE, SIDE, 3), 90, dtype=np.uint8)
    pixels[SIDE // 2 - 10 : SIDE // 2 + 10, SIDE // 2 - 10 : SIDE // 2 + 10] = 255, 0, 0
    return pixels


def middle_of_red(content: bytes, matrix: list[float]) -> list[float]:
    """Return where the red square of a picture lies in the world frame."""
    pixels = np.asarray(Image.open(io.BytesIO(content)).convert("RGB")).astype(int)
    rows, columns = np.nonzero(pixels[:, :, 0] - pixels[:, :, 1] > 120)
    column, row = columns.mean() + 0.5, rows.mean() + 0.5
    a, d, b, e, c, f = matrix
    return [a * column + b * row + c, d * column + e * row + f]


@pytest.mark.slow
def test_part_around_the_junction_is_saved(town: Client, tmp_path: Path) -> None:
    before = town.project
    picture = write_picture(tmp_path / "town.tif", *at_junction(tmp_path))
    after = town.ok("POST", "/api/aerial?name=town.tif", picture.read_bytes())["project"]
    assert (after["map_key"], after["undo"]) == (before["map_key"], before["undo"])
    _, headers, content = town.raw("GET", "/api/aerial")
    assert headers["content-type"] == "image/jpeg"
    assert middle_of_red(content, after["aerial"]["matrix"]) == pytest.approx(before["roi"]["center_m"][:2], abs=0.5)
    _, y0, _, y1 = town.ok("GET", "/api/map")["bounds_m"]
    size = Image.open(io.BytesIO(content)).size
    assert size[0] <= SIDE and size[1] < y1 - y0 + 20  # the rest is cut off
    assert sorted(path.name for path in (tmp_path / "work" / "town").glob("aerial*")) == ["aerial.jgw", "aerial.jpg"]
    assert not list((tmp_path / "scratch").iterdir())
    assert town.ok("DELETE", "/api/aerial")["project"]["aerial"] is None
    assert town("GET", "/api/aerial")[0] == 404


@pytest.mark.slow
def test_png_with_a_world_file_lies_in_the_system_of_the_scenario(town: Client, tmp_path: Path) -> None:
    project = town.project
    ((x, y),) = WorldFrame("EPSG:32632").from_lon_lat(np.array([at_junction(tmp_path)])).tolist()
    png = io.BytesIO()
    pixels = np.dstack([red_square(), np.full((SIDE, SIDE), 255)]).astype(np.uint8)
    pixels[:100, :, 3] = 0  # nothing is known there
    Image.fromarray(pixels).save(png, "PNG")
    world = f"0.5\n0\n0\n-0.5\n{x - SIDE / 4 + 0.25}\n{y + SIDE / 4 - 0.25}\n"
    path = f"/api/aerial?name=town.png&world={quote(world)}"
    after = town.ok("POST", path, png.getvalue())["project"]
    _, headers, content = town.raw("GET", "/api/aerial")
    assert headers["content-type"] == "image/png"
    assert middle_of_red(content, after["aerial"]["matrix"]) == pytest.approx(project["roi"]["center_m"][:2], abs=0.5)
    status, message, _ = town.refused("POST", f"{path}&crs=EPSG:32633", png.getvalue())
    assert status == 422 and "does not show this junction, but a place 4" in message
    assert town.project["aerial"] == after["aerial"]


def huge_png() -> bytes:
    """A PNG of a few bytes that declares 60,000 x 60,000 pixels."""
    header = b"IHDR" + (60_000).to_bytes(4, "big") * 2 + b"\x08\x02\x00\x00\x00"
    data = b"IDAT" + zlib.compress(b"\x00" * 10_000)
    chunks = [
        (len(chunk) - 4).to_bytes(4, "big") + chunk + zlib.crc32(chunk).to_bytes(4, "big") for chunk in (header, data)
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(chunks)


@pytest.mark.slow
def test_other_pictures_are_refused_with_the_reason(town: Client, tmp_path: Path) -> None:
    far = write_picture(tmp_path / "far.tif", 13.4, 52.5).read_bytes()
    nowhere = write_picture(tmp_path / "nowhere.tif", 13.4, 52.5, None).read_bytes()
    png = io.BytesIO()
    Image.fromarray(red_square()).save(png, "PNG")
    here = quote("1 0 0 -1 568450 5761700")
    for query, content, reason in (
        ("name=far.tif", far, "does not show this junction, but a place 239 km away"),
        ("name=nowhere.tif", nowhere, "does not show this junction"),
        ("name=a.png", png.getvalue(), "a.png: does not say where it is"),
        ("name=a.png&world=1+2+3", png.getvalue(), "its world file: expected six lines"),
        (f"name=a.png&world={here}&crs=no", png.getvalue(), "unknown coordinate reference system"),
        (f"name=a.png&world={here}", png.getvalue()[:2000], "a.png: cannot be read as a picture"),
        (f"name=a.png&world={here}", huge_png(), "a.png: cannot be read as a picture"),
        ("name=a.jpg", b"<svg onload='alert(1)'/>", "a.jpg: is no GeoTIFF, PNG or JPEG"),
        ("name=a.tif", b"II*\x00" + b"\xff" * 200, "a.tif: cannot be read as a picture"),
    ):
        status, message, field = town.refused("POST", f"/api/aerial?{query}", content)
        assert (status, field) == (422, "name") and reason in message, (query, message)
        assert str(tmp_path) not in message
    assert town.refused("POST", "/api/aerial?name=a.svg", b"<svg/>")[0] == 415
    assert town.project["aerial"] is None
    assert not list((tmp_path / "scratch").iterdir())


@pytest.mark.slow
def test_a_picture_that_is_a_link_is_not_sent(town: Client, tmp_path: Path) -> None:
    folder = tmp_path / "work" / "town"
    (tmp_path / "secret").write_text("secret")
    (folder / "aerial.png").symlink_to(tmp_path / "secret")
    (folder / "aerial.pgw").write_text("1 0 0 -1 0 0")
    assert town("GET", "/api/aerial")[0] == 404
    assert town.project["aerial"] is None
