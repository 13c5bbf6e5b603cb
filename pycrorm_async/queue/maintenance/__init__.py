"""Inspect a spool, and repair a damaged recorder's folder."""
