"""The report is one sound file that fetches nothing, says what the artefacts hold, and has the same bytes each time.

Runs are small and go through the real stages; only the traffic is made up.
"""

import base64
import csv
import html
import json
import re
import shutil
import xml.etree.ElementTree as ET
import zlib
from dataclasses import replace
from html.parser import HTMLParser

import numpy as np
import pytest

from egvs.artefacts import parquet
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.core.files import add_checksum
from egvs.core.grid import Grid
from egvs.report import colours, figures, maps, svg_figures
from egvs.report import page as report
from egvs.report import page as report_page
from egvs.report.basemap import Roads, outlines_of
from egvs.report.figures import Figures
from egvs.report.maps import Backdrop
from egvs.report.ranking import Ranking
from egvs.report.svg_figures import MapSite
from egvs.scenario.effects_config import EffectsConfig
from egvs.scenario.loading import scenario_from_dict
from egvs.scoring.egvs import EntropyField
from egvs.scoring.scorer import Scorer
from egvs.stages import scan, score
from egvs.stages.inputs import get_scene, open_folder
from egvs.stages.site_scans import empty_scans
from egvs.studies import accuracy, score_errors, study_settings
from egvs.world.mesh import World, write_ply
from tests.stage_runner import inputs_of, run_stage

NASTY = '<b>&"x'
SITES = [("north", 6, 9, 2), ("south", 6, -1, 2), (NASTY, 6, -1, 3), ("west", -2, 4, 1.5)]
SENSOR = {"elevations_deg": [-40, 0], "channels": 6, "azimuth_step_deg": 3, "range_m": 60}
FRAMES = 40
PLAIN = Backdrop((), Roads())
VOID = {"meta", "br", "link", "img", "input", "hr"}


def scenario(folder, sites, columns=(), **keys):
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


def box(x0, y0, x1, y1, top):
    """Corners and outward faces of a box that stands on the ground."""
    corners = [[x, y, z] for z in (0, top) for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
    sides = [[i, (i + 1) % 4, (i + 1) % 4 + 4] for i in range(4)] + [[i, (i + 1) % 4 + 4, i + 4] for i in range(4)]
    return np.array(corners, dtype=float), np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], *sides])


def world():
    solids = [
        ("hall", "building", box(8, 6, 12, 7, 5)),
        ("p1", "pole", box(3, 6.5, 3.2, 6.7, 4)),
        ("oak", "tree_crown", box(0, 0, 3, 1, 4)),
    ]
    vertices = np.concatenate([b[0] for *_, b in solids])
    faces = np.concatenate([b[1] + 8 * i for i, (*_, b) in enumerate(solids)]).astype(np.int32)
    return World(vertices, faces, np.repeat(np.arange(3, dtype=np.int32), 12), tuple((n, k) for n, k, _ in solids))


def lane(grid):
    """Counts of a lane along y = 4: busier to the west."""
    counts = np.zeros(grid.shape, dtype=np.int64)
    counts[:, 7:10, :3] = np.arange(1, grid.shape[0] + 1)[::-1, None, None]
    return counts


def drive(path):
    """Two cars, one behind the other, to the west along y = 4."""
    rows = [
        (frame, name, 11.5 - 0.2 * frame + ahead) for frame in range(FRAMES) for name, ahead in (("a", 0), ("b", -5))
    ]
    frame, vehicle, x_m = map(list, zip(*rows, strict=True))
    fixed = {"part": 0, "kind": "passenger", "y_m": 4.0, "z_m": 0.75, "yaw_rad": np.pi, "pitch_rad": 0.0}
    fixed |= {"length_m": 4.0, "width_m": 1.8, "height_m": 1.5}
    columns = {"frame": frame, "vehicle": vehicle, "x_m": x_m} | {name: [v] * len(rows) for name, v in fixed.items()}
    parquet.write_artefact(path, "trajectories", columns, {"schema": 1, "frames": FRAMES})


def finished(folder, sites=SITES, counts=lane, record=True, **keys):
    """The folder of a run up to the scores, and its scenario; it holds no trajectories."""
    keys["score"] = {"gamma": 10.0, "others": []} | keys.get("score", {})
    about = scenario(folder / "scenario", sites, **keys)
    out, grid = folder / "out", about.roi.grid
    counted = counts(grid)
    flat = np.flatnonzero(counted)
    index = dict(zip(("ix", "iy", "iz"), (a.astype(np.int32) for a in np.unravel_index(flat, grid.shape)), strict=True))
    columns = {"block": np.zeros(len(flat), dtype=np.uint16), **index, "count": counted.ravel()[flat].astype(np.uint32)}
    more = {"grid": grid.to_json(), "frames": FRAMES, "block_frames": FRAMES, "memory_frames": 1.0}
    parquet.write_artefact(out / "tpog.parquet", "tpog", columns, {"schema": 1, **more})
    drive(out / "trajectories.parquet")
    write_ply(out / "statics.ply", world(), {})
    run_stage(scan, about, out, jobs=1)
    run_stage(score, about, out, jobs=1)
    if record:
        (out / "run.json").write_text(json.dumps(add_checksum(a_record())), encoding="utf-8")
    return about, out


def a_record(seconds=1.25):
    traffic = {
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


def page(about, out):
    run_stage(report, about, out)
    return (out / "report.html").read_text(encoding="utf-8")


class Reader(HTMLParser):
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
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag, attributes):
        self.handle_starttag(tag, attributes)
        self.handle_endtag(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.texts.append(data)
        if "tr" in self.open:
            self.rows[-1] += f"{data.strip()}|"

    @property
    def text(self):
        return " ".join(" ".join(self.texts).split())


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Scenario, folder and page of the plain small run."""
    about, out = finished(tmp_path_factory.mktemp("made"))
    return about, out, page(about, out)


# ---- counts


def test_counts_stand_beside_what_was_simulated(tmp_path):
    about, out = finished(tmp_path)
    record = a_record()
    record["stages"]["traffic"]["summary"]["counts"] = [
        {"place": "<a> to b", "kind": "", "counted_per_h": 320.0, "simulated_per_h": 311.5, "geh": 0.48},
        {"place": "c", "kind": "truck", "counted_per_h": 60.0, "simulated_per_h": 20.0, "geh": 6.32},
    ]
    (out / "run.json").write_text(json.dumps(add_checksum(record)), encoding="utf-8")
    read = Reader(page(about, out))
    assert "<a> to b|all|320|311.5|0.5|" in read.rows
    assert "c|truck|60|20|6.3|!|" in [row.replace("||", "|") for row in read.rows]


def test_without_counts_there_is_no_table_of_them(made):
    assert "Counted and simulated" not in made[2]


# ---- one sound file


def test_it_is_well_formed_and_its_ids_are_unique(made):
    read = Reader(made[2])
    assert len(read.ids) == len(set(read.ids)) > 5
    used = re.findall(r"url\(#([^)]+)\)", made[2])
    assert used and set(used) <= set(read.ids)


def test_it_fetches_nothing(made):
    read = Reader(made[2])
    assert read.fetched and all(value.startswith("data:image/png;base64,") for value in read.fetched)
    assert {tag for tag, _ in read.tags}.isdisjoint({"link", "iframe", "object", "embed", "base", "form"})
    assert "http://" not in made[2] and "https://" not in made[2] and "@import" not in made[2]
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", made[2]))


def test_what_users_wrote_is_escaped_and_comes_through(made):
    text = made[2]
    assert NASTY not in text and "<i>late" not in text
    assert re.findall("<script[^>]*>", text) == ['<script type="application/json" id="site-data">', "<script>"]
    read = Reader(text)
    assert any(f"|{NASTY}|" in row for row in read.rows)
    assert "<script>alert(1)</script>" in read.text and "<i>late</i>" in read.text


def test_every_figure_says_what_it_shows(made):
    drawn = [values for tag, values in Reader(made[2]).tags if tag == "svg"]
    assert len(drawn) == 11
    assert all(values["role"] == "img" and values["aria-label"] for values in drawn)
    rows = read_scores(made[1] / "scores.parquet").to_pylist()
    best = next(row for row in rows if row["rank"] == 1)
    assert any(f"{best['entropy_seen']:.1%}" in values["aria-label"] for values in drawn)


def test_the_figures_are_files_of_their_own(made):
    for figure in re.findall(r"<svg.*?</svg>", made[2], re.DOTALL):
        root = ET.fromstring(svg_figures.standalone(figure))
        assert root.tag == "{http://www.w3.org/2000/svg}svg"


# ---- the same bytes


def test_it_depends_on_no_path_and_no_moment(made, tmp_path):
    about, out, text = made
    shutil.copytree(out, tmp_path / "elsewhere")
    assert page(about, tmp_path / "elsewhere") == text
    assert str(out) not in text and str(about.folder) not in text


def test_costs_are_shown_and_are_inputs(made, tmp_path):
    about, out, text = made
    shutil.copytree(out, tmp_path / "out")
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(a_record(seconds=98.76))))
    assert "98.76" in page(about, tmp_path / "out") and "98.76" not in text
    assert "77.77" not in text, "SUMO's own seconds differ from run to run"
    assert inputs_of(report, about, tmp_path / "out") != inputs_of(report, about, out)


def test_whatever_is_shown_is_an_input(made, tmp_path):
    about, out, _ = made
    before = inputs_of(report, about, out)
    changed = a_record()
    changed["stages"]["traffic"]["summary"]["collisions"] = 8
    (tmp_path / "out").mkdir()
    for name in ("tpog.parquet", "scores.parquet", "scans.parquet", "statics.ply"):
        shutil.copy(out / name, tmp_path / "out")
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(changed)))
    assert inputs_of(report, about, tmp_path / "out") != before
    assert inputs_of(report, scenario(tmp_path, SITES, seed=3), out) != before
    json.dumps(before.to_json(), allow_nan=False)


def test_what_is_not_shown_is_no_input(made, tmp_path):
    """A run that was audited says so in the summary of its scores; ``verify`` runs it again without."""
    about, out, _ = made
    shutil.copytree(out, tmp_path / "out")
    audited = a_record()
    audited["stages"]["score"] = audited["stages"]["tpog"] | {"summary": {"audit": {"misplaced_chords": 0}}}
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(audited)))
    other, own = inputs_of(report, about, tmp_path / "out"), inputs_of(report, about, out)
    assert other.more["costs"]["score"] == [1.25, 512.0]
    assert (other.files, other.settings, other.more["summaries"]) == (own.files, own.settings, own.more["summaries"])


def test_it_is_the_same_without_kept_scans(tmp_path):
    kept, cast = (finished(tmp_path / str(keep), record=False, scan={"keep": keep}) for keep in (True, False))
    assert not (cast[1] / "scans.parquet").exists()
    assert page(*kept) == page(*cast)


# ---- what it says


def test_ranking_holds_every_site_and_equal_scores_share_a_rank(tmp_path):
    about, out = finished(tmp_path, sites=[*SITES, ("twin", 6, 9, 2)])
    read = Reader(page(about, out))
    for row in read_scores(out / "scores.parquet").to_pylist():
        shown = next(r for r in read.rows if f"|{row['site']}|" in r)
        assert f"{row['egvs']:,.0f}|" in shown and f"{row['entropy_seen']:.1%}|" in shown
        twins = row["site"] in ("north", "twin")
        assert shown.strip("|").split("|")[0] == f"{row['rank']}{'=' if twins else ''}"


def test_headline_names_the_best_and_its_lead(made):
    rows = sorted(read_scores(made[1] / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    text = Reader(made[2]).text
    assert f"{rows[0]['site']} is the best of 4 sites" in text
    assert f"leads {rows[1]['site']}, the next, by {1 - rows[1]['egvs'] / rows[0]['egvs']:.1%}" in text


def test_what_sites_see_agrees_with_their_scores(made):
    about, out, text = made
    tpog = read_tpog(out / "tpog.parquet")
    field = EntropyField.of(tpog.counts, tpog.frames, tpog.grid)
    rows = {row["site"]: row for row in read_scores(out / "scores.parquet").to_pylist()}
    work = open_folder(about, out)
    scorer = Scorer(get_scene(work), tpog)
    for site_scan in empty_scans(work, ["north", "west"]):
        name, crossed = site_scan.site.name, scorer.hits(site_scan.beams).ravel()[field.cells] > 0
        assert field.per_cell_bit[crossed].sum() / field.per_cell_bit.sum() == pytest.approx(rows[name]["entropy_seen"])
        if rows[name]["rank"] in (1, 4):
            assert f"sees {crossed.sum():,} of {len(crossed):,} uncertain voxels" in text


def test_the_record_is_shown(made):
    text = Reader(made[2]).text
    for shown in (
        "3 to 5",
        "1,234",
        "5 m/s (18 km/h)",
        "25.0%",
        "12.5 s",
        "9.8.7",
        "4 lines",
        "1.25",
        "512 MB",
        "ab" * 32,
    ):
        assert shown in text


def test_effects_are_named_and_no_longer_left_out(made):
    about, out, text = made
    assert "Effects none" in Reader(text).text and "fog" in text
    foggy = about.with_effects(EffectsConfig.of({"fog": {"visibility_m": 100}, "moving_occlusion": {}}))
    ranking, tpog = Ranking.read(out / "scores.parquet"), read_tpog(out / "tpog.parquet")
    shown = report_page.render_page(foggy, ranking, tpog, Figures("", "", None, Backdrop((), Roads())), {}, None)
    assert "this run models fog, moving occlusion. Left out are rain, " in Reader(shown).text


# ---- edges


def test_own_columns_of_the_sites_file_are_shown_by_pole(tmp_path):
    rows = [("a", 6, 9, 2, "City & Co", 7), ("b", 6, 9, 3, "City & Co", 8), ("c", 6, -1, 3, "", 9)]
    table = (
        page(*finished(tmp_path, rows, columns=("owner", "fid")))
        .split("What your file of sites says of them")[1]
        .split("</table>")[0]
    )
    assert '>Pole</th><th scope="col">owner</th><th scope="col">fid</th>' in table
    assert ">a</th><td>City &amp; Co</td><td>" in table
    assert ">c</th><td>\u2013</td><td>9</td>" in table
    assert {"7, 8", "8, 7"} & {cell.split("<")[0] for cell in table.split("<td>")}


def test_without_own_columns_there_is_no_table_of_them(made):
    assert "What your file of sites says" not in made[2]


def test_one_site(tmp_path):
    text = page(*finished(tmp_path, sites=SITES[:1]))
    read = Reader(text)
    assert "north, the only site, sees" in read.text
    assert sum(tag == "svg" for tag, _ in read.tags) == 7


def test_no_traffic(tmp_path):
    about, out = finished(tmp_path, counts=lambda grid: np.zeros(grid.shape, dtype=np.int64))
    read = Reader(page(about, out))
    assert read.text.count("No traffic in the region") >= 3
    assert sum(tag == "svg" for tag, _ in read.tags) == 1, "the map of the sites stays"
    assert "nan" not in read.text.lower().split()


def test_nothing_uncertain(tmp_path):
    about, out = finished(tmp_path, counts=lambda grid: (lane(grid) > 0) * FRAMES)
    assert "Nothing in the region is uncertain" in Reader(page(about, out)).text


def test_all_scores_equal(tmp_path):
    about, out = finished(tmp_path, sites=[(f"s{i}", 6, 9, 2) for i in range(3)])
    read = Reader(page(about, out))
    assert "All 3 sites score the same" in read.text
    assert sum(row.startswith("|1=") or row.startswith("1=") for row in (r.lstrip("|") for r in read.rows)) == 3


def test_no_cap(tmp_path):
    about, out = finished(tmp_path, score={"gamma": float("inf")})
    text = Reader(page(about, out)).text
    assert "∞" in text and "inf" not in text.split() and "any site could reach" not in text
    json.dumps(inputs_of(report, about, out).to_json(), allow_nan=False)


@pytest.mark.slow
def test_no_record_no_costs(tmp_path):
    about, out = finished(tmp_path, record=False)
    read = Reader(page(about, out))
    assert any(row.strip("|").startswith("traffic|–|") for row in read.rows)
    (out / "run.json").write_text(
        json.dumps(add_checksum(a_record() | {"stages": {"scan": {"artefacts": {}, "summary": {}}}}))
    )
    assert Reader(page(about, out)).text == read.text


def test_a_far_site_is_on_the_map(tmp_path):
    about, out = finished(tmp_path, sites=[*SITES, ("far", 40, 30, 5)])
    x0, y0, x1, y1 = svg_figures.extent(about.roi.grid, [MapSite("far", 40, 30, 5, 1.0, 1)])
    assert x0 < 0 and y0 < 0 and x1 > 40 and y1 > 30
    assert "far" in Reader(page(about, out)).text


def choices(text):
    """What the page holds of the sites that can be chosen."""
    return json.loads(re.search(r'id="site-data">(.*?)</script>', text, re.DOTALL).group(1))


@pytest.mark.slow
@pytest.mark.parametrize(("count", "is_coarse"), [(40, False), (41, True)])
def test_every_site_can_be_chosen_with_larger_pixels_where_there_are_many(tmp_path, monkeypatch, count, is_coarse):
    monkeypatch.setattr(figures, "_COARSE_PIXELS", 100)
    sites = [(f"g{n:03}", 0.3 * n, -1, 2) for n in range(count)]
    about, out = finished(tmp_path, sites=sites)
    text = page(about, out)
    found = choices(text)["sites"]
    ranked = sorted(read_scores(out / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    assert sorted(found) == [name for name, *_ in sites]
    assert ("drawn with larger pixels" in text) == is_coarse
    assert ("6 more sites between these are not listed, but can be chosen below" in text) == is_coarse

    def width(site, kind):
        return int.from_bytes(base64.b64decode(found[site]["images"][kind][0])[16:20], "big")

    best, second = ranked[0]["site"], ranked[1]["site"]
    assert width(best, "scan") == 300 and width(second, "scan") == (150 if is_coarse else 300)
    assert width(second, "seen") == (width(best, "seen") // 2 if is_coarse else width(best, "seen"))


@pytest.mark.slow
def test_five_hundred_sites(tmp_path):
    sites = [(f"g{n:03}", 0.5 * (n % 25), -1 - 0.5 * (n // 25), 2) for n in range(500)]
    about, out = finished(tmp_path, sites=sites)
    text = page(about, out)
    read = Reader(text)
    rows = sorted(read_scores(out / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    shown = [row for row in read.rows if re.search(r"\|g\d{3}\|", f"|{row}")]
    assert len(shown) == 35 and "465 more sites" in read.text and "can be chosen below" not in read.text
    assert list(choices(text)["sites"]) == [row["site"] for row in rows[:195] + rows[-5:]]
    assert "any of the first 195 and the last 5 sites" in read.text
    assert f"|{rows[-1]['site']}|" in shown[-1]
    assert len(text) < 2_000_000
    titles = [t for t in read.texts if "rank" in t and "EGVS" in t and "height" in t]
    assert len({name for title in titles for name in re.findall(r"g\d{3}", title)}) == 500, (
        "each tells its name on the map"
    )


# ---- the drawings


def decoded(png):
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


def test_north_is_up_and_east_is_right():
    grid = Grid((0.0, 0.0, 0.0), 1.0, (4, 3, 1))
    field = np.zeros((4, 3))
    field[3, 2], field[0, 0] = 4.0, 1.0
    drawn = maps.occupancy(grid, field, "voxels", PLAIN, [MapSite("a", 0, 0, 1, 1.0, 1)], "")
    for png in re.findall(r'href="([^"]+)"', drawn):
        index = decoded(png)
        assert index.shape == (3, 4) and index[0, 3] == 254 and index[2, 0] == 1 + 253.999 // 2
        assert np.count_nonzero(index) == 2


def test_large_grids_are_averaged():
    field = np.zeros((1300, 700))
    field[:2, :2] = 3.0
    smaller = colours.downsample(field, np.mean)
    assert smaller.shape == (650, 350) and smaller[0, 0] == 3.0 and smaller.sum() == 3.0


def test_names_do_not_hide_one_another():
    candidates = [MapSite(f"c{n:02}", 5.0 * n, 50.0, 2.0, 100.0 - n, n + 1) for n in range(8)]
    grid = Grid((0.0, 0.0, 0.0), 0.5, (200, 100, 4))
    drawn = maps.site_map(grid, np.zeros((200, 100)), PLAIN, candidates, "")
    labels = [(float(x), float(y)) for x, y in re.findall(r'class="label" x="([\d.]+)" y="([\d.]+)"', drawn)]
    assert len(labels) == 8
    for i, (x, y) in enumerate(labels):
        for u, v in labels[:i]:
            assert abs(x - u) >= 21 or abs(y - v) >= 12


def test_sites_at_one_place_are_rings_and_the_best_is_inside():
    candidates = [
        MapSite("low", 5.0, 5.0, 2.0, 10.0, 2),
        MapSite("high", 5.0, 5.0, 4.0, 20.0, 1),
        MapSite("else", 9.0, 9.0, 4.0, 5.0, 3),
    ]
    drawn = maps.site_map(Grid((0.0, 0.0, 0.0), 0.5, (20, 20, 4)), np.zeros((20, 20)), PLAIN, candidates, "")
    both = re.search(r'<g class="site first"[^>]*>.*?</g>', drawn).group()
    radii = [(float(r), int(q)) for q, r in re.findall(r'class="q(\d+)".*?r="([\d.]+)"', both)]
    assert len(radii) == 2 and radii[0][0] > radii[1][0] and radii[1][1] == 16
    assert "high, low" in drawn and "height 4 m; low" in both


def test_outlines_have_no_inner_edges():
    outlines = {group.look: group for group in outlines_of(world(), (0.0, 0.0, 12.0, 8.0))}
    assert {look: group.kinds for look, group in outlines.items()} == {
        "large": ("building",), "small": ("pole",), "green": ("tree crown",),
    }  # fmt: skip
    assert [len(ring) for ring in outlines["large"].rings] == [5], "a rectangle: its triangles are united"


def test_outlines_are_cut_to_what_is_shown():
    (buildings,) = outlines_of(world(), (9.0, 5.0, 10.0, 8.0))
    assert buildings.rings[0][:, 0].min() >= 8.0 and buildings.rings[0][:, 0].max() <= 11.0
    empty = World(np.empty((0, 3)), np.empty((0, 3), dtype=np.int32), np.empty(0, dtype=np.int32), ())
    assert outlines_of(empty, (0.0, 0.0, 1.0, 1.0)) == ()


@pytest.mark.parametrize(
    ("low", "high", "texts"),
    [
        (0, 10, ["0", "2", "4", "6", "8", "10"]),
        (389_401, 389_499, ["389,420", "389,440", "389,460", "389,480"]),
        (-0.3, 0.3, ["-0.2", "0.0", "0.2"]),
        (0, 0.05, ["0.00", "0.01", "0.02", "0.03", "0.04", "0.05"]),
        (5, 5, []),
    ],
)
def test_ticks_are_round(low, high, texts):
    assert [text for _, text in svg_figures.round_values(low, high, 5)] == texts


@pytest.mark.slow
def test_the_accuracy_study_is_shown_where_there_is_one(mini, tmp_path, run_egvs, monkeypatch):
    """Its recommendation, the front, the figure; not of another scenario or other files; the run is verified in each
    case."""
    monkeypatch.setattr(study_settings, "VOXELS_M", (1.0,))
    monkeypatch.setattr(study_settings, "GAMMAS", (2.0,))
    monkeypatch.setattr(study_settings, "_others", lambda _: iter(()))
    monkeypatch.setattr(accuracy, "REPEATS", 1)
    own = score_errors.mark_pareto_front

    def thinned(rows, tolerance):
        """The clock decides which of two fast settings is the cheapest: here it is always the same."""
        return own(
            [replace(r, seconds=0.5 if r.setting == "every 2nd azimuth" else 1.0, judged=0.0) for r in rows], tolerance
        )

    monkeypatch.setattr(score_errors, "mark_pareto_front", thinned)
    out = tmp_path / "out"

    def shown():
        return "What accuracy costs" in (out / "report.html").read_text()

    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert not shown()
    code, printed, error = run_egvs("accuracy", mini, "--out", out)
    assert code == 0, error
    assert printed.splitlines()[-1] == str(out / "report.html")
    text = (out / "report.html").read_text()
    assert f"data:image/png;base64,{base64.b64encode((out / 'accuracy.png').read_bytes()).decode()}" in text
    rows = parquet.read_artefact(out / "accuracy.parquet", "accuracy")[0].to_pylist()
    best = next(row for row in rows if row["recommended"])
    assert best["setting"] == "every 2nd azimuth"
    section = text[text.index("What accuracy costs") :]
    section = section[: section.index("</section>")]
    assert f"<code>{best['overrides']}</code>" in html.unescape(section)
    assert section.count("<tr") == 1 + sum(
        row["front"] or row["recommended"] or row["kind"] == "scenario" for row in rows
    )
    assert run_egvs("verify", out)[0] == 0

    assert run_egvs("accuracy", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not shown()  # that study is of another scenario than the run
    assert run_egvs("verify", out)[0] == 0
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert shown()
    assert run_egvs("verify", out)[0] == 0
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    assert run_egvs("run", mini, "--out", out, "--set", "score.gamma=3.0")[0] == 0
    assert not shown()  # nor is it of other sites


@pytest.mark.slow
def test_a_study_that_was_replaced_is_named_by_verify(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("run", mini, "--out", out)[0] == 0
    assert run_egvs("accuracy", mini, "--out", out, "--budget", "0.001s")[0] == 0
    (out / "accuracy.png").write_bytes((out / "accuracy.png").read_bytes() + b"x")
    code, printed, _ = run_egvs("verify", out)
    assert code == 1
    assert "report.html shows accuracy.png, which was replaced since" in printed


@pytest.mark.slow
def test_a_damaged_study_is_named(mini, tmp_path, run_egvs):
    out = tmp_path / "out"
    assert run_egvs("accuracy", mini, "--out", out, "--budget", "0.001s")[0] == 0
    parquet.write_artefact(
        out / "accuracy.parquet",
        "scores",
        {name: [] for name in parquet.arrow_schema("scores").names},
        {"schema": 1},
    )
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "accuracy.parquet: does not match its checksum in accuracy.sha256. Remove it, or run" in error
    (out / "accuracy.sha256").unlink()  # as an earlier version left none
    code, _, error = run_egvs("run", mini, "--out", out)
    assert code == 2
    assert "accuracy.parquet: is not an accuracy study (" in error
    assert "Remove it, or run egvs accuracy again." in error
