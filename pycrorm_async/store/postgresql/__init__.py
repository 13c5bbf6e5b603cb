"""Everything only PostgreSQL understands: how to connect, the tables' text, the statements, which fault is whose."""
