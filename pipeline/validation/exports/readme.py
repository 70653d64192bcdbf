"""The README of a folder of labelled point clouds: what is in it, in which frames, and how it was made."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence

import numpy as np

from pipeline.artefacts.traffic_frames import NO_VEHICLES
from pipeline.core.version import __version__
from pipeline.effects import on_traffic
from pipeline.validation.classes import CLASSES
from pipeline.validation.exports import openpcdet
from pipeline.validation.exports.layouts import LAYOUTS, Layout
from pipeline.validation.exports.sites import TRAINING, SiteSummary
from pipeline.validation.unseen_record import UnseenRecord

_IDLE = "moving_occlusion"
"""Bodies stop beams themselves: it has nothing to do here."""


def text(record: UnseenRecord, kind: str, sites: Sequence[SiteSummary]) -> str:
    """The whole README, Markdown."""
    layout = LAYOUTS[kind]
    parts = [
        _title(record, kind, sites),
        _sites(sites),
        _frames(),
        _files(layout, sites),
        _labels(sites),
        _making(record, sites),
    ]
    if kind == "openpcdet":
        parts.append(_openpcdet(sites))
    return "\n".join(parts)


def _title(record: UnseenRecord, kind: str, sites: Sequence[SiteSummary]) -> str:
    return f"""\
# Point clouds of {record.scenario.name}

{len(sites)} sites, {record.frames} frames each, {sum(about.points for about in sites)} points; format {kind}. \
Made by `egvs clouds`, version {__version__}. All simulated.
"""


def _sites(sites: Sequence[SiteSummary]) -> str:
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


def _frames() -> str:
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


def _files(layout: Layout, sites: Sequence[SiteSummary]) -> str:
    empty = sum(len(about.empty) for about in sites)
    rows = [
        "## Files\n",
        "Names of frames are their numbers in the record of traffic, the same at all sites.\n",
        f"- `{layout.points}/*{layout.suffix}`: {layout.about_points}. Intensity is from 0 to 1.",
    ]
    if layout.label_text is not None:
        rows.append(f"- `{layout.labels}/*.txt`: {layout.about_labels}.")
    if layout.calibration:
        rows.append(
            "- `calib/*.txt`: a thought camera at the sensor that looks along x: it carries boxes there and back."
            " A loader that keeps only what a camera sees (`FOV_POINTS_ONLY`) drops most of them: switch that off."
        )
    rows += [
        f"- `ImageSets/train.txt`, `val.txt`: the first {TRAINING:.0%} of the frames, in time, and the rest;"
        f" `empty.txt`: those of both without any labelled box, which many loaders cannot read ({empty} here)."
        " Each frame is in one.",
        "- `objects.csv`: every box of every frame, seen or not, in the frame above: its number in the frame, SUMO's"
        " name and vClass, part (0, or 1.. for the rear of an articulated vehicle), class, points on it,"
        " `in_roi` (1: ground truth of `egvs validate`).",
        "- `about.json`: pose, sensor, noise, counts, `T_world_level`.",
    ]
    return "\n".join(rows) + "\n"


def _labels(sites: Sequence[SiteSummary]) -> str:
    total: Counter[str] = Counter()
    for about in sites:
        total.update(about.classes)
    rows = [
        "## Labels and classes\n",
        "Every box with at least one point is labelled, in the region of interest or not: what is seen must not be"
        " taught as background. `egvs validate` asks for less and more: vehicles whose centre is in the region of"
        f" interest, also those without a point; not for {', '.join(sorted(NO_VEHICLES))}.\n",
        "| class | labelled boxes |\n|---|---:|",
        *(f"| {name} | {total[name]} |" for name in CLASSES if total[name]),
    ]
    return "\n".join(rows) + "\n"


def _making(record: UnseenRecord, sites: Sequence[SiteSummary]) -> str:
    scenario, scene = record.scenario, record.scene
    traffic = [effect.NAME for effect in on_traffic.live(scenario)[0]]
    beams = [effect.NAME for effect in scene.effects if effect.NAME != _IDLE]
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
        *(f"- Effect without a consequence here: {idle.name} ({idle.why})." for idle in scene.idle),
        "- Not modelled: a frame is one instant (no rolling shutter), one return a beam, no mixed returns at edges.",
    ]
    return "\n".join(rows) + "\n"


def _openpcdet(sites: Sequence[SiteSummary]) -> str:
    first = shlex.quote(sites[0].site)
    names = ", ".join(f"'{name}'" for name in CLASSES if any(about.classes[name] for about in sites))
    return f"""\
## Training with OpenPCDet

Each site's folder is a custom dataset, and `{openpcdet.FILE}` in it the configuration of it (its grid holds all
labelled boxes in the region of interest). From OpenPCDet's folder, with this one as HERE:

```
cp -r HERE/{first}/. data/custom/
cp HERE/{first}/{openpcdet.FILE} tools/cfgs/dataset_configs/
python -m pcdet.datasets.custom.custom_dataset create_custom_infos tools/cfgs/dataset_configs/{openpcdet.FILE}
```

The list of classes stands in two files of OpenPCDet: `class_names` at the end of `custom_dataset.py`, and
`CLASS_NAMES` in the model's configuration, with an anchor for each; both stand ready in the first lines of
`{openpcdet.FILE}`. The classes here are

```
[{names}]
```

Frames have the same names at all sites. To learn from several at once, put the site's name before those of its files
and lists; a grid and anchors for all follow from the ranges and heights in each `{openpcdet.FILE}`.
"""
