"""What is said to the world and how: messages, MQTT, recordings."""
