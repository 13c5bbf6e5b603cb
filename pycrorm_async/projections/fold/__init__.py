"""Turn events into rows, without reading a table."""
