"""Locations: designators that propose poses for the robot's base."""
