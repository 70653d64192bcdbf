"""Poses of OpenLABEL's coordinate systems: from the one that a cuboid is in to the outermost that poses lead to."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from egvs.core.grid import FloatArray
from egvs.extensions.tracks.boxes import Pose, is_rotation, to_rotations
from egvs.extensions.tracks.formats.documents import Node
from egvs.extensions.tracks.model import TrackFrame

_UTM_NAME = re.compile(r"utm[-_ ]?(\d{1,2})([c-hj-np-rt-x])", re.IGNORECASE)
"""ASAM's example is utm-30t. The letter is a band, north from N on; S is left out, as it may mean "south"."""

_MAX_PARENTS = 20


@dataclass(frozen=True)
class SystemPose:
    """How positions of a coordinate system become those of an outer one.

    Attributes
    ----------
    name
        Name of the outer system; empty if unknown.
    pose
        From the inner to the outer system.
    frame
        The outer system as tracks state it.
    """

    name: str
    pose: Pose
    frame: TrackFrame


def pose_in_station(root: Node, sensor: str) -> SystemPose:
    """Return the pose of a sensor in the base of its TUMTraf station; that of the sensor itself if the file has none.

    The sensor is above the base: a pose in which it is below is the inverse.
    """
    system = _find_system(root, sensor)
    pose = None if system is None else system.find("pose_wrt_parent")
    if system is None or pose is None:
        return SystemPose(sensor, Pose(), TrackFrame())
    matrix = _matrix(pose)
    rotation, translation = matrix[:3, :3], matrix[:3, 3]
    if translation[2] < 0:
        rotation, translation = rotation.T, -rotation.T @ translation
    return SystemPose(system.get("parent").text(), Pose.from_arrays(rotation, translation), TrackFrame())


def pose_in_world(root: Node, properties: Node | None, system: str) -> SystemPose:
    """Return the pose of a system of ASAM OpenLABEL in its outermost ancestor to which poses lead.

    Parameters
    ----------
    root
        The member ``openlabel`` of the document.
    properties
        The frame's ``frame_properties``; their ``transforms`` have priority over ``pose_wrt_parent``.
    system
        Name of the system.
    """
    transforms = None if properties is None else properties.find("transforms")
    by_source = {}
    for _, member in transforms.members() if transforms is not None else ():
        by_source[member.get("src").text()] = member
    matrix = np.eye(4)
    for _ in range(_MAX_PARENTS):
        transform, declared = by_source.get(system), _find_system(root, system)
        if transform is not None:
            matrix = _matrix(transform.get("transform_src_to_dst")) @ matrix
            system = transform.get("dst").text()
        elif declared is not None and declared.find("pose_wrt_parent") is not None:
            matrix = _matrix(declared.get("pose_wrt_parent")) @ matrix
            system = declared.get("parent").text()
        else:
            pose = Pose.from_arrays(matrix[:3, :3], matrix[:3, 3])
            return SystemPose(system, pose, _utm_frame(declared, system))
    raise root.error(f"the coordinate system {system[:80]!r} is its own ancestor", "Correct the coordinate systems.")


def _find_system(root: Node, name: str) -> Node | None:
    systems = root.find("coordinate_systems")
    return None if systems is None else systems.find(name)


def _utm_frame(declared: Node | None, name: str) -> TrackFrame:
    """Return the UTM zone that a system names; that of the map for others."""
    kind = None if declared is None else declared.find("type")
    match = _UTM_NAME.fullmatch(name)
    if kind is None or kind.value != "geo_utm" or match is None or not 1 <= int(match[1]) <= 60:
        return TrackFrame()
    return TrackFrame(f"EPSG:{(32600 if match[2].lower() >= 'n' else 32700) + int(match[1])}")


def _matrix(pose: Node) -> FloatArray:
    """Return a pose, a matrix of 16 numbers by rows or a quaternion and a translation, as a matrix (4, 4)."""
    matrix = np.eye(4)
    flat = pose.find("matrix4x4")
    if flat is not None:
        matrix[:] = np.reshape(flat.numbers(16), (4, 4))
        if matrix[3].tolist() != [0.0, 0.0, 0.0, 1.0]:
            raise flat.error(f"expected 0, 0, 0, 1 as the last row, got {matrix[3].tolist()}")
    else:
        matrix[:3, :3] = to_rotations(np.array(pose.get("quaternion").numbers(4)))
        matrix[:3, 3] = pose.get("translation").numbers(3)
    if not is_rotation(matrix[:3, :3]) or np.abs(matrix[:3, 3]).max() > 1e8:
        raise pose.error("expected a rotation and a translation in metres")
    return matrix
