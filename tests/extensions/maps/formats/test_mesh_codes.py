"""Japanese grid squares: positions of known places."""

from __future__ import annotations

import pytest

from egvs.extensions.maps.formats.mesh_codes import grid_square, parse_tile_name


@pytest.mark.parametrize(
    ("code", "lat_deg", "lon_deg"),
    [
        ("5339", 35.54, 139.777),
        ("533926", 35.54, 139.777),
        ("53392642", 35.54, 139.777),
        ("53394525", 35.6895, 139.6917),
    ],
)
def test_square_contains_a_known_place(code: str, lat_deg: float, lon_deg: float) -> None:
    square = grid_square(code)
    assert square is not None
    assert square.west <= lon_deg < square.east and square.south <= lat_deg < square.north


def test_squares_have_their_size_and_quarters() -> None:
    square = grid_square("53394525")
    assert square is not None
    assert square.north - square.south == pytest.approx(30 / 3600)
    assert square.east - square.west == pytest.approx(45 / 3600)
    halves = [grid_square(f"53394525{digit}") for digit in "1234"]
    middle = (square.west + square.east) / 2, (square.south + square.north) / 2
    assert [(half.west >= middle[0] - 1e-9, half.south >= middle[1] - 1e-9) for half in halves if half] == [
        (False, False), (True, False), (False, True), (True, True),
    ]  # fmt: skip
    quarter = grid_square("5339452534")
    assert quarter is not None and halves[2] is not None
    assert (quarter.east, quarter.north) == pytest.approx((halves[2].east, halves[2].north))


@pytest.mark.parametrize("code", ["533985", "533958", "533945250", "533945255", "53394", ""])
def test_rejects_codes_without_a_square(code: str) -> None:
    assert grid_square(code) is None


def test_names_of_tiles() -> None:
    tile = parse_tile_name("533926_dem_6697_op.gml")
    assert tile is not None and tile.kind == "dem"
    assert parse_tile_name("53392642_bldg_6697_op2.gml") is not None
    for name in ("plateau_buildings.gml", "12345_bldg_6697_op.gml", "53399942_bldg_6697_op.gml", "53392642.gml"):
        assert parse_tile_name(name) is None
