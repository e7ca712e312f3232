"""What turns a film into pictures: layers, outputs, files that are gone on with, videos."""
