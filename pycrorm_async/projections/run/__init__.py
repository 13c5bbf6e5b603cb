"""Running folds: batches, checkpoints, catching up."""
