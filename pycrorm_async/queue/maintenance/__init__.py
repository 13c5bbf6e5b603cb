"""Inspection, repair and salvage of a recorder's folder."""
