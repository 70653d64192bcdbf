"""``egvs what-if``: a lorry in front of a pole hides the lane behind it, for a share of the time.

The twin computes expected scores, and the standard error of a change, from the replicates one number at a time.
"""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import InputError
from egvs.results.ranking import RankedSite, Ranking
from egvs.runs import run
from egvs.scenario.loading import load
from egvs.statistics.blocks import standard_error_inflation
from egvs.studies import what_if
from egvs.studies.paired_errors import SiteReplicates, read_replicates
from egvs.studies.what_if import WhatIfResult, WhatIfRun, compare_runs, grow_trees, prepare_runs, solid_documents
from tests.conftest import collection, feature, write_mini

LORRY = """
[what_if.lorry]
share = 0.25
boxes = [{x_m = 10, y_m = 10, length_m = 90, width_m = 2, height_m = 5, kind = "lorry"}]
"""
"""A box as long as the street and higher than the sensors, between pole_a (y = 12) and both lanes (y = 2, -2)."""

SOUTH = LORRY.replace("what_if.lorry", "what_if.south").replace("y_m = 10", "y_m = -10").replace("0.25", "0.9")
"""The same in front of pole_b, the best site."""

FAR = """
[what_if.far]
share = 0.5
vehicles = "parked.csv"
"""
PARKED = "x_m,y_m,yaw_deg,type\n110,60,90,truck\n120,60,0,car\n"


def scenario(folder: Path, text: str, **files: str) -> Path:
    made = write_mini(folder / "mini")
    (made / "scenario.toml").write_text((made / "scenario.toml").read_text() + text)
    for name, content in files.items():
        (made / name.replace("_csv", ".csv").replace("_geojson", ".geojson")).write_text(content)
    return made


def run_one(_number: int, what_if_run: WhatIfRun) -> None:
    run.run(what_if_run.scenario, what_if_run.folder)


def by_name(folder: Path) -> dict[str, RankedSite]:
    return {site.site: site for site in Ranking.read(RunFolder(folder).scores).sites}


@pytest.fixture(scope="module")
def answered(tmp_path_factory: pytest.TempPathFactory) -> WhatIfResult:
    """The lorry, and vehicles far away, on the small scenario."""
    folder = tmp_path_factory.mktemp("what_if")
    path = scenario(folder, LORRY + FAR + SOUTH, parked_csv=PARKED)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        runs = [what_if.replace(one, folder=folder / one.folder) for one in prepare_runs(path.relative_to(folder))]
        return compare_runs(runs, run_one)


@pytest.mark.slow
def test_lorry_hides_both_lanes_from_the_pole_behind_it(answered: WhatIfResult) -> None:
    """All beams of pole_a that point south end on the lorry: nothing of the lanes is left."""
    before, present = (by_name(one.folder)["pole_a"] for one in answered.runs[:2])
    assert before.score > 0
    assert present.score == 0
    other = [by_name(one.folder)["pole_b"].score for one in answered.runs[:2]]
    assert other[1] == pytest.approx(other[0], rel=0.05)  # it stands on the other side of the lanes


def test_expected_score_is_the_mean_over_the_time(answered: WhatIfResult) -> None:
    sites = {site.site: site for site in answered.sites}
    lorry, far, south, together = sites["pole_a"].expected
    before = sites["pole_a"].before
    assert lorry == pytest.approx(0.75 * before)
    assert far == before
    assert together == pytest.approx(lorry * south / before)


def test_solids_that_hide_the_same_vehicles_leave_no_negative_score() -> None:
    """The first site loses nearly all to either table; the second has nothing to lose; the third gains."""
    before = np.array([993.0, 0.0, 10.0])
    present = [np.array([156.0, 0.0, 20.0]), np.array([224.0, 5.0, 10.0])]
    together = what_if.expected_values(before, present, [0.3, 1.0])
    one_by_one = [what_if.expected_values(before, [p], [share]) for p, share in zip(present, (0.3, 1.0), strict=True)]
    assert 0.0 < together[0] <= min(values[0] for values in one_by_one)
    assert together.tolist() == pytest.approx([(993 - 0.3 * 837) / 993 * 224, 5.0, 13.0])


@pytest.mark.slow
def test_all_together_is_between_0_and_the_worst_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    same = LORRY.replace("what_if.lorry", "what_if.same").replace("0.25", "1")
    scenario(tmp_path, LORRY.replace("0.25", "0.9") + same)
    result = compare_runs(prepare_runs(Path("mini")), run_one)
    for site in result.sites:
        *single, together = site.expected
        assert together is not None
        assert 0.0 <= together <= min(value for value in single if value is not None)


def test_best_site_changes_where_its_view_is_hidden(answered: WhatIfResult) -> None:
    south = answered.answers[2]
    assert (south.best_before, south.best_present, south.best_expected) == ("pole_b", "pole_a", "pole_a")
    assert south.change is not None
    assert south.change.value == pytest.approx(-0.9 * answered.best.score)
    assert south.rival == "pole_a"
    assert south.overtakes is not None and south.overtook is not None
    assert south.overtakes > 0.5 > south.overtook
    assert "pole_a becomes the best site instead of pole_b" in south.conclusion()


def test_solids_far_away_change_nothing(answered: WhatIfResult) -> None:
    far = answered.answers[1]
    assert far.change is not None
    assert (far.name, far.change.value, far.change.se) == ("far", 0.0, 0.0)
    assert far.best_expected == far.best_present == far.best_before
    assert far.overtakes == far.overtook


def test_error_of_the_change_is_that_of_the_twin(answered: WhatIfResult) -> None:
    """Delete-a-group jackknife by hand: pseudo-values of the change, and their scatter (Busing et al. 1999)."""
    values = []
    for one in (answered.runs[0], answered.runs[3]):
        replicates = read_replicates(one.folder, by_name(one.folder))
        assert isinstance(replicates, SiteReplicates)
        values.append(replicates.values[replicates.names.index("pole_b")].tolist())
        (groups,) = replicates.groups
    frames = groups.frames.tolist()
    assert len(set(frames)) == 1  # equal groups: h = k
    change = [0.9 * (present - before) for before, present in zip(*values, strict=True)]
    k = len(frames)
    pseudo = [k * change[0] - (k - 1) * left_out for left_out in change[1:]]
    mean = sum(pseudo) / k
    se = math.sqrt(sum((one - mean) ** 2 for one in pseudo) / (k - 1) / k)
    widening = standard_error_inflation(groups.autocorrelation_frames, sum(frames), k)
    answer = answered.answers[2]
    assert answer.change is not None and answer.change.se is not None
    assert answer.change.value == pytest.approx(change[0])
    assert answer.change.se == pytest.approx(widening * se)


def test_traffic_is_simulated_once(answered: WhatIfResult) -> None:
    records = [RunRecord.read(one.folder).stages for one in answered.runs]
    assert len({json.dumps(record["traffic"].artefacts) for record in records}) == 1
    assert records[0]["statics"].artefacts != records[1]["statics"].artefacts


@pytest.mark.slow
def test_command_prints_the_answer_and_repeats_it_from_the_folders(
    tmp_path: Path, monkeypatch: Any, run_egvs: Any
) -> None:
    scenario(tmp_path, LORRY.replace("0.25", "1"))
    monkeypatch.chdir(tmp_path)
    code, printed, error = run_egvs("what-if", "mini")
    assert code == 0, error
    assert (tmp_path / "runs" / "mini@what_if=lorry" / "what_if_1.geojson").is_file()
    assert "lorry (100 % of the time): pole_b" in printed
    again = run_egvs("what-if", "mini", "--only", "lorry")
    assert again[1] == printed
    stages = [line for line in again[2].splitlines() if not line.endswith("as in the run")]
    assert [line.split()[-2] for line in stages[-2:]] == ["unchanged"] * 2


@pytest.mark.slow
def test_solid_over_a_site_gets_the_message_of_the_check(tmp_path: Path, monkeypatch: Any, run_egvs: Any) -> None:
    scenario(tmp_path, LORRY.replace("y_m = 10", "y_m = 12"))
    monkeypatch.chdir(tmp_path)
    code, _, error = run_egvs("what-if", "mini")
    assert code == 2
    assert "(10, 12, 3) is inside lorry_1 (lorry)" in error


@pytest.mark.slow
def test_scenario_without_tables_has_the_same_record_and_keys(tmp_path: Path) -> None:
    plain = load(write_mini(tmp_path / "mini"))
    assert "what_if" not in plain.model_dump(mode="json")
    shutil.copytree(tmp_path / "mini", tmp_path / "other" / "mini")
    file = tmp_path / "other" / "mini" / "scenario.toml"
    file.write_text(file.read_text() + LORRY)
    run.run(plain, tmp_path / "a")
    run.run(load(tmp_path / "other" / "mini"), tmp_path / "b")
    records = [RunRecord.read(tmp_path / name).stages for name in ("a", "b")]
    for name in records[0]:
        assert records[0][name].inputs == records[1][name].inputs, name


def test_box_has_its_corners(tmp_path: Path) -> None:
    text = LORRY.replace("x_m = 10", "x_m = 20, yaw_deg = 90").replace("length_m = 90", "length_m = 8")
    (document,) = solid_documents(load(scenario(tmp_path, text)), "lorry")
    (ring,) = document["features"][0]["geometry"]["coordinates"]
    assert sorted(map(tuple, ring[:4])) == [(19, 6), (19, 14), (21, 6), (21, 14)]


def test_parked_vehicles_have_the_sizes_of_their_classes(tmp_path: Path) -> None:
    """The truck is that of the table of classes, the car that of traffic.kinds: 7.6 m and 4.5 m long."""
    (document,) = solid_documents(load(scenario(tmp_path, FAR, parked_csv=PARKED)), "far")
    truck, car = (item["geometry"]["coordinates"][0] for item in document["features"])
    assert max(y for _, y in truck) - min(y for _, y in truck) == pytest.approx(7.6)
    assert max(x for x, _ in car) - min(x for x, _ in car) == pytest.approx(4.5)
    assert [item["properties"]["height_m"] for item in document["features"]] == [3.0, 1.5]


def test_trees_grow_about_their_centres_and_houses_and_street_lamps_do_not() -> None:
    tree = {"type": "Polygon", "coordinates": [[[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]]}
    document = json.loads(
        collection(
            feature(tree, kind="tree_crown", height_m=8, base_m=2),
            feature({"type": "Point", "coordinates": [5, 5]}, kind="tree", height_m=6, radius_m=1.5),
            feature(tree, kind="building", height_m=8),
            feature(tree, kind="street_lamp", height_m=8),
        )
    )
    grown, count = grow_trees(document, 1.5)
    crown, point, *others = grown["features"]
    assert count == 2
    assert sorted(set(map(tuple, crown["geometry"]["coordinates"][0]))) == [
        (-0.5, -0.5), (-0.5, 2.5), (2.5, -0.5), (2.5, 2.5),
    ]  # fmt: skip
    assert (crown["properties"]["height_m"], crown["properties"]["base_m"]) == (12, 2)
    assert (point["properties"]["height_m"], point["properties"]["radius_m"]) == (9, 2.25)
    assert others == document["features"][2:]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "what_if: expected at least one table, got none"),
        ("[what_if.trees]\nshare = 0.5\ntree_scale = 2\n", "what_if.trees.tree_scale: no footprint of the scenario"),
        ("[what_if.a]\nshare = 0.5\n", "expected vehicles, footprints, boxes or tree_scale, got none of them"),
        ("[what_if.a]\nshare = 1.5\nvehicles = 'p.csv'\n", "what_if.a.share"),
        ("[what_if.a]\nshare = 0.5\nvehicles = 'nowhere.csv'\n", "nowhere.csv"),
        (FAR, "parked.csv: line 2: type: expected one of car, van, truck"),
    ],
)
def test_wrong_tables_get_one_message(tmp_path: Path, run_egvs: Any, monkeypatch: Any, text: str, message: str) -> None:
    scenario(tmp_path, text, parked_csv="x_m,y_m,yaw_deg,type\n1,2,0,spaceship\n")
    monkeypatch.chdir(tmp_path)
    code, printed, error = run_egvs("what-if", "mini")
    assert (code, printed) == (2, "")
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_wrong_number_names_row_and_column(tmp_path: Path) -> None:
    path = scenario(tmp_path, FAR, parked_csv="x_m,y_m,yaw_deg,type\n1,2,0,car\n1_5,2,0,car\n")
    with pytest.raises(InputError, match=r"parked.csv: line 3: x_m: expected a number, got '1_5'"):
        solid_documents(load(path), "far")


@pytest.mark.parametrize(
    ("text", "files", "message"),
    [
        (LORRY.replace("y_m = 10", "y_m = -3950500"), {}, r"what_if.lorry.boxes.0: none of 1 solid is within 100 m .*"
         r"this one is 3,950,489 m away. Use the world frame in metres; the region is x 0 to 40, y -10 to 10."),
        (FAR, {"parked_csv": PARKED.replace("110,60", "5,-900").replace("120,60", "900,0")},
         r"parked.csv: row 1: none of 2 solids"),
        ('[what_if.works]\nshare = 1\nfootprints = ["works.geojson"]\n', {"works_geojson": collection(feature(
            {"type": "Point", "coordinates": [-500, 0]}, kind="crane", height_m=9, radius_m=1))},
         r"works.geojson: none of 1 solid .* this one is 499 m away"),
    ],
)  # fmt: skip
def test_solids_that_no_beam_can_meet_are_an_error(tmp_path: Path, text: str, files: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        prepare_runs(scenario(tmp_path, text, **files))
    assert not (tmp_path / "runs").exists()


def test_one_vehicle_within_the_range_is_enough(tmp_path: Path, monkeypatch: Any) -> None:
    """The car is 1.8 m wide: its side is 99.9 m from the region when its centre is at y = -110.8."""
    monkeypatch.chdir(tmp_path)
    path = scenario(tmp_path, FAR, parked_csv="x_m,y_m,yaw_deg,type\n900,0,0,car\n5,-110.8,0,car\n")
    assert len(prepare_runs(path.relative_to(tmp_path))) == 2
