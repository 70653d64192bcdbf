"""Opens the folder of a finished run: what it ran on, its artefacts as ``run.json`` knows them, where it lies."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.artefacts import tables
from pipeline.artefacts.readers import Tpog
from pipeline.artefacts.run_record import RECORD, RunRecord
from pipeline.core.errors import InputError
from pipeline.formats.crs import WorldFrame
from pipeline.runs import stages
from pipeline.scenario.loading import from_values
from pipeline.scenario.models import Scenario
from pipeline.scoring.scorer import Scorer
from pipeline.stages import score
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of
from pipeline.world import world_frame

_READ = ("statics", "tpog", "score")
"""Stages whose artefacts are exported."""

_SAME_DEG = 1e-8
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
    work: Workspace
    frame: WorldFrame | None

    @classmethod
    def open(cls, folder: Path) -> FinishedRun:
        """From a run's folder.

        InputError when it is not there, holds no run with scores, or the scenario's folder is gone.
        """
        if not folder.is_dir():
            raise InputError(folder, "no such folder", "the folder of a run, which egvs run makes")
        record = RunRecord.read(folder)
        if missing := [name for name in _READ if name not in record.stages]:
            found = f"the stage {missing[0]} is not done, or another version of this program did it"
            raise InputError(folder / RECORD, found, "a finished run; egvs run finishes it")
        source = Path(os.path.normpath(folder / record.scenario_folder))
        if not source.is_dir():
            found = f"the scenario's folder {source} is not there"
            raise InputError(folder / RECORD, found, "the folder where it was when the run was made")
        scenario = from_values(record.scenario, source, str(folder / RECORD))
        work = Workspace(scenario, folder, recorded=stages.recorded(record))
        run = cls(record, scenario, work, world_frame.of(scenario).frame)
        run._check_place()
        return run

    def _check_place(self) -> None:
        """InputError where the scenario's files put the world frame elsewhere by now than when the run was made."""
        path = self.artefact("scores.parquet")
        scores = tables.read(path, "scores")[0]
        if "longitude_deg" in scores.column_names:
            then = np.column_stack([scores.column(name).to_numpy() for name in ("longitude_deg", "latitude_deg")])
            xy_m = np.column_stack([scores.column(name).to_numpy() for name in ("x_m", "y_m")])
            now = None if self.frame is None else self.frame.to_degrees(xy_m)
            if now is not None and np.allclose(then, now, rtol=0.0, atol=_SAME_DEG):
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
        trajectories, then = self.artefact("trajectories.parquet"), self.record.stages["score"].files
        for name, digest in score.inputs(self.work).files.items():
            if then.get(name) != digest:
                found = f"{name} is not what scores were made from"
                raise InputError(self.work.path(RECORD), found, "egvs run makes them anew")
        return Scorer(scene_of(self.work), tpog, trajectories)

    def artefact(self, name: str) -> Path:
        """The path of an artefact that is the one that ``run.json`` names; InputError where it is not."""
        self.work.digest(name)
        return self.work.path(name)
