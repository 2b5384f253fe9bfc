"""What presses on the skin, and what its pads feel of it: scenes, foam, capacitance."""
