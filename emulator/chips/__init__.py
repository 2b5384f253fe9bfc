"""The converters and their wires: registers, I2C and SPI, and the chips of a whole skin."""
