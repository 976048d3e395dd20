"""What a person can steer with the default controller."""

AXES = ("x", "y", "z", "roll", "pitch", "yaw", "gripper")
