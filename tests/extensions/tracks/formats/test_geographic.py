"""Longitude and latitude to UTM, against figures of other programs and a slow twin of the turn of the grid."""

from __future__ import annotations

import math

import numpy as np
import pytest

from egvs.core.errors import InputError
from egvs.extensions.tracks.formats.geographic import grid_turn_rad, to_utm
from egvs.formats.georeference import WorldFrame


def error(row: int, problem: str) -> InputError:
    return InputError(f"row {row}", problem, "Correct it.")


def test_aachen_is_in_zone_32_whose_grid_is_turned_there() -> None:
    """At 6.07 E, 50.78 N the grid's north lies 2.27 degrees west of true north: tan = tan(lon - 9) sin(lat)."""
    lon_deg, lat_deg = np.array([6.07116, 6.07216]), np.array([50.78207, 50.78207])
    xy_m, frame = to_utm(lon_deg, lat_deg, error)
    assert frame.crs == "EPSG:32632"
    assert np.hypot(*(xy_m[0] - (293_487, 5_629_712))) < 200.0  # inD's origin there, to the size of its image
    turn_rad = grid_turn_rad(lon_deg, lat_deg, frame)
    expected = math.atan(math.tan(math.radians(6.07116 - 9.0)) * math.sin(math.radians(50.78207)))
    assert turn_rad[0] == pytest.approx(expected, abs=2e-5)
    # the second position is due east of the first: its grid direction is the turn
    east = xy_m[1] - xy_m[0]
    assert math.atan2(east[1], east[0]) == pytest.approx(turn_rad[0], abs=1e-4)


@pytest.mark.slow
def test_southern_hemisphere_and_other_datum() -> None:
    lon_deg, lat_deg = np.array([151.21]), np.array([-33.87])
    xy_m, frame = to_utm(lon_deg, lat_deg, error)
    assert frame.crs == "EPSG:32756" and 6.2e6 < xy_m[0, 1] < 6.3e6
    potsdam_m, frame = to_utm(np.array([13.0]), np.array([52.0]), error, "EPSG:4314")
    plain_m = WorldFrame("EPSG:32633").from_lon_lat(np.array([[13.0, 52.0]]))
    assert 50.0 < np.hypot(*(potsdam_m - plain_m)[0]) < 250.0  # the shift of that datum


@pytest.mark.parametrize(("lon", "lat"), [(200.0, 50.0), (10.0, 89.0), (12.0, 50.0), (10.0, 51.5)])
def test_positions_far_from_the_others_are_errors(lon: float, lat: float) -> None:
    with pytest.raises(InputError, match="row 3"):
        to_utm(np.array([10.0, 10.1, 10.0, lon]), np.array([50.0, 50.0, 50.1, lat]), error)
