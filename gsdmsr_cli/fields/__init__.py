"""Plane grids and small networks that motions share."""
