"""What was recorded: captured, played, processed, exported and drawn again."""
