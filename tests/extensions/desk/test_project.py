"""Changes of a scenario: what they write, what is refused and why, undo and redo."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest

from egvs.extensions.desk.project import CsvTable
from egvs.extensions.desk.refusals import RefusalError, parse_number
from egvs.scenario.loading import load
from egvs.sensors.sites import candidate_sites
from tests.extensions.desk.conftest import write_inline_plan, write_periods
from tests.extensions.desk.serving import Client

pytestmark = pytest.mark.system  # a junction is made from a map


def read(folder: Path, name: str) -> str:
    return (folder / "work" / "town" / name).read_text()


def site(desk: Client, name: str) -> dict[str, object]:
    return next(each for each in desk.project["sites"] if each["site"] == name)


@pytest.mark.parametrize(("text", "value"), [("8.5", 8.5), ("8,5", 8.5), (" -3 ", -3.0), (4, 4.0), ("0.125", 0.125)])
def test_numbers_as_people_type_them(text: object, value: float) -> None:
    assert parse_number(text, "x") == value


@pytest.mark.parametrize("text", ["1.234", "1,234", "", "nan", "1e999", "8 5", "1_0", True, None, [], "inf"])
def test_other_numbers_are_refused(text: object) -> None:
    with pytest.raises(RefusalError):
        parse_number(text, "x")


def test_tables_keep_their_form() -> None:
    text = "site;x_m;note\na;1;one, two\nb;2;\n"
    assert CsvTable.parse(text).to_text() == text


@pytest.mark.slow
def test_lists_scenarios_and_shipped_ones(town: Client) -> None:
    start = town.ok("GET", "/api/start")
    assert [each["id"] for each in start["scenarios"]] == ["mini", "town"]
    assert {"demo", "roundabout"} <= {each["id"] for each in start["shipped"]}
    assert {".osm", ".net.xml"} <= set(start["map_kinds"])


@pytest.mark.slow
def test_shows_poles_of_the_map_first(town: Client) -> None:
    project = town.project
    assert [(each["site"], each["kind"], each["exists"]) for each in project["sites"]] == [
        ("signal1", "signal", True),
        ("lamp1", "lamp", True),
    ]
    assert project["sites_editable"] and not project["counts"][0]["reason"]


@pytest.mark.slow
def test_shows_the_map(town: Client) -> None:
    scene = town.ok("GET", "/api/map")
    assert scene["key"] == town.project["map_key"]
    assert {"building", "pole"} <= {solid["kind"] for solid in scene["solids"]}
    assert scene["lanes"] and scene["junctions"]
    assert "OpenStreetMap" in scene["attribution"]
    for solid in scene["solids"]:
        assert solid["outline_m"][0][0] == solid["outline_m"][0][-1]


@pytest.mark.slow
def test_adds_moves_edits_and_removes_a_pole(town: Client, tmp_path: Path) -> None:
    before = read(tmp_path, "sites.csv")
    assert town.ok("POST", "/api/sites", {"x_m": "211,5", "y_m": 211})["site"] == "new1"
    assert read(tmp_path, "sites.csv") == before + "new1,211.5,211.0,,\n"
    town.ok("PATCH", "/api/sites/new1", {"x_m": 212})
    town.ok("PATCH", "/api/sites/new1", {"z_m": "6,5", "pitch_deg": -5, "cost": 100, "must": True, "exists": True})
    changed = site(town, "new1")
    assert [changed[key] for key in ("x_m", "z_m", "pitch_deg", "cost", "must", "exists")] == [
        212,
        6.5,
        -5,
        100,
        True,
        True,
    ]
    assert load(tmp_path / "work" / "town").placement.forced == ("new1",)
    town.ok("PATCH", "/api/sites/new1", {"site": "corner"})
    assert load(tmp_path / "work" / "town").placement.forced == ("corner",)
    town.ok("PATCH", "/api/sites/corner", {"must": False, "must_not": True, "z_m": None, "pitch_deg": "", "cost": None})
    assert load(tmp_path / "work" / "town").placement.excluded == ("corner",)
    town.ok("DELETE", "/api/sites/corner")
    assert read(tmp_path, "sites.csv") == before
    assert load(tmp_path / "work" / "town").placement.excluded == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("x_m", "y_m", "reason"),
    [
        (200, 200, "in the junction of East Street and North Street"),
        (230, 198.2, "in a lane of East Street"),
        (230, 222, "building"),
        (9000, 0, "from the region of interest"),
    ],
)
def test_refuses_impossible_positions(town: Client, tmp_path: Path, x_m: float, y_m: float, reason: str) -> None:
    before = read(tmp_path, "sites.csv")
    position = {"x_m": x_m, "y_m": y_m}
    checked = town.ok("POST", "/api/sites/check", position)
    assert not checked["ok"] and reason in checked["message"]
    for method, path in (("POST", "/api/sites"), ("PATCH", "/api/sites/lamp1")):
        status, message, _ = town.refused(method, path, position)
        assert status == 422 and reason in message
    assert read(tmp_path, "sites.csv") == before
    assert town.project["undo"] is None


@pytest.mark.slow
@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"x_m": "1.234"}, "x_m"),
        ({"z_m": "high"}, "z_m"),
        ({"z_m": 1e9}, "z_m"),
        ({"sensor": "no such"}, "sensor"),
        ({"cost": -1}, "cost"),
        ({"must": True}, "must"),
        ({"must": "yes"}, "must"),
        ({"site": "signal1"}, "site"),
        ({"site": "a/b"}, "site"),
        ({"site": ""}, "site"),
        ({"points": "/etc/passwd"}, "points"),
        ({"z_m": 6, "must": True, "must_not": True, "pitch_deg": 0}, "z_m"),
    ],
)
def test_refuses_wrong_values_and_changes_nothing(
    town: Client, tmp_path: Path, body: dict[str, object], field: str
) -> None:
    before = [read(tmp_path, name) for name in ("sites.csv", "scenario.toml")]
    status, message, wrong = town.refused("PATCH", "/api/sites/lamp1", body)
    assert (status in (409, 422), wrong) == (True, field), message
    assert str(tmp_path) not in message
    assert [read(tmp_path, name) for name in ("sites.csv", "scenario.toml")] == before


@pytest.mark.slow
def test_unknown_poles_are_refused(town: Client) -> None:
    assert town.refused("PATCH", "/api/sites/nobody", {"z_m": 4})[0] == 404
    assert town.refused("DELETE", "/api/sites/nobody")[0] == 404


@pytest.mark.slow
def test_names_stay_text(town: Client) -> None:
    name = "<img src=x onerror=alert(1)>"
    assert town.ok("POST", "/api/sites", {"x_m": 211, "y_m": 211, "site": name})["site"] == name
    status, headers, body = town.raw("GET", "/api/state")
    assert (status, headers["content-type"], headers["x-content-type-options"]) == (200, "application/json", "nosniff")
    assert name.encode() in body
    town.ok("DELETE", "/api/sites/%3Cimg%20src=x%20onerror=alert(1)%3E")


@pytest.mark.slow
def test_counts_are_written_to_the_table(town: Client, tmp_path: Path) -> None:
    (before,) = town.project["counts"]
    town.ok("PUT", "/api/counts", {"counts": {"0": "120", "1": "45,5"}})
    (after,) = town.project["counts"]
    assert [each["count_per_h"] for each in after["movements"][:2]] == [120, 45.5]
    assert after["total_per_h"] == before["total_per_h"] + 120 + 45.5 - 65 - 43
    assert [count.per_hour for count in load(tmp_path / "work" / "town").traffic.counts[:2]] == [120, 45.5]
    assert town.project["assumed"][0] == "traffic that was not counted"
    town.ok("POST", "/api/undo", {})
    assert "from the road classes" in town.project["assumed"][0]
    town.ok("POST", "/api/redo", {})
    first = after["movements"][0]
    assert (first["approach"], first["turn"]) == ("East Street (east)", "straight")
    assert first["from_m"][0] > 205 and first["to_m"][0] < 195  # from the east to the west
    for value in ("many", "-1", "1.234", 1e6, None):
        assert town.refused("PUT", "/api/counts", {"counts": {"3": value}})[::2] == (422, "3")
    assert town.refused("PUT", "/api/counts", {"counts": {"99": 1}})[0] == 404
    assert town.refused("PUT", "/api/counts", {"counts": [1]})[0] == 422


@pytest.mark.slow
def test_more_vehicles_than_lanes_carry_are_said_at_once(town: Client) -> None:
    approach = town.ok("PUT", "/api/counts", {"counts": {"0": "2500"}})["project"]["counts"][0]["approaches"][0]
    assert approach["limit_per_h"] < 2500
    movement = town.project["counts"][0]["movements"][0]
    assert "exceed" in approach["problem"] + movement["problem"]


@pytest.mark.slow
def test_settings_keep_comments(town: Client, tmp_path: Path) -> None:
    town.ok(
        "PUT", "/api/settings", {"frames": "500", "warmup_s": 60, "heights_m": ["4", 6], "pitch_deg": ["-5", "aim"]}
    )
    scenario = load(tmp_path / "work" / "town")
    assert (scenario.traffic.frames, scenario.traffic.warmup_s) == (500, 60)
    assert (scenario.sites.heights_m, scenario.sites.pitch_deg) == ((4, 6), (-5, "aim"))
    assert "# assumed. Replace it by the real plan" in read(tmp_path, "scenario.toml")
    for body in ({"frames": 0.5}, {"frames": -1}, {"sensor": "x"}, {"extends": "/etc"}, {"heights_m": []}):
        assert town.refused("PUT", "/api/settings", body)[0] == 422


@pytest.mark.slow
def test_costs_say_what_plans_cost(town: Client, tmp_path: Path) -> None:
    sensor = town.project["mounts"]["sensor"]
    unknown = {"pole_cost": 0, "sensor_costs": {sensor: None}, "least": None, "most": None, "most_sensors": 12}
    assert town.project["costs"] == unknown
    town.ok("POST", "/api/sites", {"x_m": 211, "y_m": 211})
    town.ok("PUT", "/api/settings", {"pole_cost": 500, "sensor_costs": {sensor: "8000"}})
    known = {"pole_cost": 500, "sensor_costs": {sensor: 8000}, "least": 8000, "most": 24_500}
    assert town.project["costs"] == unknown | known
    town.ok("PATCH", "/api/sites/lamp1", {"sensor": "OS1-128"})
    costs = town.project["costs"]
    assert (costs["sensor_costs"], costs["least"]) == ({sensor: 8000, "OS1-128": None}, None)  # one is not known
    town.ok("PUT", "/api/settings", {"sensor_costs": {"OS1-128": 15_000}})
    town.ok("PATCH", "/api/sites/new1", {"must_not": True})
    assert (town.project["costs"]["least"], town.project["costs"]["most"]) == (8000, 23_000)
    for wrong in ({"none": 1}, {sensor: "dear"}, {sensor: -1}, 5):
        assert town.refused("PUT", "/api/settings", {"sensor_costs": wrong})[0] == 422


@pytest.mark.slow
def test_last_pole_takes_the_sensor_of_all_along(town: Client, tmp_path: Path) -> None:
    for name in ("signal1", "lamp1"):
        town.ok("PATCH", f"/api/sites/{name}", {"sensor": "OS1-128"})
    assert town.project["mounts"]["sensor"] == "OS1-128"
    assert {each.sensor for each in candidate_sites(load(tmp_path / "work" / "town"))} == {"OS1-128"}


@pytest.mark.slow
def test_undo_and_redo_restore_every_byte(town: Client, tmp_path: Path) -> None:
    folder = tmp_path / "work" / "town"

    def contents() -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in folder.iterdir()}

    states = [contents()]
    town.ok("POST", "/api/sites", {"x_m": 211, "y_m": 211})
    states.append(contents())
    town.ok("PATCH", "/api/sites/new1", {"exists": True})
    states.append(contents())
    town.ok("PUT", "/api/counts", {"counts": {"2": 77}})
    states.append(contents())
    assert (town.project["undo"], town.project["redo"]) == ("counts", None)
    for state in states[-2::-1]:
        town.ok("POST", "/api/undo", {})
        assert contents() == state
    assert town.refused("POST", "/api/undo", {})[0] == 409
    for state in states[1:]:
        town.ok("POST", "/api/redo", {})
        assert contents() == state
    assert town.refused("POST", "/api/redo", {})[0] == 409


@pytest.mark.slow
def test_edits_by_hand_are_taken_over_and_can_be_undone(town: Client, tmp_path: Path) -> None:
    path = tmp_path / "work" / "town" / "sites.csv"
    before = path.read_text()
    path.write_text(before + "mine,211,211,,\n")
    assert site(town, "mine")["x_m"] == 211
    assert town.project["undo"] == "changes on disk"
    path.write_text("nonsense")
    assert town.project["problem"]
    assert town.refused("POST", "/api/sites", {"x_m": 212, "y_m": 212})[0] == 409
    town.ok("POST", "/api/undo", {})
    town.ok("POST", "/api/undo", {})
    assert (path.read_text(), town.project["problem"]) == (before, "")


@pytest.mark.slow
def test_suggests_kerbs(town: Client) -> None:
    poles = town.ok("GET", "/api/suggestions")["poles"]
    assert len(poles) > 4
    assert all(town.ok("POST", "/api/sites/check", pole)["ok"] for pole in poles)


@pytest.mark.slow
def test_a_rule_of_sites_cannot_be_edited(town: Client) -> None:
    town.ok("POST", "/api/copy", {"shipped": "nishishinjuku", "name": "copy"})
    project = town.project
    if not project["sites_editable"]:
        assert project["sites_reason"]
        assert town.refused("POST", "/api/sites", {"x_m": 0, "y_m": 0})[0] == 409
    assert project["id"] == "copy"
    town.ok("POST", "/api/close", {})
    assert town.ok("GET", "/api/state")["project"] is None
    assert town.refused("GET", "/api/map")[0] == 409


@pytest.mark.slow
def test_check_says_what_the_command_says(town: Client) -> None:
    assert town.ok("GET", "/api/check") == {"errors": [], "warnings": []}


@pytest.mark.slow
def test_signals_are_written_to_the_table(town: Client, tmp_path: Path) -> None:
    (signal,) = town.project["signals"]
    streets = [{row["approach"] for row in phase["green"]} for phase in signal["phases"]]
    assert streets == [{"East Street (east)", "East Street (west)"}, {"North Street (north)", "North Street (south)"}]
    assert signal["phases"][0]["green"][0]["turns"] == ["right", "straight", "left"]
    greens = [phase["green_s"] for phase in signal["phases"]]
    times = {"name": signal["name"], "green_s": ["32,5", greens[1]], "yellow_s": 4, "all_red_s": signal["all_red_s"]}
    (changed,) = town.ok("PUT", "/api/signals", times)["project"]["signals"]
    assert [phase["green_s"] for phase in changed["phases"]] == [32.5, greens[1]]
    assert (changed["yellow_s"], changed["all_red_s"]) == (4, signal["all_red_s"])
    assert "1,East Street (east),right straight left,32.5\n" in read(tmp_path, "signals.csv")
    assert town.refused("PUT", "/api/signals", {**times, "green_s": ["0", 30]})[::2] == (422, "green_s.0")
    assert town.refused("PUT", "/api/signals", {**times, "green_s": []})[0] == 422
    assert town.refused("PUT", "/api/signals", {**times, "yellow_s": "short"})[::2] == (422, "yellow_s")
    assert town.refused("PUT", "/api/signals", {**times, "name": "no"})[0] == 409
    write_inline_plan(tmp_path / "work" / "town")
    town.ok("GET", "/api/map")
    (other,) = town.project["signals"]
    assert (other["name"], other["file"], other["phases"]) == (signal["name"], "scenario.toml", [])
    assert town.refused("PUT", "/api/signals", {**times, "green_s": []})[0] == 409


@pytest.mark.slow
def test_counts_of_a_period_are_in_its_table(town: Client, tmp_path: Path) -> None:
    write_periods(tmp_path / "work" / "town")
    morning, evening = town.project["counts"]
    assert (morning["period"], evening["period"]) == ("morning", "evening")
    assert morning["total_per_h"] > evening["total_per_h"]
    before = read(tmp_path, "counts.csv")
    after = town.ok("PUT", "/api/counts", {"period": "evening", "counts": {"0": "77"}})["project"]["counts"]
    assert [period["movements"][0]["count_per_h"] for period in after] == [65, 77]
    assert read(tmp_path, "counts.csv") == before
    periods = load(tmp_path / "work" / "town").by_period()
    assert periods["evening"].traffic.counts[0].per_hour == 77
    assert town.refused("PUT", "/api/counts", {"counts": {"0": "77"}})[::2] == (404, "period")
    town.ok("POST", "/api/undo", {})
    assert town.project["counts"][1] == evening


@pytest.mark.slow
def test_obstacles_are_a_table_of_the_scenario(town: Client, tmp_path: Path) -> None:
    before = read(tmp_path, "scenario.toml")
    lorry = {"name": "lorry1", "kind": "lorry", "x_m": 190, "y_m": "203,5", "yaw_deg": 0}
    lorry |= {"length_m": 12, "width_m": 2.5, "height_m": 3.8}
    assert town.ok("PUT", "/api/obstacles", {"obstacles": [lorry]})["project"]["obstacles"] == [{**lorry, "y_m": 203.5}]
    table = load(tmp_path / "work" / "town").what_if["obstacles"]
    assert (table.share, table.boxes[0].kind, table.boxes[0].y_m) == (1.0, "lorry1", 203.5)
    for wrong in ([lorry, lorry], [{**lorry, "width_m": 0}], [{**lorry, "x_m": "1.234"}], [{"name": "x"}], "all", [1]):
        assert town.refused("PUT", "/api/obstacles", {"obstacles": wrong})[0] == 422
    assert town.refused("POST", "/api/what_if", {})[0] == 409  # there is no run
    town.ok("PUT", "/api/obstacles", {"obstacles": []})
    assert load(tmp_path / "work" / "town").what_if == {}
    town.ok("POST", "/api/undo", {})
    town.ok("POST", "/api/undo", {})
    assert read(tmp_path, "scenario.toml") == before


def packed(**files: str) -> bytes:
    """A ZIP archive of these files, by name."""
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return data.getvalue()


@pytest.mark.slow
def test_archives_of_others_are_checked(desk: Client, tmp_path: Path) -> None:
    before = sorted(tmp_path.rglob("*"))
    for archive in (
        b"no archive",
        packed(**{"readme.txt": "x"}),
        packed(**{"scenario.toml": "nonsense"}),
        packed(**{"../scenario.toml": "seed = 1"}),
    ):
        assert desk.refused("POST", "/api/import?name=sent.zip", archive)[0] in (415, 422)
    assert desk.refused("POST", "/api/import?name=mini.zip", packed(**{"scenario.toml": ""}))[0] == 409
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.slow
def test_a_scenario_that_is_a_link_is_not_opened(desk: Client, tmp_path: Path) -> None:
    path = tmp_path / "work" / "mini" / "scenario.toml"
    path.rename(tmp_path / "elsewhere.toml")
    path.symlink_to(tmp_path / "elsewhere.toml")
    assert desk.refused("POST", "/api/open", {"scenario": "mini"})[0] == 409
