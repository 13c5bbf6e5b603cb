"""Tables and views of a generation."""
