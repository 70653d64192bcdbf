"""Run folders are named by their settings: equal settings have equal names, and other settings have other names."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.runs.run import default_folder
from egvs.runs.run_names import MAX_LABEL_LENGTH, parse_overrides, run_folder, settings_label, short_key

NUMBERS = st.one_of(st.integers(-3, 3), st.floats(allow_nan=False), st.sampled_from([0.5, 5, 5.0, 1e-9, 1e300]))
WORDS = st.one_of(st.sampled_from(["a", "A", "a.", "true", "5", "b,c", "b-c", "ä", "", "x" * 60]), st.text(max_size=4))
VALUES: dict[str, st.SearchStrategy[Any]] = {
    "score.gamma": NUMBERS,
    "traffic.frames": NUMBERS,
    "placement.refine.heights_m": NUMBERS,
    "effects.rain.rate_mm_h": NUMBERS,
    "traffic.kinds[car].length_m": NUMBERS,
    "traffic.kinds[Car].length_m": NUMBERS,
    "sites.sensor": WORDS,
    "sites.file": st.one_of(st.none(), WORDS),
    "scan.keep": st.booleans(),
    "roi.center_m": st.lists(NUMBERS, max_size=3),
    "effects.rain": st.just({}),
}
"""Keys of scenarios, and values that they can have."""

SETTINGS = st.fixed_dictionaries({}, optional=VALUES).filter(bool)

LABELS = {
    "gamma=5": {"score.gamma": 5.0},
    "gamma=0.5": {"score.gamma": 0.50},
    "gamma=inf": {"score.gamma": float("inf")},
    "frames=300,gamma=5": {"score.gamma": 5, "traffic.frames": 300},
    "rain.rate_mm_h=20": {"effects.rain.rate_mm_h": 20.0},
    "range_limit=on": {"effects.range_limit": {}},
    "frames=300,slope=on": {"effects.slope": {}, "traffic.frames": 300},
    "rank_by=egvs": {"score.rank_by": "egvs"},
    "keep=false": {"scan.keep": False},
    "placement.refine.heights_m=3": {"placement.refine.heights_m": 3},
}


@pytest.mark.parametrize(("label", "overrides"), LABELS.items(), ids=LABELS)
def test_label_spells_simple_overrides(label: str, overrides: dict[str, Any]) -> None:
    assert settings_label(overrides) == label


HASHED = {
    "upper case": ({"sites.sensor": "VLP-16"}, "sensor=VLP-16"),
    "a path": ({"sites.file": "other/sites.csv"}, "file=other-sites.csv"),
    "a list": ({"roi.center_m": [1.0, -2.5]}, "center_m=1--2.5"),
    "a word that looks like a truth value": ({"sites.sensor": "true"}, "sensor=true"),
    "long, cut between pairs": (
        {"effects.rain.rate_mm_h": 20, "effects.fog.visibility_m": 150, "traffic.frames": 300},
        "fog.visibility_m=150,frames=300",
    ),
    "one long pair, cut": ({"description": "x" * 60}, "description=" + "x" * 28),
    "a removed setting": ({"sites.yaw_deg": None, "sites.aim": "roi"}, "aim=roi"),
}


@pytest.mark.parametrize(("overrides", "start"), HASHED.values(), ids=HASHED)
def test_label_that_does_not_spell_the_overrides_ends_in_a_hash(overrides: dict[str, Any], start: str) -> None:
    label = settings_label(overrides)
    assert re.fullmatch(rf"{re.escape(start)},[0-9a-f]{{8}}", label), label


def test_hash_of_a_label_is_the_same_in_every_version() -> None:
    assert settings_label({"sites.sensor": "VLP-16"}) == "sensor=VLP-16,511b6d4c"  # as in docs/artefacts.md


@pytest.mark.slow
@given(SETTINGS, SETTINGS)
def test_labels_are_equal_exactly_where_settings_are(a: dict[str, Any], b: dict[str, Any]) -> None:
    assert (settings_label(a).lower() == settings_label(b).lower()) == (a == b)
    reordered = dict(reversed(list(a.items())))
    assert settings_label(reordered) == settings_label(a)


@pytest.mark.slow
@given(SETTINGS)
def test_label_is_a_file_name_on_every_system(settings: dict[str, Any]) -> None:
    label = settings_label(settings)
    assert re.fullmatch(r"[A-Za-z0-9_.=+,-]+", label), label
    assert not label.endswith(".")
    assert len(label) <= MAX_LABEL_LENGTH + len(",12345678")


def test_key_is_shortened_where_its_last_part_is_unique() -> None:
    assert short_key("traffic.frames") == "frames"
    assert short_key("effects.moving_occlusion.frames") == "moving_occlusion.frames"
    assert short_key("sites.heights_m") == "sites.heights_m"  # sites.grid and placement.refine have one too
    assert short_key("traffic.kinds[car].length_m") == "traffic.kinds.car.length_m"
    assert short_key("seed") == "seed"


SAME = {
    "another order": (["score.gamma=5", "tpog.blocks=2"], ["tpog.blocks=2", "score.gamma=5"]),
    "another spelling": (["score.gamma=0.5"], ["score.gamma = 0.50"]),
    "quotes": (["score.rank_by=coverage"], ['score.rank_by="coverage"']),
    "the last one counts": (["score.gamma=3", "score.gamma=5"], ["score.gamma=5"]),
    "a table": (["score={gamma=5, others=[]}"], ["score.others=[]", "score.gamma=5"]),
    "what the file says": (["score.gamma=4.0"], []),
    "a default": (["scan.keep=true"], []),
}


@pytest.mark.parametrize(("first", "second"), SAME.values(), ids=SAME)
def test_same_settings_have_the_same_folder(mini: Path, first: list[str], second: list[str]) -> None:
    assert default_folder(egvs.load(mini, first)) == default_folder(egvs.load(mini, second))


def test_folder_is_named_by_scenario_and_overrides(mini: Path) -> None:
    assert default_folder(egvs.load(mini)) == Path("runs/mini")
    assert default_folder(egvs.load(mini, ["score.gamma=5"])) == Path("runs/mini@gamma=5")
    assert default_folder(egvs.load(mini, ["score.gamma=5", "name=wet"])) == Path("runs/wet@gamma=5")
    assert default_folder(egvs.load(mini, ["name=wet"])) == Path("runs/wet")


def test_scenario_that_needs_an_override_is_compared_as_written(mini: Path) -> None:
    file = mini / "scenario.toml"
    file.write_text(file.read_text().replace('file = "sites.csv"\n', ""))
    scenario = egvs.load(mini, ['sites.file="sites.csv"', "score.gamma=5.0"])
    assert scenario.overrides == {"score.gamma": 5.0, "sites.file": "sites.csv"}


def test_overrides_of_a_city_have_one_label_in_every_spelling() -> None:
    spellings = (["score.gamma=5", "roi.voxel_m=0.50"], ["roi.voxel_m = 0.5", "score.gamma=2", "score.gamma=5.0"])
    tables = (["costs.sensor={VLP-16=5}"], ["costs.sensor.VLP-16=5.0"])
    assert len({run_folder("hersfeld", parse_overrides(overrides)) for overrides in tables}) == 1
    labels = {run_folder("hersfeld", parse_overrides(overrides)) for overrides in spellings}
    assert labels == {Path("runs/hersfeld@gamma=5,voxel_m=0.5")}
