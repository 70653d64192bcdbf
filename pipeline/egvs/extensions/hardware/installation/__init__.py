"""From a plan to an installed sensor: sheets for the crew, and the check of a measured scan against the plan."""
