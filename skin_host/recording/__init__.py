"""What was recorded: captured, played, processed, exported and drawn again."""

#: Of recordings of messages, CAN frames, or both.
MCAP_SUFFIX = ".mcap"
