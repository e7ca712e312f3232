"""Shows a run in a browser, also while it is being trained.

The server is a process of its own, which reads what the training writes anyway: its log and its
checkpoints. While somebody looks, it leaves a mark in the run folder, and the training then writes
a snapshot of the splats now and then. So a browser that stalls, or a server that dies, cannot touch
the training, and one that nobody looks at spends nothing.
"""
