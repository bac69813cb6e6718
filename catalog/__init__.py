"""What exists and how it came to be; knows no tensors, tasks or flows."""
