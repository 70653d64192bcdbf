"""A junction made ready for validation: its scene, and the record of traffic that the TPOG never saw.

The stages are those of a run, and come through its store: what another command has made is not made again.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipeline.artefacts import tables
from pipeline.artefacts.traffic_frames import TrafficFrame, read
from pipeline.core.progress import Progress, silent
from pipeline.runs.workflow import bring
from pipeline.scenario.models import Scenario
from pipeline.sensing.scene import Scene
from pipeline.stages.base import Workspace
from pipeline.stages.shared.scene import scene_of
from pipeline.validation import unseen_traffic

_STAGES = ("statics", "traffic")


@dataclass(frozen=True)
class UnseenRecord:
    """A junction with its record.

    Attributes
    ----------
    scenario
        With the seed and the frames of the record.
    scene
        The static world, sites, sensors and effects; as in a run of the scenario itself.
    trajectories
        The record, ``trajectories.parquet``.
    numbers
        The frames of it that are used, (frames,) int64, ascending.
    keys
        Hash of everything that the static world and the record depend on, by stage.
    """

    scenario: Scenario
    scene: Scene
    trajectories: Path
    numbers: NDArray[np.int64]
    keys: dict[str, str]

    @property
    def frames(self) -> int:
        """How many frames are used."""
        return len(self.numbers)

    def read(self) -> Iterator[TrafficFrame]:
        """The frames that are used, in order."""
        return read(self.trajectories, self.numbers)


def prepare(
    scenario: Scenario,
    folder: Path,
    frames: int,
    *,
    apart_s: float = unseen_traffic.APART_S,
    jobs: int | None = None,
    progress: Progress = silent,
) -> UnseenRecord:
    """Bring the static world and the record of a scenario into a folder.

    Parameters
    ----------
    folder
        Where both are laid; they belong to the record, and stay as long as it is used.
    frames
        How many are used; the record may have more.
    apart_s
        Time between two frames, at least.

    Raises
    ------
    InputError
        Where traffic has fewer frames that far apart; or what the stages refuse.
    """
    unseen = unseen_traffic.scenario_of(scenario, frames, apart_s)
    folder.mkdir(parents=True, exist_ok=True)
    work = Workspace(unseen, folder, jobs=jobs, progress=progress)
    keys = bring(work, *_STAGES)
    with tables.reader(work.path("trajectories.parquet"), "trajectories") as (_, about):
        recorded = int(about["frames"])
    numbers = unseen_traffic.numbers(unseen, recorded, frames, apart_s)
    return UnseenRecord(unseen, scene_of(work), work.path("trajectories.parquet"), numbers, keys)
