"""Lane changes that the markings of a map forbid, as SUMO knows them.

A lane that no connection leads to, and that no marking lets vehicles change to, would never be used by those who come
from upstream, and those whose turn begins there would wait forever. Changes to such a lane are allowed and reported.
"""

from __future__ import annotations

NO_CHANGE = "emergency"
"""Who may change lanes across a solid line; SUMO has no word for nobody."""


def open_unreachable_lanes(changes: list[set[int]], entered: set[int]) -> list[int]:
    """Allow changes to the lanes that cannot be reached from those that are entered; return these lanes.

    Parameters
    ----------
    changes
        The neighbouring lanes that vehicles may change to, by lane of a road; changed in place.
    entered
        The lanes that a connection leads to.

    Examples
    --------
    >>> changes = [{1}, {0}, set()]
    >>> open_unreachable_lanes(changes, {0}), changes
    ([2], [{1}, {0, 2}, set()])
    """
    opened: list[int] = []
    while True:
        reached = set(entered)
        queue = list(entered)
        while queue:
            new = changes[queue.pop()] - reached
            reached |= new
            queue += new
        beside = [
            (lane, other)
            for lane in range(len(changes))
            if lane not in reached
            for other in (lane - 1, lane + 1)
            if other in reached
        ]
        if not beside:
            return sorted(opened)
        lane, other = beside[0]
        changes[other].add(lane)
        opened.append(lane)
