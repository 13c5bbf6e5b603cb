"""Recall from a memory: keep its cases at hand, and ask for those most like a cue, a case or the present."""
