"""Extracts of OpenStreetMap: streets, and what stands beside them."""

ATTRIBUTION = "(c) OpenStreetMap contributors, ODbL"
