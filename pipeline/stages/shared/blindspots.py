"""The places at which a run's vehicles were recorded, on the roads that its traffic was simulated on."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipeline.core import files
from pipeline.scenario.models import Scenario
from pipeline.scoring.blindspots.road_places import RoadPlaces
from pipeline.scoring.blindspots.spots import Spots
from pipeline.scoring.targets.record import Floats, TargetRecord
from pipeline.stages.base import Workspace
from pipeline.traffic import sumo_folder


def network_digests(scenario: Scenario) -> dict[str, str]:
    """The network whose lanes are named, by sha256; nothing where there is none."""
    path = _network_path(scenario)
    return {} if path is None else {"network": files.sha256_of(path)}


def spots_of(work: Workspace, record: TargetRecord, recorded: list[int], weight: Floats) -> Spots:
    """Where each vehicle-frame of a record is.

    Parameters
    ----------
    recorded
        Frames that were recorded in each period.
    weight
        How much each vehicle-frame counts, (n,) float64.
    """
    roads, scenario = None, work.scenario
    if _network_path(scenario) is not None:
        network = sumo_folder.roads(next(iter(scenario.by_period().values())))
        roads = RoadPlaces.of(network, scenario.roi.grid.roi) if network is not None else None
    period = np.searchsorted(np.cumsum(recorded), record.numbers[record.frame], side="right")
    return Spots.of(record, roads, weight, period.astype(np.int64))


def _network_path(scenario: Scenario) -> Path | None:
    """The network that all the traffic drove on; None where a finished file names none, or periods have networks of
    their own."""
    paths = {sumo_folder.network_path(alone) for alone in scenario.by_period().values()}
    return paths.pop() if len(paths) == 1 else None
