"""The exploration tasks: touch must find out what the camera cannot show."""
