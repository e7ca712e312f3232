"""The options of a training: presets, where they come from, and how they are checked."""
