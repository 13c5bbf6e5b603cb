"""Declare the types of designators and the descriptions of objects."""
