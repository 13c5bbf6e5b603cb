"""Views that are computed from the tables and from facts of the field."""
