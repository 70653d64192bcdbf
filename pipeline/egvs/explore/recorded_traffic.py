"""A minute of recorded traffic with the returns of some sensors, as a recording of the scene's messages.

Each kind of body is one batched mesh of the unit box; an instance is scaled and turned to its box, so that a frame
takes about 40 bytes per road user. Lengths are in metres.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray
from viser.infra import StateSerializer

from egvs.artefacts.traffic_frames import TrafficFrame
from egvs.clouds.simulation import MeshPart
from egvs.core.grid import BoolArray, FloatArray, Roi, Vec3
from egvs.core.progress import ProgressCallback
from egvs.explore import drawing
from egvs.explore.road_meshes import Mesh
from egvs.explore.session import Playback
from egvs.sensors.sites import Pose, Site

CLIP_S = 60.0
"""Longest recording."""

FRAME_S = 0.25
"""Shortest time between two pictures when recorded traffic plays."""

MAX_RETURNS = 600_000
"""Most returns in a recording, 6 bytes each; of more, every k-th is drawn."""

_HALF_PRECISION_M = 128.0
"""Positions up to here are drawn in half precision: within 3 cm."""

_CENTIMETRES = 2
_UNKNOWN_COLOUR = (150, 154, 166)


def frames_per_step(period_s: float) -> int:
    """Return by how many frames a new picture moves on: traffic with short frames plays in real time.

    >>> frames_per_step(0.1), frames_per_step(1.0)
    (2, 1)
    """
    return max(1, round(FRAME_S / period_s))


@dataclass(frozen=True, eq=False)
class TrafficClip:
    """Recorded frames with the returns of sensors.

    Attributes
    ----------
    frames
        The frames.
    kinds
        Body of each box of each frame.
    is_visible
        Whether one of the sensors has enough returns on each box, (boxes,) for each frame.
    returns_m
        Returns of all sensors on boxes, (n, 3) float64 for each frame, world frame.
    step_s
        Time between two frames.
    has_returns
        False if no returns of these sensors can be simulated, because their empty scans were measured.
    """

    frames: list[TrafficFrame]
    kinds: list[list[str]]
    is_visible: list[BoolArray]
    returns_m: list[FloatArray]
    step_s: float
    has_returns: bool

    @classmethod
    def of(cls, playback: Playback, sites: Sequence[Site], progress: ProgressCallback) -> TrafficClip:
        """Simulate the first minute of the recorded traffic.

        Parameters
        ----------
        playback
            The recorded traffic.
        sites
            The sensors, each in its pose.
        progress
            Called after each simulated sweep.
        """
        step = frames_per_step(playback.period_s)
        count = max(1, round(CLIP_S / (step * playback.period_s)))
        numbers = list(range(0, playback.frames, step))[:count]
        frames = [playback.frame(number) for number in numbers]
        is_visible = [np.zeros(len(frame.boxes), dtype=np.bool_) for frame in frames]
        returns_m: list[list[FloatArray]] = [[] for _ in frames]
        has_returns = False
        for done, site in enumerate(sites):
            for index, frame in enumerate(frames):
                played = playback.simulate(site, frame)
                has_returns |= len(played.returns_m) > 0
                is_visible[index] |= played.is_visible
                returns_m[index].append(played.returns_m[played.owner >= 0])
                progress("sweeps", done * len(frames) + index + 1, len(sites) * len(frames))
        return cls(
            frames, [playback.kinds(frame) for frame in frames], is_visible,
            [np.concatenate([np.empty((0, 3)), *parts]) for parts in returns_m], step * playback.period_s, has_returns,
        )  # fmt: skip

    @property
    def duration_s(self) -> float:
        """Length of the recording."""
        return len(self.frames) * self.step_s

    @property
    def returns_step(self) -> int:
        """Every which return is drawn: 1 for all."""
        return max(1, -(-sum(map(len, self.returns_m)) // MAX_RETURNS))

    def share_visible(self, roi: Roi) -> float | None:
        """Return the share of vehicles in the region, in all frames, that are visible; None without vehicles."""
        rows = [frame.target_rows(roi) for frame in self.frames]
        count = sum(map(len, rows))
        visible = sum(int(visible[row].sum()) for visible, row in zip(self.is_visible, rows, strict=True))
        return visible / count if count else None


def body_mesh(parts: Sequence[MeshPart]) -> Mesh:
    """Return a body in the unit box around 0 as a mesh without duplicate corners."""
    corners = np.concatenate([part.triangles for part in parts]).reshape(-1, 3).astype(np.float32)
    points, faces = np.unique(corners, axis=0, return_inverse=True)
    return Mesh(points, faces.reshape(-1, 3).astype(np.int32))


class TrafficRecorder:
    """Draws a clip in a scene, frame by frame.

    Parameters
    ----------
    scene
        The scene.
    playback
        Has the bodies.
    clip
        The clip.
    zero_m
        Origin of the drawing.
    """

    def __init__(self, scene: viser.SceneApi, playback: Playback, clip: TrafficClip, zero_m: Vec3) -> None:
        self._clip, self._zero_m = clip, np.asarray(zero_m)
        self._bodies: dict[str, tuple[viser.BatchedMeshHandle, int]] = {}
        for kind in sorted({kind for kinds in clip.kinds for kind in kinds}):
            most = max(kinds.count(kind) for kinds in clip.kinds)
            mesh = body_mesh(playback.parts[kind])
            handle = scene.add_batched_meshes_simple(
                f"/traffic/{kind}", mesh.points, mesh.faces, np.tile([1.0, 0.0, 0.0, 0.0], (most, 1)),
                np.zeros((most, 3)), batched_scales=np.zeros((most, 3)),
                batched_colors=np.zeros((most, 3), dtype=np.uint8), lod="off", flat_shading=True, side="double",
                cast_shadow=False, receive_shadow=False,
            )  # fmt: skip
            self._bodies[kind] = handle, most
        returns_m = np.concatenate([points - self._zero_m for points in clip.returns_m])
        is_near = float(np.abs(returns_m).max(initial=0.0)) <= _HALF_PRECISION_M
        self._returns: viser.PointCloudHandle | None = None
        if len(returns_m):
            self._returns = scene.add_point_cloud(
                "/traffic/returns", np.zeros((0, 3), dtype=np.float32), drawing.SCAN_COLOUR,
                point_size=drawing.RETURN_M, precision="float16" if is_near else "float32", point_shading="flat",
            )  # fmt: skip

    def record(self, recording: StateSerializer) -> None:
        """Draw all frames, with the time between them in the recording."""
        for index in range(len(self._clip.frames)):
            self._draw(index)
            recording.insert_sleep(self._clip.step_s)
        self._clear()  # the recording shares memory with the handles: its first state is empty again

    def _draw(self, index: int) -> None:
        frame, kinds = self._clip.frames[index], np.array(self._clip.kinds[index], dtype=np.str_)
        colours = np.where(self._clip.is_visible[index][:, None], drawing.VISIBLE_COLOUR, drawing.HIDDEN_COLOUR)
        if not self._clip.has_returns:
            colours = np.tile(_UNKNOWN_COLOUR, (len(colours), 1))
        for kind, (handle, most) in self._bodies.items():
            rows = np.flatnonzero(kinds == kind)
            boxes = frame.boxes[rows]
            headings = np.degrees(np.column_stack([boxes[:, 6], frame.pitch_rad[rows]]))
            turns = [drawing.pose_quaternion(Pose(0.0, 0.0, 0.0, yaw, pitch, 0.0)) for yaw, pitch in headings.tolist()]
            positions_m, scales = np.round(boxes[:, :3] - self._zero_m, _CENTIMETRES), boxes[:, 3:6]
            handle.batched_positions = _fill(positions_m, most, 0.0)
            handle.batched_wxyzs = _fill(np.reshape(turns, (-1, 4)), most, [1.0, 0.0, 0.0, 0.0])
            handle.batched_scales = _fill(scales, most, 0.0)
            handle.batched_colors = _fill(drawing.linear_colours(colours[rows]), most, 0.0).astype(np.uint8)
        if self._returns is not None:
            returns_m = self._clip.returns_m[index][:: self._clip.returns_step] - self._zero_m
            self._returns.points = returns_m.astype(np.float32)

    def _clear(self) -> None:
        for handle, most in self._bodies.values():
            handle.batched_scales = np.zeros((most, 3), dtype=np.float32)
        if self._returns is not None:
            self._returns.points = np.zeros((0, 3), dtype=np.float32)


def _fill(values: NDArray[np.float64 | np.uint8], rows: int, rest: float | Sequence[float]) -> NDArray[np.float32]:
    """Return values (n, columns) as float32, followed by the same row until there are ``rows``."""
    filled = np.empty((rows, values.shape[1]), dtype=np.float32)
    filled[:] = rest
    filled[: len(values)] = values
    return filled
