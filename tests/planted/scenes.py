"""The files of a small scenario, written from :mod:`tests.planted.truth` as other programs would write them."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.conftest import collection, feature
from tests.planted.truth import PERIOD_S, RANGE_M, SIZES_M, STREET, Box, Frames, Mount, Prism, Truth

LANES_Y_M = {"east": -1.6, "west": 1.6}
"""Middle of each lane; they are 3.2 m wide and lead from x = -40 m to 90 m, or back."""

Place = Callable[[float, float], tuple[float, float]]
"""Coordinates of a file at a position in the world frame."""


def same_place(x_m: float, y_m: float) -> tuple[float, float]:
    """World frame."""
    return x_m, y_m


@dataclass
class Scene:
    """A scenario before it is written.

    Attributes
    ----------
    truth
        What the files should say.
    config
        Keys of scenario.toml, with dots, and their values.
    files
        Contents by name.
    """

    truth: Truth
    config: dict[str, Any] = field(default_factory=dict)
    files: dict[str, str | bytes] = field(default_factory=dict)

    def write(self, folder: Path) -> Path:
        """Write all files into a new folder."""
        folder.mkdir(parents=True)
        for name, content in self.files.items():
            data = content if isinstance(content, bytes) else content.encode()
            (folder / name).write_bytes(data)
        (folder / "scenario.toml").write_text("".join(f"{k} = {to_toml(v)}\n" for k, v in self.config.items()))
        return folder

    def replace(self, name: str, old: str, new: str) -> None:
        """Replace a text of a file everywhere; it must be there."""
        text = self.files[name]
        assert isinstance(text, str)
        assert old in text, f"{name} has no {old!r}"
        self.files[name] = text.replace(old, new)


def to_toml(value: Any) -> str:
    """Write a value as TOML."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {to_toml(item)}" for key, item in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(to_toml, value)) + "]"
    if isinstance(value, float) and math.isinf(value):
        return "inf"
    return json.dumps(value)


def street(truth: Truth = STREET) -> Scene:
    """The street with a network, a finished FCD file, footprints and sites, all in the world frame."""
    scene = Scene(truth)
    kinds = []
    for name, (length_m, width_m, height_m) in SIZES_M.items():
        vclass = {"car": "passenger", "truck": "truck"}[name]
        kinds.append({"name": name, "vclass": vclass, "length_m": length_m, "width_m": width_m, "height_m": height_m})
    scene.config = {
        "roi.center_m": truth.region_m,
        "roi.size_m": truth.size_m,
        "roi.voxel_m": truth.voxel_m,
        "traffic.roads": "net.net.xml",
        "traffic.fcd": "fcd.csv",
        "traffic.frame_period_s": PERIOD_S,
        "traffic.kinds": kinds,
        "statics.footprints": ["solids.geojson"],
        "tpog.blocks": 4,
        "sites.file": "sites.csv",
        "sites.sensor": "small",
        "sensors.small": sensor(truth),
        "score.gamma": truth.gamma,
        "score.others": [],
        "score.blindspots": False,
    }
    scene.files = {
        "net.net.xml": network(truth.ground_m),
        "fcd.csv": fcd_csv(truth.frames) if len(truth.periods) == 1 else "",
        "solids.geojson": solids(truth.solids, truth.ground_m),
        "sites.csv": sites(truth.mounts),
    }
    return scene


def sensor(truth: Truth) -> dict[str, Any]:
    """A table [sensors.NAME]."""
    azimuths = truth.azimuths_deg
    step_deg = azimuths[1] - azimuths[0]
    values = {"elevations_deg": truth.elevations_deg, "azimuth_step_deg": step_deg, "range_m": RANGE_M}
    if len(azimuths) * step_deg != 360:
        values["azimuth_deg"] = (azimuths[0], azimuths[-1])
    return values


def network(
    z_m: float = 0.0, location: str = 'netOffset="0.00,0.00" projParameter="!"', lanes: dict[str, float] | None = None
) -> str:
    """A network of straight lanes: their names and heights, beside those at ``z_m``."""
    edges = ""
    for suffix, height_m in {"": z_m, **(lanes or {})}.items():
        for name, y_m in LANES_Y_M.items():
            ends = [(-40, y_m), (90, y_m)]
            shape = " ".join(f"{x},{y},{height_m}" for x, y in (ends if name == "east" else reversed(ends)))
            lane = f'<lane id="{name}{suffix}_0" index="0" length="130" speed="13.9" shape="{shape}"/>'
            edges += f'<edge id="{name}{suffix}" from="a{suffix}" to="b{suffix}">{lane}</edge>\n'
    return f'<net version="1.20">\n<location {location}/>\n{edges}</net>\n'


FCD_COLUMNS = ("time", "id", "x", "y", "z", "angle", "type", "speed")


def fcd_rows(frames: Frames, place: Place = same_place) -> list[dict[str, Any]]:
    """Rows of a finished FCD file: the middle of the front bumper, degrees clockwise from north."""
    rows = []
    for number, frame in enumerate(frames):
        for box in frame:
            x_m, y_m, z_m = box.front_m
            x, y = place(x_m, y_m)
            angle_deg = (90.0 - math.degrees(box.yaw_rad)) % 360.0
            values = (number * PERIOD_S, box.name, x, y, z_m, angle_deg, box.kind, box.speed_m_s)
            rows.append(dict(zip(FCD_COLUMNS, values, strict=True)))
    return rows


def csv_text(rows: Sequence[dict[str, Any]], delimiter: str = ",", names: dict[str, str] | None = None) -> str:
    """Write rows as CSV, columns under other names."""
    header = delimiter.join((names or {}).get(key, key) for key in rows[0])
    lines = [delimiter.join(_cell(value) for value in row.values()) for row in rows]
    return "\n".join([header, *lines]) + "\n"


def _cell(value: Any) -> str:
    return f"{value:.10f}".rstrip("0").rstrip(".") if isinstance(value, float) else str(value)


def fcd_csv(frames: Frames, without: Sequence[str] = (), place: Place = same_place, **changes: Any) -> str:
    """A finished FCD file; ``changes`` are functions of a row that replace a column."""
    rows = []
    for row in fcd_rows(frames, place):
        changed = {key: changes[key](row) if key in changes else value for key, value in row.items()}
        rows.append({key: value for key, value in changed.items() if key not in without})
    return csv_text(rows, ";")


def fcd_xml(frames: Frames, location: str = "", place: Place = same_place) -> str:
    """A finished FCD file as SUMO writes it."""
    steps: dict[float, str] = {}
    for row in fcd_rows(frames, place):
        values = " ".join(f'{key}="{_cell(row[key])}"' for key in FCD_COLUMNS[1:])
        steps[row["time"]] = steps.get(row["time"], "") + f"<vehicle {values}/>"
    body = "\n".join(f'<timestep time="{time:.2f}">{vehicles}</timestep>' for time, vehicles in steps.items())
    return f"<fcd-export>{location}\n{body}\n</fcd-export>\n"


def track_rows(frames: Frames, place: Place = same_place) -> list[dict[str, Any]]:
    """Rows of recorded tracks: centres of boxes, yaw counter-clockwise from east in radians."""
    rows = []
    for number, frame in enumerate(frames):
        for box in frame:
            x, y = place(box.x_m, box.y_m)
            size = {"l": box.length_m, "w": box.width_m, "h": box.height_m}
            row = {"t": number * PERIOD_S, "n": box.name, "x": x, "y": y, "z": box.z_m, "a": box.yaw_rad, **size}
            rows.append({**row, "c": box.kind})
    return rows


TRACK_COLUMNS = {
    "time": "t", "id": "n", "x": "x", "y": "y", "z": "z", "yaw": "a", "length": "l", "width": "w", "height": "h",
    "type": "c",
}  # fmt: skip


def tracks(truth: Truth = STREET, place: Place = same_place, **columns: Any) -> Scene:
    """The street with recorded tracks instead of the finished file; ``columns`` are keys of track_columns."""
    scene = street(truth)
    del scene.config["traffic.fcd"], scene.config["traffic.kinds"], scene.files["fcd.csv"]
    scene.config["traffic.tracks"] = ["tracks.csv"]
    scene.config["traffic.track_columns"] = {**TRACK_COLUMNS, **columns}
    scene.files["tracks.csv"] = csv_text(track_rows(truth.frames, place))
    return scene


def solids(
    prisms: Sequence[Prism],
    zero_m: float = 0.0,
    place: Place = same_place,
    crs: str | None = None,
    **properties: Any,
) -> str:
    """Footprints of GeoJSON; heights count from ``zero_m``."""
    features = []
    for prism in prisms:
        ring = [list(place(*corner)) for corner in [*prism.ring_m, prism.ring_m[0]]]
        heights = {"base_m": prism.foot_m - zero_m, "height_m": prism.roof_m - zero_m}
        geometry = {"type": "Polygon", "coordinates": [ring]}
        features.append(feature(geometry, name=prism.name, kind="building", **heights, **properties))
    return collection(*features, crs=crs)


def polygons(prisms: Sequence[Prism], zero_m: float = 0.0, location: str = "", place: Place = same_place) -> str:
    """A .poly.xml file of SUMO."""
    shapes = ""
    for prism in prisms:
        shape = " ".join("{},{}".format(*place(*corner)) for corner in prism.ring_m)
        heights = {"height": prism.roof_m - zero_m, "min_height": prism.foot_m - zero_m}
        params = "".join(f'<param key="{key}" value="{value}"/>' for key, value in heights.items())
        shapes += f'<poly id="{prism.name}" type="building" fill="1" shape="{shape}">{params}</poly>\n'
    return f"<additional>{location}{shapes}</additional>"


def obj_mesh(prisms: Sequence[Prism], scale: float = 1.0) -> str:
    """A Wavefront file of triangles."""
    text, count = "", 0
    for prism in prisms:
        text += f"o {prism.name}\n"
        for triangle in prism.triangles_m * scale:
            text += "".join("v {:.6f} {:.6f} {:.6f}\n".format(*corner) for corner in triangle)
            text += f"f {count + 1} {count + 2} {count + 3}\n"
            count += 3
    return text


SITE_COLUMNS = ("site", "x_m", "y_m", "z_m", "yaw_deg", "pitch_deg", "roll_deg")


def site_rows(mounts: Sequence[tuple[str, Mount]], place: Place = same_place) -> list[dict[str, Any]]:
    """Rows of a file of sites."""
    rows = []
    for name, mount in mounts:
        x, y = place(mount.x_m, mount.y_m)
        values = (name, x, y, mount.z_m, mount.yaw_deg, mount.pitch_deg, mount.roll_deg)
        rows.append(dict(zip(SITE_COLUMNS, values, strict=True)))
    return rows


def sites(mounts: Sequence[tuple[str, Mount]], place: Place = same_place, names: dict[str, str] | None = None) -> str:
    """A file of sites, columns under other names."""
    return csv_text(site_rows(mounts, place), names=names)


def boxes_of(frames: Frames, name: str) -> list[Box]:
    """The boxes of one vehicle, in order of time."""
    return [box for frame in frames for box in frame if box.name == name]
