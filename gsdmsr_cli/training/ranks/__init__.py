"""Several processes, on one machine or more, that make the steps of one training together.

All of them, the ranks, hold the same model and make the same steps. Each takes the gradients of
its share of a step's views; these are exchanged, and added up in the views' order, so that the
result is that of one process to the last bit.
"""
