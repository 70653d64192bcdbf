"""Buildings and furniture from city models, outlines and meshes."""
