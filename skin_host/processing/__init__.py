"""Sweeps to pressure to contacts. Pure: takes arrays and times, returns arrays."""
