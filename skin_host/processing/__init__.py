"""Sweeps to pressure to contacts. Pure: arrays and time in, arrays out."""
