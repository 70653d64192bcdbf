"""Tests of what is told before a run."""
