"""What a fitted scene yields for use elsewhere: actors, blocks of street, and how well seen."""
