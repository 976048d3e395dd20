"""Tests of a tactile sensor by known loads, for any sensor: `manifeel verify-sensor`."""
