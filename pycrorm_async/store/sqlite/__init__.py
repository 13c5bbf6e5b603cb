"""Implement the log on SQLite: connections, locks, tables, statements and errors."""
