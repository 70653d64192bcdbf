"""Formats of recorded tracks, and of labels of sweeps; see :mod:`egvs.extensions.tracks.sources`.

The pattern of a table is one name in its first line that other formats lack; the modules look at all names.
"""

from __future__ import annotations

from egvs.core.readers import Reader

_FORMATS = "egvs.extensions.tracks.formats"
_JSON = (".json",)  # members of JSON objects have no order: the one that tells may come after 4 kB

READERS = (
    Reader("Argoverse 2", "tracks", f"{_FORMATS}.argoverse2", head=rb"\A(?:PAR1|ARROW1)"),
    Reader(
        "DAIR-V2X or V2X-Seq labels",
        "tracks",
        f"{_FORMATS}.dair_v2x",
        head=rb'"(?:3d_location|label_lidar_std_path)"',
    ),
    Reader(
        "DAIR-V2X or V2X-Seq labels",
        "tracks",
        f"{_FORMATS}.dair_v2x",
        suffixes=_JSON,
        content=rb'"(?:3d_location|label_lidar_std_path)"',
    ),
    Reader("highD tracks", "tracks", f"{_FORMATS}.highd", head=rb"(?i)\A[^\n]*xVelocity"),
    Reader("INTERACTION or TAF-BW tracks", "tracks", f"{_FORMATS}.interaction", head=rb"(?i)\A[^\n]*agent_type"),
    Reader("inD, rounD, exiD or uniD tracks", "tracks", f"{_FORMATS}.levelx", head=rb"(?i)\A[^\n]*xCenter"),
    Reader("LUMPI labels", "tracks", f"{_FORMATS}.lumpi", head=rb"\A(?:[^,\n]*,){15}"),
    Reader("NGSIM trajectories", "tracks", f"{_FORMATS}.ngsim", head=rb"(?i)\A[^\n]*Global_Time"),
    Reader("OpenLABEL", "tracks", f"{_FORMATS}.openlabel", head=rb'"openlabel"'),
    Reader("OpenLABEL", "tracks", f"{_FORMATS}.openlabel", suffixes=_JSON, content=rb'"openlabel"'),
    Reader("ASAM OSI", "tracks", f"{_FORMATS}.osi", suffixes=(".osi",), head=rb"\A\x89MCAP0\r\n"),
    Reader("pNEUMA trajectories", "tracks", f"{_FORMATS}.pneuma", head=rb"(?i)\A[^\n]*traveled_d"),
    Reader("SinD tracks", "tracks", f"{_FORMATS}.sind", head=rb"(?i)\A[^\n]*agent_type"),
    Reader("DAIR-V2X or V2X-Seq labels", "labels", f"{_FORMATS}.dair_v2x", head=rb'"3d_location"|\A\s*\[\s*\]'),
    Reader("DAIR-V2X or V2X-Seq labels", "labels", f"{_FORMATS}.dair_v2x", suffixes=_JSON, content=rb'"3d_location"'),
    Reader("OpenLABEL", "labels", f"{_FORMATS}.openlabel", head=rb'"openlabel"'),
    Reader("OpenLABEL", "labels", f"{_FORMATS}.openlabel", suffixes=_JSON, content=rb'"openlabel"'),
    Reader("V2X-Seq trajectory forecasting", "tracks", f"{_FORMATS}.v2x_seq_tfd", head=rb"(?i)\A[^\n]*intersect_id"),
)
