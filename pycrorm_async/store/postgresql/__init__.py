"""Implement the log on PostgreSQL: connections, roles, tables, statements and errors."""
