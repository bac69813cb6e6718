"""What the user asked to see: configurations compared on scenes, stored in the catalog, drawn."""
