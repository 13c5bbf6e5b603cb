"""This package converts parameter values to event values, shortens long ones and marks missing ones."""
