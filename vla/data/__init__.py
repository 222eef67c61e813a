"""Episode store, window loader and dataset formats."""
