"""Bounds: what the paper claims about the worst error, and what can be proved."""
