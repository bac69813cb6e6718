"""What the doctor asks of a log: do poses, sweeps, boxes, lenses and clocks agree."""
