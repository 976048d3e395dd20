"""Image of the gel from behind: its surface, its colours, and their calibration."""
