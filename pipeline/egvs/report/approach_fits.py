"""Observed queues and speeds of approaches beside the simulated ones, from the artefacts of a run."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.core.errors import InputError
from egvs.scenario.model import Scenario
from egvs.traffic import approach_queues, observed
from egvs.traffic.approach_queues import VehicleFrames
from egvs.traffic.network import read_net_xml

_COLUMNS = ("frame", "vehicle", "part", "kind", "x_m", "y_m", "yaw_rad", "length_m")


@dataclass(frozen=True)
class ApproachFit:
    """Queue and speed of an approach, observed and simulated; None where nothing was observed or simulated."""

    approach: str
    period: str
    observed_queue_m: float | None
    queue_m: float
    mean_queue_m: float
    observed_speed_kmh: float | None
    speed_kmh: float | None
    vehicles: int

    def to_json(self) -> dict[str, Any]:
        """The form in the summary of a stage."""
        return asdict(self)


def compare_approaches(scenario: Scenario, trajectories: Path, network: Path | None) -> tuple[ApproachFit, ...]:
    """Compare what was observed with the recorded frames.

    Parameters
    ----------
    scenario
        A scenario with ``traffic.observed``.
    trajectories
        The artefact.
    network
        The simulated network.

    Raises
    ------
    InputError
        When the file of observations is not valid, or there is no network.
    """
    if network is None:
        problem = "the run folder has no network"
        raise InputError(f"{scenario.file}: {observed.KEY}", problem, "Use traffic that is simulated on a network.")
    roads = read_net_xml(network)
    observations = observed.read_observed(scenario, roads)
    paths = approach_queues.approach_paths(observed.approach_index(scenario, roads).movements, roads)
    boxes, windows = _read_boxes(trajectories)
    fits = []
    for observation in observations:
        first, end = windows[observation.period]
        traffic = approach_queues.measure_approach(paths[observation.approach], boxes, first, end)
        speed_kmh = None if math.isnan(traffic.speed_kmh) else round(traffic.speed_kmh, 1)
        fits.append(
            ApproachFit(
                observation.approach, observation.period, observation.queue_m, round(traffic.queue_m, 1),
                round(traffic.mean_queue_m, 1), observation.speed_kmh, speed_kmh, traffic.vehicles,
            )
        )  # fmt: skip
    return tuple(fits)


def _read_boxes(path: Path) -> tuple[VehicleFrames, Mapping[str, tuple[int, int]]]:
    """Return the boxes of vehicles without their rear parts, and the frames of each period ("" without periods)."""
    table, metadata = parquet.read_artefact(path, "trajectories", columns=list(_COLUMNS))
    _, vehicle = np.unique(table.column("vehicle").to_numpy(zero_copy_only=False).astype(str), return_inverse=True)
    kinds = table.column("kind").to_numpy(zero_copy_only=False).astype(str)
    keep = (table.column("part").to_numpy() == 0) & ~np.isin(kinds, sorted(NON_VEHICLE_KINDS))
    values = {name: table.column(name).to_numpy()[keep] for name in ("frame", "x_m", "y_m", "yaw_rad", "length_m")}
    boxes = VehicleFrames(
        values["frame"].astype(np.int64), vehicle[keep].astype(np.int64),
        np.column_stack([values["x_m"], values["y_m"]]), values["yaw_rad"], values["length_m"],
        metadata["frame_period_s"],
    )  # fmt: skip
    windows = {"": (0, metadata["frames"])}
    first = 0
    for period in metadata.get("periods", ()):
        windows[period["name"]] = (first, first + period["frames"])
        first += period["frames"]
    return boxes, windows
