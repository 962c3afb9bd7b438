"""HTTP: thin routes over the catalog."""
