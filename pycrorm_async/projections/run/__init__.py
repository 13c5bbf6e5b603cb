"""Run the fold: read batches of events, write their rows and the checkpoints."""
