"""Height of the surfaces near a pad, by rays or by a camera."""
