"""A finished run opened, and the CRS it is exported in.

Opens the folder of a finished run: what it ran on, its artefacts as ``run.json`` knows them, where it lies.

The reference system that exported positions are in: the scenario's own, degrees (WGS 84), or local metres.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.artefacts.tpog import Tpog
from egvs.core.errors import InputError
from egvs.formats import georeference
from egvs.formats.georeference import WorldFrame
from egvs.runs import stages
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.scoring.scorer import Scorer
from egvs.stages import score
from egvs.stages.base import StageContext
from egvs.stages.inputs import get_scene, open_folder
from egvs.world import geolocation

_READ_STAGES = ("statics", "tpog", "score")
"""Stages whose artefacts are exported."""

_TOLERANCE_DEG = 1e-8
"""A millimetre."""


@dataclass(frozen=True)
class FinishedRun:
    """A run that has scores.

    Attributes
    ----------
    work
        Its folder; an artefact that is not the one that ``run.json`` names is refused when it is read through it.
    frame
        Where its world frame lies on the Earth; None where neither the scenario nor its network says it.
    """

    record: RunRecord
    scenario: Scenario
    work: StageContext
    frame: WorldFrame | None

    @classmethod
    def open(cls, folder: Path) -> FinishedRun:
        """From a run's folder.

        InputError when it is not there, holds no run with scores, or the scenario's folder is gone.
        """
        if not folder.is_dir():
            raise InputError(folder, "no such folder", "the folder of a run, which egvs run makes")
        record = RunRecord.read(folder)
        if missing := [name for name in _READ_STAGES if name not in record.stages]:
            found = f"the stage {missing[0]} is not done, or another version of this program did it"
            raise InputError(RunFolder(folder).run_record, found, "a finished run; egvs run finishes it")
        source = Path(os.path.normpath(folder / record.scenario_folder))
        if not source.is_dir():
            found = f"the scenario's folder {source} is not there"
            raise InputError(RunFolder(folder).run_record, found, "the folder where it was when the run was made")
        scenario = scenario_from_dict(record.scenario, source, str(RunFolder(folder).run_record))
        work = open_folder(scenario, folder, recorded=stages.recorded_digests(record))
        run = cls(record, scenario, work, geolocation.scenario_georeference(scenario).frame)
        run._check_georeference()
        return run

    def _check_georeference(self) -> None:
        """InputError where the scenario's files put the world frame elsewhere by now than when the run was made."""
        path = self.artefact(RunFolder.scores.name)
        scores = parquet.read_artefact(path, "scores")[0]
        if "longitude_deg" in scores.column_names:
            then = np.column_stack([scores.column(name).to_numpy() for name in ("longitude_deg", "latitude_deg")])
            xy_m = np.column_stack([scores.column(name).to_numpy() for name in ("x_m", "y_m")])
            now = None if self.frame is None else self.frame.to_degrees(xy_m)
            if now is not None and np.allclose(then, now, rtol=0.0, atol=_TOLERANCE_DEG):
                return
            found = "its sites lie elsewhere on the Earth than the scenario, or its network, says by now"
        elif self.frame is None:
            return
        else:  # a run of an older version, or of before the scenario said it
            found = "its sites have no longitude and latitude, and the scenario, or its network, has a place by now"
        raise InputError(path, found, "egvs run makes it anew")

    def scorer(self, tpog: Tpog) -> Scorer:
        """What counts the voxels that sites see, as the run did it.

        InputError where an artefact, or a file of the scenario that scores were made from, is another by now: what a
        site sees would not be what its score says.
        """
        trajectories, then = self.artefact(RunFolder.trajectories.name), self.record.stages["score"].files
        for name, digest in score.dependencies(self.work).files.items():
            if then.get(name) != digest:
                found = f"{name} is not what scores were made from"
                raise InputError(self.work.folder.run_record, found, "egvs run makes them anew")
        return Scorer(get_scene(self.work), tpog, trajectories)

    def artefact(self, name: str) -> Path:
        """The path of an artefact that is the one that ``run.json`` names; InputError where it is not."""
        self.work.digest(name)
        return self.work.path(name)


Floats = NDArray[np.float64]

SCENARIO_CRS, WGS84_CRS = "scenario", "wgs84"
CRS_CHOICES = (SCENARIO_CRS, WGS84_CRS)

_DIGITS_M, _DIGITS_DEG = 6, 9  # a micrometre, 0.1 mm


@dataclass(frozen=True)
class ExportCrs:
    """A reference system, and how world-frame positions get there.

    Attributes
    ----------
    crs
        As PROJ and GDAL understand it: ``"EPSG:32632"``, WKT.
    words
        What a user calls it.
    frame
        Where the world frame lies; None for local metres.
    is_degrees
        Whether coordinates are longitude and latitude.
    """

    crs: str
    words: str
    frame: WorldFrame | None
    is_degrees: bool

    @classmethod
    def of(cls, frame: WorldFrame | None, choice: str, center_m: tuple[float, float], location: object) -> ExportCrs:
        """The system of a choice in :data:`CRS_CHOICES`.

        Parameters
        ----------
        center_m
            The middle of the region of interest, world frame.
        location
            The run, for messages.

        Raises
        ------
        InputError
            For degrees of a scenario that does not say where its world frame lies.
        """
        if choice == WGS84_CRS:
            if frame is None:
                found = "has no degrees: nothing says where the scenario's world frame lies on the Earth"
                right = (
                    "[crs] with epsg in the scenario, or a network with a <location>; or another format in local metres"
                )
                raise InputError(location, found, f"{right} (--crs scenario)")
            return cls("EPSG:4326", "longitude and latitude (WGS 84)", frame, is_degrees=True)
        if frame is None:
            words = "local metres of the world frame, as the scenario does not say where on the Earth it lies"
            return cls(georeference.LOCAL_METRES, words, None, is_degrees=False)
        known = georeference.crs_name(frame, center_m)
        return cls(known, georeference.parse_crs(known, str(location)).name, frame, is_degrees=False)

    @property
    def is_local(self) -> bool:
        """Whether nobody knows where on the Earth positions are."""
        return self.frame is None

    def from_world(self, xy_m: Floats) -> Floats:
        """Coordinates (n, 2) of world-frame positions (n, 2) in metres."""
        if self.frame is None:
            return xy_m
        if self.is_degrees:
            return np.round(self.frame.to_degrees(xy_m), _DIGITS_DEG)
        eastings: Floats = np.subtract(xy_m, self.frame.offset_m, dtype=np.float64)
        return np.round(eastings, _DIGITS_M)

    def to_world(self, xy: Floats) -> Floats:
        """World-frame positions (n, 2) in metres of coordinates (n, 2)."""
        if self.frame is None:
            return xy
        return self.frame.from_degrees(xy) if self.is_degrees else np.add(xy, self.frame.offset_m)

    def geometries(self, shapes: Any) -> Any:
        """Shapely geometries of the world frame, (n,) object, in this system."""
        import shapely

        return shapely.transform(shapes, self.from_world)
