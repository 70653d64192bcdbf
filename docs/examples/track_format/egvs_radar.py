"""Formats of the radar."""

from egvs.core.readers import Reader

READERS = (Reader("radar tracks", "tracks", "egvs_radar_tracks", head=rb"\A[^\n]*\bx_cm\b"),)
