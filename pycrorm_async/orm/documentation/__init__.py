"""Describe views and columns in words, from the docstrings of the mapped classes."""
