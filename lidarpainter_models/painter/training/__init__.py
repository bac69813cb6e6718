"""The one training loop of all painters that learn: batches, steps, averages, checkpoints."""
