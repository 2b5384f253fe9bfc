"""Fits curves, gains and the foam's memory to known pressures. Pure."""
