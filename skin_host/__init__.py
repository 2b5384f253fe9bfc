"""The robot side: CAN frames in, calibrated pressure and touch events over MQTT out."""

__version__ = "0.1.0"
