"""The files that a run leaves: Parquet by the schemas in ``data_schemas``, ``run.json``, and their readers."""
