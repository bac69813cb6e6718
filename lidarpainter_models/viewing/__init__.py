"""A fitted drive in a browser, drawn by viser: its nodes, and the live viewer around them."""
