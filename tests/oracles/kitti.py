"""KITTI's average precision, written step by step and slowly from its published semantics, threshold by threshold.

Nothing is shared with the package: overlap is shapely's, the rule of the thresholds is in rationals, each threshold
matches every frame anew, and leaving frames out means to give fewer frames."""

from dataclasses import dataclass
from fractions import Fraction

import numpy as np
import shapely
from shapely import affinity

SAMPLES = 41


@dataclass
class Scene:
    """One frame: objects (box, ignored) and detections (box, score)."""

    objects: list
    detections: list


def overlap(a, b, view):
    first, second = (
        affinity.translate(
            affinity.rotate(shapely.box(-c[3] / 2, -c[4] / 2, c[3] / 2, c[4] / 2), c[6], (0, 0), use_radians=True),
            c[0],
            c[1],
        )
        for c in (a, b)
    )
    shared, plan = first.intersection(second).area, (a[3] * a[4], b[3] * b[4])
    if view == "bev":
        return shared / (sum(plan) - shared)
    shared *= max(0.0, min(a[2] + a[5] / 2, b[2] + b[5] / 2) - max(a[2] - a[5] / 2, b[2] - b[5] / 2))
    return shared / (plan[0] * a[5] + plan[1] * b[5] - shared)


def statistics(scene, overlaps, least, threshold=None):
    """True positives, false positives and the scores of true positives, of one frame.

    Without a threshold an object takes the highest score, with one the largest overlap."""
    assigned = [False] * len(scene.detections)
    scores, true = [], 0
    for i, (_, ignored) in enumerate(scene.objects):
        chosen, best = None, None
        for j, (_, score) in enumerate(scene.detections):
            if assigned[j] or (threshold is not None and score < threshold) or overlaps[i][j] <= least:
                continue
            rank = score if threshold is None else overlaps[i][j]
            if chosen is None or rank > best:
                chosen, best = j, rank
        if chosen is None:
            continue
        assigned[chosen] = True
        if not ignored:
            true += 1
            scores.append(scene.detections[chosen][1])
    false = sum(
        not taken and (threshold is None or score >= threshold)
        for taken, (_, score) in zip(assigned, scene.detections, strict=True)
    )
    return true, false, scores


def thresholds(scores, objects):
    """Scores that come nearest to the recalls 0, 1/40 .. 1."""
    scores, chosen, recall = sorted(scores, reverse=True), [], Fraction(0)
    for i, score in enumerate(scores):
        left = Fraction(i + 1, objects)
        right = Fraction(i + 2, objects) if i < len(scores) - 1 else left
        if right - recall < recall - left and i < len(scores) - 1:
            continue
        chosen.append(score)
        recall += Fraction(1, SAMPLES - 1)
    return chosen


def average_precision(scenes, view, least):
    """AP R11, AP R40, and recall at the lowest threshold."""
    overlaps = [[[overlap(o, d, view) for d, _ in s.detections] for o, _ in s.objects] for s in scenes]
    every = list(zip(scenes, overlaps, strict=True))
    objects = sum(not ignored for s in scenes for _, ignored in s.objects)
    scores = [score for s, its in every for score in statistics(s, its, least)[2]]
    precision, recall = [0.0] * SAMPLES, 0.0
    for k, threshold in enumerate(thresholds(scores, objects)):
        counted = [statistics(s, its, least, threshold) for s, its in every]
        true, false = sum(c[0] for c in counted), sum(c[1] for c in counted)
        precision[k], recall = true / (true + false), true / objects
    for k in range(SAMPLES):
        precision[k] = max(precision[k:])
    r11 = sum(precision[k] for k in range(0, SAMPLES, 4)) / 11
    return np.array([r11, sum(precision[1:]) / 40, recall])
