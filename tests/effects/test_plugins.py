"""An effect of somebody else's package is found, checked, run and known by its source like this program's own."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import pipeline

EFFECT = '''
"""Every second return is lost (an example)."""

import numpy as np

from pipeline.effects.base import Detect
from pipeline.scenario.effects import EffectParameters


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


def egvs(package: Path | None, *arguments: object) -> subprocess.CompletedProcess[str]:
    path = {} if package is None else {"PYTHONPATH": str(package)}
    code = "from pipeline.cli.app import main; main()"
    words = [sys.executable, "-c", code, *(str(a) for a in arguments)]
    return subprocess.run(words, capture_output=True, text=True, env=os.environ | path)


@pytest.mark.system
def test_it_is_run_like_any_other(mini, package, tmp_path):
    plain, halved, dropped = (tmp_path / name for name in ("plain", "halved", "dropped"))
    assert egvs(None, "run", mini, "--out", plain).returncode == 0
    done = egvs(package, "run", mini, "--out", halved, "--set", "effects.half.share=0.25")
    assert done.returncode == 0, done.stderr
    assert egvs(None, "run", mini, "--out", dropped, "--set", "effects.dropout.share=0.25").returncode == 0
    egvs_of = {f: pipeline.read_scores(f / "scores.parquet")["egvs"].to_pylist() for f in (plain, halved, dropped)}
    assert egvs_of[halved] == egvs_of[dropped] != egvs_of[plain]
    named = json.loads((halved / "run.json").read_text())["scenario"]["effects"]
    assert named == {"half": {"share": 0.25}}
    assert "unchanged" in egvs(package, "run", mini, "--out", halved, "--set", "effects.half.share=0.25").stderr
    assert egvs(package, "verify", halved).returncode == 0


@pytest.mark.system
def test_a_changed_line_of_it_makes_the_score_stage_run_again(mini, package, tmp_path):
    call = ("run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert egvs(package, *call).returncode == 0
    (package / "half_returns.py").write_text(EFFECT.replace("1.0 - self.parameters.share", "0.5"))
    lines = {line.split()[0]: line for line in egvs(package, *call).stderr.splitlines() if line.strip()}
    assert "unchanged" not in lines["score"]
    assert all("unchanged" in lines[stage] for stage in ("traffic", "statics", "scan", "tpog"))


@pytest.mark.system
@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("effects.half.shares=0.25", "effects.half.shares: unknown key; did you mean share?"),
        ('effects.half.share="much"', "effects.half.share: 'much'; input should be a valid number"),
        ("effects.halve.share=0.25", "effects.halve: unknown effect; did you mean half?"),
    ],
)
def test_its_parameters_are_checked_like_any_other_s(mini, package, tmp_path, setting, message):
    done = egvs(package, "run", mini, "--out", tmp_path / "run", "--set", setting)
    assert (done.returncode, message in done.stderr) == (2, True), done.stderr


@pytest.mark.system
def test_it_is_in_the_list_and_without_the_package_it_is_unknown(mini, package, tmp_path):
    assert "half" in egvs(package, "effects").stdout.split()
    done = egvs(None, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert done.returncode == 2 and "effects.half: unknown effect" in done.stderr


@pytest.mark.system
def test_one_that_cannot_be_imported_is_named_with_its_package(mini, package, tmp_path):
    (package / "half_returns.py").write_text("import no_such_library\n")
    done = egvs(package, "run", mini, "--out", tmp_path / "run", "--set", "effects.half.share=0.25")
    assert done.returncode == 1 and "half_returns:Half" in done.stderr and "Traceback" not in done.stderr
