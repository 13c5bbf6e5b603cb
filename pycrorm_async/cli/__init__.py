"""This package implements the command `pycrorm`, one file per verb; results go to stdout, other output to stderr."""
