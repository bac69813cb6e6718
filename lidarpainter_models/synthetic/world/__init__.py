"""What stands and moves in the street, as meshes."""
