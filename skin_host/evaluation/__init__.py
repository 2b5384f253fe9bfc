"""`skin bench` and `skin report`: measured on host and emulator together."""

from skin_host import emulator_path

emulator_path.provide()  # its worker processes begin here, not at the command line
