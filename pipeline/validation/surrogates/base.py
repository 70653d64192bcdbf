"""What a score is: a number for a site that claims to foretell how well a detector works there.

A score is an entry point of the group ``egvs.scores`` (``name = "module:OBJECT"``), a :class:`Score`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Value = float | int | bool | str
"""Of a parameter."""

EVIDENCE = ("counted", "log_reach", "returns", "vehicles")
"""What a score may name in ``needs``: the parts of :class:`SiteEvidence` that take time."""

VOXEL, OCCLUSION, GAMMA = "voxel_m", "moving_occlusion", "gamma"
"""Parameters that are settings of the scenario: of these, the scenario's own value is tried too."""


@dataclass(frozen=True)
class Score:
    """A score.

    Attributes
    ----------
    name
        As its entry point has it.
    formula
        What it is, in words.
    source
        Where it is published.
    sign
        1 where more is said to be better, -1 where less is.
    function
        The score of a site, from its evidence and the parameters of ``sweep``, by name; a plain float. Not a number
        where it is not defined. The same for the same evidence.
    needs
        What it asks of the evidence, of ``EVIDENCE``: worked out, and timed, before it is called.
    sweep
        Parameter -> values that are tried, all combinations. ``voxel_m`` and ``moving_occlusion`` say what the evidence
        is gathered with and are not handed to ``function``; where one is not named, it is as the scenario has it.
    """

    name: str
    formula: str
    source: str
    sign: int
    function: Callable[..., float]
    needs: tuple[str, ...] = ()
    sweep: Mapping[str, tuple[Value, ...]] = field(default_factory=dict)
