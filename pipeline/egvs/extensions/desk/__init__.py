"""The planner's desk: from a map to a plan in the browser."""
