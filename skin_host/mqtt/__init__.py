"""Messages and the broker: payloads, topics, the publisher and its connection."""
