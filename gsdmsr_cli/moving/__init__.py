"""Splats that move, in one small file: what is baked of a model, how it is coded, and its reader.

The layout is docs/file-format.md.
"""
