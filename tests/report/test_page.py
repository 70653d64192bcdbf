"""The report is one valid file that loads nothing, agrees with the artefacts, and has the same bytes each time."""

from __future__ import annotations

import json
import re
import shutil
from itertools import pairwise

import numpy as np
import pytest

from egvs.artefacts.checksums import add_checksum
from egvs.artefacts.readers import read_scores
from egvs.artefacts.tpog import read_tpog
from egvs.drawing.run_figures import Figures
from egvs.report import page
from egvs.report.page import PageContents
from egvs.results.ranking import Ranking
from egvs.scenario.effects_config import EffectsConfig
from tests.report.small_runs import (
    EMPTY_BACKDROP,
    FRAMES,
    SENSOR,
    SITES,
    UNSAFE_NAME,
    PageReader,
    lane_counts,
    make_record,
    make_scenario,
    render_report,
    run_to_scores,
    site_data,
)
from tests.scoring.roads import NETWORK
from tests.stage_runner import inputs_of


def test_shows_counted_and_simulated_vehicles(tmp_path):
    scenario, out = run_to_scores(tmp_path)
    record = make_record()
    record["stages"]["traffic"]["summary"]["counts"] = [
        {"place": "<a> to b", "kind": "", "counted_per_h": 320.0, "simulated_per_h": 311.5, "geh": 0.48},
        {"place": "c", "kind": "truck", "counted_per_h": 60.0, "simulated_per_h": 20.0, "geh": 6.32},
    ]
    (out / "run.json").write_text(json.dumps(add_checksum(record)), encoding="utf-8")
    read = PageReader(render_report(scenario, out))
    assert "<a> to b|all|320|311.5|0.5|" in read.rows
    assert "c|truck|60|20|6.3|!|" in [row.replace("||", "|") for row in read.rows]


def test_flows_that_are_assumed_are_not_called_counted(tmp_path):
    scenario, out = run_to_scores(tmp_path)
    record = make_record()
    record["stages"]["traffic"]["summary"]["counts"] = [
        {"place": "a to b", "kind": "", "counted_per_h": 320.0, "simulated_per_h": 311.5, "geh": 0.48},
    ]
    (out / "run.json").write_text(json.dumps(add_checksum(record)), encoding="utf-8")
    assumed = scenario.model_copy(update={"assumed": ("traffic (from the road classes)",)})
    page = render_report(assumed, out)
    assert "Assumed and simulated traffic" in page and "Counted" not in page
    other = scenario.model_copy(update={"assumed": ("positions of traffic lights",)})
    assert "Counted and simulated traffic" in render_report(other, out)


def test_counts_are_described_as_movements_of_the_network(tmp_path):
    (tmp_path / "scenario").mkdir()
    (tmp_path / "scenario" / "made.net.xml").write_text(NETWORK)
    (tmp_path / "out" / "sumo").mkdir(parents=True)
    (tmp_path / "out" / "sumo" / "network.net.xml").write_text(NETWORK)
    counts = [{"from_edge": "near", "to_edge": "up", "per_hour": 320.0}, {"edge": "back", "per_hour": 60.0}]
    traffic = {"network": "made.net.xml", "frames": FRAMES, "counts": counts}
    scenario, out = run_to_scores(tmp_path, traffic=traffic)
    record = make_record()
    record["stages"]["traffic"]["summary"]["counts"] = [
        {"place": place, "kind": "", "counted_per_h": 60.0, "simulated_per_h": 60.0, "geh": 0.0}
        for place in ("near to up", "back")
    ]
    (out / "run.json").write_text(json.dumps(add_checksum(record)), encoding="utf-8")
    read = PageReader(render_report(scenario, out))
    assert "near to up|High Street (west), left to an unnamed street|all|60|60|0.0|" in read.rows
    assert "back|High Street (east)|all|60|60|0.0|" in read.rows


def test_has_no_table_of_counts_without_counts(plain_run):
    assert "Counted and simulated" not in plain_run[2]


def test_the_answer_and_its_map_come_first(plain_run):
    """Two lines, the map, what is assumed; what compares scores comes after the ranking."""
    text = PageReader(plain_run[2]).text.partition("Before you trust")[0]
    assert "is the best of 4 sites" in text
    page = plain_run[2]
    positions = [page.index(part) for part in ("<h1>", '<p class="lede">', "<svg", 'class="caveats"', "<table")]
    assert positions == sorted(positions)
    assert page.index("<h2>Ranking") < page.index("<h2>What the score means")


def test_no_heading_skips_a_level(plain_run):
    levels = [int(tag[1]) for tag, _ in PageReader(plain_run[2]).tags if re.fullmatch("h[1-6]", tag)]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(levels))


def test_page_is_well_formed_and_ids_are_unique(plain_run):
    read = PageReader(plain_run[2])
    assert len(read.ids) == len(set(read.ids)) > 5
    used = re.findall(r"url\(#([^)]+)\)", plain_run[2])
    assert used and set(used) <= set(read.ids)


def test_page_loads_nothing_from_elsewhere(plain_run):
    read = PageReader(plain_run[2])
    assert read.fetched and all(value.startswith(("data:image/png;base64,", "#")) for value in read.fetched)
    assert {tag for tag, _ in read.tags}.isdisjoint({"link", "iframe", "object", "embed", "base", "form"})
    assert "http://" not in plain_run[2] and "https://" not in plain_run[2] and "@import" not in plain_run[2]
    assert all(target.startswith("#") for target in re.findall(r"url\(([^)]*)\)", plain_run[2]))


def test_escapes_text_of_users(plain_run):
    text = plain_run[2]
    assert UNSAFE_NAME not in text and "<i>late" not in text
    assert re.findall("<script[^>]*>", text) == ['<script type="application/json" id="site-data">', "<script>"]
    read = PageReader(text)
    assert any(f"|{UNSAFE_NAME}|" in row for row in read.rows)
    assert "<script>alert(1)</script>" in read.text and "<i>late</i>" in read.text


def test_every_figure_has_a_text_alternative(plain_run):
    drawn = [values for tag, values in PageReader(plain_run[2]).tags if tag == "svg"]
    assert len(drawn) == 12
    assert all(values["role"] == "img" and values["aria-label"] for values in drawn)
    rows = read_scores(plain_run[1] / "scores.parquet").to_pylist()
    best = next(row for row in rows if row["rank"] == 1)
    assert any(f"{100 * best['entropy_seen']:.1f} %" in values["aria-label"] for values in drawn)


def test_bytes_do_not_depend_on_path_or_time(plain_run, tmp_path):
    scenario, out, text = plain_run
    shutil.copytree(out, tmp_path / "elsewhere")
    assert render_report(scenario, tmp_path / "elsewhere") == text
    assert str(out) not in text and str(scenario.folder) not in text


def test_shows_costs_and_counts_them_as_inputs(plain_run, tmp_path):
    scenario, out, text = plain_run
    shutil.copytree(out, tmp_path / "out")
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(make_record(seconds=98.76))))
    assert "98.76" in render_report(scenario, tmp_path / "out") and "98.76" not in text
    assert "77.77" not in text, "SUMO's own seconds differ from run to run"
    assert inputs_of(page, scenario, tmp_path / "out") != inputs_of(page, scenario, out)


def test_everything_on_the_page_is_an_input(plain_run, tmp_path):
    scenario, out, _ = plain_run
    before = inputs_of(page, scenario, out)
    changed = make_record()
    changed["stages"]["traffic"]["summary"]["collisions"] = 8
    (tmp_path / "out").mkdir()
    for name in ("tpog.parquet", "scores.parquet", "scans.parquet", "statics.ply"):
        shutil.copy(out / name, tmp_path / "out")
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(changed)))
    assert inputs_of(page, scenario, tmp_path / "out") != before
    assert inputs_of(page, make_scenario(tmp_path, SITES, seed=3), out) != before
    json.dumps(before.to_json(), allow_nan=False)


def test_summaries_that_are_not_on_the_page_are_no_input(plain_run, tmp_path):
    """A run that was audited says so in the summary of its scores; ``verify`` runs it again without."""
    scenario, out, _ = plain_run
    shutil.copytree(out, tmp_path / "out")
    audited = make_record()
    audited["stages"]["score"] = audited["stages"]["tpog"] | {"summary": {"audit": {"misplaced_chords": 0}}}
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(audited)))
    other, original = inputs_of(page, scenario, tmp_path / "out"), inputs_of(page, scenario, out)
    assert other.more["costs"]["score"] == [1.25, 512.0]
    assert (other.files, other.settings, other.more["summaries"]) == (
        original.files,
        original.settings,
        original.more["summaries"],
    )


def test_page_is_the_same_without_saved_scans(tmp_path):
    saved, traced = (run_to_scores(tmp_path / str(keep), record=False, scan={"keep": keep}) for keep in (True, False))
    assert not (traced[1] / "scans.parquet").exists()
    assert render_report(*saved) == render_report(*traced)


def test_ranking_has_every_site_and_equal_scores_share_a_rank(tmp_path):
    scenario, out = run_to_scores(tmp_path, sites=[*SITES, ("twin", 6, 9, 2)])
    read = PageReader(render_report(scenario, out))
    for row in read_scores(out / "scores.parquet").to_pylist():
        visible_row = next(r for r in read.rows if f"|{row['site']}|" in r)
        assert f"{row['egvs']:,.0f}|" in visible_row and f"{100 * row['entropy_seen']:.1f} %|" in visible_row
        twins = row["site"] in ("north", "twin")
        assert visible_row.strip("|").split("|")[0] == f"{row['rank']}{'=' if twins else ''}"


def test_headline_names_the_best_site_and_the_lead(plain_run):
    rows = sorted(read_scores(plain_run[1] / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    text = PageReader(plain_run[2]).text
    assert f"Pole {rows[0]['site']}, 1.5 m up, level, is the best of 4 sites" in text
    assert f"leads the next site, {rows[1]['site']}, by {100 * (1 - rows[1]['egvs'] / rows[0]['egvs']):.1f} %" in text


def test_says_which_losses_of_returns_are_simulated(plain_run, tmp_path):
    scenario, out, text = plain_run
    shutil.copytree(out, tmp_path / "out")
    record = make_record()
    summary = {"sites": 4, "solids": 3, "lanes": 0, "losses": ["losses are simulated for small (17 m)"]}
    record["stages"]["check"] = record["stages"]["tpog"] | {"summary": summary}
    (tmp_path / "out" / "run.json").write_text(json.dumps(add_checksum(record)))
    assert "Losses are simulated for small (17\u00a0m)." in render_report(scenario, tmp_path / "out")
    assert "losses are simulated" not in text.lower()


def test_shows_the_record_of_the_run(plain_run):
    text = PageReader(plain_run[2]).text
    for visible_row in (
        "3 to 5",
        "1,234",
        "5 m/s (18 km/h)",
        "25.0 %",
        "12.5 s",
        "9.8.7",
        "4 lines",
        "1.25",
        "512 MB",
        "ab" * 32,
    ):
        assert visible_row in text


def test_lists_effects_that_are_modelled_and_those_that_are_not(plain_run):
    scenario, out, text = plain_run
    assert "Effects none" in PageReader(text).text and "fog" in text
    foggy = scenario.with_effects(EffectsConfig.from_dict({"fog": {"visibility_m": 100}, "moving_occlusion": {}}))
    ranking, tpog = Ranking.read(out / "scores.parquet"), read_tpog(out / "tpog.parquet")
    html = page.render_page(PageContents(foggy, ranking, tpog, Figures("", "", None, EMPTY_BACKDROP), {}))
    assert "This run models these effects: fog, moving occlusion. It does not model rain, " in PageReader(html).text


def test_shows_user_columns_by_pole(tmp_path):
    rows = [("a", 6, 9, 2, "City & Co", 7), ("b", 6, 9, 3, "City & Co", 8), ("c", 6, -1, 3, "", 9)]
    table = (
        render_report(*run_to_scores(tmp_path, rows, columns=("owner", "fid")))
        .split("<h2>Your columns from the sites file")[1]
        .split("</table>")[0]
    )
    assert '>Pole</th><th scope="col">owner</th><th scope="col">fid</th>' in table
    assert ">a</th><td>City &amp; Co</td><td>" in table
    assert ">c</th><td>\u2013</td><td>9</td>" in table
    assert {"7, 8", "8, 7"} & {cell.split("<")[0] for cell in table.split("<td>")}


def test_has_no_table_of_user_columns_without_them(plain_run):
    assert "Your columns from the sites file" not in plain_run[2]


TWO_SENSORS = {"small": SENSOR, "dense": SENSOR | {"azimuth_step_deg": 1}}
SITES_OF_TWO_SENSORS = [("n small", 6, 9, 2, "small"), ("n dense", 6, 9, 2, "dense"), ("s", 6, -1, 2, "small")]


def sensor_section(folder, **keys):
    """Text of the section on sensors, ranked by the share of vehicles seen well."""
    keys |= {"sensors": TWO_SENSORS, "score": {"rank_by": "seen_well"}}
    html = render_report(*run_to_scores(folder, SITES_OF_TWO_SENSORS, columns=("sensor",), **keys))
    assert PageReader(html).ids.count("sensors") == 1
    return html.split('<section id="sensors">')[1].split("</section>")[0]


def test_compares_sensors_where_there_are_several(tmp_path):
    section = sensor_section(tmp_path)
    rows = [row.split("</th>")[0] for row in section.split('<th scope="row">')[1:]]
    assert rows == ["small", "dense"]  # the one that sees least is the baseline
    assert "One more" not in section
    assert "--set &#39;costs.sensor={&#34;small&#34; = PRICE, &#34;dense&#34; = PRICE}&#39;" in section
    assert "docs/validity.md" in section


def test_has_no_section_on_sensors_with_one_sensor(plain_run):
    assert "Which sensor?" not in plain_run[2]


def test_costs_are_an_input_of_the_page(plain_run, tmp_path):
    _, out, _ = plain_run
    before = inputs_of(page, make_scenario(tmp_path, SITES), out)
    assert inputs_of(page, make_scenario(tmp_path, SITES, costs={"pole": 5}), out) != before


def test_page_of_one_site(tmp_path):
    text = render_report(*run_to_scores(tmp_path, sites=SITES[:1]))
    read = PageReader(text)
    assert "Pole north, 2 m up, level, the only site, sees" in read.text
    assert sum(tag == "svg" for tag, _ in read.tags) == 8


def test_page_without_traffic(tmp_path):
    scenario, out = run_to_scores(tmp_path, counts=lambda grid: np.zeros(grid.shape, dtype=np.int64))
    read = PageReader(render_report(scenario, out))
    assert read.text.count("No traffic in the region") >= 3
    assert sum(tag == "svg" for tag, _ in read.tags) == 1, "the map of the sites stays"
    assert "nan" not in read.text.lower().split()


def test_page_without_uncertainty(tmp_path):
    scenario, out = run_to_scores(tmp_path, counts=lambda grid: (lane_counts(grid) > 0) * FRAMES)
    assert "Nothing in the region is uncertain" in PageReader(render_report(scenario, out)).text


def test_page_of_equal_scores(tmp_path):
    scenario, out = run_to_scores(tmp_path, sites=[(f"s{i}", 6, 9, 2) for i in range(3)])
    read = PageReader(render_report(scenario, out))
    assert "All 3 sites score the same" in read.text
    assert sum(row.startswith("|1=") or row.startswith("1=") for row in (r.lstrip("|") for r in read.rows)) == 3


def test_page_without_a_cap(tmp_path):
    scenario, out = run_to_scores(tmp_path, score={"gamma": float("inf")})
    text = PageReader(render_report(scenario, out)).text
    assert "∞" in text and "inf" not in text.split() and "upper limit" not in text
    json.dumps(inputs_of(page, scenario, out).to_json(), allow_nan=False)


@pytest.mark.slow
def test_page_without_a_record_has_no_costs(tmp_path):
    scenario, out = run_to_scores(tmp_path, record=False)
    read = PageReader(render_report(scenario, out))
    assert any(row.strip("|").startswith("traffic|–|") for row in read.rows)
    (out / "run.json").write_text(
        json.dumps(add_checksum(make_record() | {"stages": {"scan": {"artefacts": {}, "summary": {}}}}))
    )
    assert PageReader(render_report(scenario, out)).text == read.text


@pytest.mark.slow
def test_page_of_five_hundred_sites(tmp_path):
    sites = [(f"g{n:03}", 0.5 * (n % 25), -1 - 0.5 * (n // 25), 2) for n in range(500)]
    scenario, out = run_to_scores(tmp_path, sites=sites)
    text = render_report(scenario, out)
    read = PageReader(text)
    rows = sorted(read_scores(out / "scores.parquet").to_pylist(), key=lambda row: row["rank"])
    listed = [row for row in read.rows if re.search(r"\|g\d{3}\|", f"|{row}")]
    assert len(listed) == 35 and "465 more sites" in read.text and "can be chosen below" not in read.text
    assert list(site_data(text)["sites"]) == [row["site"] for row in rows[:195] + rows[-5:]]
    assert "any of the first 195 and the last 5 sites" in read.text
    assert f"|{rows[-1]['site']}|" in listed[-1]
    assert len(text) < 2_000_000
    titles = [t for t in read.texts if "rank" in t and "EGVS" in t and "height" in t]
    assert len({name for title in titles for name in re.findall(r"g\d{3}", title)}) == 500, (
        "each tells its name on the map"
    )
