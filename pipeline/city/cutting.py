"""Cuts one recording of a city's traffic to all its junctions in one pass.

Steps, for some whole frames at a time: rows become boxes, and are counted, as for any scenario, so that the same
promises are kept; each junction takes the rows whose boxes may lie in its region (:mod:`pipeline.city.regions`), as
they are, and writes them as floating car data that state their frames (:mod:`pipeline.traffic.finished.stated`). Times
count from the first frame. Memory does not grow with the number of frames.

World frame, metres, milliseconds.
"""

from __future__ import annotations

import resource
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from pipeline.artefacts import schemas, tables
from pipeline.city.regions import Region
from pipeline.core.progress import Progress
from pipeline.scenario.models import Scenario
from pipeline.traffic import boxes, trajectories
from pipeline.traffic.extensions import TrafficExtension
from pipeline.traffic.finished.stated import StatedFcd
from pipeline.traffic.frames import FrameGroup
from pipeline.traffic.recording import Recording
from pipeline.traffic.tally import TrafficTally

GROUP_FRAMES = 20
"""Frames that are held at a time, with every vehicle of the city."""

_FLUSH_ROWS = 8192
"""Rows of a junction that are written together."""

_SPARE_FILES = 64
_COLUMNS = ("id", "type", "x", "y", "z", "angle", "slope", "speed")


@dataclass
class _Cut:
    """A junction's rows on their way into its file."""

    region: Region
    file: tables.TableWriter
    rows: int = 0
    _waiting: list[pa.Table] = field(default_factory=list)

    def add(self, rows: pa.Table) -> None:
        self._waiting.append(rows)
        self.rows += rows.num_rows
        if sum(table.num_rows for table in self._waiting) >= _FLUSH_ROWS:
            self.flush()

    def flush(self) -> None:
        if self._waiting and (rows := pa.concat_tables(self._waiting).combine_chunks()).num_rows:
            columns = {f"vehicle_{name}": rows[name].chunk(0) for name in _COLUMNS}
            self.file.write({"timestep_time": rows["time_ms"].to_numpy() / 1000.0, **columns})
        self._waiting.clear()


def write(
    scenario: Scenario,
    recording: Recording,
    regions: Mapping[str, Region],
    paths: Mapping[str, Path],
    extensions: Sequence[TrafficExtension],
    progress: Progress,
) -> tuple[TrafficTally, dict[str, int]]:
    """Write the file of every junction; what the whole traffic adds up to, and the rows of each junction.

    No file appears before the recording is through and keeps its promises: InputError and RunError as
    :func:`pipeline.traffic.trajectories.write`.
    """
    tally = TrafficTally(recording.window.count, on_purpose=recording.stopped_on_purpose)
    period_ms, place = recording.window.period_ms, recording.source or recording.place
    uncounted = frozenset[str]().union(*(extension.uncounted_types(recording.sizes) for extension in extensions))
    followed = {name: region.followed_types(recording.sizes) for name, region in regions.items()}
    _allow_files(len(regions))
    with ExitStack() as stack:
        cuts = {
            name: _Cut(region, stack.enter_context(tables.writer(paths[name], "fcd")))
            for name, region in regions.items()
        }
        for group in trajectories.groups_of(recording, GROUP_FRAMES):
            tally.add(boxes.from_bumpers(group, recording.sizes, period_ms / 1000.0, place, uncounted))
            for name, rows in _shares(group, period_ms, cuts, recording.sizes, followed):
                cuts[name].add(rows)
            progress("frames written", group.first_frame + group.frames, tally.frames)
        trajectories.check(scenario, tally, recording)
        stated = StatedFcd.about(period_ms, tally.frames, dict(recording.sizes))
        for cut in cuts.values():
            cut.flush()
            cut.file.describe({"schema": schemas.VERSION, **stated.model_dump(mode="json")})
    return tally, {name: cut.rows for name, cut in cuts.items()}


def _allow_files(count: int) -> None:
    """All junctions' files are open at a time: more than a process has by default, in a large city."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = count + _SPARE_FILES
    if soft != resource.RLIM_INFINITY and soft < wanted and (hard == resource.RLIM_INFINITY or hard >= wanted):
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _shares(
    group: FrameGroup,
    period_ms: int,
    cuts: Mapping[str, _Cut],
    sizes: Mapping[str, boxes.Size],
    followed: Mapping[str, frozenset[str]],
) -> Iterator[tuple[str, pa.Table]]:
    """The rows of a group that each junction takes, in order of time; those that take none are left out."""
    rows = _on_the_clock(group, period_ms)
    x, y = rows["x"].to_numpy(), rows["y"].to_numpy()
    types = rows["type"].combine_chunks().dictionary_encode()
    names, code = types.dictionary.to_pylist(), types.indices.to_numpy()
    reach_m = np.array([np.hypot(sizes[name].length_m, sizes[name].width_m) for name in names])[code]
    eastward = np.argsort(x, kind="stable")
    far_m = float(reach_m.max(initial=0.0))
    for name, cut in cuts.items():
        region = cut.region
        bounds = np.searchsorted(x[eastward], [region.low_x_m - far_m, region.high_x_m + far_m])
        near = eastward[bounds[0] : bounds[1]]
        near = near[_may_reach(region, x[near], y[near], reach_m[near])]
        if followed[name]:
            whole = np.flatnonzero(np.array([its in followed[name] for its in names])[code])
            near = np.union1d(near, whole)
        if near.size:
            yield name, rows.take(pa.array(np.sort(near)))


def _on_the_clock(group: FrameGroup, period_ms: int) -> pa.Table:
    """The group's rows in order of their frames, with times from the first frame on."""
    order = np.argsort(group.frame, kind="stable")  # persons come after the vehicles of the whole group
    rows = group.rows.take(pa.array(order)) if np.any(np.diff(group.frame) < 0) else group.rows
    index = rows.schema.get_field_index("time_ms")
    return rows.set_column(index, "time_ms", pc.cast(pa.array(group.frame[order] * period_ms), pa.int64()))


def _may_reach(
    region: Region, x_m: NDArray[np.float64], y_m: NDArray[np.float64], reach_m: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Whether boxes with these front bumpers may lie in the region in part."""
    inside = (x_m >= region.low_x_m - reach_m) & (x_m <= region.high_x_m + reach_m)
    found: NDArray[np.bool_] = inside & (y_m >= region.low_y_m - reach_m) & (y_m <= region.high_y_m + reach_m)
    return found
