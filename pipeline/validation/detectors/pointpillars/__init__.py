"""PointPillars: a sweep becomes upright columns of points, these an image, and that boxes of vehicles."""
