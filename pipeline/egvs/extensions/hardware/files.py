"""Files with the results of commands for designed and installed sensors, in a run folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.artefacts.run_folder import RunFile
from egvs.core.files import hash_json

if TYPE_CHECKING:
    from egvs.scenario.model import Scenario

SENSOR_DESIGN = RunFile("sensor_design.json", "sensor design")
SHEETS = RunFile("sheets.json", "sheets")
ACCEPTANCE = RunFile("acceptance.json", "accept")

PLANNED_KEY = "planned"
"""Key of the entry of a sheet: whether the site was part of the plan."""

FILES = (SENSOR_DESIGN, SHEETS, ACCEPTANCE)
"""All files; the entry point of the group ``egvs.files``."""


def design_digest(scenario: Scenario) -> str:
    """Return a hash of the settings of sensors, scores and effects, on which the design of a sensor depends."""
    sensors = {name: sensor.model_dump(mode="json") for name, sensor in scenario.sensors.items()}
    return hash_json([sensors, scenario.score.model_dump(mode="json"), scenario.effects.model_dump(mode="json")])
