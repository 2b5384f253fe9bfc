"""Output: messages, MQTT, recordings."""
