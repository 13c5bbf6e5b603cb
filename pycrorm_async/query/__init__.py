"""Query a memory: sessions, data frames, named queries, and snapshots of an episode at a moment."""
