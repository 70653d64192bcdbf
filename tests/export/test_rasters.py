"""Rasters hold the numbers of the artefacts, at their places; read by Pillow, which knows nothing of maps."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

import egvs
from egvs.artefacts.readers import read_blindspots, read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.export.export import export_run
from egvs.scoring.egvs import binary_entropy
from tests.export.conftest import OFFSET_M
from tests.export.readers import utm32

pytest.importorskip("rasterio", reason="the extra egvs[gis] is not installed")

Call = Callable[..., tuple[int, str, str]]

SCALE, TIE, NODATA, KEYS, WORDS, SCALED = 33550, 33922, 42113, 34735, 270, 42112
"""TIFF tags of GeoTIFF 1.1: size of a cell, place of the north-western corner, GDAL's no data, the system; a
description; GDAL's own, where it keeps a scale and an offset."""


def opened(path: Path) -> tuple[NDArray[np.float64], dict[int, object]]:
    """Rows from the north, and the tags."""
    with Image.open(path) as image:
        return np.array(image, dtype=np.float64), dict(image.tag_v2)


def test_occupancy_raster_equals_the_artefact(located: Path, tmp_path: Path) -> None:
    export_run(located, "geotiff", out=tmp_path)
    values, tags = opened(tmp_path / "tpog.tif")
    tpog = read_tpog(located / "tpog.parquet")
    assert float(tags[NODATA]) == -9999
    assert tags[SCALE][:2] == (0.5, 0.5)
    assert tags[TIE][3:5] == pytest.approx((0 - OFFSET_M[0], 10 - OFFSET_M[1]), abs=0.01)  # x 0 to 40, y -10 to 10
    assert 25832 in tags[KEYS]
    for ix, iy in np.ndindex(*tpog.grid.shape[:2]):
        column = tpog.counts[ix, iy]
        expected = column.sum() / 40 if column.any() else -9999
        assert values[39 - iy, ix] == pytest.approx(expected, rel=1e-6)


@pytest.mark.slow
def test_visible_and_missed_add_up_to_the_entropy(located: Path, tmp_path: Path) -> None:
    name = "pole_a"
    export_run(located, "geotiff", out=tmp_path, sites=[name])
    (visible, _), (missed, _) = (opened(tmp_path / f"{word}_{name}.tif") for word in ("seen", "missed"))
    tpog = read_tpog(located / "tpog.parquet")
    entropy = np.array([[sum(binary_entropy(int(c), 40) for c in column) for column in row] for row in tpog.counts])
    known = np.flipud(entropy.T) > 0
    assert ((visible == -9999) == ~known).all()
    assert (visible + missed)[known] == pytest.approx(np.flipud(entropy.T)[known], rel=1e-5)
    share = next(
        row["entropy_seen"] for row in read_scores(located / "scores.parquet").to_pylist() if row["site"] == name
    )
    assert visible[known].sum() / entropy.sum() == pytest.approx(share, rel=1e-5)
    assert 0 < share < 1


def test_missed_vehicles_equal_the_blind_spots(located: Path, tmp_path: Path) -> None:
    export_run(located, "geotiff", out=tmp_path, sites=["pole_a"])
    values, tags = opened(tmp_path / "vehicles_missed_pole_a.tif")
    spots = next(read_blindspots(located / "blindspots.parquet", {"pole_a"}))
    expected = np.flipud(np.nan_to_num(spots.share_missed, nan=-9999).T)
    assert values == pytest.approx(expected, rel=1e-6)
    assert tags[SCALE][0] == spots.cell_m


def test_image_has_a_colour_table_and_no_data_is_0(located: Path, tmp_path: Path) -> None:
    export_run(located, "geotiff", out=tmp_path)
    values, _ = opened(tmp_path / "tpog.tif")
    with Image.open(tmp_path / "tpog_colours.tif") as image:
        steps, palette, tags = np.array(image), image.getpalette(), dict(image.tag_v2)
        assert image.mode == "P"
        assert SCALED not in tags  # QGIS looks for scaled values in the colour table, and shows nothing
    assert float(tags[NODATA]) == 0
    assert ((steps == 0) == (values == -9999)).all()
    assert steps.max() == 254
    output = re.fullmatch(
        r"Occupied voxels in the column on average \(voxel\): \(step - 1\) \* ([0-9.e-]+), steps of 1 to 254;"
        " 0 where there is no data",
        str(tags[WORDS]),
    )
    assert values[values != -9999] == pytest.approx((steps[steps > 0] - 1.0) * float(output[1]), abs=values.max() / 500)
    assert palette[3:6] == [0xFD, 0xE7, 0x25]  # the least is light, the most dark: viridis
    assert palette[254 * 3 :][:3] == [0x44, 0x01, 0x54]


def test_style_spans_the_values(located: Path, tmp_path: Path) -> None:
    export_run(located, "geotiff", out=tmp_path)
    values, _ = opened(tmp_path / "tpog.tif")
    items = list(ET.parse(tmp_path / "tpog.qml").getroot().iter("item"))
    assert float(items[-1].get("value")) == pytest.approx(values.max(), rel=1e-6)
    assert (items[0].get("color"), items[-1].get("color")) == ("#fde725", "#440154")


def test_cells_in_degrees_have_the_value_at_their_position(located: Path, tmp_path: Path) -> None:
    """The middle of each cell, brought into the world frame by the projection's formulas, lies in the column of voxels
    whose value it has."""
    export_run(located, "geotiff", crs="wgs84", out=tmp_path)
    values, tags = opened(tmp_path / "tpog.tif")
    tpog = read_tpog(located / "tpog.parquet")
    west, north = tags[TIE][3:5]
    wide, tall = tags[SCALE][:2]
    assert 4326 in tags[KEYS]
    rows, columns = values.shape
    checked = 0
    for row, column in np.ndindex(rows, columns):
        easting, northing = utm32(west + (column + 0.5) * wide, north - (row + 0.5) * tall)
        place = (easting + OFFSET_M[0]) / 0.5, (northing + OFFSET_M[1] + 10) / 0.5
        if min(abs(at - round(at)) for at in place) < 0.01:  # on the edge of two voxels
            continue
        ix, iy = (int(np.floor(at)) for at in place)
        inside = 0 <= ix < 80 and 0 <= iy < 40
        has = inside and tpog.counts[ix, iy].any()
        expected = tpog.counts[ix, iy].sum() / 40 if has else -9999
        assert values[row, column] == pytest.approx(expected, rel=1e-6)
        checked += has
    assert checked > 300


@pytest.mark.slow
def test_scans_that_were_not_saved_need_unchanged_inputs(mini: Path, tmp_path: Path, run_egvs: Call) -> None:
    """A site that hangs elsewhere by now would be shown with views that its score does not say."""
    run = tmp_path / "run"
    egvs.run(egvs.load(mini, ["scan.keep=false"]), run)
    code, output, _ = run_egvs("export", run, "--to", "geotiff", "--out", tmp_path / "a")
    assert code == 0
    (mini / "sites.csv").write_text((mini / "sites.csv").read_text().replace("pole_a,10,", "pole_a,11,"))
    output = f'egvs: {run / "run.json"}: sites.csv has changed since the sites were scored. Repeat "egvs run".\n'
    assert run_egvs("export", run, "--to", "geotiff", "--out", tmp_path / "b") == (2, "", output)
    assert not (tmp_path / "b").exists()
    assert run_egvs("figure", run, "--what", "seen", "--format", "svg", "--out", tmp_path / "b.svg") == (2, "", output)
    assert run_egvs("export", run, "--to", "csv", "--out", tmp_path / "b")[0] == 0


@pytest.mark.slow
def test_sites_with_similar_names_have_separate_files(mini: Path, tmp_path: Path) -> None:
    """Signs that no file can have, capitals, and what pictures are called."""
    names = ["a.b", "A_B", "a_b_colours"]
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\n" + "".join(f"{n},{10 + i},12,3\n" for i, n in enumerate(names)))
    egvs.run(egvs.load(mini), tmp_path / "run")
    done = export_run(tmp_path / "run", "geotiff", out=tmp_path / "out", sites=names)
    assert len({path.name.lower() for path in done.paths}) == len(done.paths) == 3 * (1 + 3 * len(names))
    with Image.open(tmp_path / "out" / "seen_a_b_colours.tif") as image:
        assert image.mode == "P"


def test_files_have_the_same_bytes_twice(located: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        export_run(located, "geotiff", out=tmp_path / name)
    files = sorted(path.name for path in (tmp_path / "a").iterdir())
    assert len(files) == 12
    assert all((tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes() for name in files)
