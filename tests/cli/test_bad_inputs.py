"""Every wrong input is answered with one message of its own, exit code 2, and nothing written."""

from __future__ import annotations

import gzip
import json
import math
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from egvs.artefacts.checksums import add_checksum
from egvs.cli import options
from egvs.core.errors import InputError
from tests.conftest import BUILDING, collection, fcd, feature

Change = Callable[[Path], object]


def edit(old: str, new: str, name: str = "scenario.toml") -> Change:
    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return change


def add(text: str) -> Change:
    return lambda folder: (folder / "scenario.toml").write_text((folder / "scenario.toml").read_text() + text)


def put(name: str, content: str | bytes, *also: Change) -> Change:
    def change(folder: Path) -> None:
        (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
        for other in also:
            other(folder)

    return change


def remove(name: str) -> Change:
    return lambda folder: (folder / name).unlink()


def statics(*features: dict) -> Change:
    return put("statics.geojson", collection(*features))


def polygon(*rings: list[list[float]], **properties: object) -> dict:
    return feature({"type": "Polygon", "coordinates": list(rings)}, **{"height_m": 5, **properties})


def sites(*rows: str, head: str = "site,x_m,y_m,z_m") -> Change:
    return put("sites.csv", "\n".join([head, *rows]) + "\n")


def traffic(line: str) -> Change:
    """Replace the finished FCD file by another source."""
    return edit('fcd = "fcd.csv"', line)


NET = 'network = "net.net.xml"'
POINTS = edit('sensor = "small"', 'sensor = "small"\npoints = "cloud.csv"')
ONE_SITE = sites("only,10,12,3")

# name of the case -> how the scenario is spoilt, what the message must say
BAD: dict[str, tuple[Change, str]] = {
    # the scenario file
    "no scenario.toml": (remove("scenario.toml"), r"expected a scenario.toml"),
    "not TOML": (add("\n[roi\n"), r"scenario.toml: is not valid TOML"),
    "not UTF-8": (put("scenario.toml", b"\xff\xfe\x00"), r"is not valid TOML.*utf-8"),
    "unknown key": (edit("voxel_m", "voxel_size_m"), r"roi.voxel_size_m: unknown key. Did you mean voxel_m\?"),
    "unknown table": (add("\n[trafic]\nframes = 3\n"), r"trafic: unknown key. Did you mean traffic\?"),
    "missing table": (edit('[sites]\nfile = "sites.csv"\nsensor = "small"\n', ""), r"sites: this key is required"),
    "wrong type": (edit("frames = 40", 'frames = "many"'), r"traffic.frames: expected a valid integer, got 'many'"),
    "text for a number": (
        edit("voxel_m = 0.5", 'voxel_m = "0.5"'),
        r"roi.voxel_m: expected a valid number, got '0.5'",
    ),
    "truth for a number": (edit("gamma = 4", "gamma = true"), r"score.gamma: .*, got True"),
    "text for a truth value": (edit("frames = 40", "frames = 40\n[scan]\nkeep = 'no'"), r"scan.keep: .*, got 'no'"),
    "a date": (edit("gamma = 4", "gamma = 2026-01-01"), r"score.gamma: .*, got '2026-01-01'"),
    "fraction for a count": (edit("frames = 40", "frames = 40.5"), r"traffic.frames: .*, got 40.5"),
    "negative voxel": (
        edit("voxel_m = 0.5", "voxel_m = -0.5"),
        r"roi.voxel_m: expected a value greater than 0, got -0.5",
    ),
    "NaN voxel": (edit("voxel_m = 0.5", "voxel_m = nan"), r"roi.voxel_m: .*, got nan"),
    "infinite ROI": (edit("size_m = [40, 20, 5]", "size_m = [inf, 20, 5]"), r"roi.size_m.0: .*, got inf"),
    "two numbers for a size": (edit("size_m = [40, 20, 5]", "size_m = [40, 20]"), r"roi.size_m"),
    "ROI no multiple": (
        edit("[40, 20, 5]", "[40.3, 20, 5]"),
        r"roi.size_m: 40.3 m along x .* nearest sizes that fit are 40 or 40.5 m",
    ),
    "too many voxels": (edit("voxel_m = 0.5", "voxel_m = 0.001"), r"roi.voxel_m: 0.001 m gives .* voxels"),
    "blocks do not divide": (
        edit("blocks = 4", "blocks = 7"),
        r"tpog.blocks = 7 does not divide traffic.frames = 40. Use traffic.frames = 35 or 42, or other blocks",
    ),
    "gamma below 0": (edit("gamma = 4", "gamma = -1"), r"score.gamma: .*, got -1"),
    "gamma NaN": (edit("gamma = 4", "gamma = nan"), r"score.gamma: .*, got nan"),
    "two traffic sources": (
        traffic('fcd = "fcd.csv"\nnetwork = "n.xml"'),
        r"exactly one of network, sumocfg, fcd and tracks",
    ),
    "key that acts on nothing": (
        edit("frames = 40", "frames = 40\nvehicles = 3"),
        r"vehicles has no effect with fcd",
    ),
    "two kinds of one name": (
        add('\n[[traffic.kinds]]\nname = "car"\nlength_m = 4\nwidth_m = 2\nheight_m = 1\n'),
        r"same name: car",
    ),
    "size of a kind 0": (edit("length_m = 4.5", "length_m = 0"), r"traffic.kinds.0.length_m: .*, got 0"),
    # traffic
    "FCD missing": (remove("fcd.csv"), r"traffic.fcd = 'fcd.csv': no such file"),
    "FCD empty": (put("fcd.csv", ""), r"fcd.csv: is empty"),
    "FCD without angle": (put("fcd.csv", fcd().replace("vehicle_angle", "vehicle_odd")), r"fcd.csv: .*angle"),
    "FCD with an unknown type": (put("fcd.csv", fcd().replace(";car;", ";bus;")), r"bus"),
    "FCD with NaN": (put("fcd.csv", fcd().replace("-2.0;90.0", "nan;90.0", 1)), r"fcd.csv.*nan"),
    "FCD truncated gzip": (
        put("fcd.csv", gzip.compress(fcd().encode(), mtime=0)[:-40]),
        r"fcd.csv: .*(damaged gzip|Truncated compressed)",
    ),
    "FCD malformed XML": (put("fcd.csv", "<fcd-export><timestep time='0'>"), r"fcd.csv: is not well-formed XML"),
    "FCD with entities": (
        put("fcd.csv", "<!DOCTYPE a [<!ENTITY b 'c'>]><fcd-export>&b;</fcd-export>"),
        r"fcd.csv: declares XML entities",
    ),
    "FCD too short": (edit("frames = 40", "frames = 400"), r"40"),
    "FCD at another period": (edit("frame_period_s = 0.5", "frame_period_s = 0.3"), r"frame_period_s|0\.3"),
    "network missing": (
        put("x", "", traffic(NET), edit("warmup_s = 0", ""), edit("frame_period_s = 0.5", "")),
        r"traffic.network = 'net.net.xml': no such file",
    ),
    "network empty": (
        put("net.net.xml", "<net></net>", traffic(NET), edit("frame_period_s = 0.5", "")),
        r"net.net.xml.*no road",
    ),
    "network that is none": (
        put("net.net.xml", "<routes/>", traffic(NET), edit("frame_period_s = 0.5", "")),
        r"expected the root element <net>, got <routes>",
    ),
    "period no multiple of the step": (
        put(
            "net.net.xml",
            "<net></net>",
            traffic(NET),
            edit("frame_period_s = 0.5", "frame_period_s = 0.35\nstep_s = 0.1"),
        ),
        r"frame_period_s.*0.35.*0.1|0.35",
    ),
    "period whose name is none": (
        put("x", "", edit("warmup_s = 0", 'warmup_s = 0\nperiods = [{ name = "rush hour" }]')),
        r"periods.0.name: expected a name, got 'rush hour'. Use a name .*no spaces",
    ),
    # statics
    "statics missing": (remove("statics.geojson"), r"statics.footprints = 'statics.geojson': no such file"),
    "statics no JSON": (put("statics.geojson", "{"), r"statics.geojson: is not valid JSON"),
    "statics no collection": (put("statics.geojson", "[]"), r"got no features list"),
    "statics without height": (
        statics(feature({"type": "Point", "coordinates": [1, 1]}, radius_m=1)),
        r"height_m is missing",
    ),
    "statics upside down": (statics(polygon(BUILDING[0], base_m=7)), r"expected height_m above base_m = 7, got 5"),
    "statics NaN height": (statics(polygon(BUILDING[0], height_m=math.nan)), r"height_m: .*, got nan"),
    "statics point without radius": (
        statics(feature({"type": "Point", "coordinates": [1, 1]}, height_m=3)),
        r"radius_m is missing",
    ),
    "statics self-crossing polygon": (
        statics(polygon([[0, 0], [4, 4], [4, 0], [0, 4], [0, 0]], name="bow")),
        r"feature 0 \(bow\): geometry: is not a valid polygon \(Self-intersection",
    ),
    "statics hole outside": (
        statics(polygon(BUILDING[0], [[50, 50], [51, 50], [51, 51], [50, 50]])),
        r"is not a valid polygon \(Hole lies outside",
    ),
    "statics without area": (
        statics(polygon([[0, 0], [4, 4], [2, 2], [0, 0]])),
        r"not a valid polygon|encloses no area",
    ),
    "statics odd geometry": (statics(feature({"type": "Circle"}, height_m=3)), r"expected a GeoJSON geometry"),
    "statics infinite coordinate": (
        put("statics.geojson", collection(polygon(BUILDING[0])).replace("14", "1e999", 1)),
        r"expected finite coordinates",
    ),
    "mesh that is none": (
        put("m.stl", "solid nothing", add('\n[[statics.meshes]]\nfile = "m.stl"\n')),
        r"m.stl: (cannot be|the file has no triangles)",
    ),
    # sites and sensors
    "sites missing": (remove("sites.csv"), r"sites.file = 'sites.csv': no such file"),
    "sites empty": (put("sites.csv", "site,x_m,y_m,z_m\n"), r"sites.csv: expected at least one site"),
    "sites without z": (sites("a,1,12", head="site,x_m,y_m"), r"line 2 \(a\): z_m is missing"),
    "sites with text": (sites("a,1,north,3"), r"line 2 \(a\): y_m: .*finite number.*'north'"),
    "sites with a misspelt column": (
        sites("a,1,12,3,9", head="site,x_m,y_m,z_m,yaw_dge"),
        r"line 2 \(a\): unknown column 'yaw_dge'\. Did you mean yaw_deg\?",
    ),
    "sites with a column without a name": (
        sites("0,a,1,12,3", head=",site,x_m,y_m,z_m"),
        r"header: column 1 has no name, but line 2 has the value '0' there. Name or remove the column",
    ),
    "sites with semicolons": (
        put("sites.csv", "site;x_m;y_m;z_m\na;1,500;12;3\n"),
        r"sites.csv: line 2: x_m: 1,500 can mean 1500 or 1.500. Use no separators of thousands",
    ),
    "sites with costs in thousands": (
        sites("a,1,12,3,8.000", "b,1,14,3,950", head="site,x_m,y_m,z_m,cost"),
        r"sites.csv: line 2 \(a\): cost: 8.000 can mean 8 or 8000. Write 8 or 8000.",
    ),
    "sites from the middle of the region": (
        put("sites.csv", "site,x_m,y_m,z_m\na,3.1,8.7,4\n", edit("center_m = [20, 0,", "center_m = [420, 395,")),
        r"the site is .* Move it within .* The middle of the region is at x 420, y 395: add it to positions that count"
        r" from there. Longitude and latitude belong in columns longitude and latitude.",
    ),
    "sites with bars": (put("sites.csv", "site|x_m|y_m|z_m\n"), r"sites.csv: the columns are separated by '\|'"),
    "sites ragged": (sites("a,1,12"), r"line 2: expected 4 values, got 3"),
    "site twice": (sites("a,1,12,3", "a,2,12,3"), r"there are two sites 'a'"),
    "site NaN": (sites("a,nan,12,3"), r"line 2 \(a\): x_m: .*'nan'"),
    "site in a wall": (sites("a,16,6,3"), r"site a: \(16, 6, 3\) is inside house \(building\)"),
    "site below ground": (sites("a,1,12,-1"), r"site a: z_m = -1 is not above the ground"),
    "site too far": (sites("a,1,500,3"), r"site a: the site is 490.0 m from the region of interest"),
    "unknown sensor": (
        edit('sensor = "small"', 'sensor = "VLP32C"'),
        r"scenario\.toml: sites\.sensor: unknown sensor 'VLP32C'\. Did you mean VLP-32C\?",
    ),
    "pitch beyond 90": (
        sites("a,1,12,3,100", head="site,x_m,y_m,z_m,pitch_deg"),
        r"line 2 \(a\): pitch_deg: .*between -90 and 90, got 100",
    ),
    "azimuth step does not divide": (
        edit("azimuth_step_deg = 1.0", "azimuth_step_deg = 0.7"),
        r"azimuth_step_deg = 0.7 does not divide 360",
    ),
    "elevations and channels disagree": (edit("[-15, 5]", "[-15, 0, 5]"), r"channels = 8 needs 2 elevations_deg"),
    "unknown site to keep": (
        add('keep_visibility = ["pole_z"]\n'),
        r"score.keep_visibility: there is no site 'pole_z'.*pole_a, pole_b",
    ),
    "site that would be a path": (
        sites("../../a,1,12,3"),
        r"line 2 \(../../a\): site: .*name of up to 80 characters.*'../../a'",
    ),
    "site beyond the Earth": (sites("a,1e300,12,3"), r"line 2 \(a\): x_m: .*finite number of at most .*'1e300'"),
    "a column twice": (sites("a,1,12,3,2", head="site,x_m,y_m,z_m,x_m"), r"two columns are called 'x_m'"),
    "too many beams": (
        edit("azimuth_step_deg = 1.0", "azimuth_step_deg = 1e-7"),
        r"8 rings every 1e-07 degrees make more than",
    ),
    "ROI beyond the Earth": (
        edit("center_m = [20, 0, 2.5]", "center_m = [1e300, 0, 2.5]"),
        r"roi.center_m.0: .*, got 1e\+300",
    ),
    "endless traffic": (
        edit("frame_period_s = 0.5", "frame_period_s = 1e12"),
        r"at most 10,000,000 seconds of traffic",
    ),
    "statics beyond the Earth": (
        statics(polygon([[0, 0], [1e300, 0], [1e300, 1], [0, 0]])),
        r"expected coordinates within .*, got 1e\+300 m",
    ),
    "statics nested without end": (
        put("statics.geojson", "[" * 200_000),
        r"statics.geojson: (is not valid JSON|has no list)",
    ),
    # measured scans
    "points beyond the Earth": (
        put("cloud.csv", "x_m,y_m,z_m\n10,1e200,3\n", POINTS, ONE_SITE),
        r"points: .*cloud.csv: .*got 1e\+200 m",
    ),
    "points from elsewhere": (
        put("cloud.csv", "x_m,y_m,z_m\n10,500,3\n", POINTS, ONE_SITE),
        r"points: .*cloud.csv: none of 1 point lies on a beam",
    ),
    "points missing": (
        put("sites.csv", "site,x_m,y_m,z_m\na,10,12,3\n", POINTS),
        r"points = 'cloud.csv': no such file",
    ),
    "points for two sites": (
        put("cloud.csv", "x_m,y_m,z_m\n1,1,0\n", POINTS),
        r"one measured scan is given for 2 sites",
    ),
    "points without z": (put("cloud.csv", "x_m,y_m\n1,1\n", POINTS, ONE_SITE), r"cloud.csv.*z_m"),
    "points of an unknown kind": (
        put("cloud.abc", "1", edit('sensor = "small"', 'sensor = "small"\npoints = "cloud.abc"'), ONE_SITE),
        r"cloud.abc.*\.pcd",
    ),
    "truncated PCD": (
        put(
            "cloud.pcd",
            b"VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\n"
            b"WIDTH 9\nHEIGHT 1\nPOINTS 9\nDATA binary\n\x00\x00",
            edit('sensor = "small"', 'sensor = "small"\npoints = "cloud.pcd"'),
            ONE_SITE,
        ),
        r"cloud.pcd",
    ),
}


def refused(run_egvs, *arguments: object) -> tuple[str, str]:
    """What a command that is given wrong input prints and answers."""
    code, printed, error = run_egvs(*arguments)
    assert code == 2, error
    assert "Traceback" not in error
    return printed, error


@pytest.mark.parametrize(("change", "message"), BAD.values(), ids=BAD.keys())
def test_wrong_scenario_is_answered(mini: Path, tmp_path: Path, run_egvs, change: Change, message: str) -> None:
    change(mini)
    out = tmp_path / "out"
    printed, error = refused(run_egvs, "run", mini, "--out", out)
    last = error[error.index("egvs: ") :]
    assert re.search(message, last, re.DOTALL), last
    assert printed == ""
    assert not list(out.glob(".*.partial"))
    assert not (out / "scores.parquet").exists() or "keep_visibility" in message


def test_every_message_is_its_own() -> None:
    messages = [message for _, message in BAD.values()]
    assert len(messages) >= 50
    assert len(set(messages)) > 0.9 * len(messages)


COMMANDS = {
    "unknown verb": (["rum", "x"], r"No such command"),
    "no such folder": (["run", "nowhere"], r"nowhere: no such folder. Give a folder with a scenario.toml"),
    "folder misspelt": (["run", "{mini}i"], r"minii: no such folder. Did you mean .*mini\?"),
    "--osm missing": (["new", "{out}", "--osm", "x.osm"], r"x.osm: no such file. Check the path"),
    "--poles without every": (["new", "{out}", "--osm", "x.osm", "--poles", "20m"], r"x.osm: no such file"),
    "--poles= without every": (["new", "{out}", "--osm", "x.osm", "--poles=20", "--walk"], r"x.osm: no such file"),
    "--poles in quotes": (["new", "{out}", "--osm", "x.osm", "--poles", "every 20m"], r"x.osm: no such file"),
    "--poles= in quotes": (["new", "{out}", "--osm", "x.osm", "--poles=every 20m"], r"x.osm: no such file"),
    "--poles every": (["new", "{out}", "--osm", "x.osm", "--poles", "every", "20m"], r"x.osm: no such file"),
    "--poles=every": (["new", "{out}", "--osm", "x.osm", "--poles=every", "20m"], r"x.osm: no such file"),
    "--poles no length": (["new", "{out}", "--osm", "x.osm", "--poles", "far"], r"--poles: expected existing"),
    "figure without --what": (["figure", "{out}"], r"--what: expected one of ranking, map, tpog, seen, missed"),
    "--count 0": (["place", "{mini}", "--count", "0"], r"^egvs: --count: expected at least 1 sensor, got 0"),
    "--count -1": (["place", "{mini}", "--count", "-1"], r"^egvs: --count: expected at least 1 sensor, got -1"),
    "--budget 0": (["place", "{mini}", "--budget", "0"], r"^egvs: --budget: expected a cost above 0, got 0"),
    "--out of a page": (
        ["explore", "{mini}", "--out", "page.html"],
        r"^egvs: --out: expected the folder of the run, got page.html. .*, use egvs explore --to page.html.$",
    ),
    "--budget 30.000": (
        ["place", "{mini}", "--budget", "30.000"],
        r"^egvs: --budget: 30.000 can mean 30 or 30000. Write 30 or 30000.$",
    ),
    "--set placement.budget=30.000": (
        ["place", "{mini}", "--set", "placement.budget=30.000"],
        r"^egvs: --set: placement.budget: 30.000 can mean 30 or 30000. Write 30 or 30000.$",
    ),
    "--set of a price": (
        ["check", "{mini}", "--set", 'costs.sensor={{"VLP-32C" = 8.450}}'],
        r"^egvs: --set: costs.sensor.VLP-32C: 8.450 can mean 8.45 or 8450. Write 8.45 or 8450.$",
    ),
    "--set of a budget without costs": (
        ["place", "{mini}", "--set", "placement.budget=30"],
        r"^egvs: command line: placement.budget: the cost of site \w+ is unknown",
    ),
    "--surroundings 1,500": (["new", "{out}", "--osm", "x", "--surroundings", "1,500"], r"1,500 can mean 1.5 or 1500"),
    "--reach in per cent": (["place", "{mini}", "--reach", "95"], r"^egvs: --reach: .* got 95. Use 0.95 for 95 %"),
    "--reach below 0": (["place", "{mini}", "--reach", "-1"], r"^egvs: --reach: .* got -1. Use a share such as 0.95"),
    "--set without value": (["run", "{mini}", "--set", "roi.voxel_m"], r"--set roi.voxel_m: expected KEY=VALUE"),
    "--set unknown": (["run", "{mini}", "--set", "roi.voxel=1"], r"roi.voxel: unknown key. Did you mean voxel_m"),
    "--set of a row that is not there": (
        ["run", "{mini}", "--set", "traffic.kinds.tram.share=1"],
        r"--set traffic.kinds.tram.share=1: there is no row 'tram'. Use one of car, or a number from 0",
    ),
    "a name of 5,000 characters": (
        ["run", "{mini}", "--set", f'traffic.fcd="{"x" * 5000}"'],
        r"traffic.fcd = 'x+ \.\.\. \([0-9,]+ characters\) \.\.\. x+': the path is longer than",
    ),
    "a size without end": (
        ["run", "{mini}", "--set", "roi.size_m=[1e308,20,5]"],
        r"roi.voxel_m: 0.5 m gives more than 1e\+300 x 40 x 10 = more than 1e\+300 voxels. .*EGVS_MAX_VOXELS",
    ),
    "three sizes without end": (["run", "{mini}", "--set", "roi.size_m=[1e308,1e308,1e308]"], r"more than 1e\+300 vox"),
    "voxels of next to nothing": (["run", "{mini}", "--set", "roi.voxel_m=1e-300"], r"1e-300 m gives .*1e\+300 voxels"),
    "a size of next to nothing": (
        ["run", "{mini}", "--set", "roi.size_m=[1e-300,20,5]"],
        r"roi.size_m: 1e-300 m along x is not a whole number of voxels of 0.5 m. The nearest sizes that fit are 0.5 m",
    ),
    "voxels without end": (
        ["run", "{mini}", "--set", "roi.voxel_m=1e308"],
        r"not a whole number of voxels of 1e\+308 m",
    ),
    "ten million channels": (
        ["check", "{mini}", "--set", "sensors.small.channels=10000000"],
        r"channels: expected a value less than or equal to 10000, got 10000000",
    ),
    "beams without end": (
        ["check", "{mini}", "--set", "sensors.small.azimuth_step_deg=1e-300"],
        r"8 rings every 1e-300 degrees make more than 3,000,000 beams.* EGVS_MAX_BEAMS to raise it",
    ),
    "a number of thousands of digits": (
        ["check", "{mini}", "--set", f"seed={'9' * 5000}"],
        r"seed: expected a valid integer, got '9+ ... \(.* chara",
    ),
    "a list thousands deep": (
        ["check", "{mini}", "--set", f"seed={'[' * 5000}{']' * 5000}"],
        r"seed: expected a valid integer, got '\[+ ... \(.* cha",
    ),
    "--set of a whole row": (["run", "{mini}", "--set", "traffic.kinds.car=1"], r"traffic.kinds.car.KEY=VALUE"),
    "--set through a value": (["run", "{mini}", "--set", "seed.x=1"], r"'seed' is not a table"),
    "--traci without port": (["traffic", "{mini}", "--traci", "here"], r"--traci: expected HOST:PORT, got 'here'"),
    "--cloud unknown": (["scan", "{mini}", "--cloud", "xyz"], r"--cloud: expected ply or pcd, got 'xyz'"),
    "stage before its inputs": (["tpog", "{mini}", "--out", "{out}"], r"trajectories.parquet|statics.ply"),
    "verify nothing": (["verify", "{out}"], r"out: no such folder"),
    "jobs 0": (["run", "{mini}", "--jobs", "0"], r"--jobs"),
    "--at no place": (
        ["new", "{out}", "--osm", "x.osm", "--at", "here"],
        r"--at: expected LAT,LON in degrees, got 'here'",
    ),
    "--at with decimal commas, in two words": (
        ["new", "{out}", "--download", "--at", "152,2724", "-8,0405"],
        r"--at: expected LAT,LON within 85 and 180 degrees, got 152.2724,-8.0405",
    ),
    "--surroundings beyond the Earth": (
        ["new", "{out}", "--osm", "x.osm", "--surroundings", "1e300"],
        r"--surroundings: expected a length in metres, or all, got '1e300'",
    ),
    "osm missing": (["new", "{out}", "--osm", "{out}.osm"], r"\.osm"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("arguments", "message"), COMMANDS.values(), ids=COMMANDS.keys())
def test_wrong_command_is_answered(mini: Path, tmp_path: Path, run_egvs, arguments: list[str], message: str) -> None:
    _, error = refused(run_egvs, *(a.format(mini=mini, out=tmp_path / "out") for a in arguments))
    assert re.search(message, error), error


@pytest.mark.parametrize("spacing", ["1e-06", "1e-300", "9.99989e-321"])
@pytest.mark.parametrize("rule", ["grid={low_m=[0,0],high_m=[9,9],%s}", "along=[{line_m=[[0,0],[9,9]],%s}]"])
def test_sites_without_end_are_refused(mini: Path, run_egvs, spacing: str, rule: str) -> None:
    asked = f"sites.{rule % f'spacing_m={spacing},heights_m=[3]'}"
    said = " ".join("".join(refused(run_egvs, "check", mini, "--set", asked)).split())
    told = f"more than 100,000 candidates (spacing_m = {spacing}). Use a wider spacing, or fewer heights and pitches"
    assert told in said
    assert "set EGVS_MAX_SITES to raise it" in said


def spoil_parquet(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-20] ^= 0xFF
    path.write_bytes(bytes(data))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trajectories.parquet", "tpog.parquet", "scans.parquet", "statics.ply"])
@pytest.mark.parametrize("how", ["truncated", "one byte", "other columns", "no file"])
def test_a_damaged_artefact_is_named_by_the_stage_that_reads_it(
    mini: Path, tmp_path: Path, run_egvs, name: str, how: str
) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    out = tmp_path / "out"
    for stage in ("traffic", "statics", "tpog", "scan"):
        assert run_egvs(stage, mini, "--out", out)[0] == 0
    path = out / name
    if how == "truncated":
        path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    elif how == "one byte" and path.suffix == ".parquet":
        spoil_parquet(path)
    elif how == "other columns" and path.suffix == ".parquet":
        pq.write_table(pa.table({"a": [1]}), path)
    else:
        path.unlink()
    readers = {"trajectories.parquet": "tpog", "tpog.parquet": "score", "scans.parquet": "score", "statics.ply": "scan"}
    assert name in refused(run_egvs, readers[name], mini, "--out", out)[1]


def metadata_of(path: Path, metadata: object) -> None:
    """Write a Parquet file again with other metadata under the key egvs."""
    import pyarrow.parquet as pq

    table = pq.read_table(path)
    raw = metadata if isinstance(metadata, bytes) else json.dumps(metadata).encode()
    pq.write_table(table.replace_schema_metadata({b"egvs": raw}), path)


def record_what_lies_there(out: Path, stage: str) -> None:
    """Have run.json name a stage's artefacts as they are now, so that their digests keep no damage out."""
    from egvs.core import files

    record = json.loads((out / "run.json").read_text())
    made = record["stages"][stage]["artefacts"]
    record["stages"][stage]["artefacts"] = {name: files.hash_file(out / name) for name in made}
    (out / "run.json").write_text(json.dumps(add_checksum(record)))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda about: b"{", "the metadata is not JSON"),
        (lambda about: [about], "a JSON object as metadata, got \\["),
        (lambda about: about | {"schema": 99}, "expected schema version 1, got 99"),
        (lambda about: about | {"grid": None}, "grid = None"),
        (lambda about: about | {"grid": {"origin_m": [0, 0, 0], "voxel_m": 0, "shape": [1, 1, 1]}}, "grid = "),
        (
            lambda about: about | {"grid": {"origin_m": [0, 0, 0], "voxel_m": 1, "shape": [10**6, 10**6, 10**6]}},
            "grid = ",
        ),
        (lambda about: {k: v for k, v in about.items() if k != "frames"}, "frames = None"),
        (lambda about: about | {"frames": "many"}, "frames = 'many'"),
        (lambda about: about | {"block_frames": 0}, "block_frames = 0"),
    ],
)
def test_altered_metadata_is_named(mini: Path, tmp_path: Path, run_egvs, change, message: str) -> None:
    from egvs.artefacts import parquet

    out = tmp_path / "out"
    for stage in ("traffic", "statics", "tpog", "scan"):
        assert run_egvs(stage, mini, "--out", out)[0] == 0
    path = out / "tpog.parquet"
    metadata_of(path, change(parquet.read_metadata(path, "tpog")))
    record_what_lies_there(out, "tpog")
    _, error = refused(run_egvs, "score", mini, "--out", out)
    assert re.search(rf"tpog.parquet: .*{message}", error), error


def test_an_empty_set_of_features_is_a_world_of_ground_alone(mini: Path, tmp_path: Path, run_egvs) -> None:
    (mini / "statics.geojson").write_text(json.dumps({"type": "FeatureCollection", "crs": None, "features": []}))
    code, _, error = run_egvs("statics", mini, "--out", tmp_path / "out")
    assert code == 0, error


@pytest.mark.parametrize("separator", [",", " ", ", ", ";", " ; ", "\t"])
@pytest.mark.parametrize("point", [".", ","])
def test_understands_point(point: str, separator: str) -> None:
    assert options.latitude_and_longitude(f"52{point}2724{separator}8{point}0405") == (52.2724, 8.0405)


@pytest.mark.parametrize("text", ["", "52.2724", "52,2724,8", "52.2724 8.0405 3", "N52 E8", "52,27,24 8"])
def test_rejects_point(text: str) -> None:
    with pytest.raises(InputError, match=r"--around: expected LAT,LON in degrees, got .*Use coordinates such as"):
        options.latitude_and_longitude(text, "--around")
