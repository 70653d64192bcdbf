"""Requests, targets, and files that are there already."""

from __future__ import annotations

import errno
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest

from egvs.core import plugins
from egvs.export.export import FORMATS, export_run

pytest.importorskip("pyogrio", reason="the extra egvs[gis] is not installed")
pytest.importorskip("geopandas", reason="the extra egvs[gis] is not installed")

Call = Callable[..., tuple[int, str, str]]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            ("--to", "shp"),
            "--to: expected one of gpkg, geojson, geoparquet, kml, csv, geotiff, dxf, glb, usd, got 'shp'",
        ),
        (("--to", "gpkg", "--crs", "EPSG:4326"), "--crs: expected scenario or wgs84, got 'EPSG:4326'"),
        (("--to", "kml", "--crs", "scenario"), "--crs: KML files are always in degrees"),
        (("--to", "csv", "--crs", "wgs84"), "cannot write degrees, because the scenario has no reference system"),
        (("--to", "kml"), "cannot write degrees, because the scenario has no reference system. Add [crs]"),
        (("--to", "csv", "--site", "pole_a"), "--site: works only with --to geotiff, got --to csv"),
        (
            ("--to", "geotiff", "--site", "pole_z"),
            "--site: this run has no site 'pole_z'. Choose one of pole_a",
        ),
        (
            ("--to", "gpkg", "--out", "sites.csv"),
            "--out: expected a file name ending in .gpkg",
        ),
    ],
)
def test_rejects_impossible_requests_with_one_message(
    local: Path, run_egvs: Call, options: tuple[str, ...], message: str
) -> None:
    before = sorted(local.rglob("*"))
    code, out, err = run_egvs("export", local, *options)
    assert (code, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    assert sorted(local.rglob("*")) == before


@pytest.mark.parametrize(("to", "library"), [("gpkg", "pyogrio"), ("geoparquet", "geopandas"), ("geotiff", "rasterio")])
def test_names_the_missing_extra(
    local: Path, run_egvs: Call, monkeypatch: pytest.MonkeyPatch, to: str, library: str
) -> None:
    monkeypatch.setattr(plugins, "find_spec", lambda name: None)
    code, _, err = run_egvs("export", local, "--to", to)
    output = f"egvs: export to {to} needs {library}, which is not installed. Run pip install 'egvs[gis]'\n"
    assert (code, err) == (2, output)


@pytest.mark.parametrize("to", sorted(FORMATS))
def test_rejects_a_target_that_cannot_be_written(located: Path, tmp_path: Path, run_egvs: Call, to: str) -> None:
    (tmp_path / "file").write_text("mine")
    code, _, err = run_egvs("export", located, "--to", to, "--out", tmp_path / "file" / f"run.{to}")
    assert code == 2
    assert "cannot be written (" in err
    assert err.count("\n") == 1
    assert (tmp_path / "file").read_text() == "mine"


def test_rejects_a_file_where_a_folder_is_needed(located: Path, tmp_path: Path, run_egvs: Call) -> None:
    (tmp_path / "file").write_text("mine")
    code, _, err = run_egvs("export", located, "--to", "csv", "--out", tmp_path / "file")
    assert (code, (tmp_path / "file").read_text()) == (2, "mine")
    assert "is a file. Give a folder: --to csv writes several files" in err


@pytest.mark.slow
def test_replaces_no_file_in_a_user_s_folder(local: Path, run_egvs: Call) -> None:
    """Of a scenario its sites, of a run its blind spots."""
    for to, folder, name in (("csv", local.parent / "mini", "sites.csv"), ("geoparquet", local, "blindspots.parquet")):
        content, before = (folder / name).read_bytes(), sorted(folder.rglob("*"))
        code, _, err = run_egvs("export", local, "--to", to, "--out", folder)
        assert (code, err) == (
            2,
            f"egvs: --out: {folder / name} already exists. Choose a new folder, or one without these files.\n",
        )
        assert ((folder / name).read_bytes(), sorted(folder.rglob("*"))) == (content, before)


@pytest.mark.parametrize("to", ["gpkg", "kml"])
def test_replaces_no_file_of_a_user(located: Path, tmp_path: Path, run_egvs: Call, to: str) -> None:
    (path := tmp_path / f"mine.{to}").write_text("mine")
    code, _, err = run_egvs("export", located, "--to", to, "--out", path)
    assert (code, err) == (2, f"egvs: --out: {path} already exists. Choose another name.\n")
    assert path.read_text() == "mine"


def test_all_files_appear_or_none(located: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy, copied = shutil.copyfile, []

    def full(source: Path, target: Path) -> None:
        if len(copied) == 2:
            raise OSError(errno.ENOSPC, "No space left on device", str(source), None, str(target))
        copied.append(copy(source, target))

    monkeypatch.setattr(shutil, "copyfile", full)
    with pytest.raises(OSError, match="No space left") as caught:
        export_run(located, "csv", out=tmp_path / "out")
    assert caught.value.filename == str(tmp_path / "out" / "footprints.csv")
    assert copied
    assert not list((tmp_path / "out").iterdir())


def test_removes_stale_layers_from_the_run_folder(local: Path, tmp_path: Path) -> None:
    shutil.copytree(local.parent, tmp_path / "copy")
    folder = tmp_path / "copy" / "run" / "export" / "csv"
    folder.mkdir(parents=True)
    for name in ("plan.csv", "mine.csv"):
        (folder / name).write_text("of before")
    export_run(tmp_path / "copy" / "run", "csv")
    assert {path.name for path in folder.iterdir()} == {
        "sites.csv", "blindspots.csv", "footprints.csv", "region.csv", "mine.csv"
    }  # fmt: skip


def test_writes_into_the_run_folder_by_default_and_can_repeat_it(local: Path, run_egvs: Call) -> None:
    output = [run_egvs("export", local, "--to", "csv") for _ in range(2)]
    assert output[0] == output[1]
    paths = [Path(line) for line in output[0][1].splitlines()[1:]]
    assert [path.name for path in paths] == ["sites.csv", "blindspots.csv", "footprints.csv", "region.csv"]
    assert {path.parent for path in paths} == {local / "export" / "csv"}
    shutil.rmtree(local / "export")
