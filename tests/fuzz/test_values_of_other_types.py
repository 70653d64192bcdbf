"""JSON with a value of another type at any place is rejected with the file's name, or read; readers raise nothing else.

A list where a name is expected cannot be looked up in a table, for example.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from egvs.core.errors import InputError
from egvs.core.grid import Roi
from egvs.extensions.hardware.fit.calibration import _read_transformation
from egvs.extensions.maps.formats.cityjson import CityJsonFile
from egvs.extensions.tracks.formats import dair_v2x, openlabel
from egvs.formats.georeference import Georeference
from egvs.formats.sweep_labels import LabelOptions
from egvs.sensors.beam_files import read_beam_file
from egvs.sensors.site_files import read_features
from egvs.world.footprints import read_footprints
from tests.extensions.maps.test_citygml import city_json
from tests.extensions.tracks import writers_json
from tests.extensions.tracks.boxes import moving_boxes
from tests.fuzz import bases
from tests.fuzz.structure import holders

_OTHERS: tuple[Any, ...] = (None, True, -1, 1e308, 10**200, float("nan"), "x", [], ["x"], [[0]], {}, {"x": ["y"]})
_NOWHERE = Georeference(None, Roi((20.0, 0.0, 2.5), (40.0, 20.0, 5.0)), "scenario.toml")


def _city(folder: Path) -> Path:
    path = folder / "city.json"
    path.write_text(json.dumps(city_json()), encoding="utf-8")
    return path


def _made(make: Callable[[Path], None], name: str) -> Callable[[Path], Path]:
    def write(folder: Path) -> Path:
        make(folder)
        return folder / name

    return write


def _tracks(write: Callable[[Path, Any], Path]) -> Callable[[Path], Path]:
    return lambda folder: write(folder, moving_boxes(("car",), n_frames=1))


def _labels(form: str) -> Callable[[Path], Path]:
    return _made(bases.labelled(form), "labels/sweep0.json")


def _read_city(path: Path) -> None:
    for city_object in CityJsonFile(path).objects():
        assert city_object.name


READERS: dict[str, tuple[Callable[[Path], Path], Callable[[Path], object]]] = {
    "CityJSON": (_city, _read_city),
    "footprints": (
        _made(bases.plain, "scenario/statics.geojson"),
        lambda path: read_footprints(path, _NOWHERE),
    ),
    "sites": (_made(bases.sites, "scenario/sites.geojson"), lambda path: list(read_features(path, _NOWHERE))),
    "Ouster": (_made(bases.metadata, "scenario/metadata.json"), read_beam_file),
    "calibration": (_made(bases.calibrated, "calibration.json"), _read_transformation),
    "OpenLABEL": (_tracks(writers_json.write_openlabel), openlabel.read),
    "labels in OpenLABEL": (_labels("openlabel"), lambda path: openlabel.read_labels(path, LabelOptions())),
    "V2X-Seq": (_tracks(writers_json.write_dair_v2x), dair_v2x.read),
    "labels of DAIR-V2X": (_labels("dair"), lambda path: dair_v2x.read_labels(path, LabelOptions())),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", READERS)
def test_value_of_another_type_is_rejected_or_read(name: str, tmp_path: Path) -> None:
    write, read = READERS[name]
    path = write(tmp_path)
    document = json.loads(path.read_text(encoding="utf-8"))
    read(path)
    rejected = 0
    for text in _variants(document):
        path.write_text(text, encoding="utf-8")
        try:
            read(path)
        except InputError as error:
            assert path.name in str(error), text
            rejected += 1
    assert rejected > 20


def _variants(document: Any) -> Iterator[str]:
    """Yield the document with another value at each place, but only at the first three of a list."""
    for holder, key in list(holders(document)):
        if isinstance(holder, list) and key > 2:
            continue
        value = holder[key]
        for other in _OTHERS:
            holder[key] = other
            yield json.dumps(document)
        holder[key] = value
