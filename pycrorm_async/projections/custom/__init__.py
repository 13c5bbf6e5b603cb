"""Fold the log into tables of the user's own."""
