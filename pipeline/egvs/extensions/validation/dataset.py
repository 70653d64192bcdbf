"""Datasets of labelled point clouds (``egvs clouds``): one folder per site, a README, configurations of OpenPCDet.

The folder appears complete or not at all: it is written as ``.<name>.partial`` and renamed at the end. An interrupted
export leaves its traffic and its static world in the store; the next one starts the clouds again, and removes what a
killed one has left.

The configuration makes a site's folder a custom dataset of OpenPCDet. Its grid follows OpenPCDet's tutorial on custom
datasets: along x and y a multiple of 16 voxels of 0.1 m, along z 40 voxels. It contains all labelled boxes in the
region of interest. The classes and anchors for the configuration of a model are in its first lines, as comments.
"""

from __future__ import annotations

import math
import shlex
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from egvs._version import __version__
from egvs.artefacts.frame_boxes import NON_VEHICLE_KINDS
from egvs.clouds import simulation as cloud_simulation
from egvs.clouds.simulation import CloudSimulator
from egvs.core import files
from egvs.core.errors import InputError, RunError, unknown_site
from egvs.core.progress import ProgressCallback, no_progress
from egvs.core.threads import thread_count
from egvs.core.wording import format_percent
from egvs.effects import registry
from egvs.extensions.validation import held_out_traffic
from egvs.extensions.validation.dataset_files import (
    LAYOUTS,
    MIN_POINTS_TO_PASTE,
    TRAINING_SHARE,
    Layout,
    SiteSummary,
    write_site,
)
from egvs.extensions.validation.detector_results import CLASSES, MAX_CAR_LENGTH_M
from egvs.extensions.validation.held_out_traffic import HeldOutTraffic
from egvs.runs import locks
from egvs.scenario.model import Scenario
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Site, candidate_sites

CONFIG_FILE = "custom_dataset.yaml"
VOXEL_M = 0.1

README_FILE = "README.md"

_GRID_STEP_M = 16 * VOXEL_M
_LEVELS = 40
_MIN_HEIGHT_M = 6.0
_MARGIN_M = 0.5  # below and above the boxes

_RECORD_FOLDER = ".record"

_UNUSED_EFFECT = "moving_occlusion"
"""Has no effect on point clouds, where the bodies of vehicles stop the beams."""

_KITTI_CLASSES = {
    **{name: "Car" for name in ("Car", "Van", "Truck", "Trailer", "Bus", "Tram", "Misc")},
    **{name: "Cyclist" for name in ("Cyclist", "Motorcycle")},
    "Pedestrian": "Pedestrian",
}
"""Class of KITTI that each class counts as in OpenPCDet's evaluation."""

_CONFIG_TEMPLATE = """\
# For OpenPCDet's CustomDataset; in tools/cfgs/dataset_configs/. The grid holds all labelled boxes in the region.
#
# For the model's configuration, from the labels here (0 is the sensor's height, so the ground lies below it):
# CLASS_NAMES: [{present}]
# ANCHOR_GENERATOR_CONFIG: [
{anchors}# ]
DATASET: 'CustomDataset'
DATA_PATH: '../data/custom'

POINT_CLOUD_RANGE: [{grid}]

MAP_CLASS_TO_KITTI: {{
{map}
}}

DATA_SPLIT: {{
    'train': train,
    'test': val
}}

INFO_PATH: {{
    'train': [custom_infos_train.pkl],
    'test': [custom_infos_val.pkl],
}}

POINT_FEATURE_ENCODING: {{
    encoding_type: absolute_coordinates_encoding,
    used_feature_list: ['x', 'y', 'z', 'intensity'],
    src_feature_list: ['x', 'y', 'z', 'intensity'],
}}

DATA_AUGMENTOR:
    DISABLE_AUG_LIST: ['placeholder']
    AUG_CONFIG_LIST:
{pasting}        - NAME: random_world_flip
          ALONG_AXIS_LIST: ['x', 'y']

        - NAME: random_world_rotation
          WORLD_ROT_ANGLE: [-0.78539816, 0.78539816]

        - NAME: random_world_scaling
          WORLD_SCALE_RANGE: [0.95, 1.05]

DATA_PROCESSOR:
    - NAME: mask_points_and_boxes_outside_range
      REMOVE_OUTSIDE_BOXES: True

    - NAME: shuffle_points
      SHUFFLE_ENABLED: {{
        'train': True,
        'test': False
      }}

    - NAME: transform_points_to_voxels
      VOXEL_SIZE: [{voxel}]
      MAX_POINTS_PER_VOXEL: 5
      MAX_NUMBER_OF_VOXELS: {{
        'train': 150000,
        'test': 150000
      }}
"""

_ANCHOR_TEMPLATE = """\
#     {{'class_name': '{name}', 'anchor_sizes': [[{size}]], 'anchor_rotations': [0, 1.57],
#      'anchor_bottom_heights': [{bottom:g}], 'align_center': False, 'feature_map_stride': 8,
#      'matched_threshold': {matched:g}, 'unmatched_threshold': {unmatched:g}}},
"""

_VEHICLE_LENGTH_M = 3.0
"""Classes with at least this mean length get OpenPCDet's thresholds for vehicles, others those for people."""

_PASTING_TEMPLATE = """\
        - NAME: gt_sampling
          USE_ROAD_PLANE: False
          DB_INFO_PATH:
              - custom_dbinfos_train.pkl
          PREPARE: {{
             filter_by_min_points: [{min_points}],
          }}
          SAMPLE_GROUPS: [{groups}]
          NUM_POINT_FEATURES: 4
          DATABASE_WITH_FAKELIDAR: False
          REMOVE_EXTRA_WIDTH: [0.0, 0.0, 0.0]
          LIMIT_WHOLE_SCENE: True

"""


def point_cloud_range_m(summary: SiteSummary) -> list[float]:
    """Return OpenPCDet's POINT_CLOUD_RANGE: lowest x, y, z, highest x, y, z.

    The range of a site without labels is a small grid around the sensor.
    """
    low = summary.low_m or [-1.0, -1.0, -_MIN_HEIGHT_M]
    high = summary.high_m or [1.0, 1.0, 0.0]
    west, south = (math.floor(value / _GRID_STEP_M) * _GRID_STEP_M for value in low[:2])
    east, north = (math.ceil(value / _GRID_STEP_M) * _GRID_STEP_M for value in high[:2])
    bottom = math.floor(low[2] - _MARGIN_M)
    top = max(bottom + _MIN_HEIGHT_M, math.ceil(high[2] + _MARGIN_M))
    return [round(value, 3) for value in (west, south, bottom, east, north, top)]


def openpcdet_config(summary: SiteSummary) -> str:
    """Return the text of :data:`CONFIG_FILE`."""
    grid = point_cloud_range_m(summary)
    names = [name for name in CLASSES if summary.classes[name]]
    pasted = [name for name in names if summary.pasted[name]]
    pasting = ""
    if pasted:
        pasting = _PASTING_TEMPLATE.format(
            min_points=", ".join(f"'{name}:{MIN_POINTS_TO_PASTE // 2}'" for name in pasted),
            groups=", ".join(f"'{name}:15'" for name in pasted),
        )
    return _CONFIG_TEMPLATE.format(
        present=", ".join(f"'{name}'" for name in names),
        grid=", ".join(f"{value:g}" for value in grid),
        anchors="".join(_anchor_lines(summary, name) for name in names),
        map=",\n".join(f"    '{name}': '{_KITTI_CLASSES[name]}'" for name in CLASSES),
        pasting=pasting,
        voxel=f"{VOXEL_M:g}, {VOXEL_M:g}, {(grid[5] - grid[2]) / _LEVELS:g}",
    )


def _anchor_lines(summary: SiteSummary, name: str) -> str:
    """Return the lines of a class in the model's list of anchors."""
    *size, bottom = summary.anchors[name]
    matched, unmatched = (0.55, 0.4) if size[0] >= _VEHICLE_LENGTH_M else (0.5, 0.35)
    sizes = ", ".join(f"{value:g}" for value in size)
    return _ANCHOR_TEMPLATE.format(name=name, size=sizes, bottom=bottom, matched=matched, unmatched=unmatched)


def readme_text(record: HeldOutTraffic, kind: str, sites: Sequence[SiteSummary]) -> str:
    """Return the README, in Markdown."""
    layout = LAYOUTS[kind]
    parts = [
        _title_section(record, kind, sites),
        _sites_section(sites),
        _frames_section(),
        _files_section(layout, sites),
        _labels_section(sites),
        _method_section(record, sites),
    ]
    if kind == "openpcdet":
        parts.append(_openpcdet_section(sites))
    return "\n".join(parts)


def _title_section(record: HeldOutTraffic, kind: str, sites: Sequence[SiteSummary]) -> str:
    points = sum(site.points for site in sites)
    return f"""\
# Point clouds of {record.scenario.name}

{len(sites)} sites, {record.frames} frames each, {points} points; format {kind}. Simulated by `egvs clouds`, \
version {__version__}.
"""


def _sites_section(sites: Sequence[SiteSummary]) -> str:
    rows = ["## Sites\n", "One folder per site. x, y, z in the world frame, in metres; angles in degrees.\n"]
    columns = [
        *("site", "sensor", "x", "y", "z", "yaw", "pitch", "roll", "frames", "points", "labelled boxes"),
        *("vehicles in the region", "labelled vehicles in the region"),
    ]
    rows += ["| " + " | ".join(columns) + " |", "|---|---|" + "---:|" * (len(columns) - 2)]
    for site in sites:
        pose = [f"{value:g}" for value in site.pose.values()]
        counts = (site.frames, site.points, site.labelled, site.in_roi, site.in_roi_labelled)
        rows.append("| " + " | ".join([site.site, site.sensor, *pose, *map(str, counts)]) + " |")
    return "\n".join(rows) + "\n"


def _frames_section() -> str:
    return """\
## Frame of points and boxes

Units are metres and radians. The origin is the sensor. x is level and points along the site's yaw, y to the left, z up,
also for a tilted sensor: points are rotated by its roll and pitch, because a box here has no angle except its heading.
So the ground is at about minus the height of the sensor. Headings are counter-clockwise from x, seen from above: 0
drives along x, pi/2 along y. `T_world_level` in each `about.json` is the transform to the world frame (x east, y north,
z up), `T_level_sensor` that from the sensor's own frame: for `egvs accept`, points (n, 3) are turned back by
`points @ T_level_sensor[:3, :3]`.

Boxes are upright. A vehicle on a slope is pitched (`pitch_rad` in `objects.csv`, nose up), so points on it may be
slightly outside of its box. The same is true for all points, because of range noise.
"""


def _files_section(layout: Layout, sites: Sequence[SiteSummary]) -> str:
    empty = sum(len(site.empty) for site in sites)
    rows = [
        "## Files\n",
        "Files are named after the number of their frame in the recorded traffic, the same at all sites.\n",
        f"- `{layout.points}/*{layout.suffix}`: {layout.points_description}. Intensity is from 0 to 1.",
    ]
    if layout.label_text is not None:
        rows.append(f"- `{layout.labels}/*.txt`: {layout.labels_description}.")
    if layout.calibration:
        rows.append(
            "- `calib/*.txt`: a virtual camera at the sensor that looks along x, for the conversion of boxes. A loader"
            " that keeps only what a camera sees (`FOV_POINTS_ONLY`) drops most of them: turn that off."
        )
    rows += [
        f"- `ImageSets/train.txt`, `val.txt`: the first {format_percent(TRAINING_SHARE, 0)} of the frames, "
        "and the rest; `empty.txt`:"
        f" the frames of both without labelled boxes, which many loaders cannot read ({empty} here). Each frame is in"
        " one of them.",
        "- `objects.csv`: every box of every frame, visible or not, in the frame above: its number in the frame, SUMO's"
        " id and vClass, part (0, or 1.. for the rear of an articulated vehicle), class, number of points on it,"
        " `in_roi` (1: ground truth of `egvs validate`).",
        "- `about.json`: pose, sensor, noise, counts, transforms.",
    ]
    return "\n".join(rows) + "\n"


def _labels_section(sites: Sequence[SiteSummary]) -> str:
    total = sum((site.classes for site in sites), Counter[str]())
    rows = [
        "## Labels and classes\n",
        "Every box with at least one point is labelled, also outside the region of interest, so that no visible vehicle"
        " is learned as background. The ground truth of `egvs validate` differs: vehicles whose centre is in the region"
        f" of interest, also those without points, but not {', '.join(sorted(NON_VEHICLE_KINDS))}.\n",
        "| class | labelled boxes |\n|---|---:|",
        *(f"| {name} | {total[name]} |" for name in CLASSES if total[name]),
    ]
    if by_size := describe_classes_by_size(sites):
        rows.append(f"\n{by_size}")
    return "\n".join(rows) + "\n"


def describe_classes_by_size(sites: Sequence[SiteSummary]) -> str:
    """Return which labels follow from the size of boxes, as a sentence; empty if none does."""
    total = sum((site.by_size for site in sites), Counter[str]())
    if not total:
        return ""
    counts = ", ".join(f"{total[name]:,} {name}" for name in CLASSES if total[name])
    return (
        f"Labelled by size: {counts}. Their vClass is that of cars, but they are longer than {MAX_CAR_LENGTH_M:g} m; "
        "set vclass in traffic.kinds, or vClass in the vehicle types."
    )


def _method_section(record: HeldOutTraffic, sites: Sequence[SiteSummary]) -> str:
    scenario = record.scenario
    scene = record.scene
    traffic_effects = ", ".join(effect.NAME for effect in registry.active_traffic_effects(scenario)[0])
    beam_effects = ", ".join(effect.NAME for effect in scene.effects if effect.NAME != _UNUSED_EFFECT)
    noise_m = {site.sensor: site.range_sigma_m for site in sites}
    noise = ", ".join(f"{sensor} {sigma_m:g} m" for sensor, sigma_m in noise_m.items())
    numbers = record.numbers
    spacing_s = int(np.diff(numbers).min(initial=numbers[-1])) * scenario.traffic.frame_period_s
    if scenario.traffic.is_finished:
        traffic = "The traffic was recorded, so these are the frames that the TPOG was computed from."
    else:
        traffic = "The traffic has a seed of its own: the TPOG was not computed from it."
    rows = [
        "## Method\n",
        f"- Frames {numbers[0]} to {numbers[-1]} of the recording, at least {spacing_s:g} s apart, seed"
        f" {scenario.seed}. {traffic}",
        "- Each cloud has its own random numbers, from the seed, the name of the site and the number of the frame.",
        f"- Range noise (standard deviation): {noise}.",
        f"- Effects on beams and returns: {beam_effects or 'none'}; on traffic: {traffic_effects or 'none'}.",
        *(f"- Inactive effect: {effect.name} ({effect.why})." for effect in scene.inactive_effects),
        "- Not modelled: rolling shutter (a frame is one instant), second returns; without the effect mixed_returns,"
        " mixed returns at edges.",
    ]
    return "\n".join(rows) + "\n"


def _openpcdet_section(sites: Sequence[SiteSummary]) -> str:
    first = shlex.quote(sites[0].site)
    names = ", ".join(f"'{name}'" for name in CLASSES if any(site.classes[name] for site in sites))
    return f"""\
## Training with OpenPCDet

Each site's folder is a custom dataset with its configuration `{CONFIG_FILE}`, whose grid contains all labelled boxes
in the region of interest. In OpenPCDet's folder, with HERE for this folder:

```
cp -r HERE/{first}/. data/custom/
cp HERE/{first}/{CONFIG_FILE} tools/cfgs/dataset_configs/
python -m pcdet.datasets.custom.custom_dataset create_custom_infos tools/cfgs/dataset_configs/{CONFIG_FILE}
```

Edit the list of classes in two files of OpenPCDet: `class_names` at the end of `custom_dataset.py`, and `CLASS_NAMES`
in the model's configuration, with an anchor for each class. The first lines of `{CONFIG_FILE}` contain both. The
classes here are

```
[{names}]
```

Frames have the same names at all sites. To train on several sites at once, put the name of the site before the names in
its files and lists, and choose a grid and anchors for all sites from the ranges and heights in each `{CONFIG_FILE}`.
"""


@dataclass(frozen=True)
class WrittenDataset:
    """A dataset that was written.

    Attributes
    ----------
    folder
        Its folder.
    kind
        Name of its format.
    frames
        Number of frames of each site.
    sites
        Summary of each site.
    """

    folder: Path
    kind: str
    frames: int
    sites: tuple[SiteSummary, ...]


def write_dataset(
    scenario: Scenario,
    folder: Path,
    *,
    sites: Sequence[str] = (),
    frames: int,
    spacing_s: float | None = None,
    kind: str = "kitti",
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> WrittenDataset:
    """Write labelled point clouds of a scenario's sites in frames of held-out traffic.

    Parameters
    ----------
    scenario
        The scenario.
    folder
        New or empty; nothing is overwritten.
    sites
        Names of sites; all by default.
    frames
        Number of frames of each site.
    spacing_s
        Minimum time between two frames, in seconds; by default 7 s, or what the traffic allows.
    kind
        One of :data:`egvs.extensions.validation.dataset_files.LAYOUTS`.
    jobs
        Number of threads; one per core when None. The files do not depend on it.
    progress
        Receives the progress of traffic, static world and clouds.

    Raises
    ------
    InputError
        For an unknown format or site, a folder that is not empty, a site with a measured scan, a full disk, too few
        frames of traffic, or a scenario that a stage refuses.
    """
    if kind not in LAYOUTS:
        raise InputError("--format", f"unknown format {kind!r}", f"Use one of {', '.join(LAYOUTS)}.")
    _check_empty(folder)
    selected = _selected_sites(candidate_sites(scenario), sites)
    with _partial_folder(folder) as partial:
        record = held_out_traffic.prepare_held_out_traffic(
            scenario, partial / _RECORD_FOLDER, frames, apart_s=spacing_s, jobs=jobs, progress=progress
        )
        if sites:
            _check_feasible(record.scene, selected)
        names = {site.name for site in selected}
        feasible = [site for site in record.scene.sites if site.name in names]
        summaries = _write_sites(partial, folder, record, feasible, LAYOUTS[kind], thread_count(jobs), progress)
        if kind == "openpcdet":
            for summary in summaries:
                files.write_text(partial / summary.site / CONFIG_FILE, openpcdet_config(summary))
        files.write_text(partial / README_FILE, readme_text(record, kind, summaries))
        shutil.rmtree(partial / _RECORD_FOLDER)
    return WrittenDataset(folder, kind, frames, tuple(summaries))


def _write_sites(
    partial: Path,
    folder: Path,
    record: HeldOutTraffic,
    sites: Sequence[Site],
    layout: Layout,
    threads: int,
    progress: ProgressCallback,
) -> list[SiteSummary]:
    """Write the folder of each site."""
    scanner = Scanner(record.scene, full_sweep=True)
    bodies = cloud_simulation.vehicle_meshes(record.scene.scenario)
    scanner.check(sites)
    summaries: list[SiteSummary] = []
    for site in sites:
        simulator = CloudSimulator.of_site(record.scene, site, scanner, bodies)
        if not summaries:
            _check_disk_space(partial, folder, simulator, record, sites, layout)
        finished = len(summaries) * record.frames
        total = len(sites) * record.frames

        def site_progress(what: str, done: int, _: int, finished: int = finished, total: int = total) -> None:
            progress(what, finished + done, total)

        summaries.append(write_site(partial / site.name, record, simulator, layout, threads, site_progress))
    return summaries


def _selected_sites(candidates: Sequence[Site], names: Sequence[str]) -> list[Site]:
    """Return the sites with these names, or all, in the scenario's order; an InputError if one cannot be exported."""
    by_name = {site.name: site for site in candidates}
    for name in names:
        if name not in by_name:
            raise unknown_site("--site", name, list(by_name))
    selected = [site for site in candidates if not names or site.name in names]
    for site in selected:
        cloud_simulation.check_no_measured_scan(site)
        if site.name.startswith(".") or site.name.casefold() == README_FILE.casefold():
            raise InputError(f"site {site.name}", "its name is reserved in the exported folder", "Rename the site.")
    return selected


def _check_feasible(scene: Scene, sites: Sequence[Site]) -> None:
    """Raise an InputError for a site that the scene drops because no pole can stand there."""
    reasons = {site.name: reason for site, reason in scene.dropped}
    for site in sites:
        if site.name in reasons:
            problem = f"the site {site.name!r} is dropped, because it is {reasons[site.name]}"
            raise InputError("--site", problem, "Use a site that is scanned.")


def _check_empty(folder: Path) -> None:
    """Raise an InputError for a folder that is not empty."""
    hint = "Use a new or empty folder."
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}", "expected a folder, got a file", hint)
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"--out {folder}", "the folder is not empty", hint)


@contextmanager
def _partial_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder to write to, and rename it at the end; after an exception, remove it."""
    files.check_no_link(folder / README_FILE)
    target = folder.resolve()
    partial = target.with_name(f".{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock = target.with_name(f".{target.name}.lock")
        locks.create_lock(lock)
    except OSError as error:
        problem = f"the folder cannot be written ({error.strerror})"
        raise InputError(f"--out {folder}", problem, "Use a folder that you may write to.") from None
    with locks.locked(lock, wait=False, remove=True) as is_locked:
        if not is_locked:
            raise RunError(f"{folder}: another export is writing to this folder")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir()
        try:
            with files.attach_filename(target):
                yield partial
            partial.replace(target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise


def _check_disk_space(
    partial: Path,
    folder: Path,
    simulator: CloudSimulator,
    record: HeldOutTraffic,
    sites: Sequence[Site],
    layout: Layout,
) -> None:
    """Raise an InputError if the clouds do not fit on the disk, with the share of returns of the first site."""
    share = float(np.isfinite(simulator.view.empty_range_m).mean())
    beams = sum(record.scene.sensor(site.sensor).beams for site in sites)
    need = beams * share * record.frames * layout.point_bytes
    free = shutil.disk_usage(partial).free
    if need > free:
        problem = f"the points need about {need / 1e9:,.1f} GB, but {free / 1e9:,.1f} GB are free"
        raise InputError(f"--out {folder}", problem, "Use fewer --frames, fewer sites (--site), or another disk.")
