"""Describe the views of a memory: for people and programs that write SQL."""
