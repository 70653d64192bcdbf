"""How often boxes of larger vehicles and people match by chance, beside cars, in simulated traffic.

*Noticed* (:mod:`egvs.scoring.noticed`) rests on boxes of one list that the other list has within 3 m. Of the cars, .13
match the list of 60 s later, by chance. For others this was not measured, and the labels are not at hand. What matters
is where they are beside the others, which simulated traffic shows: a larger vehicle matches any vehicle, as a car does,
and people match people and bicycles.

``python -m benchmarks.chance_matches`` simulates :data:`SCENARIOS` and prints, for each, the share of the boxes in the
region that the frame of 60 s later has: for all road users, and with the later frame thinned at random, of vehicles so
that .13 of the cars match, and of people to :data:`PEOPLE_PER_SWEEP`, as in the labels. Standard errors are from
leaving out 20 s at a time. The table is kept in ``docs/data/chance_matches.csv``.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

import egvs
from egvs.artefacts.run_folder import RunFolder
from egvs.artefacts.traffic_frames import TrafficFrame, read_frames
from egvs.core.grid import Roi
from egvs.extensions.validation.measured.label_agreement import CHANCE_SHIFT_S
from egvs.extensions.validation.measured.list_pairs import match_boxes
from egvs.extensions.validation.measured.list_poses import NEAR_M
from egvs.extensions.validation.measured.ratios import Ratio, ratio_of_sums
from egvs.runs.run_context import open_folder
from egvs.stages import traffic

SCENARIOS = Path(__file__).parents[1] / "scenarios"
NAMES = ("hill", "roundabout")
PEOPLE = ("pedestrian", "bicycle")
LARGE = ("delivery", "truck", "trailer", "bus", "coach")
GROUPS = ("cars", "larger vehicles", "people")
MEASURED = 0.13
"""Share of the cars that matched by chance in the labels."""

PEOPLE_PER_SWEEP = 1.0
"""2,156 boxes in 2,110 pairs of sweeps."""

BLOCK_S = 20.0


def group_of(kind: str) -> str:
    """Return the group of a vClass."""
    return "people" if kind in PEOPLE else "larger vehicles" if kind in LARGE else "cars"


def in_region(frame: TrafficFrame, roi: Roi) -> TrafficFrame:
    """Return the boxes of a frame whose centre is in the region of interest."""
    rows = frame.target_rows(roi, PEOPLE).tolist()
    vehicles, kinds = ([names[row] for row in rows] for names in (frame.vehicles, frame.kinds))
    return TrafficFrame(frame.number, tuple(vehicles), tuple(kinds), frame.boxes[rows], frame.pitch_rad[rows])


def chance_shares(frames: Sequence[TrafficFrame], shift: int, block: int, kept: Sequence[float]) -> dict[str, Ratio]:
    """Return the share of the boxes of each group that a later frame has, too.

    Parameters
    ----------
    frames
        Consecutive frames.
    shift
        Number of frames between the two; the last frames are compared with earlier ones.
    block
        Frames that are left out together, for the standard errors.
    kept
        Shares of the boxes of vehicles and of people that the later frame keeps, at random.
    """
    found: dict[str, list[tuple[float, int]]] = {group: [] for group in GROUPS}
    rng = np.random.default_rng(1)
    for number, frame in enumerate(frames):
        later = frames[number + shift if number + shift < len(frames) else number - shift]
        is_person = np.isin(later.kinds, PEOPLE)
        chosen = rng.random(len(is_person)) < np.where(is_person, kept[1], kept[0])
        classes = [["pedestrian" if kind in PEOPLE else "car" for kind in each.kinds] for each in (frame, later)]
        matched = match_boxes(frame.boxes, classes[0], later.boxes, classes[1], NEAR_M, chosen)
        for kind, is_matched in zip(frame.kinds, matched.tolist(), strict=True):
            found[group_of(kind)].append((float(is_matched), number // block))
    shares = {}
    for group, rows in found.items():
        values, blocks = np.array(rows).reshape(-1, 2).T
        shares[group] = ratio_of_sums(values, np.ones(len(values)), blocks.astype(np.int64))
    return shares


def thinning(frames: Sequence[TrafficFrame], shift: int, block: int) -> tuple[float, float]:
    """Return the shares of vehicles and people to keep, so that cars match as often, and people are as many, as there.

    The share of vehicles is found by bisection; more of them match more.
    """
    people = float(np.mean([sum(kind in PEOPLE for kind in frame.kinds) for frame in frames]))
    low, high = 0.0, 1.0
    for _ in range(10):
        middle = (low + high) / 2
        matches_more = chance_shares(frames, shift, block, (middle, 1.0))["cars"].value > MEASURED
        low, high = (low, middle) if matches_more else (middle, high)
    return (low + high) / 2, min(1.0, PEOPLE_PER_SWEEP / people) if people else 1.0


def main() -> None:
    """Simulate the scenarios and print the table."""
    print("simulated traffic,frame 60 s later,cars,larger vehicles,people and bicycles")
    for name in NAMES:
        scenario = egvs.load(SCENARIOS / name)
        with tempfile.TemporaryDirectory() as temporary:
            context = open_folder(scenario, Path(temporary))
            traffic.STAGE.run(context, traffic.STAGE.dependencies(context))
            every = round(1 / scenario.traffic.frame_period_s)  # one frame a second
            numbers = np.arange(0, scenario.traffic.frames or 0, every)
            trajectories = RunFolder(Path(temporary)).trajectories
            frames = [in_region(frame, scenario.roi.box) for frame in read_frames(trajectories, numbers)]
        shift, block = round(CHANCE_SHIFT_S), round(BLOCK_S)
        for label, kept in (("all boxes", (1.0, 1.0)), ("thinned to the labels", thinning(frames, shift, block))):
            shares = chance_shares(frames, shift, block, kept)
            cells = [
                f"{ratio.value:.2f} ± {ratio.se:.2f}" if np.isfinite(ratio.value) else "" for ratio in shares.values()
            ]
            print(",".join([name, label, *cells]), flush=True)


if __name__ == "__main__":
    main()
