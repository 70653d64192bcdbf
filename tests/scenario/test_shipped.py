"""The scenarios that come with the program are found by name."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

import egvs


def test_unknown_scenario_lists_known_ones() -> None:
    with pytest.raises(egvs.InputError, match=r"scenario: expected one of demo, hill, .*roundabout, got 'roundabuot'"):
        egvs.shipped_scenario("roundabuot")


@pytest.mark.parametrize("name", ["..", "demo/..", ""])
def test_name_is_no_path(name: str) -> None:
    with pytest.raises(egvs.InputError, match="expected one of"):
        egvs.shipped_scenario(name)


def test_load_finds_shipped_scenario_unless_a_folder_has_its_name(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert egvs.load("nishishinjuku").folder == egvs.shipped_scenario("nishishinjuku")
    assert egvs.load("roundabout", ["traffic.frames=100"]).overrides == {"traffic.frames": 100}
    shutil.copytree(mini, "roundabout")
    assert egvs.load("roundabout").folder.resolve() == tmp_path / "roundabout"


@pytest.mark.parametrize(
    ("name", "hint"),
    [
        (
            "elsewhere",
            r"Give a folder with a scenario.toml, or the name of a shipped scenario: demo, hill, .*roundabout\.$",
        ),
        ("nishi-shinjuku", r"Did you mean nishishinjuku\?$"),
        ("elsewhere/roundabout", r"Did you mean roundabout\?$"),
    ],
)
def test_unknown_folder_lists_shipped_scenarios(
    name: str, hint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(egvs.InputError, match=rf"no such folder\. {hint}"):
        egvs.load(name)


@pytest.mark.parametrize(
    "call",
    [
        egvs.run,
        egvs.place,
        egvs.build_scene,
        egvs.JointScore.of,
        egvs.effect_statuses,
        partial(egvs.run_ablation, out="x"),
    ],
)
def test_path_in_place_of_scenario_is_named(call: Callable[[str], object]) -> None:
    with pytest.raises(
        egvs.InputError, match=r"^scenario: expected the result of egvs.load, got 'demo'\. Use egvs.load"
    ):
        call("demo")
