"""Measurements that anyone can repeat: of the kernels, in turns with a yardstick."""
