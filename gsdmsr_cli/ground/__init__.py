"""What everything else stands on: errors, files, geometry, machines, plug-ins."""
