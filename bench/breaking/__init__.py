"""Faults to inject, one file for each part that fails. Acknowledged events are noted outside of that part."""
