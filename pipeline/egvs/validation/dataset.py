"""Egvs clouds: labelled point clouds, README, OpenPCDet configuration.

The dataset configuration with which OpenPCDet takes a site's folder as its custom dataset.

The grid follows OpenPCDet's tutorial on custom datasets: along x and y a multiple of 16 voxels of 0.1 m, along z 40
voxels. It holds all labelled boxes in the region of interest. What a model's own configuration should say, its classes
and the anchor of each, stands at the top as a comment.

The README of a folder of labelled point clouds: what is in it, in which frames, and how it was made.

Makes a folder of labelled point clouds: one folder a site, and a README that says what is in them.

The folder appears whole or not at all: it is written aside (``.<name>.partial``) and renamed at the end. An export that
was interrupted leaves its traffic and its static world in the store, and the next one begins its clouds anew; what is
left of one that was killed is removed then.
"""

from __future__ import annotations

import difflib
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
from egvs.artefacts.traffic_frames import NON_VEHICLE_KINDS
from egvs.core import files
from egvs.core.errors import InputError, RunError
from egvs.core.runtime import ProgressCallback, no_progress, thread_count
from egvs.effects import registry
from egvs.runs import locks
from egvs.scenario.model import Scenario
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sites import Site, candidate_sites
from egvs.validation import cloud_simulation, held_out_traffic
from egvs.validation.cloud_simulation import CloudSimulator
from egvs.validation.dataset_files import LAYOUTS, MIN_POINTS_TO_PASTE, TRAINING_SHARE, Layout, SiteSummary, write_site
from egvs.validation.held_out_traffic import HeldOutTraffic
from egvs.validation.sweeps import CLASSES

CONFIG_FILE = "custom_dataset.yaml"
VOXEL_M = 0.1

_SIXTEEN_M = 16 * VOXEL_M
_LEVELS = 40
_LEAST_HEIGHT_M = 6.0
_MARGIN_M = 0.5  # below and above the boxes

_KITTI_CLASSES = {
    **{name: "Car" for name in ("Car", "Van", "Truck", "Trailer", "Bus", "Tram", "Misc")},
    **{name: "Cyclist" for name in ("Cyclist", "Motorcycle")},
    "Pedestrian": "Pedestrian",
}
"""What each class counts as in OpenPCDet's evaluation, which knows KITTI's three."""

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
"""Classes of this mean length and more get the thresholds that OpenPCDet gives vehicles, others those of people."""

_PASTING_TEMPLATE = """\
        - NAME: gt_sampling
          USE_ROAD_PLANE: False
          DB_INFO_PATH:
              - custom_dbinfos_train.pkl
          PREPARE: {{
             filter_by_min_points: [{fewest}],
          }}
          SAMPLE_GROUPS: [{groups}]
          NUM_POINT_FEATURES: 4
          DATABASE_WITH_FAKELIDAR: False
          REMOVE_EXTRA_WIDTH: [0.0, 0.0, 0.0]
          LIMIT_WHOLE_SCENE: True

"""


def present_classes(summary: SiteSummary) -> list[str]:
    """The classes with labels, in the order of listings."""
    return [name for name in CLASSES if summary.classes[name]]


def point_cloud_range_m(summary: SiteSummary) -> list[float]:
    """POINT_CLOUD_RANGE: lowest x, y, z, highest x, y, z; of a site without labels, a grid round the sensor."""
    low, high = summary.low_m or [-1.0, -1.0, -_LEAST_HEIGHT_M], summary.high_m or [1.0, 1.0, 0.0]
    west, south = (math.floor(value / _SIXTEEN_M) * _SIXTEEN_M for value in low[:2])
    east, north = (math.ceil(value / _SIXTEEN_M) * _SIXTEEN_M for value in high[:2])
    bottom = math.floor(low[2] - _MARGIN_M)
    top = max(bottom + _LEAST_HEIGHT_M, math.ceil(high[2] + _MARGIN_M))
    return [round(value, 3) for value in (west, south, bottom, east, north, top)]


def openpcdet_config(summary: SiteSummary) -> str:
    """The text of :data:`CONFIG_FILE`."""
    grid, names = point_cloud_range_m(summary), present_classes(summary)
    well = [name for name in names if summary.pasted[name]]
    pasting = _PASTING_TEMPLATE.format(
        fewest=", ".join(f"'{name}:{MIN_POINTS_TO_PASTE // 2}'" for name in well),
        groups=", ".join(f"'{n}:15'" for n in well),
    )
    return _CONFIG_TEMPLATE.format(
        present=", ".join(f"'{name}'" for name in names),
        grid=", ".join(f"{value:g}" for value in grid),
        anchors="".join(_anchor_lines(summary, name) for name in names),
        map=",\n".join(f"    '{name}': '{_KITTI_CLASSES[name]}'" for name in CLASSES),
        pasting=pasting if well else "",
        voxel=f"{VOXEL_M:g}, {VOXEL_M:g}, {(grid[5] - grid[2]) / _LEVELS:g}",
    )


def _anchor_lines(summary: SiteSummary, name: str) -> str:
    """The lines of a class in the model's list of anchors."""
    *size, bottom = summary.anchors[name]
    matched, unmatched = (0.55, 0.4) if size[0] >= _VEHICLE_LENGTH_M else (0.5, 0.35)
    sizes = ", ".join(f"{value:g}" for value in size)
    return _ANCHOR_TEMPLATE.format(name=name, size=sizes, bottom=bottom, matched=matched, unmatched=unmatched)


_UNUSED_EFFECT = "moving_occlusion"
"""Bodies stop beams themselves: it has nothing to do here."""


def readme_text(record: HeldOutTraffic, kind: str, sites: Sequence[SiteSummary]) -> str:
    """The whole README, Markdown."""
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
    return f"""\
# Point clouds of {record.scenario.name}

{len(sites)} sites, {record.frames} frames each, {sum(about.points for about in sites)} points; format {kind}. \
Made by `egvs clouds`, version {__version__}. All simulated.
"""


def _sites_section(sites: Sequence[SiteSummary]) -> str:
    rows = ["## Sites\n", "One folder a site. x, y, z in the world frame, metres; angles in degrees.\n"]
    names = (
        "site, sensor, x, y, z, yaw, pitch, roll, frames, points, labelled boxes, vehicles in the region, of them seen"
    )
    columns = names.split(", ")
    rows += ["| " + " | ".join(columns) + " |", "|---|---|" + "---:|" * (len(columns) - 2)]
    for about in sites:
        pose = [f"{value:g}" for value in about.pose.values()]
        counts = (about.frames, about.points, about.labelled, about.in_roi, about.in_roi_labelled)
        rows.append("| " + " | ".join([about.site, about.sensor, *pose, *map(str, counts)]) + " |")
    return "\n".join(rows) + "\n"


def _frames_section() -> str:
    return """\
## Frame of points and boxes

Metres and radians. The origin is the sensor. x is level and points along the site's yaw, y to the left, z straight up,
also where the sensor is tilted: points are turned by its roll and pitch, since a box here has no angle but its heading.
So the ground lies at about minus the sensor's height above it. A heading is counter-clockwise from x, seen from above;
0 drives along x, pi/2 along y. `T_world_level` in each `about.json` brings points into the world frame (x east,
y north, z up).

Boxes are upright. A vehicle on a slope is pitched (`pitch_rad` in `objects.csv`, nose up): points on it may lie a
little outside of its upright box, and so may any point, by the noise of its range.
"""


def _files_section(layout: Layout, sites: Sequence[SiteSummary]) -> str:
    empty = sum(len(about.empty) for about in sites)
    rows = [
        "## Files\n",
        "Names of frames are their numbers in the record of traffic, the same at all sites.\n",
        f"- `{layout.points}/*{layout.suffix}`: {layout.points_description}. Intensity is from 0 to 1.",
    ]
    if layout.label_text is not None:
        rows.append(f"- `{layout.labels}/*.txt`: {layout.labels_description}.")
    if layout.calibration:
        rows.append(
            "- `calib/*.txt`: a thought camera at the sensor that looks along x: it carries boxes there and back."
            " A loader that keeps only what a camera sees (`FOV_POINTS_ONLY`) drops most of them: switch that off."
        )
    rows += [
        f"- `ImageSets/train.txt`, `val.txt`: the first {TRAINING_SHARE:.0%} of the frames, in time, and the rest;"
        f" `empty.txt`: those of both without any labelled box, which many loaders cannot read ({empty} here)."
        " Each frame is in one.",
        "- `objects.csv`: every box of every frame, seen or not, in the frame above: its number in the frame, SUMO's"
        " name and vClass, part (0, or 1.. for the rear of an articulated vehicle), class, points on it,"
        " `in_roi` (1: ground truth of `egvs validate`).",
        "- `about.json`: pose, sensor, noise, counts, `T_world_level`.",
    ]
    return "\n".join(rows) + "\n"


def _labels_section(sites: Sequence[SiteSummary]) -> str:
    total: Counter[str] = Counter()
    for about in sites:
        total.update(about.classes)
    rows = [
        "## Labels and classes\n",
        "Every box with at least one point is labelled, in the region of interest or not: what is seen must not be"
        " taught as background. `egvs validate` asks for less and more: vehicles whose centre is in the region of"
        f" interest, also those without a point; not for {', '.join(sorted(NON_VEHICLE_KINDS))}.\n",
        "| class | labelled boxes |\n|---|---:|",
        *(f"| {name} | {total[name]} |" for name in CLASSES if total[name]),
    ]
    return "\n".join(rows) + "\n"


def _method_section(record: HeldOutTraffic, sites: Sequence[SiteSummary]) -> str:
    scenario, scene = record.scenario, record.scene
    traffic = [effect.NAME for effect in registry.active_traffic_effects(scenario)[0]]
    beams = [effect.NAME for effect in scene.effects if effect.NAME != _UNUSED_EFFECT]
    noise = {about.sensor: about.range_sigma_m for about in sites}
    numbers = record.numbers
    whose = (
        "Its traffic comes from a finished file, so these are the frames that the TPOG is counted from."
        if scenario.traffic.fcd is not None
        else "Its traffic has a seed of its own: the TPOG has not seen it."
    )
    apart = int(np.diff(numbers).min(initial=numbers[-1])) * scenario.traffic.frame_period_s
    rows = [
        "## How it was made\n",
        f"- Frames {numbers[0]} to {numbers[-1]} of the record, at least {apart:g} s apart, seed {scenario.seed}."
        f" {whose}",
        "- Each cloud has random numbers of its own, from the seed, the site's name and the frame's number.",
        "- Noise of ranges, one standard deviation: " + ", ".join(f"{s} {v:g} m" for s, v in noise.items()) + ".",
        f"- Effects on beams and returns: {', '.join(beams) or 'none'}; on traffic: {', '.join(traffic) or 'none'}.",
        *(f"- Effect without a consequence here: {idle.name} ({idle.why})." for idle in scene.inactive_effects),
        "- Not modelled: a frame is one instant (no rolling shutter), one return a beam, no mixed returns at edges.",
    ]
    return "\n".join(rows) + "\n"


def _openpcdet_section(sites: Sequence[SiteSummary]) -> str:
    first = shlex.quote(sites[0].site)
    names = ", ".join(f"'{name}'" for name in CLASSES if any(about.classes[name] for about in sites))
    return f"""\
## Training with OpenPCDet

Each site's folder is a custom dataset, and `{CONFIG_FILE}` in it the configuration of it (its grid holds all
labelled boxes in the region of interest). From OpenPCDet's folder, with this one as HERE:

```
cp -r HERE/{first}/. data/custom/
cp HERE/{first}/{CONFIG_FILE} tools/cfgs/dataset_configs/
python -m pcdet.datasets.custom.custom_dataset create_custom_infos tools/cfgs/dataset_configs/{CONFIG_FILE}
```

The list of classes stands in two files of OpenPCDet: `class_names` at the end of `custom_dataset.py`, and
`CLASS_NAMES` in the model's configuration, with an anchor for each; both stand ready in the first lines of
`{CONFIG_FILE}`. The classes here are

```
[{names}]
```

Frames have the same names at all sites. To learn from several at once, put the site's name before those of its files
and lists; a grid and anchors for all follow from the ranges and heights in each `{CONFIG_FILE}`.
"""


README_FILE = "README.md"
_RECORD_FOLDER = ".record"


@dataclass(frozen=True)
class WrittenDataset:
    """A folder that was written."""

    folder: Path
    kind: str
    frames: int
    sites: tuple[SiteSummary, ...]


def write_dataset(
    scenario: Scenario,
    folder: Path,
    *,
    sites: Sequence[str] = (),
    frames: int = 1000,
    kind: str = "kitti",
    jobs: int | None = None,
    progress: ProgressCallback = no_progress,
) -> WrittenDataset:
    """Write labelled point clouds of a scenario's sites in frames of unseen traffic.

    Parameters
    ----------
    folder
        New or empty; nothing is overwritten.
    sites
        Names; all sites when there is none.
    frames
        How many of each site.
    kind
        One of :data:`egvs.validation.dataset_files.LAYOUTS`.
    jobs
        Threads; one a core when None. The files do not depend on it.

    Raises
    ------
    InputError
        For an unknown format or site; a folder that holds something; a site whose empty scan is measured; too little
        room on the disk; more frames than traffic has; and what the stages refuse.
    """
    if kind not in LAYOUTS:
        raise InputError("--format", repr(kind), f"one of {', '.join(LAYOUTS)}")
    _check_empty(folder)
    chosen = _selected_sites(candidate_sites(scenario), sites)
    with _partial_folder(folder) as partial:
        record = held_out_traffic.prepare_held_out_traffic(
            scenario, partial / _RECORD_FOLDER, frames, jobs=jobs, progress=progress
        )
        standing = _feasible_sites(record.scene, [site.name for site in chosen], named=bool(sites))
        written = _write_sites(partial, folder, record, standing, LAYOUTS[kind], thread_count(jobs), progress)
        for about in written if kind == "openpcdet" else ():
            files.write_text(partial / about.site / CONFIG_FILE, openpcdet_config(about))
        files.write_text(partial / README_FILE, readme_text(record, kind, written))
        shutil.rmtree(partial / _RECORD_FOLDER)
    return WrittenDataset(folder, kind, frames, tuple(written))


def _write_sites(
    partial: Path,
    folder: Path,
    record: HeldOutTraffic,
    sites: Sequence[Site],
    layout: Layout,
    jobs: int,
    progress: ProgressCallback,
) -> list[SiteSummary]:
    scanner, shapes = Scanner(record.scene, full_sweep=True), cloud_simulation.vehicle_meshes(record.scene.scenario)
    scanner.check(sites)
    written: list[SiteSummary] = []
    for site in sites:
        maker = CloudSimulator.of_site(record.scene, site, scanner, shapes)
        if not written:
            _check_disk_space(partial, folder, maker, record, sites, layout)
        done, total = len(written) * record.frames, len(sites) * record.frames

        def told(what: str, here: int, _: int, done: int = done, total: int = total) -> None:
            progress(what, done + here, total)

        written.append(write_site(partial / site.name, record, maker, layout, jobs, told))
    return written


def _selected_sites(known: Sequence[Site], names: Sequence[str]) -> list[Site]:
    """The sites of these names, or all, in the scenario's order; InputError for what cannot be exported."""
    by_name = {site.name: site for site in known}
    for name in names:
        if name not in by_name:
            near = difflib.get_close_matches(name, by_name, 1, 0.4)
            listed = [*by_name][:20]
            more = f" and {len(by_name) - len(listed)} more" if len(by_name) > len(listed) else ""
            right = f"did you mean {near[0]}?" if near else f"one of {', '.join(listed)}{more}"
            raise InputError("--site", f"no site {name!r}", right)
    chosen = [site for site in known if not names or site.name in names]
    for site in chosen:
        cloud_simulation.check_no_measured_scan(site)
        if site.name.startswith(".") or site.name.casefold() == README_FILE.casefold():
            raise InputError(f"site {site.name}", "its name cannot be that of a folder here", "another name")
    return chosen


def _feasible_sites(scene: Scene, names: Sequence[str], *, named: bool) -> list[Site]:
    """The sites of the scene; InputError for one that was asked for by name, but that no pole can stand for."""
    why = {site.name: reason for site, reason in scene.dropped}
    for name in names if named else ():
        if name in why:
            raise InputError("--site", f"the site {name!r} is dropped: it stands {why[name]}", "one that is scanned")
    return [site for site in scene.sites if site.name in names]


def _check_empty(folder: Path) -> None:
    """InputError for a folder that holds something."""
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}", "is a file", "a folder that is new or empty")
    if folder.is_dir() and any(folder.iterdir()):
        raise InputError(f"--out {folder}", "holds files already", "a folder that is new or empty: none is overwritten")


@contextmanager
def _partial_folder(folder: Path) -> Iterator[Path]:
    """Yield a folder to write to; rename it at the end, remove it where that is not reached."""
    target = folder.resolve()
    partial = target.with_name(f".{target.name}.partial")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        lock = target.with_name(f".{target.name}.lock")
        locks.create_lock(lock)
    except OSError as error:
        raise InputError(f"--out {folder}", f"cannot be written ({error.strerror})", "a folder of yours") from None
    with locks.locked(lock, wait=False, remove=True) as held:
        if not held:
            raise RunError(f"{folder}: another export is at work there")
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
    """InputError where the clouds of all sites would not fit on the disk, if as many beams return as at the first."""
    share = float(np.isfinite(simulator.view.empty_range_m).mean())
    beams = sum(record.scene.sensor(site.sensor).beams for site in sites)
    need, free = beams * share * record.frames * layout.point_bytes, shutil.disk_usage(partial).free
    if need > free:
        found = f"about {need / 1e9:,.1f} GB of points, but {free / 1e9:,.1f} GB are free there"
        raise InputError(f"--out {folder}", found, "fewer --frames, fewer sites (--site), or another disk")
