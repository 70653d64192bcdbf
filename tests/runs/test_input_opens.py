"""A cold run opens each input file at most twice: what a scenario names is resolved once and passed on.

A network is opened twice more, before all else, to recognise a map.
"""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.conftest import write_mini
from tests.processes import python

ROUNDABOUT = Path(__file__).parents[2] / "scenarios" / "roundabout"
SHORT = ['traffic.hold="at_most"', "traffic.frames=40", "traffic.warmup_s=5", "tpog.blocks=4", "roi.voxel_m=1"]

COUNT_OPENS = """
import collections, json, os, sys
import egvs

folder, out, *settings = sys.argv[1:]
opens = collections.Counter()

def count(event, arguments):
    if event == "open" and isinstance(arguments[0], str | os.PathLike):
        path = os.path.realpath(arguments[0])
        if os.path.dirname(path) == folder:
            opens[os.path.basename(path)] += 1

scenario = egvs.load(folder, settings)
sys.addaudithook(count)
egvs.run(scenario, out, jobs=1)
print(json.dumps(opens))
"""


def count_opens(folder: Path, out: Path, *settings: str) -> dict[str, int]:
    """File name -> how often a run opened it."""
    done = python(COUNT_OPENS, folder, out, *settings)
    assert done.returncode == 0, done.stderr
    opens: dict[str, int] = json.loads(done.stdout.splitlines()[-1])
    return opens


@pytest.mark.slow
def test_run_with_network_opens_each_input_a_few_times(tmp_path: Path) -> None:
    opens = count_opens(ROUNDABOUT, tmp_path / "run", *SHORT)
    assert opens.keys() >= {"network.net.xml", "sites.csv", "statics.geojson"}
    assert opens.pop("network.net.xml") <= 4
    assert max(opens.values()) <= 2, opens


@pytest.mark.slow
def test_run_of_finished_file_opens_sites_and_statics_at_most_twice(tmp_path: Path) -> None:
    opens = count_opens(write_mini(tmp_path / "mini"), tmp_path / "run")
    assert opens.keys() >= {"sites.csv", "statics.geojson"}
    assert max(opens["sites.csv"], opens["statics.geojson"]) <= 2, opens
