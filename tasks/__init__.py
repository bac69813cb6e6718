"""Thin Prefect tasks: read the catalog, call the library, write the catalog."""
