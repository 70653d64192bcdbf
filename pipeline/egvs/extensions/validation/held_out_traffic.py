"""Held-out traffic: recorded traffic that the TPOG was not computed from.

It is the scenario's own demand under another seed, in frames that lie further apart than those of the TPOG. Departures
of a user's demand are redrawn. All sites are evaluated with the same frames. A finished traffic file has no seed: its
frames are also those of the TPOG, and validation warns about that.

The static world and the record are stages of a run and come from its store, so what another command has computed is
not computed again.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from pydantic import ValidationError

from egvs.artefacts import parquet
from egvs.artefacts.traffic_frames import TrafficFrame, read_frames
from egvs.core.errors import InputError
from egvs.core.grid import IntArray
from egvs.core.progress import ProgressCallback, no_progress
from egvs.runs.run import ensure_stages
from egvs.runs.run_context import open_folder
from egvs.scenario.model import Scenario
from egvs.sensors.scene import Scene
from egvs.traffic import finished_fcd

DEFAULT_SPACING_S, MIN_SPACING_S = 7.0, 2.0
"""Time between two frames by default, and the least by default: half a second later, the same queue is no new
observation. With 7 s, 250 frames contain three times as many different vehicles as with 2 s.
"""

_SEED_STREAM = 0x7E57
"""Separates the seed of held-out traffic from all other seeds that are derived from the scenario's."""

_STAGES = ("statics", "traffic")


@dataclass(frozen=True)
class FrameSampling:
    """How held-out traffic is sampled.

    Attributes
    ----------
    frames
        Number of frames.
    spacing_s
        Minimum time between two frames, in seconds; see :func:`default_spacing_s` when None.
    """

    frames: int
    spacing_s: float | None = None


@dataclass(frozen=True)
class TrafficSample:
    """The size of the held-out traffic.

    Attributes
    ----------
    frames
        Number of frames.
    apart_s
        Minimum time between two frames.
    vehicles
        Number of different vehicles in the region of interest.
    """

    frames: int
    apart_s: float
    vehicles: int


@dataclass(frozen=True)
class HeldOutTraffic:
    """A junction and a record of its held-out traffic.

    Attributes
    ----------
    scenario
        The scenario with the seed and the frames of the record.
    scene
        Static world, sites, sensors and effects, as in a run of the original scenario.
    trajectories
        Path of the record, ``trajectories.parquet``.
    numbers
        Numbers of the frames that are used, (frames,) int64, ascending.
    keys
        Hash of everything that the static world and the record depend on, by stage.
    apart_s
        Minimum time between two of the frames.
    period_ends
        Number of frames in the record up to the end of each period; one value without periods.
    """

    scenario: Scenario
    scene: Scene
    trajectories: Path
    numbers: IntArray
    keys: dict[str, str]
    apart_s: float
    period_ends: tuple[int, ...]

    @property
    def frames(self) -> int:
        """Number of frames that are used."""
        return len(self.numbers)

    def read(self) -> Iterator[TrafficFrame]:
        """Yield the frames that are used, in order."""
        return read_frames(self.trajectories, self.numbers)

    def sample(self, frames: Sequence[TrafficFrame]) -> TrafficSample:
        """Return the size of the traffic in these frames."""
        return TrafficSample(len(frames), self.apart_s, len(self.vehicles_in_region(frames)))

    def vehicles_in_region(self, frames: Iterable[TrafficFrame]) -> set[tuple[int, str]]:
        """Return the different vehicles in the region of interest: number of the period, and SUMO's id."""
        vehicles: set[tuple[int, str]] = set()
        for frame in frames:
            period = bisect.bisect_right(self.period_ends, frame.number)
            vehicles.update((period, frame.vehicles[row]) for row in frame.target_rows(self.scene.roi))
        return vehicles


def prepare_held_out_traffic(
    scenario: Scenario,
    folder: Path,
    frames: int,
    *,
    apart_s: float | None = None,
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> HeldOutTraffic:
    """Compute the static world and record the held-out traffic of a scenario, or restore them from the store.

    Parameters
    ----------
    folder
        Folder for both. It has to exist as long as the record is used.
    frames
        Number of frames to use; the record may have more.
    apart_s
        Minimum time between two frames; see :func:`default_spacing_s` when None.
    jobs
        Number of threads; one per core when None.

    Raises
    ------
    InputError
        If the traffic has too few frames that far apart, or a stage refuses the scenario.
    """
    if apart_s is None:
        apart_s = default_spacing_s(scenario, frames)
    elif not 0.0 < apart_s < math.inf:
        raise InputError("--spacing", f"expected seconds above 0, got {apart_s:g}", "Use --spacing 7.")
    held_out = held_out_scenario(scenario, frames, apart_s)
    folder.mkdir(parents=True, exist_ok=True)
    context = open_folder(held_out, folder, jobs=jobs, progress=progress)
    keys = ensure_stages(context, *_STAGES)

    trajectories = context.path("trajectories.parquet")
    with parquet.open_artefact(trajectories, "trajectories") as (_, metadata):
        recorded = int(metadata["frames"])
        period_ends = tuple(itertools.accumulate(p["frames"] for p in metadata.get("periods", ()))) or (recorded,)
    numbers = select_frame_numbers(held_out, recorded, frames, apart_s)
    return HeldOutTraffic(held_out, context.scene, trajectories, numbers, keys, apart_s, period_ends)


def default_spacing_s(scenario: Scenario, frames: int) -> float:
    """Return the time between two frames of held-out traffic, in seconds.

    It is ``DEFAULT_SPACING_S`` where the traffic is drawn for as long as necessary. A finished file, periods, and a
    user's demand have an end: where their frames do not allow as much, it is shorter, but at least ``MIN_SPACING_S``.
    """
    traffic = scenario.traffic
    if not traffic.periods and not traffic.is_finished and not traffic.has_user_demand:
        return DEFAULT_SPACING_S
    recorded = sum(finished_fcd.recorded_frames(period) for period in scenario.by_period().values())
    widest = (recorded - 1) // max(frames - 1, 1)
    return min(DEFAULT_SPACING_S, max(MIN_SPACING_S, widest * traffic.frame_period_s))


def held_out_scenario(scenario: Scenario, frames: int, apart_s: float) -> Scenario:
    """Return the scenario whose traffic is recorded for validation.

    Parameters
    ----------
    frames
        Number of frames.
    apart_s
        Minimum time between two frames.

    Raises
    ------
    InputError
        If the simulated time would exceed the limit of a scenario.
    """
    traffic = scenario.traffic
    if traffic.is_finished:
        return scenario

    state = np.random.SeedSequence((scenario.seed, _SEED_STREAM)).generate_state(1, np.uint64)
    seed = int(state[0]) >> 33  # SUMO takes seeds of 31 bits
    # one simulation: frames far apart need no replications
    values = {key: getattr(traffic, key) for key in traffic.model_fields_set - {"seeds"}}
    if any(period.traffic.has_user_demand for period in scenario.by_period().values()):
        values["redraw_departures"] = True
    if not traffic.periods:
        stride = math.ceil(apart_s / traffic.frame_period_s - 1e-9)
        values |= {"frames": frames, "frame_period_s": stride * traffic.frame_period_s}
    try:
        held_out = type(traffic)(**values)
    except ValidationError as error:
        reason = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise InputError(
            "--frames",
            f"{frames} frames at least {apart_s:g} s apart are too many: {reason}",
            "Use fewer frames, or a smaller --spacing.",
        ) from None
    return scenario.model_copy(update={"traffic": held_out, "seed": seed})


def select_frame_numbers(scenario: Scenario, recorded: int, frames: int, apart_s: float) -> IntArray:
    """Return the numbers of the frames to use, (frames,) int64, spread over the whole record.

    Parameters
    ----------
    scenario
        From :func:`held_out_scenario`.
    recorded
        Number of frames in its record.
    frames
        Number of frames to use.
    apart_s
        Minimum time between two frames.

    Raises
    ------
    InputError
        If the record has too few frames that far apart.
    """
    period_s = scenario.traffic.frame_period_s
    stride = max(1, math.ceil(apart_s / period_s - 1e-9))
    available = (recorded - 1) // stride + 1
    if frames > available:
        problem = (
            f"expected at most {available} frames at least {apart_s:g} s apart, got {frames}: "
            f"the traffic has {recorded} frames every {period_s:g} s"
        )
        raise InputError("--frames", problem, "Use fewer frames, or a smaller --spacing.")
    return (np.arange(frames, dtype=np.int64) * available // frames) * stride
