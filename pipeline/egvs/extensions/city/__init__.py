"""All junctions of a city, on one machine or a cluster."""
