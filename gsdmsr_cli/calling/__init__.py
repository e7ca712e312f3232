"""Runs commands of ours in processes of their own: here, side by side, or on workers of Ray."""
