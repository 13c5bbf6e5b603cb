"""Run SQL that people or programs wrote by hand, and let it only read."""
