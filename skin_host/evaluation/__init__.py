"""`skin bench` and `skin report`: measured on host and emulator together."""
