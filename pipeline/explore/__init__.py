"""Lets a planner move sensors in the browser and see at once what they are worth there."""
