"""Sites that a reader would take for one another, and sites that see nothing, are named."""

from __future__ import annotations

import unicodedata
from pathlib import Path
from typing import Any

import pytest
import trimesh

import egvs
from egvs.core.errors import InputError
from egvs.scenario.fields import find_duplicates

COMPOSED = "pfahl_ä"
DECOMPOSED = unicodedata.normalize("NFD", COMPOSED)


def test_rejects_names_that_differ_only_in_their_unicode_form(mini: Path) -> None:
    rows = f"site,x_m,y_m,z_m\n{COMPOSED},10,12,3\n{DECOMPOSED},30.5,-12,3\n"
    (mini / "sites.csv").write_text(rows, encoding="utf-8")
    with pytest.raises(InputError) as error:
        egvs.build_scene(egvs.load(mini))
    assert "the sites 'pfahl_\\xe4' and 'pfahl_a\\u0308' differ only in the Unicode of accents" in str(error.value)
    assert find_duplicates([COMPOSED, DECOMPOSED, "other"]) == sorted([COMPOSED, DECOMPOSED])


def test_one_name_in_decomposed_form_is_valid(mini: Path) -> None:
    (mini / "sites.csv").write_text(f"site,x_m,y_m,z_m\n{DECOMPOSED},10,12,3\n", encoding="utf-8")
    assert [site.name for site in egvs.build_scene(egvs.load(mini)).sites] == [DECOMPOSED]


def house_without_floor(folder: Path) -> None:
    """Four walls and a roof around pole_a at (10, 12), open towards the ground."""
    box = trimesh.creation.box(extents=(6, 6, 6))
    box.apply_translation((10, 12, 3))
    box.update_faces(box.face_normals[:, 2] > -0.5)
    box.export(folder / "house.ply")
    with (folder / "scenario.toml").open("a") as file:
        file.write('\n[[statics.meshes]]\nfile = "house.ply"\nkind = "building"\n')


@pytest.mark.parametrize("rank_by", ["egvs", "expected_detections"])
def test_warns_of_site_inside_house_without_floor(mini: Path, run_egvs: Any, rank_by: str) -> None:
    house_without_floor(mini)
    code, _, printed = run_egvs("run", mini, "--out", mini / "out", "--set", f"score.rank_by={rank_by}", "--verbose")
    assert code == 0
    assert f"{rank_by} is 0 at pole_a (100 %)" in printed
    assert "a mesh without a floor is no closed solid" in printed


def test_sites_that_see_traffic_are_not_warned_about(mini: Path, run_egvs: Any) -> None:
    assert "is 0 at" not in run_egvs("run", mini, "--out", mini / "out")[2]
