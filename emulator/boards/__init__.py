"""The boards: firmware of MTBs and force/torque boards, and how they reach their chips."""
