"""Verify the log and compare the tables with it."""
