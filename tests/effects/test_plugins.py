"""An effect of somebody else's package is found, checked, run and known by its source like this program's own."""

from __future__ import annotations

import json
from pathlib import Path
from subprocess import CompletedProcess

import numpy as np
import pytest

import egvs
from egvs.core.errors import MissingBackendError, RunError
from egvs.effects import registry
from egvs.effects.base import Detect
from egvs.scenario.effects_config import EffectParameters
from egvs.scoring import visibility
from tests import processes
from tests.core.test_plugins import install, site  # noqa: F401  the fixture

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
def test_it_is_run_like_any_other(mini, package, tmp_path):
    plain, halved, dropped = (tmp_path / name for name in ("plain", "halved", "dropped"))
    assert run_egvs(None, "run", mini, "--out", plain).returncode == 0
    done = run_egvs(package, "run", mini, "--out", halved, "--set", "effects.half.share=0.25")
    assert done.returncode == 0, done.stderr
    assert run_egvs(None, "run", mini, "--out", dropped, "--set", "effects.dropout.share=0.25").returncode == 0
    egvs_of = {f: egvs.read_scores(f / "scores.parquet")["egvs"].to_pylist() for f in (plain, halved, dropped)}
    assert egvs_of[halved] == egvs_of[dropped] != egvs_of[plain]
    named = json.loads((halved / "run.json").read_text())["scenario"]["effects"]
    assert named == {"half": {"share": 0.25}}
    assert "unchanged" in run_egvs(package, "run", mini, "--out", halved, "--set", "effects.half.share=0.25").stderr
    assert run_egvs(package, "verify", halved).returncode == 0


@pytest.mark.slow
@pytest.mark.system
def test_a_changed_line_of_it_makes_the_score_stage_run_again(mini, package, tmp_path):
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
def test_its_parameters_are_checked_like_any_other_s(mini, package, tmp_path, setting, message):
    done = run_egvs(package, "run", mini, "--out", tmp_path / "run", "--set", setting)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr


@pytest.mark.system
def test_it_is_in_the_list_and_without_the_package_it_is_unknown(mini, package, tmp_path):
    assert "half" in run_egvs(package, "effects").stdout.split()
    done = run_egvs(None, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert done.returncode == 2 and "effects.half: unknown effect" in done.stderr


@pytest.mark.system
def test_one_that_cannot_be_imported_is_named_with_its_package(mini, package, tmp_path):
    (package / "half_returns.py").write_text("import no_such_library\n")
    done = run_egvs(package, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert done.returncode == 1 and "half_returns:Half" in done.stderr and "Traceback" not in done.stderr


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
def test_what_is_no_effect_of_that_name_is_refused(site: Path, source: str, problem: str) -> None:  # noqa: F811
    install(site, "somebody-elses", "zz = plug_z:Half", {"plug_z": source}, "egvs.effects")
    place = r"\(entry point 'plug_z:Half' of the package somebody-elses\)"
    with pytest.raises(MissingBackendError, match=f"^'zz' of egvs.effects cannot be loaded: {problem}.*{place}"):
        registry.find_effect_class("zz")


@pytest.mark.system
def test_two_effects_that_say_they_are_one_are_refused(mini, tmp_path):
    """Their parameters would overwrite each other in the key of the stage: a changed one would change nothing."""
    for name in ("aa", "bb"):
        install(tmp_path / "site", f"p{name}", f"{name} = plug_{name}:Half", {f"plug_{name}": EFFECT}, "egvs.effects")
    both = ("--set", "effects.aa.share=0.1", "--set", "effects.bb.share=0.2")
    done = run_egvs(tmp_path / "site", "run", mini, "--out", tmp_path / "run", *both)
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert "expected NAME = 'aa'" in done.stderr and "of the package paa" in done.stderr


BROKEN = {
    "lacks": "import no_such_library",
    "raises": "raise RuntimeError",
    "exits": "raise SystemExit(0)",
    "other_kind": "Half = dict",
    "other_name": EFFECT + '    NAME = "other"',
}


@pytest.mark.slow
@pytest.mark.system
def test_broken_ones_that_nobody_named_are_listed_as_broken(mini, tmp_path):
    for name, source in BROKEN.items():
        install(tmp_path / "site", f"p_{name}", f"{name} = plug_{name}:Half", {f"plug_{name}": source}, "egvs.effects")
    for arguments in ((), (mini,)):
        done = run_egvs(tmp_path / "site", "effects", *arguments)
        assert done.returncode == 0, done.stderr
        words = done.stdout.split()
        assert words.count("broken") == len(BROKEN) and {*BROKEN, "range_limit"} <= set(words)
    for name in ("raises", "exits", "other_name"):
        named = run_egvs(tmp_path / "site", "effects", mini, "--set", f"effects.{name}.share=0.25")
        assert named.returncode == 1 and f"p_{name}" in named.stderr and "Traceback" not in named.stderr


@pytest.mark.system
def test_the_list_says_which_package_brings_an_effect(mini, package):
    for arguments in ((), (mini,)):
        words = " ".join(run_egvs(package, "effects", *arguments).stdout.split())
        assert "half-returns" in words and "package egvs" not in words


class Given(Detect[EffectParameters]):
    NAME, SOURCE, Model = "given", "", EffectParameters


@pytest.mark.parametrize(
    ("given", "found"),
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
def test_what_is_no_share_is_refused(given: object, found: str) -> None:
    with pytest.raises(RunError, match=rf"^effects\.given: expected one share from 0 to 1 .*, got {found}$"):
        visibility._checked_shares(Given(EffectParameters()), given, 2, "crossings")


def test_shares_of_no_crossing_and_of_bits_are_shares() -> None:
    effect = Given(EffectParameters())
    assert visibility._checked_shares(effect, np.ones(0), 0, "ranges").size == 0
    assert visibility._checked_shares(effect, np.array([True, False]), 2, "ranges").tolist() == [True, False]


@pytest.mark.slow
@pytest.mark.system
@pytest.mark.parametrize("value", ["np.nan", "2.0"])
def test_a_run_with_an_effect_that_gives_no_shares_ends_with_its_name(mini, package, tmp_path, value):
    (package / "half_returns.py").write_text(EFFECT.replace("1.0 - self.parameters.share", value))
    done = run_egvs(package, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert done.returncode == 1 and "Traceback" not in done.stderr
    assert (
        "effects.half: expected one share from 0 to 1" in done.stderr
        and not (tmp_path / "run" / "scores.parquet").exists()
    )
