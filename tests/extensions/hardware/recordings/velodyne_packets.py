"""Data packets of a VLP-16, made by hand from the user manual (63-9243): 1,206 bytes, 12 blocks of two firings.

A block is FF EE, the azimuth of its first firing in 0.01 degrees (clockwise from the sensor's y axis), and 2 x 16
returns of a range in steps of 2 mm (uint16) and a reflectivity (uint8). The packet ends with the time in microseconds
past the hour, the return mode (37: strongest), and the product (22: VLP-16). Lasers fire every 2.304 microseconds, 16
in a firing of 55.296 microseconds.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path

import numpy as np

from egvs.core.grid import FloatArray

ELEVATIONS_DEG = np.array([-15, 1, -13, 3, -11, 5, -9, 7, -7, 9, -5, 11, -3, 13, -1, 15], dtype=np.float64)
"""In the order of firing."""

FIRING_US, LASER_US = 55.296, 2.304
FIRINGS = 24
"""Firings of a packet."""

STRONGEST, VLP16 = 0x37, 0x22

Ranges = Callable[[FloatArray, FloatArray], FloatArray]
"""Returns ranges in metres (0: no return) of rays with these azimuths (clockwise) and elevations, degrees."""


def packets(ranges: Ranges, turns: float, rotation_hz: float = 10.0, first_deg: float = 90.0) -> list[bytes]:
    """Return the payloads of a sensor that turns ``turns`` times, from an azimuth in the maker's system."""
    count = int(np.ceil(turns / rotation_hz * 1e6 / (FIRING_US * FIRINGS)))
    made = []
    for number in range(count):
        start_us = number * FIRINGS * FIRING_US
        firing_us = start_us + FIRING_US * np.arange(FIRINGS)
        laser_us = firing_us[:, None] + LASER_US * np.arange(16)
        azimuth = first_deg + 360.0 * rotation_hz * 1e-6 * laser_us
        metres = ranges(azimuth % 360.0, np.broadcast_to(ELEVATIONS_DEG, azimuth.shape))
        steps = np.round(metres / 0.002).astype(np.uint16)
        payload = b""
        for block in range(12):
            corner = round(100.0 * (first_deg + 360.0 * rotation_hz * 1e-6 * firing_us[2 * block])) % 36000
            payload += b"\xff\xee" + struct.pack("<H", corner)
            for firing in (2 * block, 2 * block + 1):
                payload += b"".join(struct.pack("<HB", int(step), 100) for step in steps[firing])
        made.append(payload + struct.pack("<IBB", round(start_us), STRONGEST, VLP16))
        assert len(made[-1]) == 1206
    return made


def write_pcap(path: Path, payloads: list[bytes], port: int = 2368) -> None:
    """Write UDP packets as a classic pcap file (Ethernet, IPv4), stamped when the packet is complete."""
    with path.open("wb") as file:
        file.write(struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1))
        for payload in payloads:
            (start_us,) = struct.unpack("<I", payload[1200:1204]) if len(payload) == 1206 else (0,)
            stamp_us = round(start_us + FIRINGS * FIRING_US)
            udp = struct.pack(">HHHH", port, port, 8 + len(payload), 0) + payload
            ip = struct.pack(">BBHHHBBH4s4s", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0, b"\xc0\xa8\x01\xc9", b"\xff" * 4)
            frame = b"\xff" * 6 + b"\x60\x76\x88\x00\x00\x00" + b"\x08\x00" + ip + udp
            file.write(
                struct.pack("<IIII", 1_700_000_000 + stamp_us // 10**6, stamp_us % 10**6, len(frame), len(frame))
            )
            file.write(frame)
