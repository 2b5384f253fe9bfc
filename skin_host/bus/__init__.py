"""CAN: turns received frames into sweeps of the skin, and sends commands to its boards."""
