"""Recall past situations: find the remembered actions most like this one, and count how they ended."""
