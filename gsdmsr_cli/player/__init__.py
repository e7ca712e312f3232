"""The page that plays a file of moving splats in a browser: one HTML text without a network."""
