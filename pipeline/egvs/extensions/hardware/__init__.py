"""Real sensors: fitted to their sweeps, designed, installed and accepted.

From a notebook, for a finished run; its report shows each result::

    from egvs.extensions import hardware

    hardware.design_sensor(scenario, hardware.DesignRequest("c05", ("VLP-16", "VLP-32C")), "runs/trial").chosen
    hardware.write_sheets("runs/trial", ["c03"])
    hardware.write_acceptance("runs/trial", hardware.accept("runs/trial", "c03", ["measured.pcd"]))
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from egvs.core.lazy import lazy_exports

if TYPE_CHECKING:
    from egvs.extensions.hardware.design import design_sensor
    from egvs.extensions.hardware.design_request import DesignRequest
    from egvs.extensions.hardware.fit.fit import fit_sensor
    from egvs.extensions.hardware.fit.output import write_fit
    from egvs.extensions.hardware.installation.acceptance import accept
    from egvs.extensions.hardware.installation.acceptance_page import write_acceptance
    from egvs.extensions.hardware.installation.sheet import write_sheets
    from egvs.formats.sweep_files import read_sweeps

__all__ = [
    "DesignRequest",
    "accept",
    "design_sensor",
    "fit_sensor",
    "read_sweeps",
    "write_acceptance",
    "write_fit",
    "write_sheets",
]

__getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "design": ["design_sensor"],
        "design_request": ["DesignRequest"],
        "fit.fit": ["fit_sensor"],
        "fit.output": ["write_fit"],
        "egvs.formats.sweep_files": ["read_sweeps"],
        "installation.acceptance": ["accept"],
        "installation.acceptance_page": ["write_acceptance"],
        "installation.sheet": ["write_sheets"],
    },
)
