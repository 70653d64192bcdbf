"""Opens the folder of a finished run, and chooses the reference system of an export.

The reference system is that of the scenario, degrees (WGS 84), or local metres.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.artefacts.tpog import Tpog
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray
from egvs.formats import georeference
from egvs.formats.georeference import WorldFrame
from egvs.results.plans import SensorPlan
from egvs.runs import stage_registry
from egvs.runs.run_context import open_folder
from egvs.scenario.loading import scenario_from_dict
from egvs.scenario.model import Scenario
from egvs.scoring.scorer import Scorer
from egvs.stages import score
from egvs.stages.base import StageContext
from egvs.world import geolocation

_READ_STAGES = ("statics", "tpog", "score")
"""Stages with artefacts that are exported."""

_TOLERANCE_DEG = 1e-8
"""About a millimetre."""


@dataclass(frozen=True)
class FinishedRun:
    """A run that has scores.

    Attributes
    ----------
    record
        Contents of ``run.json``.
    scenario
        The scenario of the run.
    work
        Its folder; artefacts are compared with the hashes in ``run.json`` when they are read.
    frame
        Position of the world frame on the Earth; None if neither the scenario nor its network has one.
    """

    record: RunRecord
    scenario: Scenario
    work: StageContext
    frame: WorldFrame | None

    @classmethod
    def open(cls, folder: Path) -> FinishedRun:
        """Open a run folder; InputError if it has no finished run, or the scenario folder does not exist."""
        record, record_path = RunRecord.read(folder), RunFolder(folder).run_record
        for name in _READ_STAGES:
            if name not in record.stages:
                problem = f"the stage {name} is not finished, or was run by another version of egvs"
                raise InputError(record_path, problem, 'Run "egvs run" with the options of this folder.')
        source = Path(os.path.normpath(folder / record.scenario_folder))
        if not source.is_dir():
            problem = f"the scenario folder {source} does not exist"
            raise InputError(record_path, problem, "Move it back to where it was when the run was made.")
        scenario = scenario_from_dict(record.scenario, source, str(record_path))
        work = open_folder(scenario, folder, recorded=stage_registry.recorded_digests(record))
        run = cls(record, scenario, work, geolocation.scenario_georeference(scenario).frame)
        run._check_georeference()
        return run

    def _check_georeference(self) -> None:
        """InputError if the position of the world frame has changed since the run."""
        path = self.artefact(RunFolder.scores.name)
        scores = parquet.read_artefact(path, "scores")[0]
        if "longitude_deg" in scores.column_names:
            if self.frame is not None:
                recorded = np.column_stack(
                    [scores.column(name).to_numpy() for name in ("longitude_deg", "latitude_deg")]
                )
                xy_m = np.column_stack([scores.column(name).to_numpy() for name in ("x_m", "y_m")])
                if np.allclose(recorded, self.frame.to_degrees(xy_m), rtol=0.0, atol=_TOLERANCE_DEG):
                    return
            problem = "the geographic positions of its sites differ from those in the scenario or its network"
        elif self.frame is None:
            return
        else:  # a run of an older version, or from before the scenario had a reference system
            problem = "its sites have no geographic position, but the scenario or its network has one"
        raise InputError(path, problem, 'Repeat "egvs run".')

    @property
    def plan(self) -> SensorPlan | None:
        """The plan in the folder; None without one, or where it is for other traffic, sites or settings."""
        plan = SensorPlan.read(self.work.folder)
        return plan if plan is not None and plan.belongs_to(self.record.stages) else None

    @property
    def has_outdated_plan(self) -> bool:
        """Whether the folder has a plan for other traffic, sites or settings."""
        return SensorPlan.read(self.work.folder) is not None and self.plan is None

    def scorer(self, tpog: Tpog) -> Scorer:
        """Return a scorer with the settings of the run.

        InputError if an artefact, or an input file of the score stage, has changed: the views would contradict the
        scores.
        """
        trajectories, recorded = self.artefact(RunFolder.trajectories.name), self.record.stages["score"].files
        for name, digest in score.dependencies(self.work).files.items():
            if recorded.get(name) != digest:
                problem = f"{name} has changed since the sites were scored"
                raise InputError(self.work.folder.run_record, problem, 'Repeat "egvs run".')
        return Scorer(self.work.scene, tpog, trajectories)

    def artefact(self, name: str) -> Path:
        """Return the path of an artefact; InputError if its hash is not that in ``run.json``."""
        self.work.digest(name)
        return self.work.path(name)


SCENARIO_CRS, WGS84_CRS = "scenario", "wgs84"
CRS_CHOICES = (SCENARIO_CRS, WGS84_CRS)

_DIGITS_M, _DIGITS_DEG = 6, 9  # a micrometre, 0.1 mm


@dataclass(frozen=True)
class ExportCrs:
    """The reference system of an export.

    Attributes
    ----------
    crs
        Name for PROJ and GDAL, e.g. ``"EPSG:32632"``, or WKT.
    description
        Description for users.
    frame
        Position of the world frame; None for local metres.
    is_degrees
        Whether coordinates are longitude and latitude.
    """

    crs: str
    description: str
    frame: WorldFrame | None
    is_degrees: bool

    @classmethod
    def from_choice(cls, frame: WorldFrame | None, choice: str, center_m: tuple[float, float], where: str) -> ExportCrs:
        """Return the reference system of a choice.

        Parameters
        ----------
        frame
            Position of the world frame; None if unknown.
        choice
            One of :data:`CRS_CHOICES`.
        center_m
            Centre of the region of interest, world frame.
        where
            Run and option, for messages.

        Raises
        ------
        InputError
            If degrees are requested and the position of the world frame is unknown.
        """
        if choice == WGS84_CRS:
            if frame is None:
                problem = "cannot write degrees, because the scenario has no reference system"
                hint = "Add [crs] with epsg to the scenario, use a network with a <location>, or use --crs scenario."
                raise InputError(where, problem, hint)
            return cls("EPSG:4326", "longitude and latitude (WGS 84)", frame, is_degrees=True)
        if frame is None:
            description = "local metres of the world frame, because the scenario has no reference system"
            return cls(georeference.LOCAL_METRES, description, None, is_degrees=False)
        crs = georeference.crs_name(frame, center_m)
        return cls(crs, georeference.parse_crs(crs, where).name, frame, is_degrees=False)

    @property
    def is_local(self) -> bool:
        """Whether coordinates are local metres, with an unknown position on the Earth."""
        return self.frame is None

    def from_world(self, xy_m: FloatArray) -> FloatArray:
        """Return coordinates of world-frame positions in metres; both of shape (n, 2)."""
        if self.frame is None:
            return xy_m
        if self.is_degrees:
            return np.round(self.frame.to_degrees(xy_m), _DIGITS_DEG)
        eastings: FloatArray = np.subtract(xy_m, self.frame.offset_m, dtype=np.float64)
        return np.round(eastings, _DIGITS_M)

    def to_world(self, xy: FloatArray) -> FloatArray:
        """Return world-frame positions in metres of coordinates; both of shape (n, 2)."""
        if self.frame is None:
            return xy
        if self.is_degrees:
            return self.frame.from_lon_lat(xy)
        return np.add(xy, self.frame.offset_m)

    def geometries(self, shapes: Any) -> Any:
        """Return shapely geometries of the world frame, shape (n,), in this system."""
        import shapely

        return shapely.transform(shapes, self.from_world)
