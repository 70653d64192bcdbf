"""The command line ``egvs``."""
