"""What effects of each kind have in common: switches, parameters, and combinations."""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import egvs
from egvs.artefacts import parquet
from egvs.core import files
from egvs.core.errors import InputError
from egvs.effects import pedestrians_bicycles, registry
from egvs.effects.base import Detect
from egvs.effects.divergence import Divergence
from egvs.effects.divergence import beam_nodes as cone_nodes
from egvs.effects.foliage import Foliage
from egvs.effects.mount_sway import MountSway
from egvs.effects.mount_sway import tilt_nodes as sway_nodes
from egvs.effects.rain import Rain
from egvs.effects.registry import load_effect_class
from egvs.runs import run
from egvs.scenario.effects_config import (
    DivergenceParameters,
    FoliageParameters,
    MountSwayParameters,
    RainParameters,
)
from egvs.scenario.loading import load
from egvs.scoring import visibility
from egvs.sensors import sensor, sites
from egvs.sensors.scanner import Scanner
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import Sensor
from egvs.stages import traffic
from tests.effects.detect_helpers import (
    ACTIVE,
    hits_along_beam,
    make_effect,
    make_scene,
    score_hits,
    scored,
)
from tests.effects.road_helpers import CROWD, HILL, LANES, SMALL, build_road, read_rows, road_scenario, run_and_read
from tests.effects.scan_helpers import (
    DIVERGENCE,
    FOLIAGE,
    SWAY,
    TREES,
    hits_along_only_beam,
    one_beam_scene,
    prism,
    run_scan,
    scan_hits,
    write_scene,
)
from tests.stage_runner import inputs_of, run_stage

# Settings with which an effect changes nothing.
NEUTRAL = {
    "hard limit beyond reach": [
        "effects.range_limit={rated_range_m = 30, reflectivity = 1e4, softness = 0, dropout = 0}"
    ],
    "soft limit far away": ["effects.range_limit={rated_range_m = 30, reflectivity = 1e15, dropout = 0}"],
    "no rain": ["effects.rain.rate_mm_h=0"],
    "next to no rain": ["effects.rain.rate_mm_h=1e-25"],
    "clear air": ["effects.fog.visibility_m=1e18"],
    "no dropout": ["effects.dropout.share=0"],
    "all of them": [
        "effects.rain.rate_mm_h=0", "effects.fog.visibility_m=1e18", "effects.dropout.share=0",
        "effects.range_limit={rated_range_m = 1e4, softness = 0, dropout = 0}",
    ],
}  # fmt: skip


# Settings that take more and more, with the others fixed.
WORSE_AND_WORSE = {
    "rain": [f"effects.rain.rate_mm_h={rate}" for rate in (0, 0.1, 2, 10, 50, 300)],
    "rain in France": [f"effects.rain={{rate_mm_h = {rate}, law = 'france'}}" for rate in (0, 0.1, 2, 10, 50, 300)],
    "fog": [
        f"effects.fog.visibility_m={visibility_m}"
        for visibility_m in (60000, 40000, 7000, 5000, 1001, 999, 501, 400, 100, 20)
    ],
    "fog of Kruse": [
        f"effects.fog={{visibility_m = {visibility_m}, model = 'kruse'}}"
        for visibility_m in (60000, 40000, 6001, 5999, 500, 20)
    ],
    "dropout": [f"effects.dropout.share={share}" for share in (0, 0.01, 0.3, 0.7, 1)],
    "reflectivity": [
        f"effects.range_limit={{rated_range_m = 30, reflectivity = {rho}}}" for rho in (5, 1, 0.8, 0.1, 0.01)
    ],
    "incidence": [f"effects.range_limit={{rated_range_m = 30, incidence_deg = {angle}}}" for angle in (0, 30, 60, 89)],
    "rated range": [f"effects.range_limit={{rated_range_m = {limit}, softness = 0}}" for limit in (200, 90, 40, 20, 5)],
}


# The switch, the limit, the monotonic truth
@pytest.mark.parametrize("name", ACTIVE)
def test_detect_effects_lower_all_scores(score_run: tuple[Path, Path], name: str) -> None:
    plain, plain_bytes = scored(score_run, [])
    with_effect, with_bytes = scored(score_run, ACTIVE[name])
    assert with_bytes != plain_bytes
    assert all(b < a for a, b in zip(plain["egvs"], with_effect["egvs"], strict=True))
    assert all(b > 0 for b in with_effect["egvs"])
    assert with_effect["egvs_limit"] == plain["egvs_limit"]
    assert scored(score_run, []) == (plain, plain_bytes)


@pytest.mark.parametrize("settings", NEUTRAL.values(), ids=NEUTRAL.keys())
def test_neutral_parameters_give_the_plain_score(score_run: tuple[Path, Path], settings: list[str]) -> None:
    assert scored(score_run, settings)[0] == scored(score_run, [])[0]
    np.testing.assert_array_equal(score_hits(score_run, settings), score_hits(score_run, []))


@pytest.mark.slow
@pytest.mark.parametrize("series", WORSE_AND_WORSE.values(), ids=WORSE_AND_WORSE.keys())
def test_worse_conditions_never_raise_a_score(score_run: tuple[Path, Path], series: list[str]) -> None:
    scores = np.array([scored(score_run, [setting])[0]["egvs"] for setting in series])
    assert (np.diff(scores, axis=0) <= 0).all()
    assert (scores[-1] < scores[0]).all()


def test_detect_effects_multiply(one_beam_run: tuple[Path, Path]) -> None:
    """In the voxel at 20.25 m: 3/4 are not dropped, half are detected; rain and fog attenuate the rest."""
    half = "effects.range_limit={rated_range_m = 20.25, rated_reflectivity = 0.03, dropout = 0}"
    dropout, rain, fog = "effects.dropout.share=0.25", "effects.rain.rate_mm_h=30", "effects.fog.visibility_m=200"
    assert hits_along_beam(one_beam_run, half, dropout)[20] == 0.375
    assert hits_along_beam(one_beam_run, dropout, half)[20] == 0.375
    alone = [hits_along_beam(one_beam_run, setting) for setting in (half, dropout, rain, fog)]
    together = hits_along_beam(one_beam_run, fog, rain, dropout, half)
    np.testing.assert_allclose(together, np.prod(alone, axis=0), rtol=0, atol=2.0**-31)


@pytest.mark.parametrize("name", ACTIVE)
def test_hits_are_multiplied_by_the_probability_at_the_voxel_centre(score_run: tuple[Path, Path], name: str) -> None:
    """Plain hits of each voxel times the probability there, up to 2**-33 of each and rounding."""
    scene = make_scene(score_run, *ACTIVE[name])
    (only,), sensor = registry.scenario_effects(scene.scenario, "score"), scene.sensor(scene.sites[0].sensor)
    assert isinstance(only, Detect)
    grid = scene.scenario.roi.grid
    centres_m = (np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1) + 0.5) * grid.voxel_m
    away_m = centres_m - grid.to_grid_m(np.array(scene.sites[0].pose.position_m))
    chance = only.detect(np.sqrt((away_m**2).sum(axis=-1)).ravel(), sensor).reshape(grid.shape)
    plain, result = score_hits(score_run, []), score_hits(score_run, ACTIVE[name])
    np.testing.assert_allclose(result, plain * chance, rtol=0, atol=float(plain.max()) * 2.0**-33 + 2.0**-33)
    assert (result < plain).any()


# Called for, or not
def test_why_idle_of_detect_effects(score_run: tuple[Path, Path]) -> None:
    scene = make_scene(score_run)
    assert make_effect("rain", rate_mm_h=0).why_idle(scene) == "rate_mm_h is 0"
    assert make_effect("dropout", share=0).why_idle(scene) == "share is 0"
    assert (
        make_effect("range_limit", softness=0, dropout=0, rated_range_m=600).why_idle(scene)
        == "every beam ends before the limit"
    )
    assert make_effect("range_limit", softness=0, rated_range_m=600).why_idle(scene) is None
    for name, parameters in {
        "rain": {"rate_mm_h": 1},
        "dropout": {"share": 0.1},
        "fog": {"visibility_m": 1e4},
        "range_limit": {"rated_range_m": 300},
    }.items():
        assert make_effect(name, **parameters).why_idle(scene) is None
    assert make_effect("range_limit", softness=0, rated_range_m=30).why_idle(scene) is None
    with pytest.raises(InputError, match="sensor small: rated_range_m is missing"):
        make_effect("range_limit", softness=0, dropout=0).why_idle(scene)


@pytest.mark.parametrize("name", ACTIVE)
def test_detect_effects_name_their_source(name: str) -> None:
    kind = registry.load_effect_class(name)
    assert (kind.NAME, issubclass(kind, Detect)) == (name, True)
    assert len(kind.SOURCE) > 20
    assert all(field.description for field in kind.Model.model_fields.values())


# Bad parameters
BAD_DETECT = {
    "negative rain": (
        "rain.rate_mm_h=-1",
        "effects.rain.rate_mm_h: expected a value greater than or equal to 0, got -1",
    ),
    "too much rain": (
        "rain.rate_mm_h=301",
        "effects.rain.rate_mm_h: expected a value less than or equal to 300, got 301",
    ),
    "rain that is no number": ("rain.rate_mm_h=nan", "effects.rain.rate_mm_h: expected a finite number, got nan"),
    "rain in words": ("rain.rate_mm_h=heavy", "effects.rain.rate_mm_h: expected a valid number, got 'heavy'"),
    "no rain rate": ("rain.law=france", "effects.rain.rate_mm_h: this key is required"),
    "unknown law": (
        "rain={rate_mm_h = 1, law = 'spain'}",
        "effects.rain.law: expected 'japan', 'france', 'itu2025' or 'goodin', got 'spain'",
    ),
    "unknown key": ("rain={rate_mm_h = 1, rate = 2}", "effects.rain.rate: unknown key. Did you mean rate_mm_h?"),
    "unknown effect": ("fogg.visibility_m=100", "effects.fogg: unknown effect. Did you mean fog?"),
    "no visibility": ("fog.model=kim", "effects.fog.visibility_m: this key is required"),
    "visibility of 0": ("fog.visibility_m=0", "effects.fog.visibility_m: expected a value greater than 0, got 0"),
    "infinite visibility": ("fog.visibility_m=inf", "effects.fog.visibility_m: expected a finite number, got inf"),
    "contrast of 1": (
        "fog={visibility_m = 9, contrast = 1}",
        "effects.fog.contrast: expected a value less than 1, got 1",
    ),
    "unknown model": (
        "fog={visibility_m = 9, model = 'kimm'}",
        "effects.fog.model: expected 'kim' or 'kruse', got 'kimm'",
    ),
    "no share": ("dropout={}", "effects.dropout.share: this key is required"),
    "share above 1": ("dropout.share=1.1", "effects.dropout.share: expected a value less than or equal to 1, got 1.1"),
    "reflectivity of 0": (
        "range_limit.reflectivity=0",
        "effects.range_limit.reflectivity: expected a value greater than 0, got 0",
    ),
    "grazing incidence": (
        "range_limit.incidence_deg=90",
        "effects.range_limit.incidence_deg: expected a value less than 90, got 90",
    ),
    "negative softness": (
        "range_limit.softness=-0.1",
        "effects.range_limit.softness: expected a value greater than or equal to 0, got -0.1",
    ),
    "rated at 0 m": (
        "range_limit.rated_range_m=0",
        "effects.range_limit.rated_range_m: expected a value greater than 0, got 0",
    ),
}


@pytest.mark.parametrize(("setting", "message"), BAD_DETECT.values(), ids=BAD_DETECT.keys())
def test_rejects_bad_parameters_of_detect_effects(
    mini: Path, tmp_path: Path, run_egvs, setting: str, message: str
) -> None:
    code, printed, output = run_egvs("run", mini, "--out", tmp_path / "out", "--set", f"effects.{setting}")
    assert (code, printed) == (2, "")
    assert message in " ".join(output.split())
    assert not (tmp_path / "out" / "scores.parquet").exists()


# The run
@pytest.mark.slow
def test_detect_effects_run_only_the_score_stage_again(mini: Path, tmp_path: Path) -> None:
    def states(*settings: str) -> dict[str, str]:
        visibility_m: dict[str, str] = {}
        run.run(
            egvs.load(mini, settings),
            tmp_path / "out",
            listener=lambda stage, state, _: visibility_m.__setitem__(stage, state),
        )
        return visibility_m

    states()
    for settings in (["effects.rain.rate_mm_h=5"], ["effects.rain.rate_mm_h=9"], ACTIVE["dropout"], []):
        assert {stage for stage, state in states(*settings).items() if state != "skipped"} == {
            "check",
            "score",
            "report",
        }
    assert set(states().values()) == {"skipped"}


@pytest.mark.parametrize(
    "settings", [*ACTIVE.values(), [s for each in ACTIVE.values() for s in each]], ids=[*ACTIVE, "all"]
)
def test_scores_do_not_depend_on_threads(score_run: tuple[Path, Path], settings: list[str]) -> None:
    assert len({scored(score_run, settings, jobs)[1] for jobs in (1, 2, 3)}) == 1


def test_rejects_more_beams_than_fixed_point_hits_allow(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weighted hits are added up in units of 2**-32, so 2**31 crossings in one class of voxels would leave 64 bits."""
    scenario = egvs.load(mini, ACTIVE["rain"])
    beams = sensor.resolve_sensor("small", scenario.sensors, "").beams
    monkeypatch.setattr(visibility, "MAX_CROSSINGS", beams)
    with pytest.raises(InputError, match=r"site pole_a: expected fewer than .* beams with effects, got"):
        egvs.run(scenario, tmp_path / "out")


def sum_weights(file: Path) -> list[float]:
    """The weights of each beam, added up."""
    table, _ = parquet.read_artefact(file, "scans")
    total: dict[tuple[str, int], float] = defaultdict(float)
    for name, beam, weight in zip(*(table.column(c).to_pylist() for c in ("site", "beam", "weight")), strict=True):
        total[name, beam] += weight
    return list(total.values())


# --- all three
SCAN_EFFECTS = {"divergence": [f"{DIVERGENCE}7"], "mount_sway": [f"{SWAY}0.5"], "foliage": [f"{FOLIAGE}0.7"]}


def read_score_rows(out: Path) -> list[Any]:
    table, _ = parquet.read_artefact(out / "scores.parquet", "scores")
    return table.to_pylist()


@pytest.mark.slow
@pytest.mark.parametrize("name", SCAN_EFFECTS)
def test_scan_effects_change_scores_and_write_weights(
    mini: Path, plain_scan_run: Path, tmp_path: Path, name: str
) -> None:
    out = tmp_path / "out"
    egvs.run(egvs.load(mini, SCAN_EFFECTS[name]), out, jobs=1)
    before, after = ([row["egvs"] for row in read_score_rows(folder)] for folder in (plain_scan_run, out))
    assert all(a != b for a, b in zip(before, after, strict=True))
    table, metadata = parquet.read_artefact(out / "scans.parquet", "scans")
    assert table.column_names == ["site", "beam", "dx_m", "dy_m", "dz_m", "returned", "weight"]
    weights = table.column("weight").to_numpy()
    assert weights.min() >= 0 and weights.max() <= 1
    assert max(sum_weights(out / "scans.parquet")) <= 1 + 1e-12
    for site in metadata["sites"]:
        site_rows = table.filter(np.array(table.column("site").to_pylist()) == site["site"])
        beams = site_rows.column("beam").to_numpy().astype(np.int64)
        assert (np.diff(beams) >= 0).all() and site["beams_in_roi"] == len(np.unique(beams))
        assert site["returns"] == len(np.unique(beams[site_rows.column("returned").to_numpy()]))
    assert parquet.read_artefact(plain_scan_run / "scans.parquet", "scans")[0].column_names == [
        "site",
        "beam",
        "dx_m",
        "dy_m",
        "dz_m",
        "returned",
    ]


@pytest.mark.slow
@pytest.mark.parametrize("name", SCAN_EFFECTS)
def test_scans_with_effects_do_not_depend_on_threads_or_on_storage(
    mini: Path, tmp_path: Path, plain_scan_run: Path, name: str
) -> None:
    out = [plain_scan_run.rename(tmp_path / str(jobs)) if jobs == 1 else tmp_path / str(jobs) for jobs in (1, 2, 3)]
    for jobs, folder in enumerate(out, start=1):
        egvs.run(egvs.load(mini, SCAN_EFFECTS[name]), folder, jobs=jobs)
    for file in ("scans.parquet", "scores.parquet"):
        assert len({files.hash_file(folder / file) for folder in out}) == 1
    remaining = read_score_rows(out[0])
    egvs.run(egvs.load(mini, [*SCAN_EFFECTS[name], "scan.keep=false"]), out[0], jobs=2)
    assert not (out[0] / "scans.parquet").exists()
    assert read_score_rows(out[0]) == remaining


BEHIND = prism(8, 40, 12, 44, 1, 6, "tree_crown", "far behind")


IDLE_SCAN: dict[str, tuple[list[str], tuple[dict[str, Any], ...], str]] = {
    "one sub-beam": ([f"{DIVERGENCE}1"], TREES, "sub_beams is 1"),
    "no width": ([f"{DIVERGENCE}7", "effects.divergence.divergence_mrad=[0, 0]"], TREES, "divergence_mrad is 0"),
    "no tilt": ([f"{SWAY}0"], TREES, "tilt_deg is 0"),
    "one pose": ([f"{SWAY}1", "effects.mount_sway.samples=1"], TREES, "samples is 1"),
    "no crown": ([f"{FOLIAGE}1"], TREES[-1:], "there is no closed tree crown"),
    "no crown between": ([f"{FOLIAGE}1"], (*TREES[-1:], BEHIND), "no crown lies between any site and the ROI"),
    "bare crowns out of reach": ([f"{FOLIAGE}0"], (*TREES[-1:], prism(8, 12.2, 8.5, 12.4, 1, 6, "tree_crown")), ""),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", IDLE_SCAN)
@pytest.mark.parametrize("keep", ["true", "false"])
def test_idle_scan_effects_are_skipped_without_a_trace(mini: Path, tmp_path: Path, case: str, keep: str) -> None:
    sets, solids, why = IDLE_SCAN[case]
    write_scene(mini, *solids, sites="pole_a,10,12,3\npole_b,30.5,14,3\n" if case.startswith("bare") else None)
    keeps = f"scan.keep={keep}"
    egvs.run(egvs.load(mini, [keeps]), tmp_path / "plain", jobs=1)
    record = egvs.run(egvs.load(mini, [keeps, *sets]), tmp_path / "named", jobs=1)
    output = record.stages["scan"].summary
    if case.startswith("bare"):
        assert "skipped" not in output  # beams of pole_b pass it
        return
    assert output["skipped"] == [f"{sets[0].split('.')[1]}: {why}"]
    for name in ("statics.ply", "scans.parquet", "tpog.parquet", "scores.parquet"):
        if keep == "true" or name != "scans.parquet":
            assert files.hash_file(tmp_path / "plain" / name) == files.hash_file(tmp_path / "named" / name), name


@pytest.mark.parametrize("case", [case for case in IDLE_SCAN if not case.startswith("bare")])
def test_skipping_idle_scan_effects_does_not_change_hits(
    mini: Path, tmp_path: Path, case: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    sets, solids, _ = IDLE_SCAN[case]
    write_scene(mini, *solids)
    skipped = scan_hits(mini, tmp_path / "a", *sets)
    for effect in (Divergence, MountSway, Foliage):
        monkeypatch.setattr(effect, "why_idle", lambda self, scene: None)
    forced = scan_hits(mini, tmp_path / "b", *sets)
    for site, result in skipped.items():
        np.testing.assert_array_equal(result, forced[site])


def test_scan_effects_do_not_change_measured_scans(mini: Path, tmp_path: Path) -> None:
    write_scene(mini, *TREES, sites="pole_a,10,12,3\n")
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\nseen,10,12,3,cloud.csv\ncast,30.5,-12,3,\n")
    (mini / "cloud.csv").write_text("x_m,y_m,z_m\n20,0,0\n20,1,0.5\n")
    _, out = run_scan(mini, tmp_path / "out", *(s for sets in SCAN_EFFECTS.values() for s in sets))
    table, metadata = parquet.read_artefact(out / "scans.parquet", "scans")
    assert table.column("weight").to_pylist()[:2] == [1.0, 1.0]
    assert metadata["sites"][0]["beams_in_roi"] == 2
    (mini / "sites.csv").write_text("site,x_m,y_m,z_m,points\nseen,10,12,3,cloud.csv\n")
    scene = egvs.build_scene(egvs.load(mini, [s for sets in SCAN_EFFECTS.values() for s in sets]))
    assert {effect.why for effect in scene.inactive_effects} == {"all scans are measured"} and Scanner(
        scene
    ).columns == ()


@pytest.mark.parametrize(
    "sets", [[f"{SWAY}0.01"], [f"{SWAY}3"], [f"{DIVERGENCE}19"], [f"{SWAY}3", f"{DIVERGENCE}7", f"{FOLIAGE}1"]]
)
def test_weights_of_a_beam_sum_to_one_within_the_region(mini: Path, tmp_path: Path, sets: list[str]) -> None:
    _, out = run_scan(write_scene(mini, *TREES, sites="pole_a,20,1,3\n"), tmp_path / "out", *sets)
    assert sum_weights(out / "scans.parquet") == pytest.approx([1.0] * 8 * 360, abs=1e-12)


def test_divergence_combines_with_sway(mini: Path, tmp_path: Path) -> None:
    """Every sub-beam of the cone once for each pose, with the product of the weights."""
    scenario, out = run_scan(one_beam_scene(mini), tmp_path / "out", f"{DIVERGENCE}7", f"{SWAY}0.1")
    table, _ = parquet.read_artefact(out / "scans.parquet", "scans")
    assert table.num_rows == 28
    assert sum_weights(out / "scans.parquet") == pytest.approx([1.0], abs=1e-14)
    products = np.outer(cone_nodes(7)[1], sway_nodes(4)[1]).ravel()
    np.testing.assert_allclose(table.column("weight").to_numpy(), products, rtol=1e-15)
    ends = np.column_stack([table.column(c).to_numpy() for c in ("dx_m", "dy_m", "dz_m")]) / 100
    pose, sensor = sites.candidate_sites(scenario)[0].pose, Sensor("s", (0.0,), (0.0,), 4, 100.0, "")
    cone, _, _ = Divergence(DivergenceParameters()).expand(np.array([[1.0, 0.0, 0.0]]), sensor, pose)
    both, _, _ = MountSway(MountSwayParameters(tilt_deg=0.1)).expand(cone, sensor, pose)
    np.testing.assert_allclose(ends, both, rtol=1e-15, atol=1e-15)


def test_foliage_combines_with_divergence(mini: Path, tmp_path: Path) -> None:
    """A crown so placed that only the sub-beams on one side of the cone meet it: their 3/12 pass with exp(-1).

    At x = 10, 20 m away, a cone of 10 mrad has its ring at 0.1 and 0.05 m aside; the crown begins 0.04 m aside of the
    beam and takes the three at +0.1 and +0.05 (twice): 3/12. exp(-1) for 4 m, longer by less than 1e-4 on the slant."""
    folder = one_beam_scene(mini, prism(10, 0.29, 14, 4, 0, 5, "tree_crown"))
    sets = f"{FOLIAGE}0.5", f"{DIVERGENCE}7", "effects.divergence.divergence_mrad=[10, 0.1]"
    result = hits_along_only_beam(scan_hits(folder, tmp_path / "a", *sets))
    assert result[:20] == pytest.approx(1, abs=1e-8)
    assert result[28:40] == pytest.approx(1 - 3 / 12 * (1 - math.exp(-1)), abs=1e-5)


@pytest.mark.slow
def test_foliage_combines_with_rain(mini: Path, tmp_path: Path) -> None:
    folder = one_beam_scene(mini, prism(10, -2, 14, 2, 1, 5, "tree_crown"))
    wet = "effects.rain.rate_mm_h=50"
    dry, rain, both = (
        hits_along_only_beam(scan_hits(folder, tmp_path / "a", *sets))
        for sets in ([f"{FOLIAGE}0.5"], [f"{FOLIAGE}0", wet], [f"{FOLIAGE}0.5", wet])
    )
    clear = [*range(20), *range(28, 80)]  # within the crown the parts' chords, and so their ranges, are shorter
    np.testing.assert_allclose(both[clear], (dry * rain)[clear], atol=1e-9)
    behind = 10.0 + 30.25  # range of the middle of voxel 60
    loss = Rain(RainParameters(rate_mm_h=50)).detect(np.array([behind]), Sensor("s", (0.0,), (0.0,), 4, 100.0, ""))[0]
    assert both[60] == pytest.approx(math.exp(-1) * loss, abs=1e-9)


BAD_SCAN = {
    f"{DIVERGENCE}5": ("effects.divergence.sub_beams", "got 5"),
    "effects.divergence.divergence_mrad=[-1, 2]": ("effects.divergence.divergence_mrad.0", "got -1"),
    "effects.divergence.divergence_mrad=[1]": ("effects.divergence.divergence_mrad",),
    "effects.divergence.subbeams=7": ("Did you mean sub_beams",),
    f"{SWAY}-1": ("effects.mount_sway.tilt_deg", "got -1"),
    f"{SWAY}nan": ("effects.mount_sway.tilt_deg",),
    "effects.mount_sway.samples=9": ("effects.mount_sway.tilt_deg: this key is required",),
    "effects.mount_sway={tilt_deg = 1, samples = 5}": ("effects.mount_sway.samples", "got 5"),
    f"{FOLIAGE}-0.1": ("effects.foliage.leaf_area_density", "got -0.1"),
    f"{FOLIAGE}inf": ("effects.foliage.leaf_area_density",),
    "effects.foliage.season='spring'": ("effects.foliage.season",),
    "effects.foliage.season=1.5": ("effects.foliage.season",),
    "effects.foliage.projection=0": ("effects.foliage.projection", "got 0"),
    "effects.foliage.step_m=0": ("effects.foliage.step_m", "got 0"),
}


@pytest.mark.parametrize("change", BAD_SCAN)
def test_rejects_bad_parameters_of_scan_effects(
    mini: Path, tmp_path: Path, run_egvs: Callable[..., tuple[int, str, str]], change: str
) -> None:
    code, _, err = run_egvs("scan", mini, "--out", tmp_path / "out", "--set", change)
    assert code == 2 and "Traceback" not in err
    message = " ".join(err.split()).replace(" ", " ")
    assert all(part in message for part in BAD_SCAN[change]), message


def test_scan_effects_are_active_with_simulated_sites(mini: Path) -> None:
    scene = egvs.build_scene(egvs.load(write_scene(mini, *TREES)))
    assert Foliage(FoliageParameters()).why_idle(scene) is None
    assert Divergence(DivergenceParameters()).why_idle(scene) is None
    assert MountSway(MountSwayParameters(tilt_deg=1)).why_idle(scene) is None


PLAIN_LANES = '<lane index="0" disallow="pedestrian bicycle"/>'


@pytest.fixture(scope="session")
def plain_traffic(flat_road, tmp_path_factory):
    """The bytes of the plain traffic on the flat road, and its rows."""
    out = tmp_path_factory.mktemp("plain")
    return run_and_read(road_scenario(flat_road, **SMALL), out)[1], read_rows(out)


IDLE_TRAFFIC = {
    "slope on a flat network": {"slope": {}},
    "no rear parts": {"articulated": {"auto": False}},
    "one part each": {"articulated": {"auto": False, "kinds": {"bendy": {"parts_m": [18.75]}}}},
    "nobody": {"pedestrians_bicycles": {"pedestrians_per_h": 0, "bicycles_per_h": 0}},
}


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("effects", IDLE_TRAFFIC.values(), ids=IDLE_TRAFFIC.keys())
def test_idle_traffic_effects_do_not_change_the_traffic(flat_road, plain_traffic, tmp_path, effects):
    scene = road_scenario(flat_road, effects, **SMALL)
    result, actual = run_and_read(scene, tmp_path)
    assert actual == plain_traffic[0]
    name = next(iter(effects))
    assert re.fullmatch(rf"{name}: set, but .*: skipped, the result is the same", result["notes"][-1])
    reason = load_effect_class(name)(scene.effects.named[name]).why_idle(Scene(scene, None, ()))
    assert reason and reason in result["notes"][-1]
    assert inputs_of(traffic, scene, tmp_path) == inputs_of(traffic, road_scenario(flat_road, **SMALL), tmp_path)


@pytest.mark.system
@pytest.mark.slow
def test_traffic_effects_change_the_traffic(flat_road, plain_traffic, hill_run, tmp_path):
    for number, effects in enumerate(({"articulated": {}}, CROWD)):
        assert run_and_read(road_scenario(flat_road, effects, **SMALL), tmp_path / str(number))[1] != plain_traffic[0]
    assert np.ptp(hill_run[1]["z_m"]) > 10 and "slope: on, the network has 12.0 m of relief" in hill_run[0]["notes"]


def crowd_settings(**rates):
    return {"pedestrians_bicycles": rates}


def part_settings(kind, **lists):
    return {"articulated": {"kinds": {kind: lists}}}


MISFITS = {
    "no sidewalks": (
        PLAIN_LANES,
        crowd_settings(pedestrians_per_h=9),
        r"no connected sidewalks.*--sidewalks\.guess --crossings\.guess",
    ),
    "no bicycle lanes": (
        PLAIN_LANES,
        crowd_settings(bicycles_per_h=9),
        r"no lane that bicycles may use.*--bikelanes\.guess",
    ),
    "an unknown kind": (LANES, part_settings("tram", parts_m=[5, 5]), r"no vehicle type 'tram'. Use one of bendy, car"),
    "too long parts": (
        LANES,
        part_settings("bendy", parts_m=[10, 9]),
        r"bendy\.parts_m: .*at most the type's 18\.75 m, got 19 m",
    ),
    "one short part": (LANES, part_settings("bendy", parts_m=[10]), r"exactly the type's .*, got 10 m"),
    "a hinge behind": (LANES, part_settings("bendy", parts_m=[9, 9], hinges_m=[19]), r"hinges_m: .*18\.75 m, got 19 m"),
}


@pytest.mark.system
@pytest.mark.parametrize(("lanes", "effects", "message"), MISFITS.values(), ids=MISFITS.keys())
def test_rejects_traffic_effects_that_do_not_fit_network_or_fleet(tmp_path, lanes, effects, message):
    build_road(tmp_path, 0, lanes)
    with pytest.raises(InputError, match=message):
        run_stage(traffic, road_scenario(tmp_path, effects, **SMALL), tmp_path / "out")
    assert not (tmp_path / "out" / "trajectories.parquet").exists()


BAD_TRAFFIC = {
    "slope takes nothing": ("effects.slope.grade=1", r"effects\.slope\.grade: unknown key"),
    "a negative rate": ("effects.pedestrians_bicycles.pedestrians_per_h=-1", r"pedestrians_per_h: expected .* got -1"),
    "a flat person": ("effects.pedestrians_bicycles.pedestrian_m=[0.8,0.6,0]", r"pedestrian_m"),
    "no parts": ("effects.articulated.kinds.car.parts_m=[]", r"articulated\.kinds\.car\.parts_m"),
    "too many hinges": (
        "effects.articulated.kinds.car={parts_m=[2,2],hinges_m=[2,3]}",
        r"expected 1 hinges_m for 2 parts, or none, got 2",
    ),
    "a wrong word": ("effects.articulated.kind=1", r"articulated\.kind: unknown key. Did you mean kinds\?"),
    "people beside a finished file": (
        "effects.pedestrians_bicycles.bicycles_per_h=9",
        r"cannot be added to recorded traffic",
    ),
}


@pytest.mark.system
@pytest.mark.parametrize(("override", "message"), BAD_TRAFFIC.values(), ids=BAD_TRAFFIC.keys())
def test_rejects_bad_parameters_of_traffic_effects(mini, run_egvs, tmp_path, override, message):
    code, _, output = run_egvs("traffic", mini, "--out", tmp_path / "out", "--set", override)
    assert code == 2 and re.search(message, " ".join(output.split())), output


@pytest.mark.slow
@pytest.mark.system
def test_hill_scenario_has_constant_traffic_of_all_kinds(tmp_path):
    scene = load(HILL, ["traffic.frames=120", "traffic.warmup_s=150", "tpog.blocks=1"])
    result = run_stage(traffic, scene, tmp_path)
    assert result["vehicles"]["fewest"] == result["vehicles"]["most"] == 24 and result["collisions"] == 0
    assert "slope: on, the network has 16.0 m of relief" in result["notes"]
    r = read_rows(tmp_path)
    assert {"passenger", "pedestrian", "bicycle"} < set(r["kind"]) and r["part"].max() == 1
    assert pedestrians_bicycles.PEDESTRIAN.startswith("egvs")
