"""What the policy's cameras have in common: the front and side cameras of the tasks, and the wrist camera of the robot."""

import numpy as np

IMAGE_SIZE = 256
"""Width and height of the images, in pixels (public code of the paper)."""
FIELD_OF_VIEW = np.deg2rad(75)
"""Field of view, in rad (public code of the paper)."""
NEAREST, FARTHEST = 0.01, 10.0
"""Smallest and largest distance that the cameras draw, in m; the wrist camera has its own smallest one. Set once; not tuned."""
