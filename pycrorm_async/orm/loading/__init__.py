"""Find the class of a row, and load attributes of many objects at once."""
