"""Describe the views of a memory, for users and programs that write SQL."""
