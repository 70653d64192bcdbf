r"""Moving occlusion: vehicles hide what is behind them.

The plain scene scans an empty road. With traffic, a beam ends at the first vehicle that it meets. There are two models
of the share of a beam b that reaches voxel v:

``frames`` (the default) replays recorded traffic against the beams of the empty scan,

.. math:: transmit(b, v) = \frac{1}{F} \, \#\{ f : T_f(b) \ge t_v(b) \},

with :math:`T_f` the range at which b enters the first vehicle box of frame f, :math:`t_v` the range at which it enters
v, and F replayed frames, evenly spaced over those recorded. The voxel in which a beam ends counts. Numerator and
denominator are integers: a voxel that no vehicle ever hides has a share of exactly 1.

``independent`` treats the voxels before v along the beam as independent, each free with the probability of the TPOG,

.. math:: transmit(b, v) = \prod_{u < v} (1 - p(u)).

It needs no replay, and is wrong wherever occupancies are correlated, which they always are: a car fills a dozen voxels
along a beam *together*, but counts here as a dozen independent obstacles. It therefore hides too much, the more the
smaller the voxels. It is included because grid-based planners use it; use it to see how far off it is.

Contact: a box stops a beam that passes more than 0.1 mm inside it (the same shrunk box that occupies voxels), so that a
side that coincides with a voxel's face or a beam does not matter. A box that contains the sensor is ignored
(:meth:`Replay.count_boxes_around` counts them): no pole stands in a lane, but a recorded box may still sweep over one.

Source: replayed vehicle shapes as dynamic blind zones, as in the roadside LiDAR simulation of
doi:10.1177/03611981251327575 (Transp. Res. Rec., 2025). Independent cells: the inverse beam model of Julian, Karaman
and Rus, "On mutual information-based control of range sensing robots for mapping applications", Int. J. Robot. Res. 33
(2014), where a beam ends in cell v with probability :math:`p(v) \prod_{u < v} (1 - p(u))`.

Use it for dense traffic, long vehicles and low sensors. Limits: boxes are opaque and solid (no windows, no gap under
the body); gamma caps the mean over frames, not each frame; the TPOG and the replay share their traffic, so an
unrepresentative recording affects both.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts import parquet
from egvs.artefacts.frame_boxes import FrameBoxes, read_boxes
from egvs.artefacts.tpog import Tpog
from egvs.artefacts.traffic_frames import spaced_frames
from egvs.core.errors import InputError
from egvs.core.grid import FloatArray, Grid, IntArray
from egvs.effects.base import TransmitScore
from egvs.kernels import occlusion
from egvs.scenario.effects_config import EffectParameters, MovingOcclusionParameters
from egvs.sensors.scene import Scene
from egvs.sensors.voxel_crossings import Crossings, TransmittanceSteps

_AZIMUTHS = 1024  # bins of 0.35 degrees; at 100 m a car is about as wide
_BUFFER_SIZE = 2**16  # stops that are listed at once, which bounds the memory


@dataclass(frozen=True)
class MovingOcclusion(TransmitScore[MovingOcclusionParameters]):
    """Occlusion by vehicles."""

    NAME: ClassVar[str] = "moving_occlusion"
    SOURCE: ClassVar[str] = "doi:10.1177/03611981251327575 (frames); Julian, Karaman, Rus 2014 (independent)"
    Model: ClassVar[type[EffectParameters]] = MovingOcclusionParameters
    QUALITY: ClassVar[dict[str, tuple[Any, ...]]] = {"frames": (50, 500, 0)}

    ready: Replay | FacingBoxes | IndependentVoxels | None = field(default=None, compare=False, repr=False)

    def refusal(self, scene: Scene) -> InputError | None:
        """Frames of several periods cannot be replayed by the periods' weights."""
        if self.parameters.method != "frames" or not scene.scenario.traffic.periods:
            return None
        problem = 'method = "frames" ignores the weights of the periods'
        return InputError("effects.moving_occlusion", problem, 'Use method = "independent", which weights the periods.')

    def summary(self, scene: Scene) -> str:
        """Occlusion matters wherever there is traffic."""
        return "vehicles hide what is behind them"

    @property
    def reads(self) -> tuple[str, ...]:
        """Trajectories, if they are replayed."""
        return ("trajectories.parquet",) if self.parameters.method == "frames" else ()

    def prepare(self, scene: Scene, tpog: Tpog, trajectories: Path | None) -> MovingOcclusion:
        """Read the boxes of the replayed frames, or take the counts of the TPOG."""
        if self.parameters.method == "independent":
            return replace(self, ready=IndependentVoxels(tpog.frames, tpog.counts.ravel().astype(np.uint32)))
        if trajectories is None:
            hint = 'Use method = "independent".'
            raise InputError("effects.moving_occlusion", "there are no trajectories to replay", hint)
        return replace(self, ready=read_replay(trajectories, tpog.grid, self.parameters.frames))

    def for_sensor(self, sensor_m: FloatArray, grid: Grid) -> MovingOcclusion:
        """Return the effect with the replayed boxes as one sensor sees them."""
        if isinstance(self.ready, Replay):
            return replace(self, ready=self.ready.facing(sensor_m, grid))
        return self

    def share(self, crossings: Crossings) -> FloatArray:
        """Return the share of the beam that reaches each crossing, (k,) float64."""
        if not isinstance(self.ready, FacingBoxes | IndependentVoxels):
            raise RuntimeError("moving_occlusion: share() needs the effect that prepare() and for_sensor() return")
        return self.ready.share(crossings)

    def transmittance_steps(self, ends_m: FloatArray) -> Iterator[TransmittanceSteps] | None:
        """Yield where the share of each beam drops, if boxes are replayed."""
        if isinstance(self.ready, FacingBoxes):
            return self.ready.transmittance_steps(ends_m)
        return None


@dataclass(frozen=True, eq=False)
class Replay:
    """Boxes of the replayed frames that can be between a sensor and the region of interest.

    Attributes
    ----------
    frames
        Number of replayed frames, with or without boxes.
    first_frame, frame
        Box b occurs in the frames frame[first_frame[b]] to frame[first_frame[b + 1]], int64; a vehicle at rest is one
        box in several frames.
    values
        Centre of each box in the grid frame, yaw, pitch and sizes, (n, 8) float64.
    low, high
        Corners of the axis-aligned box around each, (n, 3) float64.
    """

    frames: int
    first_frame: IntArray
    frame: IntArray
    values: FloatArray
    low: FloatArray
    high: FloatArray

    @classmethod
    def from_boxes(cls, frames: int, frame: IntArray, values: FloatArray) -> Replay:
        """Group boxes (n, 8), given with the number of the frame of each (n,), by their values."""
        distinct, box = np.unique(values, axis=0, return_inverse=True)
        numbers = np.unique(frame, return_inverse=True)[1]
        low = np.empty((len(distinct), 3))
        high = np.empty((len(distinct), 3))
        occlusion.box_bounds(distinct, low, high)
        first = np.append(0, np.cumsum(np.bincount(box, minlength=len(distinct))))
        return cls(frames, first, numbers[np.argsort(box, kind="stable")], distinct, low, high)

    def count_boxes_around(self, sensor_m: FloatArray) -> int:
        """Count the boxes (once per frame) that contain a sensor (3,) in the grid frame; they are ignored for it."""
        near = np.flatnonzero(((self.low < sensor_m) & (sensor_m < self.high)).all(axis=1))
        n_frames = np.diff(self.first_frame)
        return int(sum(n_frames[b] for b in near if occlusion.contains_sensor(self.values[b], sensor_m)))

    def facing(self, sensor_m: FloatArray, grid: Grid) -> FacingBoxes:
        """Return the boxes that can be between a sensor (3,) in the grid frame and a voxel."""
        n_boxes = len(self.values)
        size_m = np.asarray(grid.roi.size_m)
        facing = np.empty((n_boxes, 15))
        block = np.empty((n_boxes, 9))
        span = np.empty((n_boxes, 2))
        box = np.empty(n_boxes, dtype=np.int64)
        order = np.argsort(np.hypot(*(self.values[:, :2] - sensor_m[:2]).T))
        count = occlusion.orient_boxes(
            sensor_m, order, self.values, self.low, self.high, size_m, facing, block, span, box
        )
        starts, members = occlusion.bin_by_azimuth(span[:count], _AZIMUTHS)
        return FacingBoxes(self, (facing[:count], block[:count], box[:count], starts, members))


@dataclass(frozen=True, eq=False)
class FacingBoxes:
    """Replayed boxes as one sensor sees them; the arrays are those of :func:`egvs.kernels.occlusion.beam_stops`."""

    replay: Replay
    boxes: tuple[NDArray[Any], ...]

    def share(self, crossings: Crossings) -> FloatArray:
        """Return the share of the frames in which the beam reaches each crossing, (k,) float64."""
        reached = np.ones(len(crossings.cells))
        for part in self.transmittance_steps(crossings.ends_m):
            occlusion.share_at_crossings(
                crossings.first, crossings.enter_m, part.rows, part.first, part.range_m, part.share, reached
            )
        return reached

    def transmittance_steps(self, ends_m: FloatArray) -> Iterator[TransmittanceSteps]:
        """Yield where the shares of beams drop; ``ends_m`` (n, 3) are their ends relative to the sensor."""
        n_frames = self.replay.frames
        run_m = np.hypot(ends_m[:, 0], ends_m[:, 1])
        length_m = np.hypot(run_m, ends_m[:, 2])
        azimuth = np.arctan2(ends_m[:, 1], ends_m[:, 0])
        with np.errstate(divide="ignore", invalid="ignore"):  # beams that are vertical, or have no length
            beams = (ends_m[:, 2] / run_m, run_m, length_m / run_m, ends_m / length_m[:, None], length_m)
        rows = np.argsort(azimuth)
        azimuth = azimuth[rows]
        frames = (self.replay.first_frame, self.replay.frame)
        shares = (n_frames - np.arange(n_frames + 1)) / n_frames
        met = np.full(n_frames, -1, dtype=np.int64)
        capacity = max(_BUFFER_SIZE, n_frames)
        done = 0
        while done < len(rows):
            first = np.empty(len(rows) - done + 1, dtype=np.int64)
            range_m = np.empty(capacity)
            share = np.empty(capacity)
            count = occlusion.beam_stops(
                done, rows, azimuth, beams, self.boxes, frames, shares, met, first, range_m, share
            )
            total = first[count]
            yield TransmittanceSteps(rows[done : done + count], first[: count + 1], range_m[:total], share[:total])
            done += count


@dataclass(frozen=True, eq=False)
class IndependentVoxels:
    """The TPOG: number of frames in which each voxel is occupied, flat, uint32, of ``frames`` frames."""

    frames: int
    counts: NDArray[np.uint32]

    def share(self, crossings: Crossings) -> FloatArray:
        """Return the product of 1 - p over the voxels before each crossing, (k,) float64."""
        share = np.ones(len(crossings.cells))
        occlusion.multiply_free_chances(self.counts, float(self.frames), crossings.first, crossings.cells, share)
        return share


def read_replay(path: Path, grid: Grid, frames: int) -> Replay:
    """Read the boxes of the replayed frames in the grid frame; InputError for a file that is corrupt or unsorted."""
    recorded_frames = int(parquet.read_metadata(path, "trajectories")["frames"])
    selected = spaced_frames(recorded_frames, frames)
    parts = [FrameBoxes(np.empty(0, dtype=np.int64), np.empty((0, 8))), *read_boxes(path, grid, selected)]
    frame = np.concatenate([part.frame for part in parts])
    values = np.concatenate([part.values for part in parts])
    return Replay.from_boxes(len(selected), frame, values)
