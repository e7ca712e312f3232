"""One file per motion: how splats move over time."""
