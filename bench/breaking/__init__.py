"""Faults that are made, one file a kind of thing that breaks; the truth is kept outside of what is broken."""
