"""Emulated hardware: chips, boards, foam and the objects that press on it."""
