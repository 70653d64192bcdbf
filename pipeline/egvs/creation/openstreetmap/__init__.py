"""Extracts of OpenStreetMap: streets, and what stands beside them."""
