"""Do the effects that decide whether a return is noticed do what their sources say, and nothing when they have nothing
to do?

One small world is scanned once; each test scores it again under other settings. The hand-checked cases use one beam
along x through voxels of 0.5 m: the middle of its chord in voxel ix is 10.25 m + ix / 2 from the sensor."""

from __future__ import annotations

import math
import shutil
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import egvs
from egvs.artefacts import parquet
from egvs.artefacts.tpog import read_tpog
from egvs.core.errors import InputError
from egvs.effects import registry
from egvs.effects.base import Detect, Effect
from egvs.runs import run
from egvs.scenario.sensor_config import SensorConfig
from egvs.scoring import visibility
from egvs.scoring.scorer import Scorer
from egvs.sensors import sensor, sites
from egvs.sensors.scene import Scene
from egvs.sensors.sensor import CATALOGUE, Sensor
from egvs.stages import scan, score, statics, tpog, traffic
from egvs.stages.inputs import get_scene, open_folder
from egvs.stages.site_scoring import empty_scans
from tests import processes
from tests.conftest import BUILDING, SCENARIO, SITES, collection, fcd, feature
from tests.stages import run_stage

SENSOR = sensor.Sensor("test", (0.0,), (0.0,), 1, 100.0, "this test", rated_range_m=40.0)
RANGES_M = np.linspace(0.01, 200.0, 400)

# What switches each effect on so that it acts.
ON = {
    "range_limit": ["effects.range_limit.rated_range_m=30"],
    "rain": ["effects.rain.rate_mm_h=50"],
    "fog": ["effects.fog.visibility_m=100"],
    "dropout": ["effects.dropout.share=0.2"],
}

# What leaves each effect nothing to do.
NOTHING = {
    "hard limit beyond reach": ["effects.range_limit={rated_range_m = 30, reflectivity = 1e4, softness = 0}"],
    "soft limit far away": ["effects.range_limit={rated_range_m = 30, reflectivity = 1e9}"],
    "no rain": ["effects.rain.rate_mm_h=0"],
    "next to no rain": ["effects.rain.rate_mm_h=1e-25"],
    "clear air": ["effects.fog.visibility_m=1e18"],
    "no dropout": ["effects.dropout.share=0"],
    "all of them": [
        "effects.rain.rate_mm_h=0", "effects.fog.visibility_m=1e18", "effects.dropout.share=0",
        "effects.range_limit.rated_range_m=1e4", "effects.range_limit.softness=0",
    ],
}  # fmt: skip

# Settings that take more and more, with the others fixed.
WORSE = {
    "rain": [f"effects.rain.rate_mm_h={rate}" for rate in (0, 0.1, 2, 10, 50, 300)],
    "rain in France": [f"effects.rain={{rate_mm_h = {rate}, law = 'france'}}" for rate in (0, 0.1, 2, 10, 50, 300)],
    "fog": [f"effects.fog.visibility_m={seen}" for seen in (60000, 40000, 7000, 5000, 1001, 999, 501, 400, 100, 20)],
    "fog of Kruse": [
        f"effects.fog={{visibility_m = {seen}, model = 'kruse'}}" for seen in (60000, 40000, 6001, 5999, 500, 20)
    ],
    "dropout": [f"effects.dropout.share={share}" for share in (0, 0.01, 0.3, 0.7, 1)],
    "reflectivity": [
        f"effects.range_limit={{rated_range_m = 30, reflectivity = {rho}}}" for rho in (5, 1, 0.8, 0.1, 0.01)
    ],
    "incidence": [f"effects.range_limit={{rated_range_m = 30, incidence_deg = {angle}}}" for angle in (0, 30, 60, 89)],
    "rated range": [f"effects.range_limit={{rated_range_m = {limit}, softness = 0}}" for limit in (200, 90, 40, 20, 5)],
}


def write(folder: Path, scenario: str, sites_csv: str) -> Path:
    folder.mkdir()
    (folder / "scenario.toml").write_text(scenario)
    (folder / "fcd.csv").write_text(fcd())
    (folder / "sites.csv").write_text(sites_csv)
    house = feature({"type": "Polygon", "coordinates": BUILDING}, name="house", kind="building", height_m=6)
    (folder / "statics.geojson").write_text(collection(house))
    return folder


def stages(folder: Path, out: Path) -> tuple[Path, Path]:
    """Run all but the report in ``out``."""
    out.mkdir()
    scenario = egvs.load(folder)
    for stage in (statics, scan, traffic, tpog, score):
        run_stage(stage, scenario, out)
    return folder, out


@pytest.fixture(scope="module")
def done(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A scenario folder with two sites, and the folder with its artefacts."""
    top = tmp_path_factory.mktemp("detect")
    return stages(write(top / "mini", SCENARIO, SITES), top / "out")


@pytest.fixture(scope="module")
def one_beam(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The same with one site and one beam: from x = -10 along x, through the voxels (ix, 20, 4)."""
    top = tmp_path_factory.mktemp("beam")
    scenario = (
        SCENARIO.replace("[-15, 5]", "[0]")
        .replace("channels = 8\n", "")
        .replace("azimuth_step_deg = 1.0", "azimuth_step_deg = 360")
    )
    return stages(write(top / "mini", scenario, "site,x_m,y_m,z_m\nonly,-10,0.25,2.25\n"), top / "out")


def scored(done: tuple[Path, Path], settings: list[str], jobs: int | None = None) -> tuple[dict[str, list], bytes]:
    """Columns of scores.parquet under these settings, and its bytes; the module's artefacts stay as they are."""
    folder, out = done
    run_stage(score, egvs.load(folder, settings), out, jobs=jobs)
    table, _ = parquet.read_artefact(out / "scores.parquet", "scores")
    return table.to_pydict(), (out / "scores.parquet").read_bytes()


def hits(done: tuple[Path, Path], settings: list[str]) -> np.ndarray:
    """Hits of the first site in each voxel, (nx, ny, nz)."""
    folder, out = done
    scenario = egvs.load(folder, settings)
    work = open_folder(scenario, out)
    first = next(iter(empty_scans(work)))
    return Scorer(get_scene(work), read_tpog(out / "tpog.parquet")).hits(first.beams)


def along(one_beam: tuple[Path, Path], *settings: str) -> np.ndarray:
    """Hits of the only beam in the voxels along it, (nx,)."""
    found = hits(one_beam, list(settings))
    assert found[:, 20, 4].sum() == found.sum()
    return found[:, 20, 4]


def made(name: str, **parameters: object) -> Effect:
    return registry.make_effect(name, registry.find_effect_class(name).Model.from_dict(parameters))


def scene(done: tuple[Path, Path], *settings: str) -> Scene:
    scenario = egvs.load(done[0], settings)
    return Scene(scenario, None, sites.candidate_sites(scenario))  # type: ignore[arg-type]


# The switch, the limit, the monotonic truth


@pytest.mark.parametrize("name", ON)
def test_the_switch_acts(done: tuple[Path, Path], name: str) -> None:
    plain, plain_bytes = scored(done, [])
    with_effect, with_bytes = scored(done, ON[name])
    assert with_bytes != plain_bytes
    assert all(b < a for a, b in zip(plain["egvs"], with_effect["egvs"], strict=True))
    assert all(b > 0 for b in with_effect["egvs"])
    assert with_effect["egvs_limit"] == plain["egvs_limit"]
    assert scored(done, []) == (plain, plain_bytes)


@pytest.mark.parametrize("settings", NOTHING.values(), ids=NOTHING.keys())
def test_a_parameter_towards_nothing_gives_the_plain_score_exactly(
    done: tuple[Path, Path], settings: list[str]
) -> None:
    assert scored(done, settings)[0] == scored(done, [])[0]
    np.testing.assert_array_equal(hits(done, settings), hits(done, []))


@pytest.mark.parametrize("series", WORSE.values(), ids=WORSE.keys())
def test_worse_never_raises_a_score(done: tuple[Path, Path], series: list[str]) -> None:
    scores = np.array([scored(done, [setting])[0]["egvs"] for setting in series])
    assert (np.diff(scores, axis=0) <= 0).all()
    assert (scores[-1] < scores[0]).all()


rates = st.floats(0, 300)


@given(rates, rates, st.sampled_from(["japan", "france", "itu2025", "goodin"]))
def test_more_rain_takes_more_at_every_range(one: float, other: float, law: str) -> None:
    less, more = (made("rain", rate_mm_h=rate, law=law).detect(RANGES_M, SENSOR) for rate in sorted((one, other)))
    assert (more <= less).all()
    assert (np.diff(more) <= 0).all()


seen = st.floats(1, 1e5)


@given(
    seen,
    seen,
    st.sampled_from(["kim", "kruse"]),
    st.sampled_from([865.0, 905.0, 1550.0]),
    st.sampled_from([0.02, 0.05]),
)
def test_thicker_fog_takes_more_at_every_range(
    one: float, other: float, model: str, wavelength_nm: float, contrast: float
) -> None:
    sensor = Sensor("test", (0.0,), (0.0,), 1, 100.0, "this test", wavelength_nm=wavelength_nm)
    thick, thin = (
        made("fog", visibility_m=v, model=model, contrast=contrast).detect(RANGES_M, sensor)
        for v in sorted((one, other))
    )
    assert (thick <= thin).all()
    assert (np.diff(thick) <= 0).all()


@given(st.floats(0.001, 100), st.floats(0.001, 100), st.floats(0, 89.9), st.floats(0, 3))
def test_a_darker_target_is_noticed_less(one: float, other: float, incidence_deg: float, softness: float) -> None:
    dark, bright = (
        made("range_limit", reflectivity=rho, incidence_deg=incidence_deg, softness=softness).detect(RANGES_M, SENSOR)
        for rho in sorted((one, other))
    )
    assert (dark <= bright).all()
    assert (np.diff(dark) <= 0).all()
    assert ((dark >= 0) & (bright <= 1)).all()


# On paper: one beam, one voxel


def test_rain_by_hand(one_beam: tuple[Path, Path]) -> None:
    """10 mm/h: 1.58 * 10^0.63 = 6.740 dB/km; at 30.25 m 0.0605 km both ways, 0.4078 dB, a share of 10^-0.04078 =
    0.9104."""
    assert along(one_beam, "effects.rain.rate_mm_h=10")[40] == pytest.approx(0.9104, abs=5e-5)


def test_rain_in_france_by_hand(one_beam: tuple[Path, Path]) -> None:
    """10 mm/h: 1.076 * 10^0.67 = 5.033 dB/km; 0.0605 km, 0.3045 dB, 0.9323."""
    assert along(one_beam, "effects.rain={rate_mm_h = 10, law = 'france'}")[40] == pytest.approx(0.9323, abs=5e-5)


def test_rain_of_goodin_by_hand(one_beam: tuple[Path, Path]) -> None:
    """10 mm/h: 0.01 * 10^0.6 = 0.03981 / m; over 60.5 m 2.4085, e^-2.4085 = 0.0899."""
    assert along(one_beam, "effects.rain={rate_mm_h = 10, law = 'goodin'}")[40] == pytest.approx(0.0899, abs=5e-5)


def test_fog_by_hand(one_beam: tuple[Path, Path]) -> None:
    """100 m: no wavelength in Kim's model; what a black target keeps over 100 m is 2 %, so 20.5 m keep 0.02^0.205 =
    0.4484."""
    assert along(one_beam, "effects.fog.visibility_m=100")[0] == pytest.approx(0.02**0.205, abs=1e-9)
    assert along(one_beam, "effects.fog.visibility_m=100")[0] == pytest.approx(0.4484, abs=5e-5)


def test_fog_of_kruse_by_hand(one_beam: tuple[Path, Path]) -> None:
    """1 km: q = 0.585, (905 / 550)^-0.585 = 0.7473; 3.912 * 0.7473 = 2.923 / km; 0.0605 km, e^-0.1769 = 0.8379."""
    assert along(one_beam, "effects.fog={visibility_m = 1000, model = 'kruse'}")[40] == pytest.approx(0.8379, abs=5e-5)


def test_hard_limit_by_hand(one_beam: tuple[Path, Path]) -> None:
    """Rated 40 m at 0.8: a quarter of that reflectivity comes back from 20 m; middles of chords are at 19.75 and 20.25
    m."""
    found = along(
        one_beam, "effects.range_limit={rated_range_m = 40, rated_reflectivity = 0.8, reflectivity = 0.2, softness = 0}"
    )
    np.testing.assert_array_equal(found, [1.0] * 20 + [0.0] * 60)


def test_incidence_by_hand(one_beam: tuple[Path, Path]) -> None:
    """cos 60 deg = 1/2, and another factor of 1/2 in reflectivity: again 20 m."""
    found = along(
        one_beam,
        "effects.range_limit={rated_range_m = 40, rated_reflectivity = 0.8, reflectivity = 0.4, incidence_deg = 60,"
        " softness = 0}",
    )
    np.testing.assert_array_equal(found, [1.0] * 20 + [0.0] * 60)


def test_soft_limit_by_hand(one_beam: tuple[Path, Path]) -> None:
    """Rated 20.25 m: one half there. At 10.25 m the power is (20.25 / 10.25)^2 = 3.903 times the threshold, ln =
    1.3618; over a softness of 1 the normal distribution says 0.9134."""
    found = along(one_beam, "effects.range_limit={rated_range_m = 20.25, rated_reflectivity = 0.1, softness = 1}")
    assert found[20] == 0.5
    assert found[0] == pytest.approx(0.9134, abs=5e-5)


def test_dropout_by_hand(one_beam: tuple[Path, Path]) -> None:
    np.testing.assert_array_equal(along(one_beam, "effects.dropout.share=0.25"), 0.75)


def test_effects_multiply(one_beam: tuple[Path, Path]) -> None:
    """In the voxel at 20.25 m: 3/4 is not dropped, one half is noticed at the limit, rain and fog thin what is left."""
    half = "effects.range_limit={rated_range_m = 20.25, rated_reflectivity = 0.1}"
    dropout, rain, fog = "effects.dropout.share=0.25", "effects.rain.rate_mm_h=30", "effects.fog.visibility_m=200"
    assert along(one_beam, half, dropout)[20] == 0.375
    assert along(one_beam, dropout, half)[20] == 0.375
    alone = [along(one_beam, setting) for setting in (half, dropout, rain, fog)]
    together = along(one_beam, fog, rain, dropout, half)
    np.testing.assert_allclose(together, np.prod(alone, axis=0), rtol=0, atol=2.0**-31)


@pytest.mark.parametrize("name", ON)
def test_a_voxel_keeps_what_is_detected_at_the_range_of_its_centre(done: tuple[Path, Path], name: str) -> None:
    """Every voxel's plain hits, times the effect asked at that voxel; to 2**-33 of each, and what rounding adds."""
    here = scene(done, *ON[name])
    (only,), sensor = registry.scenario_effects(here.scenario, "score"), here.sensor(here.sites[0].sensor)
    assert isinstance(only, Detect)
    grid = here.scenario.roi.grid
    centres_m = (np.stack(np.meshgrid(*map(np.arange, grid.shape), indexing="ij"), axis=-1) + 0.5) * grid.voxel_m
    away_m = centres_m - grid.to_grid_m(np.array(here.sites[0].pose.position_m))
    chance = only.detect(np.sqrt((away_m**2).sum(axis=-1)).ravel(), sensor).reshape(grid.shape)
    plain, found = hits(done, []), hits(done, ON[name])
    np.testing.assert_allclose(found, plain * chance, rtol=0, atol=float(plain.max()) * 2.0**-33 + 2.0**-33)
    assert (found < plain).any()


# Against the sources


def test_rain_in_japan_is_the_rain_of_marshall_and_palmer() -> None:
    """8000 e^(-4.1 R^-0.21 D) drops / (m^3 mm), each taking away twice its cross-section: pi * 8000 / 4.1^3 R^0.63
    mm^2/m^3."""
    for rate in (1.0, 10.0, 50.0):
        by_drops_per_m = math.pi * 8000 / (4.1 * rate**-0.21) ** 3 * 1e-6
        assert made("rain", rate_mm_h=rate).extinction_per_m() == pytest.approx(by_drops_per_m, rel=0.005)  # type: ignore[attr-defined]


def test_the_laws_of_the_itu_agree_and_that_of_goodin_does_not() -> None:
    found = {
        law: made("rain", rate_mm_h=10, law=law).extinction_per_m() for law in ("japan", "france", "itu2025", "goodin")
    }  # type: ignore[attr-defined]
    assert found["france"] < found["itu2025"] < found["japan"] < 1.4 * found["france"]
    assert 25 < found["goodin"] / found["japan"] < 27


def exponent(model: str, visibility_m: float) -> float:
    """q, from the extinction at two wavelengths."""
    fog = made("fog", visibility_m=visibility_m, model=model)
    return -math.log(fog.extinction_per_m(1100.0) / fog.extinction_per_m(550.0), 2)  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("visibility_m", "kim", "kruse"),
    [
        (60_000, 1.6, 1.6),
        (10_000, 1.3, 1.3),
        (4_000, 0.98, 0.585 * 4 ** (1 / 3)),
        (700, 0.2, 0.585 * 0.7 ** (1 / 3)),
        (300, 0, 0.585 * 0.3 ** (1 / 3)),
    ],
)
def test_exponents_are_those_of_the_sources(visibility_m: float, kim: float, kruse: float) -> None:
    assert exponent("kim", visibility_m) == pytest.approx(kim, abs=1e-9)
    assert exponent("kruse", visibility_m) == pytest.approx(kruse, abs=1e-9)


@pytest.mark.parametrize("edge_m", [500.0, 1000.0, 6000.0])
def test_kims_exponent_has_no_steps_in_fog_and_mist(edge_m: float) -> None:
    assert exponent("kim", edge_m * (1 - 1e-9)) == pytest.approx(exponent("kim", edge_m * (1 + 1e-9)), abs=1e-6)


def test_fog_takes_17_db_over_the_visibility_at_550_nm() -> None:
    """As ITU-R P.1814-1 prints it: 17 / V dB/km."""
    per_m = made("fog", visibility_m=2000).extinction_per_m(550.0)  # type: ignore[attr-defined]
    assert per_m * 1000 * 10 / math.log(10) == pytest.approx(17 / 2, rel=1e-3)


def test_the_same_fog_by_either_contrast() -> None:
    """Who sees 2 % at 391 m sees 5 % at 300 m; near 700 m the exponent depends on it, too."""
    for at_2_percent in (391.2, 700.0):
        at_5_percent = at_2_percent * math.log(0.05) / math.log(0.02)
        one, other = made("fog", visibility_m=at_2_percent), made("fog", visibility_m=at_5_percent, contrast=0.05)
        assert one.extinction_per_m(905.0) == pytest.approx(other.extinction_per_m(905.0), rel=1e-12)  # type: ignore[attr-defined]


def test_the_default_softness_is_that_of_a_datasheet() -> None:
    """Ouster OS1: 10 % targets 50 % at 55 m and 90 % at 45 m."""
    os1 = sensor.CATALOGUE["OS1-128"]
    at_45, at_55 = made("range_limit").detect(np.array([45.0, 55.0]), os1)
    assert at_55 == pytest.approx(0.5, abs=1e-12)
    assert at_45 == pytest.approx(0.9, abs=0.015)


def test_next_to_the_sensor_everything_is_noticed() -> None:
    assert made("range_limit").detect(np.array([0.0, 1e-6]), SENSOR).tolist() == [1.0, 1.0]


# Sensors


def test_every_sensor_of_the_catalogue_is_rated_within_its_range() -> None:
    for entry in CATALOGUE.values():
        assert entry.rated_range_m is not None, f"{entry.name} needs one for range_limit"
        assert 0 < entry.rated_range_m <= entry.range_m
        assert 0 < entry.rated_reflectivity <= 1
        assert 800 < entry.wavelength_nm < 1600


def test_a_sensor_of_ones_own_may_be_rated(done: tuple[Path, Path]) -> None:
    rated = [
        "sensors.small.rated_range_m=30",
        "sensors.small.rated_reflectivity=0.4",
        "sensors.small.wavelength_nm=1550",
    ]
    found = sensor.resolve_sensor("small", egvs.load(done[0], rated).sensors, "here")
    assert (found.rated_range_m, found.rated_reflectivity, found.wavelength_nm) == (30.0, 0.4, 1550.0)
    assert found.divergence_mrad == sensor.Sensor.divergence_mrad
    by_sensor, by_effect = (
        scored(done, settings)[0]
        for settings in (
            [*rated, "effects.range_limit.softness=0"],
            ["effects.range_limit={rated_range_m = 30, rated_reflectivity = 0.4, softness = 0}"],
        )
    )
    assert by_sensor == by_effect


def test_a_wavelength_reaches_the_fog(done: tuple[Path, Path]) -> None:
    haze = "effects.fog={visibility_m = 1000, model = 'kruse'}"
    near, far = (scored(done, [haze, f"sensors.small.wavelength_nm={w}"])[0]["egvs"] for w in (865, 1550))
    assert all(a < b for a, b in zip(near, far, strict=True))


def test_what_a_sensor_does_not_say_leaves_no_trace() -> None:
    model = SensorConfig(elevations_deg=(0,), azimuth_step_deg=1, range_m=5)
    assert set(model.model_dump(mode="json")) == {
        "elevations_deg",
        "channels",
        "azimuth_offsets_deg",
        "azimuth_step_deg",
        "range_m",
    }
    said = model.model_copy(update={"rated_range_m": 3.0})
    assert said.model_dump(mode="json")["rated_range_m"] == 3.0
    assert SensorConfig.model_validate(said.model_dump(mode="json")) == said


def test_a_sensor_that_is_not_rated_is_told(mini: Path, tmp_path: Path, run_egvs) -> None:
    code, _, said = run_egvs("run", mini, "--out", tmp_path / "out", "--set", "effects.range_limit.reflectivity=0.2")
    assert code == 2
    assert (
        "sensor small: rated_range_m is missing. Add it to [sensors.small], or to [effects.range_limit]."
        in " ".join(said.split())
    )
    assert not (tmp_path / "out" / "scores.parquet").exists()


# Called for, or not


def test_idle_says_why(done: tuple[Path, Path]) -> None:
    here = scene(done)
    assert made("rain", rate_mm_h=0).why_idle(here) == "rate_mm_h is 0"
    assert made("dropout", share=0).why_idle(here) == "share is 0"
    assert made("range_limit", softness=0, rated_range_m=300).why_idle(here) == "every beam ends before the limit"
    for name, parameters in {
        "rain": {"rate_mm_h": 1},
        "dropout": {"share": 0.1},
        "fog": {"visibility_m": 1e4},
        "range_limit": {"rated_range_m": 300},
    }.items():
        assert made(name, **parameters).why_idle(here) is None
    assert made("range_limit", softness=0, rated_range_m=30).why_idle(here) is None
    with pytest.raises(InputError, match="sensor small: rated_range_m is missing"):
        made("range_limit", softness=0).why_idle(here)


def test_a_limit_is_not_idle_for_a_measured_scan(done: tuple[Path, Path]) -> None:
    """Its points may lie beyond the sensor's nominal range."""
    (done[0] / "one.csv").write_text("site,x_m,y_m,z_m\npole_a,10,12,3\n")
    (done[0] / "cloud.csv").write_text("x_m,y_m,z_m\n20,0,1\n")
    measured = scene(done, "sites.points='cloud.csv'", "sites.file='one.csv'")
    assert made("range_limit", softness=0, rated_range_m=300).why_idle(measured) is None


@pytest.mark.parametrize("name", ON)
def test_every_effect_names_its_source(name: str) -> None:
    kind = registry.find_effect_class(name)
    assert (kind.NAME, issubclass(kind, Detect)) == (name, True)
    assert len(kind.SOURCE) > 20
    assert all(field.description for field in kind.Model.model_fields.values())


# Bad parameters


BAD = {
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


@pytest.mark.parametrize(("setting", "message"), BAD.values(), ids=BAD.keys())
def test_bad_parameters_are_refused(mini: Path, tmp_path: Path, run_egvs, setting: str, message: str) -> None:
    code, printed, said = run_egvs("run", mini, "--out", tmp_path / "out", "--set", f"effects.{setting}")
    assert (code, printed) == (2, "")
    assert message in " ".join(said.split())
    assert not (tmp_path / "out" / "scores.parquet").exists()


@pytest.mark.parametrize(
    "key",
    ["wavelength_nm=0", "rated_range_m=-3", "rated_reflectivity=0", "divergence_mrad=[1]", "divergence_mrad=[-1, 1]"],
)
def test_bad_optics_are_refused(mini: Path, key: str) -> None:
    with pytest.raises(InputError, match=rf"sensors\.small\.{key.split('=')[0]}"):
        egvs.load(mini, [f"sensors.small.{key}"])


# The run


@pytest.mark.slow
def test_only_the_score_runs_again(mini: Path, tmp_path: Path) -> None:
    def states(*settings: str) -> dict[str, str]:
        seen: dict[str, str] = {}
        run.run(
            egvs.load(mini, settings),
            tmp_path / "out",
            listener=lambda stage, state, _: seen.__setitem__(stage, state),
        )
        return seen

    states()
    for settings in (["effects.rain.rate_mm_h=5"], ["effects.rain.rate_mm_h=9"], ON["dropout"], []):
        assert {stage for stage, state in states(*settings).items() if state != "skipped"} == {
            "check",
            "score",
            "report",
        }
    assert set(states().values()) == {"skipped"}


@pytest.mark.parametrize("settings", [*ON.values(), [s for each in ON.values() for s in each]], ids=[*ON, "all"])
def test_bytes_do_not_depend_on_threads(done: tuple[Path, Path], settings: list[str]) -> None:
    assert len({scored(done, settings, jobs)[1] for jobs in (1, 2, 3)}) == 1


MODULES = tuple(f"egvs.effects.{name}" for name in (
    "divergence", "foliage", "mount_sway", "dropout", "fog", "moving_occlusion", "rain", "range_limit", "articulated",
    "pedestrians_bicycles", "slope",
))  # fmt: skip
IMPORTED = """
import sys
import warnings
warnings.simplefilter("error")
import egvs
from egvs.stages import score
from tests.stages import run_stage
egvs.load({folder!r}, {settings!r})
run_stage(score, egvs.load({folder!r}, {settings!r}), __import__("pathlib").Path({out!r}), jobs=1)
print(sorted(name for name in sys.modules if name.startswith({MODULES})))
"""


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("settings", "expected"),
    [([], []), (ON["rain"], ["egvs.effects.rain"])],
    ids=["plain", "rain"],
)
def test_what_is_not_named_is_not_imported(
    done: tuple[Path, Path], tmp_path: Path, settings: list[str], expected: list[str]
) -> None:
    out = shutil.copytree(done[1], tmp_path / "out")
    program = IMPORTED.format(MODULES=MODULES, folder=str(done[0]), settings=settings, out=str(out))
    run = processes.python(program)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.strip() == repr(expected)


@pytest.mark.slow
@pytest.mark.system
def test_a_whole_plain_run_imports_no_effect(mini: Path, tmp_path: Path) -> None:
    program = f"""
import sys
import egvs
egvs.run(egvs.load({str(mini)!r}), {str(tmp_path / "out")!r}, jobs=1)
print([name for name in sys.modules if name.startswith({MODULES})])
"""
    run = processes.python(program)
    assert (run.returncode, run.stdout.strip()) == (0, "[]"), run.stderr


def test_more_beams_than_whole_numbers_hold_are_refused(
    mini: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Weighted hits are added up in units of 2**-32, so 2**31 crossings in one class of voxels would leave 64 bits."""
    scenario = egvs.load(mini, ON["rain"])
    beams = sensor.resolve_sensor("small", scenario.sensors, "").beams
    monkeypatch.setattr(visibility, "MAX_CROSSINGS", beams)
    with pytest.raises(InputError, match=r"site pole_a: expected fewer than .* beams with effects, got"):
        egvs.run(scenario, tmp_path / "out")
