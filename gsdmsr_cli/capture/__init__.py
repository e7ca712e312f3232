"""Prepares a scene folder with cameras from a video, a camera rig or pictures."""
