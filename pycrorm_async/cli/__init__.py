"""Implement the command `pycrorm`, one file for each verb; results go to stdout, other output to stderr."""
