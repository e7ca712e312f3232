"""The report of an evaluation that people look at: one HTML file that needs nothing else."""
