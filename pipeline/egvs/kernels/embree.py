"""Embree's bounding volume hierarchy of triangles, queried eight rays at a time.

embreex ships Embree 4 (https://github.com/RenderKit/embree) and queries it one ray at a time. Neighbouring beams of a
sensor enter much the same boxes of the tree, and Embree handles eight of them together in half the time or less. So the
library that embreex has loaded is called directly through its C interface; names, numbers and layouts are those of its
headers, ``rtcore*.h``.
"""

from __future__ import annotations

import ctypes
import functools
import weakref
from typing import Any

import embreex.rtcore_scene
import llvmlite.binding
import numba
import numpy as np
from numba import types
from numpy.typing import NDArray

from egvs.kernels.jit import njit

_PACKET = 8  # on a processor without wide vectors, Embree queries them one after the other
_ALIGNMENT = 32  # bytes
_ORIGIN, _NEAR, _DIRECTION, _TIME, _FAR, _MASK, _ID, _FLAGS = 0, 3, 4, 7, 8, 9, 10, 11  # rows of a packet: rays,
_PRIM_ID, _GEOM_ID, _ROWS = 17, 18, 24  # then hits, with spare rows; eight values of 4 bytes in each
_NONE = 0xFFFFFFFF  # RTC_INVALID_GEOMETRY_ID
_TRIANGLE_TYPE, _INDEX_BUFFER, _VERTEX_BUFFER, _UINT3, _FLOAT3 = 0, 0, 1, 0x5003, 0x9003
_MAJOR_VERSION, _OUT_OF_MEMORY, _COHERENT, _ALL = 1, 4, 1 << 16, 0xFFFFFFFF
_ROBUST = 1 << 2  # else packets slip between distant triangles, or along their surface

_BLOCK, _BINS = 512, 512  # rays that are sorted together, and the number of bins
_STRIDE = 13  # not a divisor of any common number of channels
_SMALLEST, _LARGEST = 1e-17, 1e18
"""Components of directions outside this interval are set to 0.

Embree treats smaller ones as positive for the ray, but by their sign for the packet, and then loses hits of all rays.
"""

_pointer, _number, _size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_size_t
_SIGNATURES: dict[str, tuple[Any, ...]] = {  # result, then arguments
    "rtcNewDevice": (_pointer, ctypes.c_char_p),
    "rtcGetDeviceError": (_number, _pointer),
    "rtcGetDeviceProperty": (ctypes.c_ssize_t, _pointer, _number),
    "rtcNewScene": (_pointer, _pointer),
    "rtcSetSceneFlags": (None, _pointer, _number),
    "rtcNewGeometry": (_pointer, _pointer, _number),
    "rtcSetNewGeometryBuffer": (_pointer, _pointer, _number, _number, _number, _size, _size),
    "rtcCommitGeometry": (None, _pointer),
    "rtcAttachGeometry": (_number, _pointer, _pointer),
    "rtcReleaseGeometry": (None, _pointer),
    "rtcCommitScene": (None, _pointer),
    "rtcReleaseScene": (None, _pointer),
}

_library = ctypes.CDLL(embreex.rtcore_scene.__file__)  # finds the names of the libraries that it loads, too
for _name, (_result, *_arguments) in _SIGNATURES.items():
    getattr(_library, _name).restype = _result
    getattr(_library, _name).argtypes = _arguments

llvmlite.binding.add_symbol("rtcIntersect8", ctypes.cast(_library.rtcIntersect8, _pointer).value)
_library.rtcIntersect8.argtypes, _library.rtcIntersect8.restype = (_pointer,) * 4, None
_intersect = (
    _library.rtcIntersect8
    if numba.config.DISABLE_JIT  # type: ignore[attr-defined]
    else types.ExternalFunction("rtcIntersect8", types.void(types.intp, types.intp, types.intp, types.intp))
)
_kernel = njit()
_inlined = njit(forceinline=True)


class TriangleTree:
    """Triangles in float32. Threads may share one.

    Parameters
    ----------
    triangles
        Corners (m, 3, 3), m > 0.

    Raises
    ------
    MemoryError
        When there is not enough memory for the tree.
    """

    def __init__(self, triangles: NDArray[np.float64]) -> None:
        device, count = _device(), len(triangles)
        self._scene = _library.rtcNewScene(device)
        weakref.finalize(
            self, _library.rtcReleaseScene, self._scene
        ).atexit = False  # at exit, a thread may still be casting
        _library.rtcSetSceneFlags(self._scene, _ROBUST)
        shape = _library.rtcNewGeometry(device, _TRIANGLE_TYPE)
        _library.rtcAttachGeometry(self._scene, shape)
        _library.rtcReleaseGeometry(shape)  # the scene has a reference
        _set_buffer(shape, _VERTEX_BUFFER, _FLOAT3, triangles.astype(np.float32))
        _set_buffer(shape, _INDEX_BUFFER, _UINT3, np.arange(3 * count, dtype=np.uint32))
        _library.rtcCommitGeometry(shape)
        _library.rtcCommitScene(self._scene)
        if error := _last_error(f"Embree built no tree of {count:,} triangles"):
            raise error

    def nearest(self, o: NDArray[np.float64], beam: NDArray[np.uint32], d: NDArray[np.float64]) -> NDArray[np.int32]:
        """Return the triangle that each ray meets first, -1 for none, (n,) int32.

        Parameters
        ----------
        o
            Start of all rays, (3,).
        beam, d
            Index of each ray's direction, (n,), in unit vectors (beams, 3).
        """
        triangle = np.empty(len(beam), dtype=np.int32)
        valid, packet, arguments = _aligned_rows(1).view(np.int32), _aligned_rows(_ROWS), _Arguments(_COHERENT, _ALL)
        order, words = coherent_order(beam, d), packet.view(np.uint32)
        _query(self._scene, ctypes.addressof(arguments), o, beam, d, order, valid, packet, words, triangle)
        return triangle


class _Arguments(ctypes.Structure):
    """``RTCIntersectArguments``; omitted fields are zero."""

    _fields_ = (
        ("flags", ctypes.c_uint),
        ("feature_mask", ctypes.c_uint),
        ("context", _pointer),
        ("filter", _pointer),
        ("intersect", _pointer),
        ("spare", _size * 2),
    )


def coherent_order(beam: NDArray[np.uint32], d: NDArray[np.float64]) -> NDArray[np.int32]:
    """Return an order of rays, (n,), in which rays of nearly the same direction are neighbours.

    Rays of a few azimuth steps of a sensor must be near each other already; arguments as in
    :meth:`TriangleTree.nearest`.
    """
    order = np.empty(len(beam), dtype=np.int32)
    _sort_rays(beam, d, order)
    return order


@functools.cache
def _device() -> int:
    """Embree's device, one for the process."""
    device: int | None = _library.rtcNewDevice(None)
    if device is None:
        raise RuntimeError(f"Embree cannot start (error code {_library.rtcGetDeviceError(None)})")
    if (version := _library.rtcGetDeviceProperty(device, _MAJOR_VERSION)) != 4:
        raise RuntimeError(f"embreex brings Embree {version}, whose layouts may be others than those of Embree 4")
    return device


def _set_buffer(shape: int, kind: int, form: int, values: NDArray[Any]) -> None:
    """Set the corners of a shape, or the three corner numbers of each triangle."""
    room = _library.rtcSetNewGeometryBuffer(shape, kind, 0, form, 12, values.size // 3)
    if room is None:
        problem = f"Embree has no room for {values.nbytes:,} bytes"
        raise _last_error(problem) or MemoryError(problem)
    ctypes.memmove(room, values.ctypes.data, values.nbytes)


def _last_error(problem: str) -> Exception | None:
    """The error of this thread since the last call, if any; Embree then clears it."""
    code = _library.rtcGetDeviceError(_device())
    if not code:
        return None
    kind = MemoryError if code == _OUT_OF_MEMORY else RuntimeError
    return kind(f"{problem} (error code {code})")


def _aligned_rows(rows: int) -> NDArray[np.float32]:
    """An array (rows, _PACKET) with the alignment that Embree requires."""
    room = np.zeros(4 * rows * _PACKET + _ALIGNMENT, dtype=np.uint8)
    first = -room.ctypes.data % _ALIGNMENT
    return room[first : first + 4 * rows * _PACKET].view(np.float32).reshape(rows, _PACKET)


@_kernel
def _sort_rays(beam, d, order):  # type: ignore[no-untyped-def]
    """Fill ``order``: the rays of each block, sorted into ``_BINS`` along the axis on which directions vary most."""
    along, bins, first = np.empty(_BLOCK), np.empty(_BLOCK, dtype=np.int32), np.empty(_BINS + 1, dtype=np.int32)
    for start in range(0, beam.shape[0], _BLOCK):
        block = beam[start : start + _BLOCK]
        axis, low, high = _widest_axis(block, d), np.inf, -np.inf
        for k in range(block.shape[0]):
            along[k] = d[block[k], axis]
            low, high = min(low, along[k]), max(high, along[k])
        per_bin = (_BINS - 1) / max(high - low, 1e-9)
        first[:] = 0
        for k in range(block.shape[0]):
            position = (along[k] - low) * per_bin
            bins[k] = int(position) if 0.0 <= position < _BINS else 0  # 0 where a direction is NaN
            first[bins[k] + 1] += 1
        for b in range(_BINS):
            first[b + 1] += first[b]
        for k in range(block.shape[0]):
            order[start + first[bins[k]]] = start + k
            first[bins[k]] += 1


@_inlined
def _widest_axis(beam, d):  # type: ignore[no-untyped-def]
    """The axis along which a sample of the directions varies most."""
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for k in range(0, beam.shape[0], _STRIDE):
        for axis in range(3):
            low[axis], high[axis] = min(low[axis], d[beam[k], axis]), max(high[axis], d[beam[k], axis])
    return np.argmax(high - low)


@_kernel
def _query(scene, arguments, o, beam, d, order, valid, packet, words, triangle):  # type: ignore[no-untyped-def]
    """Fill ``triangle``, see :meth:`TriangleTree.nearest`; ``words`` is ``packet`` as uint32.

    The last packet is filled up with its last ray.
    """
    for k in range(_PACKET):
        valid[0, k] = -1
        packet[_ORIGIN, k], packet[_ORIGIN + 1, k], packet[_ORIGIN + 2, k] = o[0], o[1], o[2]
        packet[_NEAR, k], packet[_TIME, k] = 0.0, 0.0
        words[_MASK, k], words[_ID, k], words[_FLAGS, k] = _NONE, 0, 0
    count = order.shape[0]
    for start in range(0, count, _PACKET):
        for k in range(_PACKET):
            n = beam[order[min(start + k, count - 1)]]
            for axis in range(3):
                part = d[n, axis]
                packet[_DIRECTION + axis, k] = part if _SMALLEST < abs(part) < _LARGEST else 0.0
            packet[_FAR, k] = np.inf
            words[_PRIM_ID, k], words[_GEOM_ID, k] = _NONE, _NONE
        _intersect(valid.ctypes.data, scene, packet.ctypes.data, arguments)
        for k in range(min(_PACKET, count - start)):
            triangle[order[start + k]] = np.int32(words[_PRIM_ID, k])
