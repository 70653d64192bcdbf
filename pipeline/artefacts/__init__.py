"""The files that a run leaves, Parquet and JSON, and their readers."""
