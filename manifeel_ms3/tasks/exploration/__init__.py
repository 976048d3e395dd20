"""The exploration tasks: what the camera cannot tell, touch must find out."""
