"""Define the tables and views of a generation, and create them."""
