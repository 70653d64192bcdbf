r"""Installation sheets: one page per pole with position, orientation, view, map and tolerances, as PDF or SVG.

Bearings are clockwise from north. The front of a sensor is its x axis, whose yaw is counter-clockwise from the x axis
of the world frame (grid east):

.. math:: bearing_{grid} = 90^\circ - yaw, \quad bearing_{true} = bearing_{grid} + \gamma

with the meridian convergence :math:`\gamma`, the angle from true north to grid north, positive where grid north points
east of true north. It is computed from the direction in which the latitude grows.
"""

from __future__ import annotations

import math
import os
import re
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from html import escape
from pathlib import Path
from typing import Any

import numpy as np

from egvs._version import __version__
from egvs.artefacts.command_results import read_results
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.tpog import Tpog
from egvs.core import files, plugins
from egvs.core.errors import InputError
from egvs.core.progress import ProgressCallback, no_progress
from egvs.drawing import colours, maps
from egvs.drawing.basemap import network_file, roads_within, world_outlines
from egvs.drawing.maps import Backdrop
from egvs.drawing.svg_figures import Box, FigureStyle, MapFrame, svg_start_tag
from egvs.export.export import safe_file_name
from egvs.export.figure import convert_svg
from egvs.export.finished_run import SCENARIO_CRS, ExportCrs
from egvs.extensions.hardware.files import PLANNED_KEY, SHEETS
from egvs.extensions.hardware.installation import tolerances, view
from egvs.extensions.hardware.installation.planned_sites import PlannedSites, path_in_run
from egvs.extensions.hardware.installation.tolerances import PoseTolerances, Tolerance
from egvs.extensions.hardware.report_section import current_sheets
from egvs.formats import georeference
from egvs.formats.georeference import WorldFrame
from egvs.results.labels import SCORE_LABELS, format_degrees
from egvs.runs.command_results import add_to_report
from egvs.sensors.sensor import Sensor
from egvs.sensors.sites import Pose, Site, grid_bearing_deg

FILE_TYPES = ("pdf", "svg")
SHEETS_FOLDER = "sheets"

_SHEET_NAME = re.compile(r"installation_.+\.[a-z]+")
"""File name of a sheet."""

_DIGEST_KEY = "sha256"
_BESIDE_KEY = "beside"
"""Key of the other files of the same sheet, such as those of another format."""
_LATITUDE_STEP_DEG = 1e-3
_PAGE_MM = (210.0, 297.0)
_STYLE = FigureStyle.for_print(_PAGE_MM[0])
_MARGIN = 70.0
_VIEW_M = 30.0
"""The map shows the field of view at most to this distance."""
_MAP_M = 45.0
"""The map shows the region of interest, and at least this far around the sensor."""


def _ignore_note(note: str) -> None:
    """Ignore a note."""


@dataclass(frozen=True)
class SheetData:
    """What a sheet says about a sensor.

    Attributes
    ----------
    site, sensor
        The sensor at its planned pose.
    scenario
        Name of the scenario.
    rank
        "sensor 1 of the plan", or the rank of the site.
    ground_m
        Height of the ground below it, world frame.
    crs
        Reference system of the coordinates: EPSG code and name, or a description of local metres.
    easting_m, northing_m
        Coordinates in that system.
    lon_lat_deg
        Longitude and latitude (WGS 84); None if the position on the Earth is unknown.
    convergence_deg
        Grid convergence (of meridians); NaN if the position on the Earth is unknown.
    zero_height_m
        Height of z = 0 of the world frame.
    tolerances
        How far the pose may be off.
    """

    site: Site
    sensor: Sensor
    scenario: str
    rank: str
    ground_m: float
    crs: str
    easting_m: float
    northing_m: float
    lon_lat_deg: tuple[float, float] | None
    convergence_deg: float
    zero_height_m: float
    tolerances: PoseTolerances

    @property
    def pose(self) -> Pose:
        """The planned pose."""
        return self.site.pose

    @property
    def mounting_height_m(self) -> float:
        """Height of the sensor above the ground."""
        return self.pose.z_m - self.ground_m

    @property
    def grid_bearing_deg(self) -> float:
        """Bearing of the front, clockwise from grid north."""
        return grid_bearing_deg(self.pose.yaw_deg)

    @property
    def true_bearing_deg(self) -> float:
        """Bearing of the front, clockwise from true north; NaN if the position on the Earth is unknown."""
        return (self.grid_bearing_deg + self.convergence_deg) % 360.0

    @cached_property
    def position_rows(self) -> list[tuple[str, str]]:
        """The position, label and value."""
        rows = [("Reference system", self.crs)]
        if self.lon_lat_deg is None:
            rows += [("x, y", f"{self.easting_m:.3f} m, {self.northing_m:.3f} m")]
        else:
            longitude, latitude = self.lon_lat_deg
            rows += [
                ("Easting", f"{self.easting_m:,.3f} m"),
                ("Northing", f"{self.northing_m:,.3f} m"),
                ("Latitude, longitude", f"{format_degrees(latitude)}, {format_degrees(longitude)} (WGS 84)"),
            ]
        height = f"z = {self.pose.z_m:.2f} m"
        if self.zero_height_m:
            height = f"{self.pose.z_m + self.zero_height_m:.2f} m ({height})"
        return [*rows, ("Height", height), ("Above the ground", f"{self.mounting_height_m:.2f} m")]

    @cached_property
    def orientation_rows(self) -> list[tuple[str, str]]:
        """The orientation, label and value."""
        pose = self.pose
        rows = [("Bearing of the front", f"{format_angle(self.grid_bearing_deg)} from grid north")]
        if self.lon_lat_deg is not None:
            rows += [
                ("", f"{format_angle(self.true_bearing_deg)} from true north"),
                ("Grid convergence", f"{self.convergence_deg:+z.3f}° (grid north from true north)"),
            ]
        tilt = f"{format_angle(abs(pose.pitch_deg))} {'up' if pose.pitch_deg > 0 else 'down'}"
        if pose.pitch_deg == 0:
            tilt = "0.0° (level)"
        mount = "upside down, the base on top" if pose.is_inverted else "upright"
        side = describe_side_tilt(pose) or "0.0°"
        rows += [("Mount", mount), ("Tilt of the front", tilt), ("Roll", side)]
        return [*rows, ("Field of view", self._field_of_view)]

    @property
    def _field_of_view(self) -> str:
        low, high = self.sensor.elevation_span_deg
        if self.pose.is_inverted:
            low, high = -high, -low
        width = "360°"
        if self.sensor.azimuth_span_deg is not None:
            first, last = self.sensor.azimuth_span_deg
            width = f"{last - first:.0f}°"
        return f"{width}, {low:+.0f}° to {high:+.0f}°, {self.sensor.range_m:g} m"


def format_angle(value_deg: float) -> str:
    """Return an angle with one decimal, e.g. "272.5°"; 360 is written as 0.

    Examples
    --------
    >>> format_angle(272.46), format_angle(359.97)
    ('272.5°', '0.0°')
    """
    return f"{round(value_deg, 1) % 360.0:.1f}°"


def describe_side_tilt(pose: Pose) -> str:
    """Return the roll of a sensor from upright or upside down, and which of its sides is up as seen from behind it.

    >>> describe_side_tilt(Pose(0, 0, 5, roll_deg=2.0)), describe_side_tilt(Pose(0, 0, 5, roll_deg=178.0))
    ('2.0°, left side up', '2.0°, right side up')
    """
    tilt_deg = pose.side_tilt_deg
    return f"{format_angle(abs(tilt_deg))}, {'left' if tilt_deg > 0 else 'right'} side up" if tilt_deg else ""


def meridian_convergence_deg(frame: WorldFrame, xy_m: tuple[float, float]) -> float:
    """Return the angle from true north to grid north, positive to the east, degrees.

    Parameters
    ----------
    frame
        Position of the world frame.
    xy_m
        World frame.
    """
    longitude, latitude = frame.to_degrees(np.array([xy_m]))[0]
    steps = [[longitude, latitude - _LATITUDE_STEP_DEG], [longitude, latitude + _LATITUDE_STEP_DEG]]
    south, north = frame.from_lon_lat(np.array(steps))
    east_m, north_m = north - south
    return -math.degrees(math.atan2(east_m, north_m))


def sheet_data(planned: PlannedSites, name: str) -> SheetData:
    """Return what the sheet of a site says.

    Parameters
    ----------
    planned
        The run.
    name
        Name of the site.
    """
    site = planned.site(name)
    run = planned.run
    xy_m = site.pose.x_m, site.pose.y_m
    reference = ExportCrs.from_choice(run.frame, SCENARIO_CRS, xy_m, str(run.work.folder.path))
    easting_m, northing_m = reference.from_world(np.array([xy_m]))[0].tolist()
    lon_lat_deg, convergence_deg = None, math.nan
    crs = reference.description
    if run.frame is not None:
        longitude, latitude = run.frame.to_degrees(np.array([xy_m]))[0].tolist()
        lon_lat_deg = longitude, latitude
        convergence_deg = meridian_convergence_deg(run.frame, xy_m)
        code = georeference.crs_name(run.frame, xy_m)
        crs = f"{code} ({crs})" if code.startswith("EPSG:") else f"{crs} (no EPSG code)"
    if name in planned.plan:
        rank = f"sensor {[*planned.plan].index(name) + 1} of the plan"
    else:
        candidates = planned.session.candidates
        rank = f"rank {candidates[name].rank} of {len(candidates)} sites"
    return SheetData(
        site=site,
        sensor=planned.sensor(site),
        scenario=run.scenario.name,
        rank=rank,
        ground_m=planned.ground_m(site),
        crs=crs,
        easting_m=easting_m,
        northing_m=northing_m,
        lon_lat_deg=lon_lat_deg,
        convergence_deg=convergence_deg,
        zero_height_m=run.scenario.crs.zero_height_m,
        tolerances=tolerances.pose_tolerances(planned.session, site),
    )


def write_sheets(
    run: str | Path,
    sites: Sequence[str] = (),
    *,
    kind: str = "pdf",
    out: Path | None = None,
    progress: ProgressCallback = no_progress,
    on_note: Callable[[str], None] = _ignore_note,
) -> list[tuple[SheetData, Path]]:
    """Write an installation sheet for each site, and add what they say to the report of the run.

    Sheets of an earlier plan are removed.

    Parameters
    ----------
    run
        Folder of a finished run.
    sites
        Names of sites, or of poles for their site in the plan or else their best one; by default those of the plan in
        the folder, or the best site without a plan.
    kind
        One of :data:`FILE_TYPES`.
    out
        Folder to write; ``sheets`` in the run folder by default.
    progress
        Called after each sheet.
    on_note
        Called with a sentence on the sheets of an earlier plan.

    Returns
    -------
    list of (SheetData, Path)
        What each sheet says, and its file.

    Raises
    ------
    InputError
        If the run is not finished, the plan is for another run, or there is no such site. Nothing is written then.
    """
    if kind not in FILE_TYPES:
        raise InputError("--format", f"expected one of {', '.join(FILE_TYPES)}, got {kind!r}")
    if kind != "svg":
        plugins.require_libraries(f"a {kind} sheet", "figure", "cairosvg")
    planned = PlannedSites.open(Path(run))
    run_folder = planned.run.work.folder
    read_results(run_folder / SHEETS.name)
    names = tuple(dict.fromkeys(map(planned.resolve, sites))) or planned.default_sites
    folder = out or run_folder.path / SHEETS_FOLDER
    paths = [folder / f"installation_{safe_file_name(name)}.{kind}" for name in names]
    for path in paths:
        files.check_writable(path)
    written = []
    for number, (name, path) in enumerate(zip(names, paths, strict=True), 1):
        data = sheet_data(planned, name)
        svg = draw_sheet(planned, data)
        with files.atomic_write(path) as partial:
            partial.write_bytes(convert_svg(f"{svg}\n", kind))
        written.append((data, path))
        progress("sheets", number, len(names))
    entries = {}
    for data, path in written:
        entries[data.site.name] = {
            **_report_entry(data, path, run_folder), PLANNED_KEY: data.site.name in planned.plan,
        }  # fmt: skip
    current, outdated = _earlier_sheets(planned)
    for name in entries.keys() & current.keys():
        entries[name][_BESIDE_KEY] = [
            {key: sheet.get(key) for key in ("file", "path", _DIGEST_KEY)}
            for sheet in (current[name], *current[name].get(_BESIDE_KEY, ()))
            if (sheet.get("file"), sheet.get("path")) != (entries[name]["file"], entries[name]["path"])
        ]
    add_to_report(run_folder.path, SHEETS, entries, removed=outdated.keys())
    for note in _remove_sheets(outdated, run_folder, folder, [path for _, path in written]):
        on_note(note)
    return written


def _earlier_sheets(planned: PlannedSites) -> tuple[dict[str, Mapping[str, Any]], dict[str, Mapping[str, Any]]]:
    """Return the recorded entries of this run and plan, and those of others."""
    folder = planned.run.work.folder
    current = current_sheets(folder, planned.run.record.stages)
    earlier = {name: result.values for name, result in read_results(folder / SHEETS.name).items()}
    outdated = {name: values for name, values in earlier.items() if name not in current}
    return {name: values for name, values in earlier.items() if name in current}, outdated


def _remove_sheets(
    outdated: Mapping[str, Mapping[str, Any]], run_folder: RunFolder, folder: Path, written: Sequence[Path]
) -> Iterator[str]:
    """Remove the files of entries that are not among the ``written`` ones; a file that somebody changed stays."""
    removed, changed = [], []
    for values in (sheet for entry in outdated.values() for sheet in (entry, *entry.get(_BESIDE_KEY, ()))):
        path = run_folder.path / str(values["path"]) if values["path"] else folder / str(values["file"])
        if path in written or not _is_sheet(path, run_folder, folder):
            continue
        if files.hash_file(path) == values.get(_DIGEST_KEY):
            path.unlink()
            removed.append(path.name)
        elif values["path"]:
            changed.append(str(path))
    if removed:
        yield f"removed, because they were of an earlier plan: {', '.join(removed)}."
    if changed:
        yield f"of an earlier plan, but changed since: {', '.join(changed)}. Remove them, or rename them."


def _is_sheet(path: Path, run_folder: RunFolder, folder: Path) -> bool:
    """Whether a recorded path is a file named as a sheet, in the run folder or the folder of sheets.

    The record may be from somebody else: it must not lead to other files.
    """
    if path.is_symlink() or not path.is_file() or not _SHEET_NAME.fullmatch(path.name):
        return False
    parent = Path(os.path.realpath(path.parent))
    return parent.is_relative_to(os.path.realpath(run_folder.path)) or parent == Path(os.path.realpath(folder))


def _report_entry(data: SheetData, path: Path, folder: RunFolder) -> dict[str, Any]:
    """Return what the report says about a sheet, JSON values."""
    return {
        "sensor": data.sensor.name,
        "pose": asdict(data.pose),
        "height_m": data.mounting_height_m,
        "bearing_deg": data.grid_bearing_deg,
        "tolerances": {row.quantity.name: describe_limit(row) for row in data.tolerances.tolerances},
        "frames": data.tolerances.frames,
        "file": path.name,
        "path": path_in_run(path, folder),
        _DIGEST_KEY: files.hash_file(path),
    }


# ---- drawing


def draw_sheet(planned: PlannedSites, data: SheetData) -> str:
    """Return a sheet as SVG text, A4."""
    width = _STYLE.width
    height = width * _PAGE_MM[1] / _PAGE_MM[0]
    inner = width - 2 * _MARGIN
    column = 0.46 * inner
    title = f"Installation sheet: {data.site.name}"
    parts = [
        svg_start_tag(width, height, title, _STYLE),
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#fff"/>',
    ]
    parts.append(_text(_MARGIN, 90, title, 30, bold=True))
    parts.append(_text(_MARGIN, 118, f"{data.sensor.name} · {data.scenario} · {data.rank}", 15, colour="#4a5262"))
    below = _table(parts, "Position", data.position_rows, _MARGIN, 165, column)
    below = _table(parts, "Orientation", data.orientation_rows, _MARGIN, below + 30, column)
    map_left = _MARGIN + column + 0.04 * inner
    map_width = inner - column - 0.04 * inner
    parts.append(f'<g transform="translate({map_left:.1f} 140)">{_draw_map(planned, data, map_width)}</g>')
    legend = f"Orange: the sensor, its field of view{_describe_radius(data)} and its front (arrow)"
    parts.append(_text(map_left, 568, legend, 11, colour="#4a5262"))

    top = max(below, 560.0) + 30
    picture_height = inner / 2.0
    session = planned.session
    camera = view.camera_pose(data.pose, data.sensor, session.scene.roi)
    pixels = view.render_view(session.scene, data.pose, data.sensor, session.work.inputs.carriageway)
    caption = f"View from the sensor, towards {format_angle(grid_bearing_deg(camera.yaw_deg))} from grid north"
    parts.append(_text(_MARGIN, top, f"{caption}, {view.HORIZONTAL_DEG:g}° wide", 15, bold=True))
    parts.append(
        f'<image x="{_MARGIN}" y="{top + 12:.1f}" width="{inner:.1f}" height="{picture_height:.1f}"'
        f' href="{colours.rgb_image_uri(pixels)}"/>'
    )
    top += picture_height + 50
    _tolerance_table(parts, data.tolerances, top, inner)
    check = f"After mounting: egvs accept RUN --site {shlex.quote(data.site.name)} --scan measured.pcd"
    parts.append(_text(_MARGIN, height - 70, check, 13))
    notes = ["Bearings are clockwise from north; the front of the sensor is its x axis.", *planned.map_credits]
    parts.append(_text(_MARGIN, height - 45, " · ".join([f"egvs {__version__}", *notes]), 11, colour="#4a5262"))
    return "\n".join([*parts, "</svg>"])


def _text(x: float, y: float, text: str, size: float, *, bold: bool = False, colour: str = "#14181f") -> str:
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size:g}" fill="{colour}"{weight}>{escape(text)}</text>'


def _table(parts: list[str], title: str, rows: Sequence[tuple[str, str]], x: float, y: float, width: float) -> float:
    """Draw rows of labels and values; return the y below them."""
    parts.append(_text(x, y, title, 15, bold=True))
    y += 8
    for label, value in rows:
        lines = _wrap(value, 32)
        for number, line in enumerate(lines):
            y += 21
            if number == 0 and label:
                parts.append(_text(x, y, label, 13, colour="#4a5262"))
            parts.append(_text(x + 0.37 * width, y, line, 13.5))
        parts.append(f'<path d="M{x:.1f} {y + 7:.1f}h{width:.1f}" stroke="#dbe0e8"/>')
    return y + 7


def _wrap(text: str, letters: int) -> list[str]:
    """Break a text between words into lines of at most so many letters."""
    lines = [""]
    for word in text.split():
        if lines[-1] and len(lines[-1]) + 1 + len(word) > letters:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return lines


def _tolerance_table(parts: list[str], result: PoseTolerances, y: float, width: float) -> None:
    label = SCORE_LABELS[result.score]
    parts.append(_text(_MARGIN, y, f"Tolerances: what costs {result.point}", 15, bold=True))
    source = (
        f"{label.noun} is {label.value(result.planned)} {label.unit}".rstrip()
        + f" as planned, from a sample of {result.frames:,} frames; each quantity is changed alone."
    )
    parts.append(_text(_MARGIN, y + 22, f"{source[:1].upper()}{source[1:]}", 12.5, colour="#4a5262"))
    y += 30
    if not result.tolerances:
        parts.append(_text(_MARGIN, y + 21, "Unknown: the scan of this site was measured, or its score is 0.", 13.5))
        return
    columns = (0.0, 0.2, 0.45)
    for tolerance in result.tolerances:
        y += 22
        name = tolerance.quantity.name
        cells = (name[:1].upper() + name[1:], describe_limit(tolerance), describe_losses(tolerance))
        for share, cell in zip(columns, cells, strict=True):
            parts.append(_text(_MARGIN + share * width, y, cell, 13.5 if share < 0.4 else 12))
        parts.append(f'<path d="M{_MARGIN:.1f} {y + 7:.1f}h{width:.1f}" stroke="#dbe0e8"/>')


def describe_limit(tolerance: Tolerance) -> str:
    """Return a tolerance in words, e.g. "2.1 degrees" or "more than 4 degrees"."""
    quantity = tolerance.quantity
    if math.isinf(tolerance.limit):
        return f"more than {tolerance.tried:g} {quantity.unit}"
    return tolerances.format_distance(tolerance.limit, quantity)


def describe_losses(tolerance: Tolerance) -> str:
    """Return the change in points at the outermost offsets, e.g. "4° down: -1.6, 4° up: -1.5 points"."""
    unit = " m" if tolerance.quantity.unit == "m" else "°"
    texts = []
    for index, direction in zip((0, -1), tolerance.quantity.directions, strict=True):
        if tolerance.offsets[index]:
            change = f"{-tolerance.losses[index]:+z.1f}"
            texts.append(f"{abs(tolerance.offsets[index]):g}{unit} {direction}: {change}")
    return f"{', '.join(texts)} points"


def _describe_radius(data: SheetData) -> str:
    """Return that the field of view ends earlier on the map than in the world; empty otherwise."""
    return f" ({_VIEW_M:g} m of {data.sensor.range_m:g} m)" if data.sensor.range_m > _VIEW_M else ""


def _draw_map(planned: PlannedSites, data: SheetData, width: float) -> str:
    """Return a map around the sensor with its field of view, as shapes in a frame that starts at 0, 0."""
    work = planned.run.work
    tpog: Tpog = planned.session.tpog
    box = _map_box(tpog, data.pose)
    backdrop = Backdrop(world_outlines(work.world, box), roads_within(network_file(work.folder.path), box))
    plan = MapFrame(box, "sheet", width=width, tallest=380.0, north=True, style=_STYLE)
    values = tpog.counts.sum(axis=2) / tpog.frames
    names, _ = maps.street_names(plan, backdrop.roads.names, [(data.pose.x_m, data.pose.y_m)])
    parts = [*maps.base_layers(plan, tpog.grid, values, backdrop), _field_of_view(plan, data), *names]
    x, y = plan.x(data.pose.x_m), plan.y(data.pose.y_m)
    parts.append(f'<circle cx="{x:.1f}" cy="{y:.1f}" r="6" fill="#e8590c" stroke="#fff" stroke-width="1.5"/>')
    figure = plan.svg(parts, f"Map around {data.site.name} with its field of view.")
    return figure[figure.index(">") + 1 : figure.rindex("</svg>")]


def _map_box(tpog: Tpog, pose: Pose) -> Box:
    (x0, y0, _), (width, height, _) = tpog.grid.origin_m, tpog.grid.roi.size_m
    return (
        min(x0, pose.x_m - _MAP_M), min(y0, pose.y_m - _MAP_M),
        max(x0 + width, pose.x_m + _MAP_M), max(y0 + height, pose.y_m + _MAP_M),
    )  # fmt: skip


def _field_of_view(plan: MapFrame, data: SheetData) -> str:
    """Return the field of view as a sector, or a circle, and an arrow along the front."""
    pose, span = data.pose, data.sensor.azimuth_span_deg
    radius_m = min(data.sensor.range_m, _VIEW_M)
    first, last = (0.0, 360.0) if span is None else span
    angles = np.radians(np.linspace(pose.yaw_deg + first, pose.yaw_deg + last, 73))
    rim = [(pose.x_m + radius_m * math.cos(angle), pose.y_m + radius_m * math.sin(angle)) for angle in angles.tolist()]
    if span is not None:
        rim.append((pose.x_m, pose.y_m))
    points = " ".join(f"{plan.x(x):.1f},{plan.y(y):.1f}" for x, y in rim)
    sector = f'<polygon points="{points}" fill="#e8590c" fill-opacity=".16" stroke="#e8590c" stroke-width="1.2"/>'
    ahead = math.radians(pose.yaw_deg)
    tip_x, tip_y = plan.x(pose.x_m + 24.0 * math.cos(ahead)), plan.y(pose.y_m + 24.0 * math.sin(ahead))
    turn = 90.0 - pose.yaw_deg
    shaft = (
        f'<path d="M{plan.x(pose.x_m):.1f} {plan.y(pose.y_m):.1f}L{tip_x:.1f} {tip_y:.1f}"'
        ' stroke="#e8590c" stroke-width="2.4"/>'
    )
    head = (
        f'<path transform="translate({tip_x:.1f} {tip_y:.1f}) rotate({turn:.2f})" d="M0 -9l5 11h-10z" fill="#e8590c"/>'
    )
    return f"{sector}{shaft}{head}"
