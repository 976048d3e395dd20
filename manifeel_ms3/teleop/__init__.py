"""Teleoperation: a person steers the robot from a browser, a SpaceMouse or a gamepad, and records demonstrations."""
