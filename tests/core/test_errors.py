"""What was found wrong or ambiguous, and how it travels."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from egvs.artefacts.run_record import StageRecord
from egvs.cli.console import ProgressDisplay
from egvs.core.errors import (
    DECIMAL_COMMA_HINT,
    WARNINGS_KEY,
    Diagnostic,
    DiagnosticsError,
    InputError,
    collect_warnings,
    truncate_text,
    unknown_site,
    with_relative_paths,
)
from egvs.core.resource_usage import ResourceUsage

ONE = Diagnostic("sites on lanes", "sites.csv: row 3 (k2)", "stands on lane e1_0", "Move it by 2 m.")


def test_collect_warnings_inverts_to_json() -> None:
    summary = json.loads(json.dumps({WARNINGS_KEY: [ONE.to_json()]}))
    assert collect_warnings([{}, summary]) == [ONE]


def test_diagnostics_error_lists_all_errors() -> None:
    error = DiagnosticsError([ONE, Diagnostic("roi", "roi", "no lane inside", "")])
    assert str(error) == "sites.csv: row 3 (k2): stands on lane e1_0. Move it by 2 m.\nroi: no lane inside"
    assert error.exit_code == 2


def test_error_without_hint_ends_with_its_problem() -> None:
    errors = [Diagnostic("roi", "roi", "no lane inside", ""), ONE]
    assert str(DiagnosticsError(errors)) == f"roi: no lane inside\n{ONE}"


def test_warning_is_printed_on_one_line(capsys) -> None:
    record = StageRecord(
        "", {}, {}, {"sites": 2, WARNINGS_KEY: [ONE.to_json()]}, ResourceUsage(seconds=1.0, peak_mb=1.0)
    )
    ProgressDisplay(with_details=True).stage_event("scan", "done", record)
    assert capsys.readouterr().err.splitlines()[1:] == [f"warning: {ONE}"]


def test_warning_names_files_relative_to_scenario(tmp_path) -> None:
    place = str(tmp_path / "maps" / "a.poly.xml")
    summary = {"solids": 1, WARNINGS_KEY: [replace(ONE, where=place).to_json(), ONE.to_json()]}
    assert [warning.where for warning in collect_warnings([with_relative_paths(tmp_path, summary)])] == [
        "maps/a.poly.xml",
        ONE.where,
    ]
    assert with_relative_paths(tmp_path, {"solids": 1}) == {"solids": 1}


def test_unknown_site_lists_the_sites_of_the_pole_that_is_meant_first() -> None:
    sites = [f"k{pole:02d}@{height}m" for pole in range(1, 13) for height in (3, 6)]
    assert str(unknown_site("--site", "k11", sites)) == (
        "--site: there is no site 'k11'. Choose one of k11@3m, k11@6m, k01@3m, k01@6m, k10@3m, k10@6m, k12@3m, k12@6m"
        " and 16 more (the most similar first)."
    )


def test_unknown_site_lists_all_of_a_few() -> None:
    assert str(unknown_site("--site", "pole_z", ["b", "pole_a"], "this run has")) == (
        "--site: this run has no site 'pole_z'. Choose one of pole_a, b."
    )


@pytest.mark.parametrize(
    ("problem", "is_comma"),
    [
        ("expected a number, got '4,5'", True),
        ("expected metres, at most 1e+08, got '-6,25'", True),
        ("cannot be read as CSV (CSV conversion error to double: invalid value ',5')", True),
        ("y: Failed to parse string: '1,57' as a scalar of type double", True),
        ("expected a number, got '4,5,6'", False),
        ("expected LAT,LON in degrees, got '50,9'", False),
        ("expected a number, got 'x'", False),
    ],
)
def test_decimal_comma_has_its_hint(problem: str, is_comma: bool) -> None:
    assert InputError("a.csv", problem, "Use numbers.").hint == (DECIMAL_COMMA_HINT if is_comma else "Use numbers.")


def test_decimal_comma_hides_no_further_errors() -> None:
    assert InputError("a.csv", "expected a number, got '4,5'", "\nb.csv: is empty").hint == "\nb.csv: is empty"


def test_long_text_says_how_much_it_lacks_however_often_it_is_shortened() -> None:
    short = truncate_text("\n".join(f"row {row}" for row in range(5_000)))
    assert short.splitlines()[-2:] == ["row 29", "... and 4,970 more"]
    assert truncate_text(short) == short
