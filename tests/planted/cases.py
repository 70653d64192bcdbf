"""All cases."""

from __future__ import annotations

from tests.planted.duplicates import DUPLICATES
from tests.planted.heights import HEIGHTS
from tests.planted.reference_points import REFERENCE_POINTS
from tests.planted.reference_systems import REFERENCE_SYSTEMS
from tests.planted.scan_readings import SCANS
from tests.planted.simulated import SIMULATED
from tests.planted.times_and_sizes import TIMES_AND_SIZES
from tests.planted.units import UNITS

CASES = (
    *HEIGHTS, *UNITS, *REFERENCE_SYSTEMS, *REFERENCE_POINTS, *SCANS, *DUPLICATES, *TIMES_AND_SIZES, *SIMULATED,
)  # fmt: skip
