"""The firmware of the MTB boards: arithmetic, access to the chips, personalities."""
