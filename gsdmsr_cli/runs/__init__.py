"""The folder that a training writes."""
