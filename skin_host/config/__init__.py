"""A configuration file as frozen settings, and what is wrong in it, with its place."""
