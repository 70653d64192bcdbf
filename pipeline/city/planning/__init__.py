"""Which poles of all junctions together: what so many sensors are worth at each, and how many each should get."""
