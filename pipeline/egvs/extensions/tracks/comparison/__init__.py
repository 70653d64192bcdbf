"""Recorded traffic compared with simulated traffic, for ``egvs compare --tpog``."""
