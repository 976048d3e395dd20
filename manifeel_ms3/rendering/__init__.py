"""Rendering: the renderer at hand, shaders, lights, surfaces, the table, and their randomization."""
