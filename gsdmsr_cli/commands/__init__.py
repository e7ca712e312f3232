"""What each subcommand does: one module per subcommand."""
