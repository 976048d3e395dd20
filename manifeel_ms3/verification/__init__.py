"""Verification of any tactile sensor by known loads: `manifeel verify-sensor`."""
