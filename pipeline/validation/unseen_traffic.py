"""Traffic that the TPOG never saw: the scenario's own demand under another seed, in frames that lie further apart.

The frames are the same for all sites. A finished file has no seed: its frames are those that the TPOG was counted from,
which is said wherever results are read.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from pipeline.core.errors import InputError
from pipeline.scenario.models import Scenario

APART_S = 2.0
"""Time between two frames, at least: half a second of the same queue is no second look."""

_STREAM = 0x7E57
"""Tells the seed of unseen traffic from every other seed that is drawn from the scenario's."""


def scenario_of(scenario: Scenario, frames: int, apart_s: float = APART_S) -> Scenario:
    """The scenario whose traffic is recorded for validation, in frames at least so far apart.

    Raises
    ------
    InputError
        For more frames than can be handled.
    """
    traffic = scenario.traffic
    if traffic.fcd is not None:
        return scenario
    seed = int(np.random.SeedSequence((scenario.seed, _STREAM)).generate_state(1, np.uint64)[0]) >> 33  # fits SUMO's
    stride = math.ceil(apart_s / traffic.frame_period_s - 1e-9)
    values = {key: getattr(traffic, key) for key in traffic.model_fields_set}
    if not traffic.periods:
        values |= {"frames": frames, "frame_period_s": stride * traffic.frame_period_s}
    try:
        unseen = type(traffic)(**values)
    except ValidationError as error:
        found = error.errors()[0]["msg"].removeprefix("Value error, ")
        raise InputError("--frames", f"{frames}, at least {apart_s:g} s apart: {found}", "fewer frames") from None
    return scenario.model_copy(update={"traffic": unseen, "seed": seed})


def numbers(scenario: Scenario, recorded: int, frames: int, apart_s: float = APART_S) -> NDArray[np.int64]:
    """Which frames of the record are used, (frames,), spread over all of it.

    Parameters
    ----------
    scenario
        From :func:`scenario_of`.
    recorded
        How many frames its record has.

    Raises
    ------
    InputError
        Where the record has fewer frames that far apart.
    """
    stride = max(1, math.ceil(apart_s / scenario.traffic.frame_period_s - 1e-9))
    most = (recorded - 1) // stride + 1
    if frames > most:
        length = f"{recorded} frames every {scenario.traffic.frame_period_s:g} s"
        raise InputError(
            "--frames", f"{frames}, of traffic with {length}", f"at most {most}: they lie at least {apart_s:g} s apart"
        )
    return (np.arange(frames, dtype=np.int64) * most // frames) * stride
