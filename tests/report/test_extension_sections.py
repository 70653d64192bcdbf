"""Sections of extensions: found by entry points, shown with their warnings, and part of what the report depends on."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import RunRecord
from egvs.core.errors import MissingBackendError
from egvs.report import extension_sections, page
from tests.core.test_plugins import clear_caches, install
from tests.report.small_runs import PageReader, render_report, run_to_scores
from tests.stage_runner import inputs_of

MODULE = """
from pathlib import Path
from egvs.report.extension_sections import SectionWarning

class Notes:
    name = "notes"
    files = ("notes.txt",)
    template = Path(__file__).with_name("notes.html.j2")

    def read(self, folder, scenario, stages):
        path = folder / "notes.txt"
        return [scenario.name, *path.read_text().split()] if path.is_file() else None

    def warnings(self, values):
        if "stop" in values:
            yield SectionWarning("Stop: it rains.", "a note says stop", "it rains", "note")

SECTION = Notes()
"""
TEMPLATE = """<section id="notes"><h2>Notes</h2>{% for word in section %}<p>{{ word }}</p>{% endfor %}</section>"""


def forget_sections() -> None:
    clear_caches()
    extension_sections.report_sections.cache_clear()
    page._template_environment.cache_clear()


@pytest.fixture
def site(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder on the path in which an extension is installed."""
    folder = tmp_path / "site"
    install(folder, "notes", "notes = plug_notes:SECTION", {"plug_notes": MODULE}, extension_sections.GROUP)
    (folder / "notes.html.j2").write_text(TEMPLATE)
    monkeypatch.syspath_prepend(str(folder))
    forget_sections()
    yield folder
    forget_sections()
    sys.modules.pop("plug_notes", None)


@pytest.mark.slow
def test_page_shows_the_section_and_its_warning(site: Path, tmp_path: Path) -> None:
    scenario, out = run_to_scores(tmp_path / "run")
    assert "notes" not in PageReader(render_report(scenario, out)).ids
    (out / "notes.txt").write_text("go <b>")
    text = render_report(scenario, out)
    assert "<p>trial</p><p>go</p><p>&lt;b&gt;</p></section>" in text and "a note says" not in text
    (out / "notes.txt").write_text("stop")
    text = render_report(scenario, out)
    assert ", but a note says stop</h1>" in text
    assert '<p>It rains: see the <a href="#notes">note</a>.</p>' in text


def test_files_template_and_module_are_inputs_of_the_report(site: Path, tmp_path: Path) -> None:
    scenario, out = run_to_scores(tmp_path / "run")
    (out / "notes.txt").write_text("go")
    before = inputs_of(page, scenario, out)
    (out / "notes.txt").write_text("stop")
    assert (changed := inputs_of(page, scenario, out)) != before
    (site / "notes.html.j2").write_text(TEMPLATE + "<p>more</p>")
    assert inputs_of(page, scenario, out) != changed
    assert "plug_notes" in extension_sections.section_modules()


def test_scenario_and_stages_are_inputs_of_the_report_where_a_section_has_a_file(site: Path, tmp_path: Path) -> None:
    box = {"x_m": 2.0, "y_m": 2.0, "length_m": 1.0, "width_m": 1.0, "height_m": 1.0}
    scenario, out = run_to_scores(tmp_path / "run", what_if={"lorry": {"share": 0.25, "boxes": [box]}})
    other = scenario.model_copy(update={"what_if": {}})
    assert inputs_of(page, other, out) == inputs_of(page, scenario, out)
    (out / "notes.txt").write_text("go")
    before = inputs_of(page, scenario, out)
    assert inputs_of(page, other, out) != before
    record = RunRecord.read(out)
    record.having("tpog", replace(record.stages["tpog"], inputs="others")).write(out)
    assert inputs_of(page, scenario, out) != before


def test_rejects_object_that_is_no_section(site: Path, tmp_path: Path) -> None:
    scenario, out = run_to_scores(tmp_path / "run")
    (site / "plug_notes.py").write_text("SECTION = 7")
    forget_sections()
    sys.modules.pop("plug_notes", None)
    with pytest.raises(MissingBackendError, match="expected an object with name, files, template, read and warnings"):
        extension_sections.read_sections(RunFolder(out), scenario, {})
