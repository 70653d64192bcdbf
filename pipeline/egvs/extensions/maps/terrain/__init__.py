"""Terrain from rasters, LandXML and CityGML."""
