"""Recall from a memory: keep its cases in this process, and search those most like a cue, a case or the present."""
