"""A captured scene: views with cameras and times, their pictures and other signals."""
