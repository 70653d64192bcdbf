"""Sound files of every kind, small and quick, and the scenarios that name them.

Nothing in them depends on the clock, so that a seed gives the same mutants on any day; what the program itself writes
(``run.json``, the store, the study) holds durations, and is the exception.
"""

from __future__ import annotations

import gzip
import io
import json
import re
import shutil
import struct
from collections.abc import Callable
from datetime import date
from functools import cache
from pathlib import Path

import numpy as np
import pyarrow.csv
import pyarrow.parquet as pq

from tests.conftest import SCENARIO, SITES, collection, fcd, feature, write_mini
from tests.extensions.city.conftest import write_city
from tests.extensions.maps.lanelet2_maps import make_crossing
from tests.extensions.tracks.boxes import moving_boxes
from tests.extensions.tracks.writers import TrackRows, write_sind, write_user_table
from tests.formats.workbooks import write_xlsx
from tests.fuzz import read_signals, read_tracks

_KINDS = SCENARIO[SCENARIO.index("[[traffic.kinds]]") : SCENARIO.index("[statics]")]
_TRAFFIC = SCENARIO[SCENARIO.index("[traffic]") : SCENARIO.index("[statics]")]
SUMO = """
vehicles = 3
frames = 30
frame_period_s = 0.5
step_s = 0.5
warmup_s = 10
hold = "at_most"
"""
ROUTES = """<routes>
 <vType id="car" length="4.5" width="1.8" height="1.5" maxSpeed="14" sigma="0.5"/>
 <route id="r" edges="left0A0 A0right0"/>
 <flow id="f" type="car" route="r" begin="0" end="60" period="4" departSpeed="max"/>
 <vehicle id="v" type="car" depart="1"><route edges="bottom0A0 A0top0"/></vehicle>
</routes>
"""
ADDITIONAL = """<additional>
 <vType id="lorry" vClass="truck" length="8" width="2.4" height="3"/>
 <inductionLoop id="d" lane="left0A0_0" pos="-10" freq="10" file="d.xml"/>
 <flow id="g" type="lorry" from="top0A0" to="A0left0" begin="0" end="60" period="15"/>
</additional>
"""
CONFIGURATION = """<configuration>
 <input><net-file value="net.net.xml"/><route-files value="own.rou.xml"/><additional-files value="own.add.xml"/></input>
 <time><begin value="0"/><end value="100"/><step-length value="0.5"/></time>
 <processing><time-to-teleport value="-1"/></processing>
 <output><summary-output value="summary.xml"/></output>
</configuration>
"""
POLYGONS = """<additional>
 <location netOffset="0.00,0.00" convBoundary="0,0,100,100" origBoundary="0,0,100,100" projParameter="!"/>
 <poly id="house" type="building" color="255,0,0" fill="1" layer="1" shape="14,5 18,5 18,8 14,8 14,5">
  <param key="height" value="6"/>
 </poly>
 <poly id="lawn" type="landuse.grass" shape="0,0 5,0 5,5" layer="0"/>
 <poi id="tree" type="natural.tree" x="22" y="-5"/>
</additional>
"""
BEAMS = "elevation_deg,azimuth_deg\n" + "".join(
    f"{elevation},{azimuth}\n" for azimuth in range(0, 360, 6) for elevation in (-15, -10, -5, 0, 5)
)
VTYPES = '<additional>\n <vType id="car" length="4.5" width="1.8" height="1.5" vClass="passenger"/>\n</additional>\n'
GEOJSON_SITES = collection(
    feature({"type": "Point", "coordinates": [10, 12, 3]}, name="pole_a", owner="city"),
    feature({"type": "Point", "coordinates": [30.5, -12]}, name="pole_b", z_m=3, yaw_deg=90),
)


def mini(folder: Path, *changes: tuple[str, str]) -> Path:
    """The scenario that all tests share, with parts of its text replaced; its folder."""
    made = write_mini(folder / "scenario")
    text = SCENARIO
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new)
    (made / "scenario.toml").write_text(text)
    return made


# ---- traffic


@cache
def network() -> bytes:
    """One crossing with lights, without the date that SUMO puts into its head."""
    import tempfile

    from egvs.traffic import sumo

    with tempfile.TemporaryDirectory() as folder:
        flags = [
            "--grid",
            "--grid.number",
            "1",
            "--grid.attach-length",
            "100",
            "--default-junction-type",
            "traffic_light",
        ]
        sumo.run_program("netgenerate", [*flags, "--offset.disable-normalization", "-o", "net.net.xml"], Path(folder))
        return re.sub(rb"<!--.*?-->\s*", b"", (Path(folder) / "net.net.xml").read_bytes(), flags=re.DOTALL)


def _simulated(folder: Path, source: str) -> Path:
    """With SUMO; the crossing's middle is at 100, 100."""
    kinds = _KINDS if source == 'network = "net.net.xml"' or source.endswith('gz"') else ""
    made = mini(folder, (_TRAFFIC, f"[traffic]\n{source}{SUMO}{kinds}"),
                ("center_m = [20, 0, 2.5]", "center_m = [100, 100, 2.5]"), ("blocks = 4", "blocks = 3"))  # fmt: skip
    (made / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,110,112,3\npole_b,88,88,3\n")
    for name, content in (("own.rou.xml", ROUTES), ("own.add.xml", ADDITIONAL), ("own.sumocfg", CONFIGURATION)):
        (made / name).write_text(content)
    (made / "net.net.xml").write_bytes(network())
    return made


def drawn(folder: Path) -> None:
    """Drawn trips on a network."""
    _simulated(folder, 'network = "net.net.xml"')


def terrain(folder: Path) -> None:
    """The same, in a hollow: points of the ground beyond the roads."""
    made = _simulated(folder, 'network = "net.net.xml"')
    text = (made / "scenario.toml").read_text()
    (made / "scenario.toml").write_text(text.replace("[statics]\n", '[statics]\nterrain = "terrain.ply"\n'))
    lines = [f"{x} {y} {max(abs(x - 100), abs(y - 100)) / 50}" for x in range(0, 201, 20) for y in range(0, 201, 20)]
    head = f"ply\nformat ascii 1.0\nelement vertex {len(lines)}\n"
    properties = "".join(f"property double {axis}\n" for axis in "xyz")
    (made / "terrain.ply").write_text(head + properties + "end_header\n" + "\n".join(lines) + "\n")


def drawn_gz(folder: Path) -> None:
    """The same, gzipped."""
    made = _simulated(folder, 'network = "net.net.xml.gz"')
    (made / "net.net.xml.gz").write_bytes(gzip.compress(network(), mtime=0))


def routed(folder: Path) -> None:
    """A network with routes."""
    _simulated(folder, 'network = "net.net.xml"\nroutes = ["own.rou.xml"]')


_PHASES = """phase,approach,movement,green_s
1,south,all,20
1,north,all,20
2,east,all,15
2,west,all,15
"""


def signalled(name: str):
    """A plan of signals in a file: a table, or a program of SUMO."""

    def make(folder: Path) -> None:
        made = _simulated(folder, 'network = "net.net.xml"')
        text = (made / "scenario.toml").read_text()
        (made / "scenario.toml").write_text(
            text.replace("[[traffic.kinds]]", f'[traffic.signals.A0]\nfile = "{name}"\n\n[[traffic.kinds]]')
        )
        program = re.search(rb"<tlLogic.*?</tlLogic>", network(), flags=re.DOTALL)
        assert program
        xml = b"<additional>\n" + program[0] + b"\n</additional>\n"
        (made / name).write_bytes(_PHASES.encode() if name.endswith(".csv") else xml)

    return make


def observed(folder: Path) -> None:
    """Counts, and what was observed of queues and speeds."""
    made = _simulated(folder, 'network = "net.net.xml"')
    counts = "".join(
        f'[[traffic.counts]]\nedge = "{edge}"\nper_hour = 300\n\n' for edge in ("left0A0", "top0A0", "right0A0")
    )
    text = (made / "scenario.toml").read_text().replace("[traffic]\n", '[traffic]\nobserved = "observed.csv"\n')
    text = text.replace("vehicles = 3\n", "").replace('hold = "at_most"\n', "")
    (made / "scenario.toml").write_text(text.replace("[[traffic.kinds]]", counts + "[[traffic.kinds]]"))
    (made / "observed.csv").write_text("approach,queue_m,speed_kmh\nwest,10,30\nnorth,12.5,\neast,,35\n")


def located(name: str):
    """The crossing in UTM, and sites in a format of GIS programs."""

    def make(folder: Path) -> None:
        import geopandas
        from shapely.geometry import Point

        made = _simulated(folder, 'network = "net.net.xml"')
        (made / "net.net.xml").write_bytes(roads())
        text = (made / "scenario.toml").read_text()
        (made / "scenario.toml").write_text(text.replace('"sites.csv"', f'"{name}"'))
        east_m, north_m = _utm_m(_LAT, _LON)
        places = [Point(east_m + x, north_m + y) for x, y in ((10, 12), (-12, -12))]
        values = {"name": ["pole_a", "pole_b"], "z_m": [3.0, 3.0]}
        frame = geopandas.GeoDataFrame(values, geometry=places, crs="EPSG:32632")
        (frame.to_parquet if name.endswith("parquet") else frame.to_file)(made / name)

    return make


def priced(folder: Path) -> None:
    """Sites with costs and poles, for a plan."""
    made = mini(folder, ("[score]", "[placement]\nbudget = 3\n\n[score]"))
    rows = "pole_a,10,12,3,2,yes\npole_b,30.5,-12,3,1,no\npole_c,20,12,3,1.5,no\n"
    (made / "sites.csv").write_text("site,x_m,y_m,z_m,cost,owner\n" + rows)


def configured(folder: Path) -> None:
    """A configuration of SUMO, with routes and additional files."""
    _simulated(folder, 'sumocfg = "own.sumocfg"')


def finished(form: str):
    """A finished file in one of the forms that SUMO writes, maybe gzipped."""

    def make(folder: Path) -> None:
        made = mini(folder, ('"fcd.csv"', f'"fcd.{form}"'))
        (made / "fcd.csv").unlink()
        (made / f"fcd.{form}").write_bytes(_fcd(form))

    return make


def _fcd(form: str) -> bytes:
    if form.endswith(".gz"):
        return gzip.compress(_fcd(form.removesuffix(".gz")), mtime=0)
    if form == "csv":
        return fcd().encode()
    table = pyarrow.csv.read_csv(io.BytesIO(fcd().encode()), parse_options=pyarrow.csv.ParseOptions(delimiter=";"))
    if form == "parquet":
        pq.write_table(table, out := io.BytesIO())
        return out.getvalue()
    lines = ["<fcd-export>"]
    for i, row in enumerate(table.to_pylist()):
        if i % 2 == 0:
            lines.append(f' <timestep time="{row["timestep_time"]:.2f}">')
        own = {key.removeprefix("vehicle_"): value for key, value in row.items() if key != "timestep_time"}
        lines.append("  <vehicle " + " ".join(f'{key}="{value}"' for key, value in own.items()) + "/>")
        if i % 2:
            lines.append(" </timestep>")
    return "\n".join([*lines, "</fcd-export>", ""]).encode()


def typed(folder: Path) -> None:
    """A finished file whose sizes stand in a file of vTypes."""
    made = mini(folder, (_KINDS, ""), ('fcd = "fcd.csv"', 'fcd = "fcd.csv"\nvtypes = ["own.add.xml"]'))
    (made / "own.add.xml").write_text(VTYPES)


def tracks(write: Callable[[Path, TrackRows], Path], *classes: str, straight: bool = False) -> Callable[[Path], None]:
    """Recorded tracks of two road users of each class, in one format."""

    def make(folder: Path) -> None:
        (folder / "tracks").mkdir()
        write(folder / "tracks", moving_boxes(classes, n_frames=20, straight=straight))

    return make


def zipped_tracks(folder: Path) -> None:
    """Tracks of SinD, gzipped."""
    tracks(write_sind, "car", "pedestrian")(folder)
    path = folder / "tracks" / "Veh_smoothed_tracks.csv"
    path.with_name(f"{path.name}.gz").write_bytes(gzip.compress(path.read_bytes(), mtime=0))
    path.unlink()


def mapped_tracks(json_lines: bool) -> Callable[[Path], None]:
    """A user's own table of tracks."""

    def write(folder: Path, boxes: TrackRows) -> Path:
        return write_user_table(folder, boxes, read_tracks.MAPPING, json_lines)

    return tracks(write, "car", "pedestrian")


def named_columns(folder: Path) -> None:
    """A network, a user's own table of tracks, and the names of its columns."""
    boxes = moving_boxes(("car", "pedestrian"), n_frames=20)
    path = write_user_table(folder, boxes, read_tracks.MAPPING, False)
    path.rename(folder / "tracks.csv")
    values = read_tracks.MAPPING.model_dump(exclude_defaults=True, exclude_none=True)
    lines = [f"{key} = {json.dumps(value)}" for key, value in values.items() if not isinstance(value, dict)]
    lines += ["[types]", *(f"{key} = {json.dumps(value)}" for key, value in values.get("types", {}).items())]
    (folder / "columns.toml").write_text("\n".join([*lines, ""]))


def signals(folder: Path) -> None:
    """Recorded signals in both formats, and both kinds of files that say what they govern."""
    target = folder / "signals"
    target.mkdir()
    rows = [
        f"{group},{100 * k},{'PERMISSIVE_MOVEMENT_ALLOWED' if (k + 200 * group) % 400 < 100 else 'STOP_AND_REMAIN'}"
        for group in (1, 2) for k in range(0, 1000, 10)
    ]  # fmt: skip
    (target / "states.csv").write_text("\n".join(["signal_group_id,timestamp_ms,movement_state", *rows, ""]))
    lights = ["RawFrameID,timestamp(ms),Vehicle Traffic light 1,Vehicle Traffic light 2"]
    lights += [
        f"{300 * number},{10000.5 * number},{states}"
        for number, states in enumerate(("1,0", "3,0", "0,0", "0,1", "0,3", "0,0") * 4)
    ]
    (target / "lights.csv").write_text("\n".join([*lights, ""]))
    (target / "groups.csv").write_text("group,from_edge,to_edge\n1,in,out\n2,in,north\n")
    names = [f"Vehicle Traffic light {number},in,{end}" for number, end in ((1, "out"), (2, "north"))]
    (target / "light_groups.csv").write_text("\n".join(["group,from_edge,to_edge", *names, ""]))
    lanes = [("1", "2, 3", "1, 2", ((-12, 1), (-100, 1))), ("2", "", "", ((12, 1), (100, 1))),
             ("3", "", "", ((1, 12), (1, 100)))]  # fmt: skip
    (target / "map.kml").write_text(read_signals.kml(lanes))


# ---- static world


def polygons(folder: Path) -> None:
    """SUMO's polygons."""
    made = mini(folder, ('footprints = ["statics.geojson"]', 'polygons = ["own.poly.xml"]'))
    (made / "own.poly.xml").write_text(POLYGONS)


def _box():
    import trimesh

    box = trimesh.creation.box((4.0, 3.0, 6.0))
    box.apply_translation((16.0, 6.5, 3.0))
    return box


_MTL = b"newmtl wall\nKd 0.5 0.5 0.5\nmap_Kd wall.png\n"


def mesh(name: str):
    """A house as a mesh; its scenario names the file ``name``."""

    def make(folder: Path) -> None:
        made = mini(folder, ('footprints = ["statics.geojson"]', f'meshes = [{{ file = "{name}" }}]'))
        box, form = _box(), name.rpartition(".")[2]
        if form == "obj":
            corners = "".join(f"v {x} {y} {z}\n" for x, y, z in box.vertices)
            triangles = "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in box.faces)
            (made / name).write_text(f"mtllib house.mtl\no house\n{corners}usemtl wall\n{triangles}")
            (made / "house.mtl").write_bytes(_MTL)
        elif form == "gltf":
            (made / name).write_text(json.dumps(_gltf(box, "house.bin"), indent=1))
            (made / "house.bin").write_bytes(_buffer(box))
        elif form == "glb":
            (made / name).write_bytes(_glb(box))
        else:
            box.export(made / name)

    return make


def _buffer(box) -> bytes:
    return box.vertices.astype("<f4").tobytes() + box.faces.astype("<u2").tobytes()


def _gltf(box, uri: str) -> dict:
    points, corners = len(box.vertices), box.faces.size
    buffer = {"byteLength": len(_buffer(box))} | ({"uri": uri} if uri else {})
    low, high = (list(map(float, bound)) for bound in box.bounds)
    return {
        "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}], "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1, "mode": 4}]}], "buffers": [buffer],
        "bufferViews": [{"buffer": 0, "byteOffset": 0, "byteLength": 12 * points},
                        {"buffer": 0, "byteOffset": 12 * points, "byteLength": 2 * corners}],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": points, "type": "VEC3", "min": low,
                       "max": high},
                      {"bufferView": 1, "componentType": 5123, "count": corners, "type": "SCALAR"}],
    }  # fmt: skip


def _glb(box) -> bytes:
    text, body = json.dumps(_gltf(box, "")).encode(), _buffer(box)
    text, body = text + b" " * (-len(text) % 4), body + b"\0" * (-len(body) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


# ---- sites, sensors, scans


def sites(folder: Path) -> None:
    """Sites as GeoJSON."""
    made = mini(folder, ('"sites.csv"', '"sites.geojson"'))
    (made / "sites.geojson").write_text(GEOJSON_SITES)


def in_workbook(folder: Path) -> None:
    """Sites in a workbook."""
    made = mini(folder, ('"sites.csv"', '"sites.xlsx"'))
    rows = [line.split(",") for line in (made / "sites.csv").read_text().splitlines()]
    write_xlsx(made / "sites.xlsx", {"Sites": rows})


def beams(folder: Path) -> None:
    """A sensor with a table of beams."""
    made = mini(folder, ("elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n", 'beams = "beams.csv"\n'))
    (made / "beams.csv").write_text(BEAMS)


def metadata(folder: Path) -> None:
    """A sensor with the metadata of an Ouster."""
    rings = "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n"
    made = mini(folder, (rings, 'beams = "metadata.json"\n'))
    beams = {"beam_altitude_angles": [5.0, -5.5, -15.0], "beam_azimuth_angles": [1.5, 0.0, -1.5]}
    text = {"beam_intrinsics": beams, "lidar_data_format": {"columns_per_frame": 512, "column_window": [0, 511]}}
    (made / "metadata.json").write_text(json.dumps(text))


def _beam_file(keys: str, text: str):
    """A sensor of which a file states the beams."""
    rings = "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n"

    def make(folder: Path) -> None:
        made = mini(folder, (rings, keys))
        (made / "beams.csv").write_text(text)

    return make


ring_table = _beam_file(
    'beams = "beams.csv"\nazimuth_step_deg = 1.0\n',
    "elevation_deg,azimuth_offset_deg,vertical_offset_m\n5,1.5,0.02\n-5.5,0,0.01\n-15,-1.5,0\n",
)
"""A sensor with a table of rings."""

robosense = _beam_file('beams = "beams.csv"\nazimuth_step_deg = 1.0\n', "5.0,1.5\n-5.5,0.0\n-15.0,-1.5\n")
"""A sensor with the angles of a RoboSense."""

directions = _beam_file(
    'pattern = {kind = "file", file = "beams.csv", samples = 3000}\n',
    "elevation_deg,azimuth_deg,dwell_s\n"
    + "".join(f"{e},{a},{0.1 + 0.01 * abs(e)}\n" for a in range(0, 360, 6) for e in (-15, -10, -5, 0)),
)
"""A sensor whose pattern does not repeat, with the directions of a Livox."""


def angles(folder: Path) -> None:
    """A sensor with the angle correction of a Hesai."""
    rings = "elevations_deg = [-15, 5]\nchannels = 8\nazimuth_step_deg = 1.0\n"
    made = mini(folder, (rings, 'beams = "angles.csv"\nazimuth_step_deg = 1.0\n'))
    (made / "angles.csv").write_text("Laser id,Elevation,Azimuth\n1,5.0,1.5\n2,-5.5,0.0\n3,-15.0,-1.5\n")


def _points() -> np.ndarray:
    """Returns of a scan from (10, 12, 3): the ground along rings."""
    azimuth = np.deg2rad(np.arange(0, 360, 3))
    rings = [np.column_stack([10 + r * np.cos(azimuth), 12 + r * np.sin(azimuth), 0 * azimuth]) for r in (6, 9, 14, 25)]
    return np.round(np.concatenate(rings), 3)


def measured(name: str):
    """A measured empty scan of the only site."""

    def make(folder: Path) -> None:
        made = mini(folder, ('sensor = "small"', f'sensor = "small"\npoints = "{name}"'))
        (made / "sites.csv").write_text("".join(SITES.splitlines(keepends=True)[:2]))
        write_cloud(made / name)

    return make


def write_cloud(path: Path, points: np.ndarray | None = None) -> None:
    """Write points, by default of the ground, in the format that the suffix names, maybe gzipped."""
    points, form = _points() if points is None else points, path.suffix.removeprefix(".")
    if form == "gz":
        plain = path.with_suffix("")
        write_cloud(plain, points)
        path.write_bytes(gzip.compress(plain.read_bytes(), mtime=0))
        return
    if form == "e57":
        from tests.formats.test_e57 import NO_TURN, cartesian, write_e57

        station = np.array([10.0, 12.0, 3.0])
        write_e57(path, (cartesian(*(points - station)), NO_TURN, station))
        return
    if form in ("las", "laz"):
        import laspy

        header = laspy.LasHeader(version="1.4", point_format=6)
        header.scales, header.creation_date = [0.001] * 3, date(2020, 1, 1)
        cloud = laspy.LasData(header)
        cloud.x, cloud.y, cloud.z = points.T
        cloud.write(path)
        return
    rows = "".join(f"{x:g},{y:g},{z:g}\n" for x, y, z in points)
    if form == "csv":
        path.write_text("x_m,y_m,z_m\n" + rows, encoding="utf-8")
    elif path.stem == "binary":
        from egvs.formats.point_clouds import write_points

        write_points(path, points)
    elif form == "pcd":
        fields = "# .PCD v0.7\nVERSION 0.7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\n"
        head = f"{fields}WIDTH {len(points)}\nHEIGHT 1\nVIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA ascii\n"
        path.write_text(head + rows.replace(",", " "), encoding="utf-8")
    else:
        properties = "".join(f"property double {axis}\n" for axis in "xyz")
        head = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n{properties}end_header\n"
        path.write_text(head + rows.replace(",", " "), encoding="utf-8")


def recording(name: str):
    """Two sweeps of a LiDAR: a recording of ROS with times of points, or a capture of a VLP-16 that turns fast."""

    def make(folder: Path) -> None:
        from tests.extensions.hardware.fit.small_sensor import TRUTH, coarse_sensor, sweep_of
        from tests.extensions.hardware.recordings.ros_recordings import write_recording
        from tests.extensions.hardware.recordings.velodyne_packets import packets, write_pcap

        if name.endswith(".pcap"):
            rng = np.random.default_rng(0)

            def yard(azimuth_deg, elevation_deg):
                azimuth, elevation = np.radians(azimuth_deg), np.radians(elevation_deg)
                with np.errstate(divide="ignore"):
                    walls = np.minimum(20.0 / np.abs(np.cos(azimuth)), 24.0 / np.abs(np.sin(azimuth)))
                    ground = np.where(elevation < 0, -2.0 / np.sin(elevation), np.inf)
                return np.minimum(walls / np.cos(elevation), ground) + rng.normal(0.0, 0.01, azimuth.shape)

            write_pcap(folder / name, packets(yard, turns=2.1, rotation_hz=20.0))
            return
        times = np.repeat(np.arange(300), 10) * 0.1 / 300
        clouds = [(1000.0 + 0.1 * i, sweep_of(TRUTH, coarse_sensor(), seed=i), times) for i in range(2)]
        write_recording(folder / name, clouds)

    return make


def sweep(name: str):
    """A sweep of a LiDAR with ten channels, in the format that the suffix names, maybe gzipped."""

    def make(folder: Path) -> None:
        from egvs.formats.point_clouds import write_points
        from tests.extensions.hardware.fit.small_sensor import TRUTH, coarse_sensor, sweep_of

        points = sweep_of(TRUTH, coarse_sensor())
        path = folder / name.removesuffix(".gz")
        if path.suffix == ".npz":
            np.savez(path, sweep=points)
        elif path.suffix == ".csv":
            rows = "".join(f"{x:.4f},{y:.4f},{z:.4f}\n" for x, y, z in points if np.isfinite(x))
            path.write_text("x_m,y_m,z_m\n" + rows, encoding="utf-8")
        else:
            write_points(path, points)
        if name.endswith(".gz"):
            (folder / name).write_bytes(gzip.compress(path.read_bytes(), mtime=0))

    return make


CARS = np.array([[9.0, 3.0, -2.25, 4.4, 1.8, 1.5, 0.0], [-10.0, -4.0, -2.25, 4.4, 1.8, 1.5, 0.0]])
"""Boxes of two cars below a sensor 3 m above the ground: centre, size and heading."""


def labelled(form: str):
    """Two sweeps of two cars, and their labels in one format."""

    def make(folder: Path) -> None:
        from egvs.formats import pcd
        from tests.extensions.validation.measured import twin

        mini(folder, ("elevations_deg = [-15, 5]\nchannels = 8", "elevations_deg = [-20, -3]\nchannels = 8"))
        (folder / "labels").mkdir()
        made = twin.Twin([_sweep_of_cars(0.0), _sweep_of_cars(0.5)], [CARS, CARS + np.eye(7)[0] / 2])
        (folder / "sweeps").mkdir()
        for number, points_m in enumerate(made.points_m):
            pcd.write(folder / "sweeps" / f"sweep{number}.pcd", points_m)
        if form == "csv":
            twin.write_table(folder / "labels" / "labels.csv", made)
        else:
            write = {"openlabel": twin.write_openlabel, "dair": twin.write_dair, "kitti": twin.write_kitti}[form]
            write(folder / "labels", made)

    return make


def _sweep_of_cars(x_m: float) -> np.ndarray:
    """Returns of a sensor above level ground with :data:`CARS`, which have moved by ``x_m``."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.0, 360.0)), np.radians(np.linspace(-20, -3, 8)))
    rays = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], -1)
    rays = rays.reshape(-1, 3)
    range_m = -3.0 / rays[:, 2]
    for x, y, z, *size, _ in CARS.tolist():
        centre, half = np.array([x + x_m, y, z]), np.array(size) / 2
        with np.errstate(divide="ignore"):
            near = np.sort(np.stack([(centre - half) / rays, (centre + half) / rays]), axis=0)
        enters, leaves = near[0].max(axis=1), near[1].min(axis=1)
        range_m = np.where((enters < leaves) & (enters > 0), np.minimum(range_m, enters), range_m)
    return rays * range_m[:, None]


def binary_sweep(folder: Path) -> None:
    """A sweep in KITTI's format."""
    from tests.extensions.hardware.fit.small_sensor import TRUTH, coarse_sensor, sweep_of

    points = sweep_of(TRUTH, coarse_sensor())
    points = points[np.isfinite(points[:, 0])]
    np.column_stack([points, np.zeros(len(points))]).astype("<f4").tofile(folder / "sweep.bin")


def calibrated(folder: Path) -> None:
    """A sweep, and a calibration of the pose."""
    sweep("sweep.pcd")(folder)
    matrix = [[1.0, 0.0, 0.0, 5.0], [0.0, 1.0, 0.0, 7.0], [0.0, 0.0, 1.0, 6.0], [0.0, 0.0, 0.0, 1.0]]
    (folder / "calibration.json").write_text(json.dumps({"transformation_matrix_into_map": matrix}))


# ---- maps


SMALL_OSM = Path(__file__).parents[1] / "creation" / "data" / "small.osm"


def extract(name: str):
    """An extract of a map, beside no scenario."""

    def make(folder: Path) -> None:
        if name.endswith(".pbf"):
            from tests.formats.test_osm import pbf_of

            pbf_of(SMALL_OSM, folder / name)
        elif name.endswith(".gz"):
            (folder / name).write_bytes(gzip.compress(SMALL_OSM.read_bytes(), mtime=0))
        else:
            shutil.copyfile(SMALL_OSM, folder / name)

    return make


def lanelets(name: str):
    """A Lanelet2 map of a crossing, beside no scenario."""

    def make(folder: Path) -> None:
        path = make_crossing(tags={"speed_limit": "50"}).writer.write(folder / "lanelets.osm")
        if name.endswith(".gz"):
            (folder / name).write_bytes(gzip.compress(path.read_bytes(), mtime=0))
            path.unlink()

    return make


def projected(folder: Path) -> None:
    """The same, and the projection of a map of Autoware beside it."""
    lanelets("lanelets.osm")(folder)
    origin = "  latitude: 49.0\n  longitude: 8.4\n  altitude: 0.0\n"
    text = f"projector_type: LocalCartesian\nvertical_datum: WGS84\nmap_origin:\n{origin}"
    (folder / "map_projector_info.yaml").write_text(text)


def counted(folder: Path) -> None:
    """An extract of a map, and counts of its junction."""
    extract("map.osm")(folder)
    rows = [f"{side},{start},{60 + number}" for number, side in enumerate("NSEW") for start in ("07:00", "07:15")]
    (folder / "counts.csv").write_text("\n".join(["approach,start,count", *rows, ""]))


def surfaced(folder: Path) -> None:
    """The crossing with its terrain and a house without a height, and a surface model that has it."""
    on_terrain("terrain.asc")(folder)
    vectors("houses.geojson", height=None)(folder)
    text = (folder / "terrain.asc").read_text()
    (folder / "surface.asc").write_text(re.sub(r"\b(4\d)\.", lambda match: f"{int(match[1]) + 9}.", text))
    shutil.copyfile(folder / "terrain.prj", folder / "surface.prj")


_LAT, _LON = 52.0, 10.0
"""Where the signals of the crossing in :func:`roads` are."""


def _utm_m(lat: float, lon: float) -> tuple[float, float]:
    from pyproj import Transformer

    return Transformer.from_crs("EPSG:4326", "EPSG:32632").transform(lat, lon)


@cache
def roads() -> bytes:
    """The crossing with lights, in UTM."""
    east_m, north_m = _utm_m(_LAT, _LON)
    projection = "+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"
    offset = f'netOffset="{100 - east_m:.2f},{100 - north_m:.2f}"'
    text, count = re.subn(rb'netOffset="[^"]*"', offset.encode(), network())
    assert count == 1
    return re.sub(rb'projParameter="[^"]*"', f'projParameter="{projection}"'.encode(), text)


@cache
def roads_as_opendrive() -> bytes:
    """The same crossing as OpenDRIVE, without the date of its header."""
    import tempfile

    from egvs.traffic import sumo

    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "roads.net.xml").write_bytes(roads())
        sumo.run_program("netconvert", ["-s", "roads.net.xml", "--opendrive-output", "roads.xodr"], Path(folder))
        text = re.sub(rb"<!--.*?-->\s*", b"", (Path(folder) / "roads.xodr").read_bytes(), flags=re.DOTALL)
    return re.sub(rb' date="[^"]*"', b"", text)


def road_map(name: str):
    """A map of the crossing alone."""

    def make(folder: Path) -> None:
        (folder / name).write_bytes(roads_as_opendrive() if ".xodr" in name else roads())

    return make


def surveyed(name: str):
    """The crossing, and beside it a point cloud without a reference system: its ground, and the wall of a house."""

    def make(folder: Path) -> None:
        (folder / "roads.net.xml").write_bytes(roads())
        x, y = (part.ravel() for part in np.meshgrid(np.arange(-20.0, 21.0, 2.0), np.arange(-20.0, 21.0, 2.0)))
        along, up = (part.ravel() for part in np.meshgrid(np.arange(0.0, 8.0, 0.5), np.arange(0.5, 6.0, 0.5)))
        wall = np.column_stack([12 + along, np.full(len(up), 12.0), up])
        write_cloud(folder / name, np.round(np.concatenate([np.column_stack([x, y, 0.01 * x]), wall]), 3))

    return make


def modelled(name: str):
    """The crossing, and beside it a mesh of a house in local metres."""

    def make(folder: Path) -> None:
        (folder / "roads.net.xml").write_bytes(roads())
        box, form = _box(), name.rpartition(".")[2]
        if form == "glb":
            (folder / name).write_bytes(_glb(box))
        elif form == "gltf":
            (folder / name).write_text(json.dumps(_gltf(box, "house.bin"), indent=1))
            (folder / "house.bin").write_bytes(_buffer(box))
        else:
            box.export(folder / name)

    return make


def on_terrain(name: str):
    """The crossing, and beside it its terrain, which rises to the north."""

    def make(folder: Path) -> None:
        from tests.extensions.maps.formats.test_landxml import landxml
        from tests.extensions.maps.formats.test_rasters import write_tiff

        (folder / "roads.net.xml").write_bytes(roads())
        east_m, north_m = (round(value) for value in _utm_m(_LAT, _LON))
        count, cell_m = 26, 20
        west_m, south_m = east_m - 260, north_m - 260
        rows = [[f"{40 + 0.2 * (count - row):.1f}"] * count for row in range(count)]
        if name.endswith(".asc"):
            head = f"ncols {count}\nnrows {count}\nxllcorner {west_m}\nyllcorner {south_m}\ncellsize {cell_m}\n"
            (folder / name).write_text(head + "".join(" ".join(row) + "\n" for row in rows))
            (folder / name).with_suffix(".prj").write_text("EPSG:32632")
        elif name.endswith(".tif"):
            import rasterio

            transform = rasterio.Affine(cell_m, 0, west_m, 0, -cell_m, south_m + count * cell_m)
            write_tiff(folder / name, np.array(rows, dtype="float32"), transform=transform, crs="EPSG:32632")
        else:
            corners = [
                (south_m, west_m),
                (south_m, west_m + 520),
                (south_m + 520, west_m + 520),
                (south_m + 520, west_m),
            ]
            points = "".join(
                f'<P id="{number}">{north} {east} {40 + 0.01 * (north - south_m):g}</P>'
                for number, (north, east) in enumerate(corners, 1)
            )
            head = '<Units><Metric linearUnit="meter"/></Units><CoordinateSystem epsgCode="32632"/>'
            (folder / name).write_text(landxml("<F>1 2 3</F><F>1 3 4</F>", head, points))

    return make


def vectors(name: str, height: float | None = 8.5):
    """The crossing, and beside it the outline of a house in a format of GIS programs."""

    def make(folder: Path) -> None:
        import geopandas
        from shapely.geometry import box

        (folder / "roads.net.xml").write_bytes(roads())
        east_m, north_m = _utm_m(_LAT, _LON)
        outline = box(east_m + 20, north_m + 20, east_m + 32, north_m + 30)
        frame = geopandas.GeoDataFrame({"name": ["h"], "height": [height]}, geometry=[outline], crs="EPSG:32632")
        if name.endswith("parquet"):
            frame.to_parquet(folder / name)
        elif name.endswith("kml"):
            degrees = frame.to_crs("OGC:CRS84").geometry.iloc[0].exterior.coords
            corners = " ".join(f"{x:.7f},{y:.7f},0" for x, y, *_ in degrees)
            ring = f"<LinearRing><coordinates>{corners}</coordinates></LinearRing>"
            outline = f"<Polygon><outerBoundaryIs>{ring}</outerBoundaryIs></Polygon>"
            (folder / name).write_text(
                '<?xml version="1.0" encoding="UTF-8"?>\n<kml xmlns="http://www.opengis.net/kml/2.2"><Document>'
                f"<Placemark><name>h</name>{outline}</Placemark></Document></kml>\n"
            )
        else:
            frame.to_file(folder / name)

    return make


def with_roads_map(name: str):
    """A map of roads, and beside it a file with a house north-east of the signals, and a lamp or a ground."""
    from tests.extensions.maps.formats import small_city_models as models

    lat, lon = 52.0006, 10.0008
    corners = [(lat, lon), (lat, lon + 2e-4), (lat + 1e-4, lon + 2e-4), (lat + 1e-4, lon)]
    floor, roof = ([(*corner, z_m) for corner in corners] for z_m in (40.0, 48.5))
    walls = [[floor[i], floor[i - 3], roof[i - 3], roof[i]] for i in range(4)]
    crs84 = [[[north_east[1], north_east[0]] for north_east in (*corners, corners[0])]]

    def gml() -> str:
        house = models.solid([models.polygon(ring) for ring in (floor[::-1], roof, *walls)])
        foot = models.multi_surface([models.polygon([(lat - 0.0012, x[1], 0.0) if i < 2 else (lat - 0.0013, x[1], 0.0)
                                                     for i, x in enumerate(corners)])])  # fmt: skip
        storeys = "<x:storeysAboveGround>3</x:storeysAboveGround>"
        return models.city_model(
            models.city_object("Building", "h", models.nest(house, "lod1Solid")),
            models.city_object("Building", "f", storeys, models.nest(foot, "lod0FootPrint")),
            srs_name="EPSG:4326",
        )

    def dem() -> str:
        cells = [(i, j) for i in range(-9, 9) for j in range(-9, 9)]
        triangles = []
        for i, j in cells:
            square = [
                (52 + (i + a) * 5e-4, 10 + (j + b) * 8e-4, 40.0 + 0.1 * (i + a))
                for a, b in ((0, 0), (0, 1), (1, 1), (1, 0))
            ]
            triangles += [models.polygon(half, tag="Triangle") for half in (square[:3], [square[0], *square[2:]])]
        tin = models.nest("".join(triangles), "reliefComponent", "TINRelief", "tin", "TriangulatedSurface", "patches")
        return models.city_model(models.city_object("ReliefFeature", "r", tin), srs_name="EPSG:4326")

    def city_json() -> str:
        points = [*floor, *roof]
        sides = [[i, (i + 1) % 4, (i + 1) % 4 + 4, i + 4] for i in range(4)]
        shell = [[ring] for ring in ([3, 2, 1, 0], [4, 5, 6, 7], *sides)]
        solid = {"type": "Solid", "lod": "1.2", "boundaries": [shell]}
        scale = [1e-7, 1e-7, 0.001]
        return json.dumps({
            "type": "CityJSON", "version": "2.0", "transform": {"scale": scale, "translate": [0, 0, 0]},
            "metadata": {"referenceSystem": "https://www.opengis.net/def/crs/EPSG/0/4326"},
            "CityObjects": {"h": {"type": "Building", "geometry": [solid]}},
            "vertices": [[round(value / unit) for value, unit in zip(point, scale, strict=True)] for point in points],
        })  # fmt: skip

    def footprints() -> str:
        return collection(feature({"type": "Polygon", "coordinates": crs84}, name="h", height=8.5), crs="OGC:CRS84")

    texts = {"city.gml": gml, "dem.gml": dem, "city.json": city_json, "houses.geojson": footprints}

    def make(folder: Path) -> None:
        (folder / "roads.net.xml").write_bytes(roads())
        (folder / name).write_text(texts[name](), encoding="utf-8")

    return make


def wanted(folder: Path) -> None:
    """A map and a table of the junctions that are wanted of it, beside no scenario."""
    extract("map.osm")(folder)
    (folder / "wanted.csv").write_text("junction,lat_deg,lon_deg\ncross,52.0,10.0\n")


def city(folder: Path) -> None:
    """A city of two junctions, whose traffic is a finished file."""
    write_city(folder / "town")


# ---- what scenarios name beside


def heir(folder: Path) -> None:
    """A scenario that extends another; that other is mutated."""
    made = mini(folder)
    (made.parent / "heir").mkdir()
    (made.parent / "heir" / "scenario.toml").write_text('extends = "../scenario"\n[score]\ngamma = 5\n')


def visible(folder: Path) -> None:
    """Hits of voxels are kept."""
    mini(folder, ("gamma = 4", 'gamma = 4\nkeep_visibility = "all"'))


def plain(folder: Path) -> None:
    """The scenario as it is."""
    mini(folder)
