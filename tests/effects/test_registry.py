"""Effects by name: plug-ins of other packages, imports, effects that change nothing."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from subprocess import CompletedProcess
from types import SimpleNamespace

import numpy as np
import pytest

import egvs
from egvs.core.errors import MissingBackendError, RunError
from egvs.effects import base, registry
from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters
from egvs.sensors import beam_hooks
from egvs.traffic.vehicle_boxes import VehicleBoxes, checked_boxes
from tests import processes
from tests.core.test_plugins import install, site  # noqa: F401  the fixture
from tests.effects.detect_helpers import ACTIVE
from tests.effects.road_helpers import SMALL, road_scenario

EFFECT = '''
"""Every second return is lost (an example)."""

import numpy as np

from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters


class HalfParameters(EffectParameters):
    share: float = 0.5


class Half(Detect[HalfParameters]):
    NAME = "half"
    SOURCE = "an example"
    Model = HalfParameters

    def detect(self, range_m, sensor):
        return np.full(len(range_m), 1.0 - self.parameters.share)
'''


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A folder on the path of a process, in which the package is installed."""
    folder = tmp_path / "site-packages"
    info = folder / "half_returns-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "half_returns.py").write_text(EFFECT)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: half-returns\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[egvs.effects]\nhalf = half_returns:Half\n")
    return folder


def run_egvs(package: Path | None, *arguments: object) -> CompletedProcess[str]:
    return processes.run_egvs(*arguments, beside=package)


@pytest.mark.slow
@pytest.mark.system
def test_plugin_effect_runs_like_a_built_in_one(mini, package, tmp_path):
    plain, halved, dropped = (tmp_path / name for name in ("plain", "halved", "dropped"))
    assert run_egvs(None, "run", mini, "--out", plain).returncode == 0
    process = run_egvs(package, "run", mini, "--out", halved, "--set", "effects.half.share=0.25")
    assert process.returncode == 0, process.stderr
    assert run_egvs(None, "run", mini, "--out", dropped, "--set", "effects.dropout.share=0.25").returncode == 0
    egvs_of = {f: egvs.read_scores(f / "scores.parquet")["egvs"].to_pylist() for f in (plain, halved, dropped)}
    assert egvs_of[halved] == egvs_of[dropped] != egvs_of[plain]
    named = json.loads((halved / "run.json").read_text())["scenario"]["effects"]
    assert named == {"half": {"share": 0.25}}
    assert "unchanged" in run_egvs(package, "run", mini, "--out", halved, "--set", "effects.half.share=0.25").stderr
    assert run_egvs(package, "verify", halved).returncode == 0


@pytest.mark.slow
@pytest.mark.system
def test_changed_plugin_source_runs_the_score_stage_again(mini, package, tmp_path):
    call = ("run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert run_egvs(package, *call).returncode == 0
    (package / "half_returns.py").write_text(EFFECT.replace("1.0 - self.parameters.share", "0.5"))
    lines = {line.split()[0]: line for line in run_egvs(package, *call).stderr.splitlines() if line.strip()}
    assert "unchanged" not in lines["score"]
    assert all("unchanged" in lines[stage] for stage in ("traffic", "statics", "scan", "occupancy"))


@pytest.mark.system
@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("effects.half.shares=0.25", "effects.half.shares: unknown key. Did you mean share?"),
        ('effects.half.share="much"', "effects.half.share: expected a valid number, got 'much'"),
        ("effects.halve.share=0.25", "effects.halve: unknown effect. Did you mean half?"),
    ],
)
def test_rejects_bad_parameters_of_plugin_effect(mini, package, tmp_path, setting, message):
    process = run_egvs(package, "run", mini, "--out", tmp_path / "run", "--set", setting)
    assert (process.returncode, message in process.stderr) == (2, True), process.stderr


@pytest.mark.slow
@pytest.mark.system
def test_plugin_effect_is_listed_only_if_installed(mini, package, tmp_path):
    assert "half" in run_egvs(package, "effects").stdout.split()
    process = run_egvs(None, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert process.returncode == 2 and "effects.half: unknown effect" in process.stderr


@pytest.mark.system
def test_names_package_of_plugin_that_cannot_be_imported(mini, package, tmp_path):
    (package / "half_returns.py").write_text("import no_such_library\n")
    process = run_egvs(package, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert process.returncode == 1 and "half_returns:Half" in process.stderr and "Traceback" not in process.stderr


NO_EFFECT = """
from egvs.scenario.effects_config import EffectParameters
class Thing:
    NAME, SOURCE, STAGE, KIND, Model = "zz", "", "score", "detect", EffectParameters
"""


@pytest.mark.parametrize(
    ("source", "problem"),
    [
        (EFFECT, "expected NAME = 'zz'.*got 'half'"),
        (NO_EFFECT + "Half = Thing", "expected a subclass of Expand, .* of egvs.effects.base"),
        (NO_EFFECT + "Half = Thing()", "expected a subclass of Expand"),
        (
            EFFECT + '    NAME = "zz"\n    Model = type("M", (), {"from_dict": 1})',
            ".*EffectParameters as its Model, got <class ",
        ),
    ],
)
def test_rejects_plugin_that_is_not_an_effect_of_that_name(site: Path, source: str, problem: str) -> None:  # noqa: F811
    install(site, "somebody-elses", "zz = plug_z:Half", {"plug_z": source}, "egvs.effects")
    where = r"\(entry point 'plug_z:Half' of the package somebody-elses\)"
    with pytest.raises(MissingBackendError, match=f"^'zz' of egvs.effects cannot be loaded: {problem}.*{where}"):
        registry.load_effect_class("zz")


@pytest.mark.parametrize(
    ("entry", "lacks"),
    [
        ("collections:OrderedDict", "NAME, SOURCE, STAGE, KIND, Model.from_dict; expected a subclass"),
        ("plug_z:TABLE", "NAME, SOURCE, STAGE, KIND, Model.from_dict; expected a subclass"),
        ("plug_z", "NAME, SOURCE, STAGE, KIND, Model.from_dict; expected a subclass"),
        ("egvs.effects.base:Detect", "NAME, SOURCE, Model.from_dict; expected a subclass"),
    ],
)
def test_rejects_object_that_is_no_effect(site: Path, entry: str, lacks: str) -> None:  # noqa: F811
    install(site, "somebody-elses", f"zz = {entry}", {"plug_z": "TABLE = {}"}, "egvs.effects")
    message = rf"cannot be loaded: it has no {lacks}.* \(entry point '{entry}' of the package somebody-elses\)"
    with pytest.raises(MissingBackendError, match=message):
        registry.load_effect_class("zz")


@pytest.mark.system
def test_rejects_two_effects_with_one_name(mini, tmp_path):
    """Their parameters would overwrite each other in the cache key of the stage."""
    for name in ("aa", "bb"):
        install(tmp_path / "site", f"p{name}", f"{name} = plug_{name}:Half", {f"plug_{name}": EFFECT}, "egvs.effects")
    both = ("--set", "effects.aa.share=0.1", "--set", "effects.bb.share=0.2")
    process = run_egvs(tmp_path / "site", "run", mini, "--out", tmp_path / "run", *both)
    assert process.returncode == 1 and "Traceback" not in process.stderr
    assert "expected NAME = 'aa'" in process.stderr and "of the package paa" in process.stderr


BROKEN = {
    "lacks": "import no_such_library",
    "raises": "raise RuntimeError",
    "exits": "raise SystemExit(0)",
    "other_kind": "Half = dict",
    "other_name": EFFECT + '    NAME = "other"',
}


@pytest.mark.slow
@pytest.mark.system
def test_lists_broken_plugins(mini, tmp_path):
    for name, source in BROKEN.items():
        install(tmp_path / "site", f"p_{name}", f"{name} = plug_{name}:Half", {f"plug_{name}": source}, "egvs.effects")
    for arguments in ((), (mini,)):
        process = run_egvs(tmp_path / "site", "effects", *arguments)
        assert process.returncode == 0, process.stderr
        words = process.stdout.split()
        assert words.count("broken") == len(BROKEN) and {*BROKEN, "range_limit"} <= set(words)
    for name in ("raises", "exits", "other_name"):
        named = run_egvs(tmp_path / "site", "effects", mini, "--set", f"effects.{name}.share=0.25")
        assert named.returncode == 1 and f"p_{name}" in named.stderr and "Traceback" not in named.stderr


@pytest.mark.slow
@pytest.mark.system
def test_list_names_the_package_of_each_effect(mini, package):
    for arguments in ((), (mini,)):
        words = " ".join(run_egvs(package, "effects", *arguments).stdout.split())
        assert "half-returns" in words and "package egvs" not in words


class Given(Detect[EffectParameters]):
    NAME, SOURCE, Model = "given", "", EffectParameters


@pytest.mark.parametrize(
    ("given", "result"),
    [
        (np.array([0.5, np.nan]), "values from nan to nan"),
        (np.array([0.5, 1.5]), "values from 0.5 to 1.5"),
        (np.array([-0.25, 0.5]), "values from -0.25 to 0.5"),
        (np.ones(3), r"an array of shape \(3,\) for 2 crossings"),
        (np.ones((2, 1)), r"an array of shape \(2, 1\) for 2 crossings"),
        (np.array(["1", "1"]), "ndarray of <U1"),
        (None, "NoneType"),
        (0.5, "float"),
    ],
)
def test_rejects_invalid_shares(given: object, result: str) -> None:
    with pytest.raises(RunError, match=rf"^effects\.given: expected one share from 0 to 1 .*, got {result}$"):
        base.checked_shares(Given(EffectParameters()), given, 2, "crossings")


def test_accepts_empty_and_boolean_shares() -> None:
    effect = Given(EffectParameters())
    assert base.checked_shares(effect, np.ones(0), 0, "ranges").size == 0
    assert base.checked_shares(effect, np.array([True, False]), 2, "ranges").tolist() == [True, False]


@pytest.mark.parametrize(
    ("given", "result"),
    [
        (None, "NoneType"),
        ((np.ones((4, 3)), np.zeros(4, int)), "tuple"),
        ((np.ones((4, 3)), np.zeros(4, int), np.ones(3)), r"shapes \(4, 3\), \(4,\) and \(3,\)"),
        ((np.ones((4, 2)), np.zeros(4, int), np.ones(4)), r"shapes \(4, 2\), \(4,\) and \(4,\)"),
        ((np.ones((4, 3)), np.full(4, 2), np.ones(4)), "parents of other beams"),
        ((np.ones((4, 3)), np.zeros(4), np.ones(4)), "parents of other beams"),
    ],
)
def test_rejects_invalid_sub_beams(given: object, result: str) -> None:
    with pytest.raises(RunError, match=rf"^effects\.given: expected directions \(m, 3\).* of 2 beams, got {result}$"):
        beam_hooks.checked_sub_beams(Given(EffectParameters()), given, 2)


@pytest.mark.parametrize(
    ("given", "result"), [(None, "got NoneType"), ("short", r"expected x_m of shape \(1,\), got \(0,\)")]
)
def test_rejects_invalid_boxes(given: str | None, result: str) -> None:
    one, none = np.ones(1), np.ones(0)
    boxes = VehicleBoxes(0, 1, one, ["a"], one, ["passenger"], one, none, *[one] * 8)
    with pytest.raises(RunError, match=rf"^Given: .*{result}$"):
        checked_boxes(Given(EffectParameters()), given and boxes)


def test_effect_with_a_number_for_all_ranges_is_named_before_a_run() -> None:
    class Constant(Given):
        def detect(self, range_m: object, sensor: object) -> float:
            return 0.5

    sensors = SimpleNamespace(used_sensors={"a": None})
    with pytest.raises(
        RunError, match=r"^effects\.given: expected one share from 0 to 1 for each of 1 ranges, got float$"
    ):
        Constant(EffectParameters()).refusal(sensors)


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("value", ["np.nan", "2.0"])
def test_names_plugin_that_returns_invalid_shares(mini, package, tmp_path, value):
    (package / "half_returns.py").write_text(EFFECT.replace("1.0 - self.parameters.share", value))
    process = run_egvs(package, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert process.returncode == 1 and "Traceback" not in process.stderr
    assert (
        "effects.half: expected one share from 0 to 1" in process.stderr
        and not (tmp_path / "run" / "scores.parquet").exists()
    )


MODULES = tuple(f"egvs.effects.{name}" for name in (
    "divergence", "foliage", "mount_sway", "dropout", "fog", "moving_occlusion", "rain", "range_limit", "articulated",
    "range_noise", "surface_losses", "mixed_returns", "pedestrians_bicycles", "slope",
))  # fmt: skip


IMPORTED = """
import sys
import warnings
warnings.simplefilter("error")
import egvs
from egvs.stages import score
from tests.stage_runner import run_stage
egvs.load({folder!r}, {settings!r})
run_stage(score, egvs.load({folder!r}, {settings!r}), __import__("pathlib").Path({out!r}), jobs=1)
print(sorted(name for name in sys.modules if name.startswith({MODULES})))
"""


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize(
    ("settings", "expected"),
    [([], []), (ACTIVE["rain"], ["egvs.effects.rain"])],
    ids=["plain", "rain"],
)
def test_imports_only_named_effects(
    score_run: tuple[Path, Path], tmp_path: Path, settings: list[str], expected: list[str]
) -> None:
    out = shutil.copytree(score_run[1], tmp_path / "out")
    program = IMPORTED.format(MODULES=MODULES, folder=str(score_run[0]), settings=settings, out=str(out))
    run = processes.python(program)
    assert (run.returncode, run.stderr) == (0, "")
    assert run.stdout.strip() == repr(expected)


@pytest.mark.slow
@pytest.mark.system
def test_plain_run_imports_no_effect(mini: Path, tmp_path: Path) -> None:
    program = f"""
import sys
import egvs
egvs.run(egvs.load({str(mini)!r}), {str(tmp_path / "out")!r}, jobs=1)
print([name for name in sys.modules if name.startswith({MODULES})])
"""
    run = processes.python(program)
    assert (run.returncode, run.stdout.strip()) == (0, "[]"), run.stderr


@pytest.mark.system
def test_flat_network_imports_no_traffic_effect(flat_road, tmp_path):
    values = road_scenario(flat_road, **(SMALL | {"frames": 8})).model_dump(mode="json")
    code = f"""
import sys; from pathlib import Path; from egvs.stages import statics, traffic; from tests.stage_runner import run_stage
from egvs.scenario.loading import scenario_from_dict
scene = scenario_from_dict({values!r}, Path({str(flat_road)!r}), "place")
run_stage(traffic, scene, Path({str(tmp_path)!r})); run_stage(statics, scene, Path({str(tmp_path)!r}))
print([m for m in sys.modules if m in ("egvs.effects.slope", "egvs.effects.articulated")])"""
    process = processes.python(code)
    assert (process.returncode, process.stdout.strip()) == (0, "[]"), process.stderr
