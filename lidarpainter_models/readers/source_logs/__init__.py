"""What readers share: a log as it streams in, its files, poses, boxes, what no car records."""
