"""Verification: the log and the tables compared."""
