"""The tables ``[traffic.signals.NAME]``: plans of traffic signals by approach and movement, or the file of one."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from egvs.scenario.fields import Positive, StrictModel

DEFAULT_MIN_GREEN_S = 5.0

ASSUMED_PLANS = "signal plans"
"""Entry of the key ``assumed`` of a scenario whose signal plans netconvert has made."""

Movements = tuple[Annotated[str, Field(min_length=1)], ...]

_PLAN_KEYS = ("all_red_s", "cycle_s", "phases", "type", "yellow_s")
"""Keys that a program in a SUMO file sets itself."""


class SignalPhaseConfig(StrictModel):
    """A phase of a signal plan: who has green, and for how long."""

    green: dict[str, Movements] = Field(
        description="Movements with green by approach, e.g. { north = ['straight', 'right'] }. An approach is the"
        " compass direction that it comes from, its street, both ('Main Street (north)') or an edge; a movement is"
        " left, straight, right, U-turn, crosswalk or all. {} is red for all vehicles; { north = [] } keeps an approach"
        " red that is in no phase",
    )
    green_s: Positive = Field(description="Green time; with actuated signals, that without any detection")
    yellow_s: float | None = Field(None, ge=0, description="Yellow after this phase, instead of that of the plan")
    all_red_s: float | None = Field(None, ge=0, description="All-red after this phase, instead of that of the plan")
    min_green_s: Positive | None = Field(
        None,
        description=f"Shortest green of an actuated phase. By default {DEFAULT_MIN_GREEN_S:g}, or green_s if shorter",
    )
    max_green_s: Positive | None = Field(None, description="Longest green of an actuated phase. By default green_s")

    @model_validator(mode="after")
    def _check_limits(self) -> SignalPhaseConfig:
        if self.shortest_green_s > self.longest_green_s:
            raise ValueError(
                f"expected min_green_s up to max_green_s, got {self.shortest_green_s:g} and {self.longest_green_s:g}"
            )
        return self

    @property
    def shortest_green_s(self) -> float:
        """Shortest green of an actuated phase."""
        return min(DEFAULT_MIN_GREEN_S, self.green_s) if self.min_green_s is None else self.min_green_s

    @property
    def longest_green_s(self) -> float:
        """Longest green of an actuated phase."""
        return self.green_s if self.max_green_s is None else self.max_green_s


class SignalConfig(StrictModel):
    """The plan of a signal. The name of its table is the id of the signal or junction, or its street names."""

    file: str | None = Field(
        None,
        min_length=1,
        description="Plan in a file, instead of phases: a table (phase, approach, movement, green_s), or a SUMO"
        " file with a <tlLogic>",
    )
    type: Literal["fixed", "actuated"] = Field(
        "fixed", description="'actuated' extends greens up to max_green_s while vehicles arrive"
    )
    cycle_s: Positive | None = Field(
        None, description="Cycle of a fixed plan; phases must add up to it. By default their sum"
    )
    offset_s: float = Field(0.0, description="Start of the first phase in the cycle, in simulation time")
    yellow_s: float = Field(
        3.0, ge=0, description="Yellow after each phase, for movements without green in the next phase"
    )
    all_red_s: float = Field(
        2.0, ge=0, description="All-red after each yellow, for movements without green in the next phase"
    )
    phases: tuple[SignalPhaseConfig, ...] = Field((), description="Phases in order; or set file")

    @property
    def is_sumo_file(self) -> bool:
        """Whether the plan is a program in a SUMO file."""
        return self.file is not None and self.file.endswith((".xml", ".xml.gz"))

    @model_validator(mode="after")
    def _check_source(self) -> SignalConfig:
        if (self.file is None) == (not self.phases):
            raise ValueError(f"expected either phases or file, got {'both' if self.phases else 'none'}")
        if self.is_sumo_file:
            unused = [key for key in _PLAN_KEYS if getattr(self, key) != type(self).model_fields[key].default]
            if unused:
                raise ValueError(f"{', '.join(unused)} has no effect with a <tlLogic> file. Change it there")
        if self.type == "actuated" and self.cycle_s is not None:
            raise ValueError("cycle_s has no effect with actuated signals. Remove it")
        if self.type == "fixed":
            for phase in self.phases:
                unused = [key for key in ("max_green_s", "min_green_s") if getattr(phase, key) is not None]
                if unused:
                    raise ValueError(f'{", ".join(unused)} has no effect with a fixed plan. Set type = "actuated"')
        return self
