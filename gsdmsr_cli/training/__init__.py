"""Trains a model on the pictures of a scene."""
