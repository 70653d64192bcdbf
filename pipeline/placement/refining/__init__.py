"""Lets the sensors of a plan move from the poses of their candidates, within what poles and mounts allow."""
