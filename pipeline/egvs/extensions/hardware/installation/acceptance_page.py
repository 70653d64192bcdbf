"""The files of an acceptance check: ``acceptance_SITE.json``, and ``acceptance_SITE.html`` with range images.

The page is one file that loads nothing, for light and dark themes.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from egvs.artefacts.command_results import read_results
from egvs.artefacts.run_folder import RunFolder
from egvs.core import files
from egvs.core.grid import FloatArray, IntArray
from egvs.drawing import colours, pages
from egvs.drawing.colours import IndexedImage
from egvs.drawing.svg_figures import ColourBar, svg_start_tag
from egvs.export.export import safe_file_name
from egvs.extensions.hardware.files import ACCEPTANCE
from egvs.extensions.hardware.installation.acceptance import Acceptance, describe_error
from egvs.extensions.hardware.installation.planned_sites import path_in_run
from egvs.extensions.hardware.installation.scan_comparison import NEARER_M, NEARER_SHARE, SURE_RANGE, ScanComparison
from egvs.results.labels import SCORE_LABELS
from egvs.runs.command_results import add_to_report

TEMPLATES = Path(__file__).parent / "templates"

CATEGORIES = (
    ("no return, none expected", "00000000", "00000000"),
    ("expected return is missing", "7048b6", "b197fc"),
    ("as expected", "c9ced8", "3d4759"),
    ("farther than expected", "31688e", "6ea8d4"),
    ("nearer than expected: vehicles, people, or changes", "e0a030", "e0a030"),
    ("obstacle that stops the beam", "c92a2a", "ff6b6b"),
)
"""What a beam shows, with its colours on light and on dark pages. Where beams share a pixel, the last entry counts."""

_AZIMUTHS, _MAX_ROWS = 720, 64
_WIDTH, _LEFT, _TOP, _IMAGE_HEIGHT = 760.0, 52.0, 8.0, 150.0


@dataclass(frozen=True)
class AcceptanceFiles:
    """The files of an acceptance check."""

    json: Path
    page: Path

    @classmethod
    def of(cls, folder: Path, site: str) -> AcceptanceFiles:
        """Return the names for a site in a folder."""
        stem = f"acceptance_{safe_file_name(site)}"
        return cls(folder / f"{stem}.json", folder / f"{stem}.html")


def write_files(folder: Path, result: Acceptance) -> AcceptanceFiles:
    """Write both files into a folder, which is made if necessary.

    Parameters
    ----------
    folder
        The folder.
    result
        The result of the check.
    """
    names = AcceptanceFiles.of(folder, result.site.name)
    files.check_writable(names.json)
    files.write_text(names.json, files.to_json_text(result.to_json(), indent=2) + "\n")
    files.write_text(names.page, render_page(result))
    return names


def write_acceptance(run: str | Path, result: Acceptance, out: Path | None = None) -> tuple[Path, ...]:
    """Write the files of an acceptance check, and add its verdict to the report of the run.

    Parameters
    ----------
    run
        The run folder.
    result
        From :func:`egvs.extensions.hardware.installation.acceptance.accept`.
    out
        Folder to write; ``acceptance`` in the run folder by default.

    Returns
    -------
    tuple of Path
        ``acceptance_SITE.json`` and ``acceptance_SITE.html``, then the file with all verdicts, and the report if the
        run is complete.

    Raises
    ------
    InputError
        If a file cannot be written, or the file with the verdicts is damaged.
    """
    folder = RunFolder(Path(run))
    read_results(folder / ACCEPTANCE.name)
    written = write_files(out or folder.path / "acceptance", result)
    entry = {
        **result.to_json(),
        "pose": asdict(result.pose.planned),
        "path": path_in_run(written.page, folder),
    }
    reported = add_to_report(folder.path, ACCEPTANCE, {result.site.name: entry})
    return (written.json, written.page, *reported)


def render_page(result: Acceptance) -> str:
    """Return the page, HTML text."""
    images = range_images(result.comparison)
    label = None if result.score is None else SCORE_LABELS[result.score.name]
    return pages.render(
        pages.page_environment(TEMPLATES), "acceptance.html.j2",
        result=result, images=images, scale=_range_scale(images.peak_m), categories=CATEGORIES, label=label,
        pose_rows=_pose_rows(result),
    )  # fmt: skip


def _pose_rows(result: Acceptance) -> list[tuple[str, str, str, str]]:
    """Return name, planned, measured and error of each parameter of the pose."""
    names = {
        "x_m": "x (m)", "y_m": "y (m)", "z_m": "z (m)",
        "yaw_deg": "yaw (degrees)", "pitch_deg": "pitch (degrees)", "roll_deg": "roll (degrees)",
    }  # fmt: skip
    pose = result.pose
    rows = []
    for key, name in names.items():
        planned, measured = getattr(pose.planned, key), getattr(pose.measured, key)
        error = describe_error(pose.values[key], pose.standard_errors[key])
        rows.append((name, f"{planned:z.3f}", f"{measured:z.3f}", error))
    return rows


@dataclass(frozen=True)
class RangeImages:
    """Range images as SVG text: azimuth to the right, elevation upwards."""

    expected: str
    measured: str
    difference: str
    peak_m: float


def range_images(comparison: ScanComparison) -> RangeImages:
    """Return the range images of a comparison."""
    elevations = np.unique(np.round(comparison.elevation_deg, 3))
    if len(elevations) <= _MAX_ROWS:
        row = np.searchsorted(elevations, np.round(comparison.elevation_deg, 3))
        n_rows = len(elevations)
    else:
        low, high = elevations[0], elevations[-1]
        n_rows = _MAX_ROWS
        row = np.minimum(((comparison.elevation_deg - low) / (high - low) * n_rows).astype(np.int64), n_rows - 1)
    column = np.minimum((comparison.azimuth_deg / 360.0 * _AZIMUTHS).astype(np.int64), _AZIMUTHS - 1)
    cell = column * n_rows + row
    shape = _AZIMUTHS, n_rows

    expected_m = np.where(np.isfinite(comparison.expected_m), comparison.expected_m, 0.0)
    measured_m = np.nan_to_num(comparison.measured_m)
    peak_m = float(max(np.quantile(expected_m, 0.98), np.quantile(measured_m, 0.98), 1.0))
    ends = elevations[0], elevations[-1]
    images = []
    for ranges_m, title in ((expected_m, "Expected"), (measured_m, "Measured")):
        image = colours.field_image(_nearest_in_cell(cell, ranges_m, shape), peak_m)
        images.append(_frame(image, colours.FIELD_PALETTES, ends, f"{title} range by azimuth and elevation."))
    category = np.zeros(shape[0] * shape[1], dtype=np.uint8)
    np.maximum.at(category, cell, beam_categories(comparison))
    palettes = {
        theme: colours.category_palette([entry[1 + index] for entry in CATEGORIES])
        for index, theme in enumerate(colours.THEMES)
    }
    difference = IndexedImage.from_indices(category.reshape(shape).T[::-1])
    alt = "Differences of measured and expected ranges by azimuth and elevation."
    return RangeImages(images[0], images[1], _frame(difference, palettes, ends, alt), peak_m)


def beam_categories(comparison: ScanComparison) -> NDArray[np.uint8]:
    """Return the index of each beam in :data:`CATEGORIES`, (beams,)."""
    expected_m, measured_m = comparison.expected_m, comparison.measured_m
    category = np.zeros(len(expected_m), dtype=np.uint8)
    returned = ~np.isnan(measured_m)
    tolerance_m = np.maximum(NEARER_M, NEARER_SHARE * np.where(np.isfinite(expected_m), expected_m, 0.0))
    with np.errstate(invalid="ignore"):
        gap_m = expected_m - measured_m
        category[returned & (np.abs(gap_m) <= tolerance_m)] = 2
        category[returned & (gap_m < -tolerance_m)] = 3
        category[returned & (gap_m > tolerance_m)] = 4
    category[~returned & (expected_m <= SURE_RANGE * np.nanmax([*measured_m, 1.0]))] = 1
    category[comparison.obstacle_beams] = 5
    return category


def _nearest_in_cell(cell: IntArray, ranges_m: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Return the smallest range above 0 in each cell, 0 without one."""
    nearest = np.full(shape[0] * shape[1], np.inf)
    some = ranges_m > 0
    np.minimum.at(nearest, cell[some], ranges_m[some])
    return np.where(np.isfinite(nearest), nearest, 0.0).reshape(shape)


def _frame(image: IndexedImage, palettes: dict[str, bytes], ends_deg: tuple[float, float], alt: str) -> str:
    """Return an image with axes."""
    width = _WIDTH - _LEFT - 20.0
    parts = [svg_start_tag(_WIDTH, _TOP + _IMAGE_HEIGHT + 38.0, alt)]
    for theme in colours.THEMES:
        parts.append(
            f'<image class="{theme}" x="{_LEFT}" y="{_TOP}" width="{width}" height="{_IMAGE_HEIGHT}"'
            f' preserveAspectRatio="none" image-rendering="pixelated" href="{image.uri(palettes[theme])}"/>'
        )
    parts.append(f'<rect class="axis" x="{_LEFT}" y="{_TOP}" width="{width}" height="{_IMAGE_HEIGHT}"/>')
    for azimuth_deg in range(0, 361, 45):
        x = _LEFT + width * azimuth_deg / 360.0
        parts.append(f'<path class="axis" d="M{x:.1f} {_TOP + _IMAGE_HEIGHT}v5"/>')
        parts.append(f'<text x="{x:.1f}" y="{_TOP + _IMAGE_HEIGHT + 18}" text-anchor="middle">{azimuth_deg}°</text>')
    for y, value in ((_TOP + 10.0, ends_deg[1]), (_TOP + _IMAGE_HEIGHT, ends_deg[0])):
        parts.append(f'<text x="{_LEFT - 6}" y="{y}" text-anchor="end">{escape(f"{value:.0f}°")}</text>')
    return "\n".join([*parts, "</svg>"])


def _range_scale(peak_m: float) -> str:
    """Return the colour scale of the ranges."""
    bar = ColourBar(0.0, peak_m, "Range (m)")
    start = svg_start_tag(460.0, 62.0, f"Colour scale: range, 0 to {peak_m:.0f} m")
    return f"{start}{bar.svg('range-scale', (16.0, 4.0), 428.0, bar.title_lines(428.0))}</svg>"
