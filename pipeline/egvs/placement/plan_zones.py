"""What the sensors of a plan find together in the zones of ``[score] zones``: ``plan_zones.parquet``.

:mod:`egvs.scoring.zone_results` defines zones, classes and shares.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.core.grid import FloatArray
from egvs.effects.returns import ReturnProbability
from egvs.results.plans import PlannedSensor
from egvs.scoring.blindspots import SpotVisibility
from egvs.scoring.targets import visible_targets
from egvs.scoring.zone_results import PLAN_ZONES, ZoneUsers
from egvs.stages.base import StageContext
from egvs.stages.plan_scans import plan_beams
from egvs.stages.site_scoring import zone_users


@dataclass(frozen=True, eq=False)
class PlanZones:
    """What a plan finds in the zones.

    Attributes
    ----------
    users
        Road users in the zones.
    together
        What all sensors find together.
    best_single
        Share found by the sensor that finds most of each zone and class alone, (k,) float64.
    """

    users: ZoneUsers
    together: SpotVisibility
    best_single: FloatArray

    @classmethod
    def of(cls, context: StageContext, sensors: Sequence[PlannedSensor], *, moved: bool) -> PlanZones:
        """Compute what the sensors of a plan find.

        Parameters
        ----------
        context
            The run; the stages up to the TPOG and the scans are up to date, and the scenario has zones.
        sensors
            The plan, at least one sensor.
        moved
            Whether the sensors were moved from their candidates, so that they are scanned anew.
        """
        users = zone_users(context)
        scene = context.scene
        sites = [sensor.mount for sensor in sensors]
        visible = []
        for _, beams in plan_beams(context, sites, moved=moved):
            visible.append(visible_targets(users.record, beams, ReturnProbability.of(scene, beams.sensor)))
        single = [users.visibility(of_sensor).share for of_sensor in visible]
        return cls(users, users.together(visible), np.max(single, axis=0))

    def write(self, path: Path, metadata: Mapping[str, Any]) -> None:
        """Write ``plan_zones.parquet``."""
        columns = {**self.users.columns(self.together), "best_single": self.best_single}
        parquet.write_artefact(path, PLAN_ZONES, columns, metadata)
