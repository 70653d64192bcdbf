"""Small runs for the tests of the report: real stages, made-up traffic; readers of pages and images."""

from __future__ import annotations

import base64
import csv
import html
import json
import re
import zlib
from html.parser import HTMLParser

import numpy as np

from egvs.artefacts import parquet
from egvs.artefacts.checksums import add_checksum
from egvs.drawing.basemap import Roads
from egvs.drawing.maps import Backdrop
from egvs.report import page
from egvs.results.ranking import RankedSite
from egvs.scenario.loading import scenario_from_dict
from egvs.stages import scan, score
from egvs.world.mesh import World, write_ply
from tests.stage_runner import run_stage

UNSAFE_NAME = '<b>&"x'


SITES = [("north", 6, 9, 2), ("south", 6, -1, 2), (UNSAFE_NAME, 6, -1, 3), ("west", -2, 4, 1.5)]


SENSOR = {"elevations_deg": [-40, 0], "channels": 6, "azimuth_step_deg": 3, "range_m": 60}


FRAMES = 40


EMPTY_BACKDROP = Backdrop((), Roads())


VOID_TAGS = {"meta", "br", "link", "img", "input", "hr"}


def make_scenario(folder, sites, columns=(), **keys):
    """A region of 12 m x 8 m x 2 m; ``keys`` are laid over the sections of the same name."""
    folder.mkdir(parents=True, exist_ok=True)
    with (folder / "sites.csv").open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("site", "x_m", "y_m", "z_m", *columns), *sites])
    (folder / "fcd.csv").write_text("")
    values = {
        "name": "trial",
        "description": 'Trees & "towers" <script>alert(1)</script>',
        "roi": {"center_m": [6, 4, 1], "size_m": [12, 8, 2], "voxel_m": 0.5},
        "traffic": {"fcd": "fcd.csv", "frames": FRAMES},
        "sites": {"file": "sites.csv", "sensor": "small"},
        "sensors": {"small": SENSOR},
        **keys,
    }
    return scenario_from_dict(values, folder, str(folder / "scenario.toml"))


def box_mesh(x0, y0, x1, y1, top):
    """Corners and outward faces of a box that stands on the ground."""
    corners = [[x, y, z] for z in (0, top) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    sides = [[i, (i + 1) % 4, (i + 1) % 4 + 4] for i in range(4)] + [[i, (i + 1) % 4 + 4, i + 4] for i in range(4)]
    return np.array(corners, dtype=float), np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], *sides])


def make_world():
    solids = [
        ("hall", "building", box_mesh(8, 6, 12, 7, 5)),
        ("p1", "pole", box_mesh(3, 6.5, 3.2, 6.7, 4)),
        ("oak", "tree_crown", box_mesh(0, 0, 3, 1, 4)),
    ]
    vertices = np.concatenate([b[0] for *_, b in solids])
    faces = np.concatenate([b[1] + 8 * i for i, (*_, b) in enumerate(solids)]).astype(np.int32)
    return World(vertices, faces, np.repeat(np.arange(3, dtype=np.int32), 12), tuple((n, k) for n, k, _ in solids))


def lane_counts(grid):
    """Counts of a lane along y = 4: busier to the west."""
    counts = np.zeros(grid.shape, dtype=np.int64)
    counts[:, 7:10, :3] = np.arange(1, grid.shape[0] + 1)[::-1, None, None]
    return counts


def write_trajectories(path):
    """Two cars, one behind the other, to the west along y = 4."""
    rows = [
        (frame, name, 11.5 - 0.2 * frame + ahead) for frame in range(FRAMES) for name, ahead in (("a", 0), ("b", -5))
    ]
    frame, vehicle, x_m = map(list, zip(*rows, strict=True))
    fixed = {"part": 0, "kind": "passenger", "y_m": 4.0, "z_m": 0.75, "yaw_rad": np.pi, "pitch_rad": 0.0}
    fixed |= {"length_m": 4.0, "width_m": 1.8, "height_m": 1.5}
    columns = {"frame": frame, "vehicle": vehicle, "x_m": x_m} | {name: [v] * len(rows) for name, v in fixed.items()}
    parquet.write_artefact(path, "trajectories", columns, {"schema": 1, "frames": FRAMES})


def run_to_scores(folder, sites=SITES, counts=lane_counts, record=True, **keys):
    """The folder of a run up to the scores, and its scenario; it holds no trajectories."""
    keys["score"] = {"gamma": 10.0, "others": []} | keys.get("score", {})
    scenario = make_scenario(folder / "scenario", sites, **keys)
    out, grid = folder / "out", scenario.roi.grid
    counted = counts(grid)
    flat = np.flatnonzero(counted)
    index = dict(zip(("ix", "iy", "iz"), (a.astype(np.int32) for a in np.unravel_index(flat, grid.shape)), strict=True))
    columns = {"block": np.zeros(len(flat), dtype=np.uint16), **index, "count": counted.ravel()[flat].astype(np.uint32)}
    more = {"grid": grid.to_json(), "frames": FRAMES, "block_frames": FRAMES, "memory_frames": 1.0}
    parquet.write_artefact(out / "tpog.parquet", "tpog", columns, {"schema": 1, **more})
    write_trajectories(out / "trajectories.parquet")
    write_ply(out / "statics.ply", make_world(), {})
    run_stage(scan, scenario, out, jobs=1)
    run_stage(score, scenario, out, jobs=1)
    if record:
        (out / "run.json").write_text(json.dumps(add_checksum(make_record())), encoding="utf-8")
    return scenario, out


def make_record(seconds=1.25):
    traffic = {
        "frames": FRAMES,
        "vehicles": {"fewest": 3, "most": 5, "different": 1234}, "mean_speed_m_s": 5.0, "share_standing": 0.25,
        "collisions": 7, "frames_with_overlap": 2, "longest_standing_s": 12.5, "sumo": "9.8.7",
        "sumo_seconds": 77.77, "notes": ["<i>late</i>"],
    }  # fmt: skip
    stage = {
        "inputs": "",
        "files": {},
        "artefacts": {"tpog.parquet": "ab" * 32},
        "summary": {},
        "cost": {"seconds": seconds, "peak_mb": 512.0},
    }
    statics = {"triangles": 36, "built": {"tree_crown": 1}, "mended": {}, "left_out": {"lines": 4}}
    return {
        "egvs": "0.1.0",
        "seed": 0,
        "scenario": {},
        "scenario_folder": ".",
        "stages": {
            "traffic": stage | {"summary": traffic, "artefacts": {}},
            "statics": stage | {"summary": statics, "artefacts": {}},
            "tpog": stage,
        },
    }


def render_report(scenario, out):
    run_stage(page, scenario, out)
    return (out / "report.html").read_text(encoding="utf-8")


def section_text(text, name):
    """The text of a section without tags, white space as single spaces; None if the page has none."""
    match = re.search(rf'<section id="{name}">(.*?)</section>', text, re.DOTALL)
    if match is None:
        return None
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", match[1])).split())


class PageReader(HTMLParser):
    """Text, tags, attributes; fails on a tag that is not closed where it should be."""

    def __init__(self, text):
        super().__init__()
        self.open, self.ids, self.tags, self.rows, self.texts, self.fetched = [], [], [], [], [], []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        assert len(values) == len(attributes), f"<{tag}> has an attribute twice"
        self.tags.append((tag, values))
        self.ids += [values["id"]] if "id" in values else []
        self.fetched += [v for k, v in attributes if k in ("src", "href", "xlink:href", "data", "srcset", "action")]
        self.rows += [""] if tag == "tr" else []
        if tag not in VOID_TAGS:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        data = data.replace("\u00a0", " ")
        self.texts.append(data)
        if "tr" in self.open:
            self.rows[-1] += f"{data.strip()}|"

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


def site_data(text):
    """What the page holds of the sites that can be chosen."""
    return json.loads(re.search(r'id="site-data">(.*?)</script>', text, re.DOTALL).group(1))


def decode_png(png):
    """Palette indices of an indexed PNG in a data URI, rows from the top."""
    data = base64.b64decode(png.partition(",")[2])
    assert data[:8] == b"\x89PNG\r\n\x1a\n"
    at, chunks = 8, {}
    while at < len(data):
        size, name = int.from_bytes(data[at : at + 4], "big"), data[at + 4 : at + 8]
        body, check = data[at + 8 : at + 8 + size], data[at + 8 + size : at + 12 + size]
        assert zlib.crc32(name + body) == int.from_bytes(check, "big")
        chunks[name] = body
        at += 12 + size
    width, height = (int.from_bytes(chunks[b"IHDR"][i : i + 4], "big") for i in (0, 4))
    rows = np.frombuffer(zlib.decompress(chunks[b"IDAT"]), dtype=np.uint8).reshape(height, width + 1)
    assert not rows[:, 0].any() and len(chunks[b"PLTE"]) <= 768
    return rows[:, 1:]


def ranked_site(name: str, x_m: float, y_m: float, z_m: float, egvs: float, rank: int) -> RankedSite:
    """A site of a ranking by EGVS, with a level sensor on a pole of the same name."""
    return RankedSite(name, x_m, y_m, z_m, egvs, rank, name, 0.0, 0.0, 0.0, "VLP-32C", 1e6, 1, 1, 0.5)
