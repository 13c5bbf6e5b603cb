"""Run SQL that a user or a program wrote, on connections that can only read."""
