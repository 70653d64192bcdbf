r"""How often vehicles hide what is behind them.

The plain scene scans an empty road. With traffic on it, a beam ends at the first vehicle that it meets. Two models of
the share of a beam b that gets as far as voxel v:

``frames`` (the default) replays recorded traffic against the beams of the empty scan,

.. math:: transmit(b, v) = \frac{1}{F} \, \#\{ f : T_f(b) \ge t_v(b) \},

with :math:`T_f` the range at which b enters the first vehicle box of frame f, :math:`t_v` the range at which it enters
v, and F frames replayed, evenly spaced over those recorded. The voxel in which a beam ends counts. Numerator and
denominator are whole numbers: a voxel that no vehicle ever hides has a share of exactly 1.

``independent`` takes the voxels before v along the beam as independent, each free with the probability that the TPOG
gives,

.. math:: transmit(b, v) = \prod_{u < v} (1 - p(u)).

It needs no replay, and is wrong wherever occupancies are correlated - which they always are: a car fills a dozen voxels
along a beam *together*, but counts here as a dozen chances to be stopped. So it hides too much, and the more the
smaller the voxels. It is here because it is what grid-based planners use; take it to see how far off it is.

Contact: a box stops a beam that passes deeper than 0.1 mm inside (the same shrunk box that occupies voxels), so no
coincidence of a side with a voxel's face or a beam decides anything. A box that holds the sensor is ignored
(:meth:`Replay.holding` counts them): no pole stands in a lane, a recorded box may still sweep over one.

Source: replayed vehicle shapes as dynamic blind zones, as in the roadside LiDAR simulation of
doi:10.1177/03611981251327575 (Transp. Res. Rec., 2025). Independent cells: the inverse beam model of Julian, Karaman
and Rus, "On mutual information-based control of range sensing robots for mapping applications", Int. J. Robot. Res. 33
(2014), where a beam ends in cell v with chance :math:`p(v) \prod_{u < v} (1 - p(u))`.

Calls for it: dense traffic, long vehicles, low sensors. Limits: boxes are opaque and whole (no windows, no gap under
the body); gamma caps the mean over frames, not each frame; the TPOG and the replay share their traffic, so an unlucky
recording is unlucky in both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BeforeValidator, Field

from pipeline.artefacts import tables
from pipeline.artefacts.readers import Tpog
from pipeline.artefacts.recorded_boxes import FrameBoxes, read_boxes
from pipeline.artefacts.traffic_frames import spread
from pipeline.core.errors import InputError
from pipeline.core.grid import Grid
from pipeline.effects.base import TransmitScore
from pipeline.kernels import occlusion as kernels
from pipeline.scenario.effects import EffectParameters, MovingOcclusionParameters
from pipeline.sensing.crossings import Crossings, Falls
from pipeline.sensing.scene import Scene

_AZIMUTHS = 1024  # cells of azimuth, 0.35 degrees each: next to a car at 100 m
_ROOM = 2**16  # stops that are listed at once: bounds the memory

Count = Annotated[int, Field(ge=0, strict=True), BeforeValidator(lambda given: 0 if given == "all" else given)]


@dataclass(frozen=True, eq=False)
class Replay:
    """Boxes of the replayed frames that can stand between a sensor and the region of interest.

    Attributes
    ----------
    frames
        How many frames are replayed, with or without boxes.
    first_frame, frame
        frame[first_frame[b]] to frame[first_frame[b + 1]] are the frames in which box b stands, int64: one box, when a
        vehicle stands still.
    values
        Centre of each box in the grid's frame, yaw, pitch and sizes, (n, 8) float64.
    low, high
        Corners of the upright box round each, (n, 3) float64.
    """

    frames: int
    first_frame: NDArray[np.int64]
    frame: NDArray[np.int64]
    values: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]

    @classmethod
    def of(cls, frames: int, frame: NDArray[np.int64], values: NDArray[np.float64]) -> Replay:
        """From boxes (n, 8) and the number of the frame of each (n,)."""
        distinct, box = np.unique(values, axis=0, return_inverse=True)
        numbers = np.unique(frame, return_inverse=True)[1]
        low, high = np.empty((len(distinct), 3)), np.empty((len(distinct), 3))
        kernels.bounds(distinct, low, high)
        first = np.append(0, np.cumsum(np.bincount(box, minlength=len(distinct))))
        return cls(frames, first, numbers[np.argsort(box, kind="stable")], distinct, low, high)

    def holding(self, sensor_m: NDArray[np.float64]) -> int:
        """How many boxes (one a frame each) hold a sensor, given in the grid's frame (3,); they are ignored for it."""
        near = np.flatnonzero(((self.low < sensor_m) & (sensor_m < self.high)).all(axis=1))
        times = np.diff(self.first_frame)
        return int(sum(times[b] for b in near if kernels.holds(self.values[b], sensor_m)))

    def seen_from(self, sensor_m: NDArray[np.float64], grid: Grid) -> FacingBoxes:
        """The boxes that can stand between a sensor, given in the grid's frame (3,), and a voxel."""
        most, size_m = len(self.values), np.asarray(grid.roi.size_m)
        facing, block, span = np.empty((most, 15)), np.empty((most, 9)), np.empty((most, 2))
        box = np.empty(most, dtype=np.int64)
        order = np.argsort(np.hypot(*(self.values[:, :2] - sensor_m[:2]).T))
        kept = kernels.face(sensor_m, order, self.values, self.low, self.high, size_m, facing, block, span, box)
        starts, members = kernels.gather(span[:kept], _AZIMUTHS)
        return FacingBoxes(self, (facing[:kept], block[:kept], box[:kept], starts, members))


@dataclass(frozen=True, eq=False)
class FacingBoxes:
    """Replayed boxes as one sensor sees them; the arrays are those of :func:`pipeline.kernels.occlusion.stops`."""

    replay: Replay
    boxes: tuple[NDArray[Any], ...]

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share of the frames in which the beam gets as far as each crossing, (k,) float64."""
        reached = np.ones(len(crossings.cells))
        for part in self.falls(crossings.ends_m):
            kernels.reach(crossings.first, crossings.enter_m, part.rows, part.first, part.range_m, part.share, reached)
        return reached

    def falls(self, ends_m: NDArray[np.float64]) -> Iterator[Falls]:
        """Where the shares of beams that end at ``ends_m`` (n, 3), seen from the sensor, fall."""
        run_m, most = np.hypot(ends_m[:, 0], ends_m[:, 1]), self.replay.frames
        length_m, azimuth = np.hypot(run_m, ends_m[:, 2]), np.arctan2(ends_m[:, 1], ends_m[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):  # beams that are vertical, or have no length
            beams = ends_m[:, 2] / run_m, run_m, length_m / run_m, ends_m / length_m[:, None], length_m
        rows, frames = np.argsort(azimuth), (self.replay.first_frame, self.replay.frame)
        azimuth, levels = azimuth[rows], (most - np.arange(most + 1)) / most
        done, met, room = 0, np.full(most, -1, dtype=np.int64), max(_ROOM, most)
        while done < len(rows):
            first, range_m, share = np.empty(len(rows) - done + 1, dtype=np.int64), np.empty(room), np.empty(room)
            count = kernels.stops(done, rows, azimuth, beams, self.boxes, frames, levels, met, first, range_m, share)
            total = first[count]
            yield Falls(rows[done : done + count], first[: count + 1], range_m[:total], share[:total])
            done += count


@dataclass(frozen=True, eq=False)
class Independent:
    """The TPOG: frames in which each voxel is occupied, flat, uint32, of ``frames`` frames."""

    frames: int
    counts: NDArray[np.uint32]

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Product of 1 - p over the voxels before each crossing, (k,) float64."""
        share = np.ones(len(crossings.cells))
        kernels.free_of_all(self.counts, float(self.frames), crossings.first, crossings.cells, share)
        return share


@dataclass(frozen=True)
class MovingOcclusion(TransmitScore[MovingOcclusionParameters]):
    """Vehicles hide what is behind them."""

    NAME: ClassVar[str] = "moving_occlusion"
    SOURCE: ClassVar[str] = "doi:10.1177/03611981251327575 (frames); Julian, Karaman, Rus 2014 (independent)"
    Model: ClassVar[type[EffectParameters]] = MovingOcclusionParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"frames": (50, 500, 0)}

    ready: Replay | FacingBoxes | Independent | None = field(default=None, compare=False, repr=False)

    def refusal(self, scene: Scene) -> InputError | None:
        """The frames of periods cannot be replayed by their weights."""
        if self.parameters.method != "frames" or not scene.scenario.traffic.periods:
            return None
        found = 'method = "frames" replays all periods alike, whatever their weights'
        return InputError("effects.moving_occlusion", found, 'method = "independent" takes the mix')

    def seen(self, scene: Scene) -> str:
        """Wherever there is traffic."""
        del scene
        return "vehicles hide what is behind them"

    @property
    def reads(self) -> tuple[str, ...]:
        """Trajectories, when they are replayed."""
        return ("trajectories.parquet",) if self.parameters.method == "frames" else ()

    def prepare(self, scene: Scene, tpog: Tpog, trajectories: Path | None) -> MovingOcclusion:
        """Read the boxes of the frames that are replayed, or take the TPOG's counts."""
        del scene
        if self.parameters.method == "independent":
            return replace(self, ready=Independent(tpog.frames, tpog.counts.ravel().astype(np.uint32)))
        if trajectories is None:
            raise InputError("effects.moving_occlusion", "no trajectories to replay", 'method = "independent"')
        return replace(self, ready=read_replay(trajectories, tpog.grid, self.parameters.frames))

    def seen_from(self, sensor_m: NDArray[np.float64], grid: Grid) -> MovingOcclusion:
        """With the boxes turned towards the sensor, where they are replayed."""
        return replace(self, ready=self.ready.seen_from(sensor_m, grid)) if isinstance(self.ready, Replay) else self

    def share(self, crossings: Crossings) -> NDArray[np.float64]:
        """Share of the beam that gets as far as each crossing."""
        if not isinstance(self.ready, FacingBoxes | Independent):
            raise RuntimeError("moving_occlusion: prepare() and seen_from() return the effect that can share()")
        return self.ready.share(crossings)

    def falls(self, ends_m: NDArray[np.float64]) -> Iterator[Falls] | None:
        """Where the share of each beam falls, where boxes are replayed."""
        return self.ready.falls(ends_m) if isinstance(self.ready, FacingBoxes) else None


def read_replay(path: Path, grid: Grid, wanted: int) -> Replay:
    """Boxes of the replayed frames in the grid's frame; InputError for a file that is corrupt or out of order."""
    chosen = spread(int(tables.read_metadata(path, "trajectories")["frames"]), wanted)
    parts = [FrameBoxes(np.empty(0, dtype=np.int64), np.empty((0, 8))), *read_boxes(path, grid, chosen)]
    frame, values = (np.concatenate([getattr(part, name) for part in parts]) for name in ("frame", "values"))
    return Replay.of(len(chosen), frame, values)
