"""Bytes on CAN to sweeps of the skin, and commands back to its boards."""
