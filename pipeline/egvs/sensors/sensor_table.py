"""Write a sensor as the table ``[sensors.NAME]`` of a scenario."""

from __future__ import annotations

import re
from typing import Any

from egvs.sensors.sensor import Sensor

_LINE = 110


def format_sensor_table(name: str, table: dict[str, Any]) -> str:
    """Return the lines of ``[sensors.NAME]`` with these keys."""
    key = name if re.fullmatch(r"[A-Za-z0-9_-]+", name) else f'"{name}"'
    lines = [f"[sensors.{key}]"]
    for entry, value in table.items():
        if not isinstance(value, list) or len(value) <= 2:
            lines.append(f"{entry} = {value!r}")
            continue
        lines.append(f"{entry} = [")
        line = "   "
        for number in value:
            if len(line) > _LINE:
                lines.append(line)
                line = "   "
            line += f" {number!r},"
        lines += [line, "]"]
    return "\n".join(lines) + "\n"


def sensor_keys(sensor: Sensor) -> dict[str, Any]:
    """Return the keys of ``[sensors.NAME]`` of a sensor; without those of its beams if they are a table or pattern."""
    keys: dict[str, Any] = {}
    if sensor.table is None:
        keys["elevations_deg"] = list(sensor.elevations_deg)
        if any(sensor.azimuth_offsets_deg):
            keys["azimuth_offsets_deg"] = list(sensor.azimuth_offsets_deg)
        keys["azimuth_step_deg"] = sensor.azimuth_step_deg
        if sensor.azimuth_deg is not None:
            keys["azimuth_deg"] = list(sensor.azimuth_deg)
    keys["range_m"] = sensor.range_m
    keys["wavelength_nm"] = sensor.wavelength_nm
    keys["divergence_mrad"] = list(sensor.divergence_mrad)
    if sensor.rated_range_m is not None:
        keys["rated_range_m"] = sensor.rated_range_m
        keys["rated_reflectivity"] = sensor.rated_reflectivity
    keys["softness"], keys["dropout"] = sensor.softness, sensor.dropout
    keys["range_sigma_m"] = sensor.range_sigma_m
    return keys
