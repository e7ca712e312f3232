"""Renders a trained model along a camera path, and writes the pictures, numbers and videos."""
