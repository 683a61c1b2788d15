"""Takes: everything of a live run in one XDF file that no crash can take away."""
