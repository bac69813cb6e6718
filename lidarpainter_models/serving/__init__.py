"""The renderer that driving simulators ask for what the sensors of a vehicle see."""
