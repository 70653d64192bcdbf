"""Notes from a visit of the sites: lines SITE: TEXT of visits.txt in the run folder; "impossible" is a warning."""

from collections.abc import Iterator, Mapping
from pathlib import Path

from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.run_record import StageRecord
from egvs.report.extension_sections import SectionWarning
from egvs.scenario.model import Scenario


class Visits:
    name = "visits"
    files = ("visits.txt",)
    template = Path(__file__).with_name("visits.html.j2")

    def read(self, folder: RunFolder, scenario: Scenario, stages: Mapping[str, StageRecord]) -> list[list[str]] | None:
        path = folder / "visits.txt"
        if not path.is_file():
            return None
        return [line.split(": ", 1) for line in path.read_text(encoding="utf-8").splitlines() if ": " in line]

    def warnings(self, values: list[list[str]]) -> Iterator[SectionWarning]:
        for site, text in values:
            if "impossible" in text:
                reason = f"no sensor can stand at {site}"
                yield SectionWarning(
                    f"The visit contradicts the ranking: {reason}.", "a visit found a problem", reason, "visit"
                )


SECTION = Visits()
