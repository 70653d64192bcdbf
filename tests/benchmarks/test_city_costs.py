"""The table of city costs: a run by hand, and the growth between two runs."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks import city_costs
from benchmarks.city_costs import RunCosts


def write_costs(path: Path, junctions: int, sumo_s: float) -> Path:
    """Write the costs of a run: per junction 6 s of two workers, a third of it for scores, and 2 MB."""
    work = {"check": 2.0, "statics": 0.0, "scan": 0.0, "traffic": 1.0, "tpog": 1.0, "score": 2.0, "report": 0.0}
    costs = {
        "parts": [
            {"part": "traffic", "seconds": 2 * sumo_s, "start_s": 0.0, "end_s": 2 * sumo_s, "within": ""},
            {"part": "SUMO", "seconds": sumo_s, "start_s": 0.0, "end_s": sumo_s, "within": "traffic"},
            {"part": "split", "seconds": sumo_s, "start_s": sumo_s, "end_s": 2 * sumo_s, "within": "traffic"},
        ],
        "stages": [{"stage": name, "seconds": 10 * s * junctions, "peak_mb": 1.0} for name, s in work.items()],
        "processes": [
            {"process": "egvs", "host": "a", "peak_mb": 300.0, "busy_s": 4.0},
            {"process": "SUMO, when the traffic was made", "host": "", "peak_mb": 60.0, "busy_s": sumo_s},
            {"process": "worker tcp://a", "host": "a", "peak_mb": 500.0, "busy_s": 4.0 * junctions},
            {"process": "worker tcp://b", "host": "b", "peak_mb": 700.0, "busy_s": 2.0 * junctions},
        ],
        "size": {"junctions": junctions, "run_bytes": 1_500_000 * junctions, "traffic_bytes": 500_000 * junctions},
    }
    path.write_text(json.dumps(costs), encoding="utf-8")
    return path


def test_processor_time_is_divided_in_proportion_to_the_stages(tmp_path: Path) -> None:
    """On a busy machine, stages take ten times as long; their processor time is the same."""
    costs = RunCosts.read(write_costs(tmp_path / "costs.json", 10, 40.0))
    assert costs.seconds == {
        "routing": 0.0, "SUMO": 40.0, "split and tables": 4.0, "checks and worlds": 20.0, "scans": 0.0,
        "occupancy": 20.0, "score": 20.0, "reports": 0.0,
    }  # fmt: skip
    assert costs.peak_mb == {"egvs": 300.0, "SUMO": 60.0, "worker": 700.0}


def test_prints_core_hours_gigabytes_and_dollars(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    files = [write_costs(tmp_path / "b.json", 20, 160.0), write_costs(tmp_path / "a.json", 10, 40.0)]
    monkeypatch.setattr("sys.argv", ["city_costs", "--dollars", "0.1", *map(str, files)])
    city_costs.main()
    rows = {line[:20].strip(): line[20:].split() for line in capsys.readouterr().out.splitlines()}
    assert rows["SUMO"] == ["8.00", "2.00", "2.22", "22.22"]
    assert rows["score"] == ["2.00", "1.00", "0.56", "5.56"]
    assert rows["all"][0] == "14.20"  # 8 of SUMO, 0.2 of this program, 6 of the workers
    assert rows["dollars, at 0.1 per"][-2:] == ["0.39", "3.94"]
    assert rows["runs"] == ["1.50", "1.00", "1.50", "15.00"]
    assert rows["peak MB of worker"] == ["700", "(10", "junctions),", "700", "(20", "junctions)"]
