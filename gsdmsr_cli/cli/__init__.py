"""The command line: one file of options per command; `main` runs it."""
