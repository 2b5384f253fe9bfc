"""The service: reads the buses, runs the processing, publishes, and obeys its operator."""
