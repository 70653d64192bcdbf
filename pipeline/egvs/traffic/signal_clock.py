"""The clock of a recorded signal program: which instant of the recording each second of a simulation shows.

The program of a network that replays a recording, state by state, says so in a ``<param>`` of its ``<tlLogic>``. People
who were recorded under these signals can walk beside simulated vehicles only if both run on this clock.
"""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree.ElementTree import Element

PARAM = "egvs.recorded_signals"
"""Key of the parameter of ``<tlLogic>``."""

TOLERANCE_S = 0.051
"""States are written in steps of 0.1 s, so they begin at most half a step early or late."""


@dataclass(frozen=True)
class SignalClock:
    """The clock of a program that replays recorded signals.

    Attributes
    ----------
    zero_s
        Time of the recording at second 0 of the simulation.
    from_s, to_s
        First and last recorded state, on the clock of the recording; before and after, a recorded cycle is repeated.
    cycle_s
        Length of that cycle.
    """

    zero_s: float
    from_s: float
    to_s: float
    cycle_s: float

    def to_param(self) -> str:
        """Return the parameter for ``<tlLogic>``, as XML."""
        numbers = (self.zero_s, self.from_s, self.to_s, self.cycle_s)
        return f'<param key="{PARAM}" value="{" ".join(f"{number:.3f}" for number in numbers)}"/>'

    @classmethod
    def from_program(cls, program: Element) -> SignalClock | None:
        """Return the clock of a ``<tlLogic>``; None for other programs.

        Raises
        ------
        ValueError
            When the parameter is not four numbers.
        """
        for param in program.iter("param"):
            if param.get("key") == PARAM:
                zero_s, from_s, to_s, cycle_s = (float(text) for text in param.attrib["value"].split())
                return cls(zero_s, from_s, to_s, cycle_s)
        return None

    def problem(self, begin_s: float, first_s: float, last_s: float) -> str:
        """Return why a simulation does not show the signals that people were recorded under; empty if it does.

        Parameters
        ----------
        begin_s
            Time of the first frame in the simulation.
        first_s, last_s
            Times of the first and the last frame in the recording of the people.
        """
        late_s = begin_s + self.zero_s - first_s
        if abs(late_s) > TOLERANCE_S:
            word = "later" if late_s > 0.0 else "earlier"
            return f"at the first frame, the recorded signals are {abs(late_s):g} s {word} than the people"
        outside_s = max(self.from_s - first_s, 0.0) + max(last_s - self.to_s, 0.0)
        if outside_s > TOLERANCE_S:
            return f"the signals were not recorded for {outside_s:.1f} of {last_s - first_s:.1f} s"
        return ""
