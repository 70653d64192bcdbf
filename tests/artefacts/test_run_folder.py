"""Files of a run folder: those of the core, and those that extensions declare."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from egvs.artefacts import run_folder
from egvs.artefacts.origin import foreign_files
from egvs.artefacts.run_folder import RunFile, RunFolder
from egvs.core.errors import MissingBackendError
from tests.core.test_plugins import install
from tests.core.test_plugins import site as plugin_site  # noqa: F401 - a fixture

DECLARED = "from egvs.artefacts.run_folder import RunFile\nFILES = ({},)"


@pytest.fixture
def site(plugin_site: Path) -> Iterator[Path]:  # noqa: F811
    run_folder.extension_files.cache_clear()
    yield plugin_site
    run_folder.extension_files.cache_clear()


def declare(site: Path, *files: str) -> None:
    """Install an extension that declares some files."""
    install(
        site, "visits", "visits = plug_visits:FILES", {"plug_visits": DECLARED.format(", ".join(files))}, "egvs.files"
    )


def test_files_of_extensions_follow_those_of_the_core(site: Path) -> None:
    declare(site, "RunFile('visits.txt', 'visit')", "RunFile('visits.sha256', 'visit')")
    files = RunFolder.all_files()
    assert files[: len(RunFolder.core_files())] == RunFolder.core_files()
    assert RunFile("visits.txt", "visit") in files
    assert "visits.sha256" in [file.name for file in RunFolder.checksum_files()]
    assert "visits.txt" not in [file.name for file in RunFolder.checksum_files()]


def test_no_run_overwrites_a_file_of_the_user_that_an_extension_would_write(site: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    (out / "visits.txt").write_text("mine")
    assert list(foreign_files(out)) == []
    declare(site, "RunFile('visits.txt', 'visit')")
    run_folder.plugins._all_entry_points.cache_clear()
    run_folder.plugins._entry_points_by_name.cache_clear()
    run_folder.extension_files.cache_clear()
    assert list(foreign_files(out)) == ["visits.txt"]


@pytest.mark.parametrize("files", ["7", "RunFile('scores.parquet', 'visit')", "RunFile('a', 'b'), RunFile('a', 'c')"])
def test_rejects_what_is_no_file_and_names_that_are_taken(site: Path, files: str) -> None:
    declare(site, files)
    with pytest.raises(MissingBackendError, match=r"'visits' of egvs\.files .*(RunFile, got|of another part)"):
        RunFolder.all_files()
