"""The live page of `skin view`: one more MQTT subscriber, drawn in a browser."""
