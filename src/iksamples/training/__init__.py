"""Training: many seeds of one small network at once, and the weights they end with."""
