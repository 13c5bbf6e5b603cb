"""Stored segments, kept so that a log that went back can be offered them again."""
