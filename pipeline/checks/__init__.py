"""Holds sites, solids, region of interest, lanes, traffic and sensors against one another before anything is run."""
