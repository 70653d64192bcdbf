"""The wheel, installed into a new environment, works in an empty folder without a checkout."""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path
from subprocess import CompletedProcess

import pyarrow.parquet as pq
import pytest

ROOT = Path(__file__).parents[2]
MAX_WHEEL_MB = 15
EXTRACT = ROOT / "tests" / "creation" / "data" / "small.osm"
FEW = ("--set", "traffic.frames=60", "--set", "traffic.warmup_s=20", "--set", "roi.voxel_m=0.5")

COMMANDS_WITH_EXTRAS = {
    ("explore", "runs/myplace"): "explore",
    ("place", "runs/myplace", "--count", "2", "--refine"): "place",
    ("export", "runs/myplace", "--to", "gpkg"): "gis",
    ("figure", "runs/myplace", "--what", "ranking"): "figure",
    ("accuracy", "myplace", *FEW): "figure",
    ("validate", "myplace", *FEW): "validate",
    ("city", "run", "town"): "cluster",
}
"""Commands, and the extra that each needs."""

pytestmark = [pytest.mark.slow, pytest.mark.system]


def build_wheel(folder: Path) -> Path:
    """Build a wheel from the checkout."""
    environment = os.environ | {"SOURCE_DATE_EPOCH": "1700000000"}
    command = [sys.executable, "-m", "build", "--wheel", "--no-isolation", "--outdir", folder, ROOT]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    (wheel,) = folder.glob("egvs-*.whl")
    return wheel


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


class Installed:
    """An environment with the wheel in it, and an empty folder to work in."""

    def __init__(self, wheel: Path, folder: Path) -> None:
        self.bin = folder / "environment" / "bin"
        self.work = folder / "work"
        self.work.mkdir()
        self.environment = {
            "PATH": f"{self.bin}:{os.environ['PATH']}",
            "HOME": "/dev/null",  # nothing can be written there, not even by root
            "LANG": "C.UTF-8",
            "TMPDIR": str(folder),
        }
        subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder / "environment"], check=True)
        self.install(str(wheel))

    def install(self, requirement: str) -> None:
        """Install a wheel, with the versions of the constraints file."""
        pip = [sys.executable, "-m", "pip", "--python", self.bin / "python", "install", "--quiet", "--no-compile"]
        options = ["--disable-pip-version-check", "--constraint", ROOT / "constraints.txt"]
        subprocess.run([*pip, *options, requirement], check=True)

    def egvs(self, *arguments: object, code: int = 0) -> CompletedProcess[str]:
        """Run a command, which must end with an exit code."""
        done = self.start(*arguments)
        out, error = done.communicate(timeout=600)
        assert done.returncode == code, f"{arguments}: {error}"
        return CompletedProcess([], code, out, error)

    def start(self, *arguments: object) -> subprocess.Popen[str]:
        """Start a command."""
        return subprocess.Popen(
            [self.bin / "egvs", *map(str, arguments)], cwd=self.work, env=self.environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, preexec_fn=_accept_interrupts,
        )  # fmt: skip


def _accept_interrupts() -> None:
    """A shell lets what it starts in the background ignore them."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Installed]:
    """The wheel without extras."""
    yield Installed(wheel, tmp_path_factory.mktemp("installed"))


def test_wheel_is_small_and_reproducible(wheel: Path, tmp_path: Path) -> None:
    assert wheel.stat().st_size < MAX_WHEEL_MB * 1_000_000
    assert build_wheel(tmp_path).read_bytes() == wheel.read_bytes()


def test_metadata_is_valid(wheel: Path) -> None:
    done = subprocess.run([sys.executable, "-m", "twine", "check", "--strict", wheel], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout


def test_demo_ranks_sites_and_equals_checkout(installed: Installed, tmp_path: Path, run_egvs) -> None:
    done = installed.egvs("demo")
    assert re.search(r"^\s*1\s+kerb_", done.stdout, re.MULTILINE), done.stdout
    results = installed.work / "egvs-demo" / "results"
    assert (results / "report.html").stat().st_size > 100_000

    code, _, error = run_egvs("demo", tmp_path / "demo")
    assert code == 0, error
    for name in ("scores.parquet", "tpog.parquet", "scans.parquet", "trajectories.parquet", "blindspots.parquet"):
        first, second = (pq.read_table(folder / name) for folder in (results, tmp_path / "demo" / "results"))
        assert first.equals(second) or repr(first.to_pylist()) == repr(second.to_pylist()), name  # NaN equals NaN


def test_commands_work_or_name_their_extra(installed: Installed, wheel: Path) -> None:
    shutil.copyfile(EXTRACT, installed.work / "extract.osm")
    runs = installed.work / "runs" / "myplace"
    assert "checked 13 sites" in installed.egvs("check", "nishishinjuku").stdout  # a shipped scenario, by name
    installed.egvs("new", "myplace", "--osm", "extract.osm")
    installed.egvs("run", "myplace", *FEW, "--out", "runs/myplace")
    installed.egvs("place", "runs/myplace", "--count", "2")
    assert "complete" in installed.egvs("runs").stdout
    shutil.copytree(runs, runs.with_name("copy"))
    installed.egvs("compare", "runs/myplace", "runs/copy")
    installed.egvs("export", "runs/myplace", "--to", "csv")
    installed.egvs("verify", "runs/myplace")
    assert (runs / "report.html").exists() and (runs / "placement.parquet").exists()

    installed.egvs("city", "new", "town", "--osm", "extract.osm")
    for command, extra in COMMANDS_WITH_EXTRAS.items():
        (message,) = installed.egvs(*command, code=2).stderr.splitlines()
        assert f"pip install 'egvs[{extra}]'" in message, message

    installed.install(f"{wheel}[explore,gis,place]")
    installed.egvs("place", "myplace", *FEW, "--count", "2", "--refine", "--set", "placement.refine.evaluations=20")
    installed.egvs("export", "runs/myplace", "--to", "gpkg")
    page = installed.start("explore", "runs/myplace", "--no-browser")
    try:
        address = page.stdout.readline().split()[0]
        opener = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())  # the link sets a cookie
        assert opener.open(address, timeout=60).status == 200
    finally:
        page.send_signal(signal.SIGINT)
        page.communicate(timeout=60)
