"""What all tests share: a small scenario that needs no simulation, the command line, and which tests are `unit` tests.

A test is `system` when it says so or its file is in :data:`SYSTEM`; all others may start no process, and are `unit`
unless they are `slow`."""

from __future__ import annotations

import gc
import json
import math
import sys
from collections.abc import Generator, Iterator
from pathlib import Path

import hypothesis
import pytest

from tests.installed import mark_complete
from tests.system_tests import SYSTEM

hypothesis.settings.register_profile("ci", derandomize=True, deadline=None)  # the same examples in every run
hypothesis.settings.load_profile("ci")  # --hypothesis-profile=default draws others

SCENARIO = """\
seed = 7

[roi]
center_m = [20, 0, 2.5]
size_m = [40, 20, 5]
voxel_m = 0.5

[traffic]
fcd = "fcd.csv"
frames = 40
frame_period_s = 0.5
warmup_s = 0

[[traffic.kinds]]
name = "car"
length_m = 4.5
width_m = 1.8
height_m = 1.5

[statics]
footprints = ["statics.geojson"]

[tpog]
blocks = 4

[sites]
file = "sites.csv"
sensor = "small"

[sensors.small]
elevations_deg = [-15, 5]
channels = 8
azimuth_step_deg = 1.0
range_m = 100

[score]
gamma = 4
"""

SITES = "site,x_m,y_m,z_m\npole_a,10,12,3\npole_b,30.5,-12,3\n"

LONGEST = (
    "tests/install/",
    "tests/docs/test_printed.py::test_program_prints",
    "tests/extensions/maps/test_round_trip_scores",
    "tests/studies/test_accuracy",
    "tests/test_architecture.py::test_each_public_name",
)
"""Files with tests that take half a minute or more."""

BUILDING = [[[14, 5], [18, 5], [18, 8], [14, 8], [14, 5]]]


def feature(geometry: dict, **properties: object) -> dict:
    """A GeoJSON feature."""
    return {"type": "Feature", "geometry": geometry, "properties": properties}


def collection(*features: dict, crs: str | None = None) -> str:
    """A GeoJSON FeatureCollection as text, in a named system, or in world-frame metres."""
    named = None if crs is None else {"type": "name", "properties": {"name": crs}}
    return json.dumps({"type": "FeatureCollection", "crs": named, "features": list(features)})


def fcd() -> str:
    """Two cars that pass each other along y = +-2, one of them turning a little; SUMO's CSV form."""
    lines = ["timestep_time;vehicle_id;vehicle_x;vehicle_y;vehicle_angle;vehicle_type;vehicle_speed"]
    for frame in range(40):
        t = 0.5 * frame
        lines.append(f"{t:.2f};east;{t * 2 + 1:.6f};-2.0;90.0;car;2.0")
        lines.append(f"{t:.2f};west;{39 - t * 1.7:.6f};{2 + 0.5 * math.sin(t):.6f};{270 - 5 * math.cos(t):.6f};car;1.7")
    return "\n".join(lines) + "\n"


@pytest.fixture(scope="session", autouse=True)
def store_of_the_session(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """What fixtures of several tests make is kept here, never in the working tree."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("EGVS_STORE", str(tmp_path_factory.mktemp("store")))
        yield


@pytest.fixture(autouse=True)
def store(tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A store of the test's own: what a test makes with parts of the program replaced must not reach another one."""
    folder = tmp_path_factory.mktemp("store")
    monkeypatch.setenv("EGVS_STORE", str(folder))
    return folder


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Leave out files without slow tests where ``-m`` asks for slow ones only: importing them takes half a minute."""
    marker = config.option.markexpr.split(" ")[0]
    if marker not in ("slow", "nightly") or collection_path.suffix != ".py":
        return None
    return None if f"mark.{marker}" in collection_path.read_text(encoding="utf-8") else True


@pytest.hookimpl(tryfirst=True)  # before -m chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark tests `system` or `unit`, and start the longest first, so that no worker waits for them at the end."""
    items.sort(key=lambda item: not item.nodeid.startswith(LONGEST))
    for item in items:
        mark_complete(item)
        if item.nodeid.startswith(SYSTEM):
            item.add_marker("system")
        if not any(item.iter_markers("system")) and not any(item.iter_markers("slow")):
            item.add_marker("unit")


def pytest_collection_finish() -> None:
    """Let garbage collection pass over what lives as long as the tests; it takes 0.5 s otherwise, in each full one."""
    gc.collect()
    gc.freeze()


_test_without_processes = ""  # that runs now


def _no_process(event: str, _: object) -> None:
    if _test_without_processes and event in ("subprocess.Popen", "os.system", "os.posix_spawn", "os.fork"):
        raise RuntimeError(f"{_test_without_processes} starts a process: mark it system")


sys.addaudithook(_no_process)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Generator[None, object, object]:
    """Remember a test that is not `system` while it and its fixtures are at work, so that they cannot start a process.

    Then no second process compiles kernels beside a run, as it would where none has been compiled yet.
    """
    global _test_without_processes
    if item.get_closest_marker("system"):
        return (yield)
    _test_without_processes = item.nodeid
    try:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("egvs.runs.kernel_compiler.thread_count", lambda _: 1)
            return (yield)
    finally:
        _test_without_processes = ""


@pytest.fixture
def mini(tmp_path: Path) -> Path:
    """A scenario folder: a finished FCD file, one building and a pole, two sites, a coarse sensor."""
    return write_mini(tmp_path / "mini")


def write_mini(folder: Path) -> Path:
    """Make the folder of :func:`mini`."""
    folder.mkdir()
    (folder / "scenario.toml").write_text(SCENARIO)
    (folder / "fcd.csv").write_text(fcd())
    (folder / "sites.csv").write_text(SITES)
    (folder / "statics.geojson").write_text(
        collection(
            feature({"type": "Polygon", "coordinates": BUILDING}, name="house", kind="building", height_m=6),
            feature({"type": "Point", "coordinates": [22, -5]}, name="lamp", kind="pole", height_m=5, radius_m=0.1),
        )
    )
    return folder


@pytest.fixture
def run_egvs(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    """Call the command line in this process: ``code, out, err = egvs("run", folder)``."""
    from egvs.cli import app

    def call(*arguments: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["egvs", *(str(a) for a in arguments)])
        capsys.readouterr()
        code = 0
        try:
            app.main()
        except SystemExit as end:
            code = int(end.code or 0)
        out, err = capsys.readouterr()
        return code, out, err

    return call
