"""Policies that learn from the demonstrations of `manifeel_ms3`, their training and their studies."""
